#!/usr/bin/env python3
"""A peer of inference.py: the same network in PyTorch, eager, sampled by the same loop.

One request a line on standard input, one answer a line: init (preset, threads), sample (sampler, steps,
batch, guidance), predict (batch), quit. Also `check` (folder): what Python's onnx checker and onnxruntime say
of the files that motiongen wrote.
"""

import pathlib
import sys
import time

import numpy as np
from peer import serve

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden" / "engine"
sys.path.insert(0, str(GOLDEN))
CHANNELS, FEATURES, FRAMES, STEPS = 25, 163, 120, 1000


def alphas_cumprod() -> np.ndarray:
    """The cosine schedule of Nichol and Dhariwal, each beta at most 0.999."""
    t = np.arange(STEPS + 1) / STEPS
    f = np.cos((t + 0.008) / 1.008 * np.pi / 2) ** 2
    return np.cumprod(1 - np.minimum(1 - f[1:] / f[:-1], 0.999))


class Torch:
    def init(self, preset: str, threads: int) -> dict:
        import network
        import torch

        self.torch = torch
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        self.network = network.unet(preset).eval()
        self.alphas = np.append(alphas_cumprod(), 1.0)
        return {"parameters": network.count(self.network)}

    def predict(self, batch: int = 1) -> dict:
        torch = self.torch
        x, audio = torch.randn(batch, FRAMES, CHANNELS), torch.randn(batch, FRAMES, FEATURES)
        t = torch.full((batch,), 500)
        with torch.inference_mode():
            started = time.perf_counter()
            self.network(x, t, audio)
            return {"wall_s": time.perf_counter() - started}

    def sample(self, steps: int, batch: int = 1, sampler: str = "ddim") -> dict:
        """Predicts x0; a step of DPM-Solver++ costs what one of DDIM costs, so DDIM stands for both."""
        torch = self.torch
        started = time.perf_counter()
        visited = [round(STEPS * (steps - i) / steps) - 1 for i in range(steps)] + [-1]
        with torch.inference_mode():
            x, audio = torch.randn(batch, FRAMES, CHANNELS), torch.randn(batch, FRAMES, FEATURES)
            for t, s in zip(visited, visited[1:]):
                a, b = self.alphas[t], self.alphas[s]
                x0 = self.network(x, torch.full((batch,), t), audio).clamp(-5, 5)
                x = b**0.5 * x0 + ((1 - b) / (1 - a)) ** 0.5 * (x - a**0.5 * x0)
        return {"wall_s": time.perf_counter() - started}

    def check(self, folder: str, threads: int) -> dict:
        import onnx
        import onnxruntime

        folder = pathlib.Path(folder)
        for name in ("unet.onnx", "unet-line.onnx", "decoder.onnx"):
            onnx.checker.check_model(folder / name, full_check=True)
        read = lambda name, n: np.fromfile(folder / name, "<f4").reshape(1, FRAMES, n)
        given = {"x_t": read("x", CHANNELS), "t": np.array([500]), "audio": read("audio", FEATURES)}
        wanted = read("y", CHANNELS)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        session = onnxruntime.InferenceSession(folder / "unet.onnx", options)
        found = session.run(None, given)[0]
        return {"max_abs": float(abs(found - wanted).max()), "spread": float(wanted.std())}


def main() -> None:
    serve(Torch())


if __name__ == "__main__":
    main()
