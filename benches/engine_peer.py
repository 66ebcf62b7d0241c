#!/usr/bin/env python3
"""A peer of engine.py: the same network in PyTorch or in onnxruntime, driven by lines of JSON.

    python engine_peer.py pytorch
    python engine_peer.py onnxruntime

Each line of standard input is a request, {"cmd": ...}, and gets one line on standard output:

  init       preset, batch, frames, threads; makes the network and its inputs
             onnxruntime also takes the path of an exported network
  forward    no gradients, no dropout; wall_s, cpu_s
  step       forward with dropout, backward, clipping and AdamW; wall_s, cpu_s and their parts
  export     path; writes the network as ONNX
  gemm       m, n, k; gflops of a product of matrices
  gradients  path, t, dtype; writes the gradient of every parameter, with the values that
             tests/golden/engine/weights.py gives to parameters and inputs, as safetensors
  quit
"""

import logging
import pathlib
import sys
import time
from typing import Any

import numpy as np
from peer import serve

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden" / "engine"
sys.path.insert(0, str(GOLDEN))
CHANNELS, FEATURES = 25, 163
LEAST_GEMM_S = 0.3


class Clock:
    """Wall time and CPU time of all threads since it was made."""

    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def wall_s(self) -> float:
        return time.perf_counter() - self.wall

    def read(self) -> dict[str, float]:
        return {"wall_s": self.wall_s(), "cpu_s": time.process_time() - self.cpu}


class Torch:
    """PyTorch as its users run it: eager, float32, fused AdamW."""

    def __init__(self) -> None:
        import network
        import torch

        self.torch, self.networks = torch, network

    def init(
        self, preset: str, batch: int, frames: int, threads: int, golden: bool = False
    ) -> dict[str, Any]:
        torch = self.torch
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        self.preset, self.batch, self.frames = preset, batch, frames
        if golden:
            return {"ok": True}
        self.network = self.networks.unet(preset)
        decaying = [p for p in self.network.parameters() if p.ndim >= 2]
        others = [p for p in self.network.parameters() if p.ndim < 2]
        groups = [{"params": decaying}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=1e-4, weight_decay=1e-4, fused=True)
        x, noise = (torch.randn(batch, frames, CHANNELS) for _ in range(2))
        audio = torch.randn(batch, frames, FEATURES)
        self.inputs, self.noise = (x, torch.randint(1000, (batch,)), audio), noise
        return {
            "parameters": self.networks.count(self.network),
            "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        }

    def forward(self) -> dict[str, float]:
        self.network.eval()
        with self.torch.inference_mode():
            clock = Clock()
            self.network(*self.inputs)
            return clock.read()

    def step(self) -> dict[str, float]:
        torch = self.torch
        self.network.train()
        clock = Clock()
        loss = torch.nn.functional.mse_loss(self.network(*self.inputs), self.noise)
        forward_s = clock.wall_s()
        loss.backward()
        backward_s = clock.wall_s() - forward_s
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()
        done = clock.read()
        return {
            **done,
            "forward_s": forward_s,
            "backward_s": backward_s,
            "optimizer_s": done["wall_s"] - forward_s - backward_s,
            "loss": loss.item(),
        }

    def export(self, path: str) -> dict[str, bool]:
        # It warns of every optional package that it does without.
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        names = {"input_names": ["x", "t", "audio"], "output_names": ["noise"]}
        program = self.torch.onnx.export(
            self.network.eval(), self.inputs, dynamo=True, verbose=False, **names
        )
        program.save(path, external_data=True)
        return {"ok": True}

    def gemm(self, m: int, n: int, k: int) -> dict[str, float]:
        torch = self.torch
        a, b, c = torch.randn(m, k), torch.randn(k, n), torch.empty(m, n)
        torch.mm(a, b, out=c)
        least_s, whole = float("inf"), Clock()
        while whole.wall_s() < LEAST_GEMM_S:
            clock = Clock()
            torch.mm(a, b, out=c)
            least_s = min(least_s, clock.wall_s())
        return {"gflops": 2e-9 * m * n * k / least_s}

    def gradients(self, path: str, t: list[int], dtype: str) -> dict[str, float]:
        import weights
        from safetensors.torch import save_file

        torch, kind = self.torch, getattr(self.torch, dtype)
        network = self.networks.unet(self.preset).to(kind).eval()
        weights.fill(network)
        shape = (self.batch, self.frames)
        x, audio, target = (
            torch.from_numpy(weights.given(f"input.{name}", (*shape, width))).to(kind)
            for name, width in [("x", CHANNELS), ("audio", FEATURES), ("target", CHANNELS)]
        )
        loss = torch.nn.functional.mse_loss(network(x, torch.tensor(t), audio), target)
        loss.backward()
        found = {
            name: torch.zeros_like(p) if p.grad is None else p.grad
            for name, p in network.named_parameters()
        }
        save_file(found, path)
        return {"ok": True, "loss": loss.item()}


class Onnxruntime:
    """onnxruntime on the CPU, with all its optimisations of the graph."""

    def init(self, path: str, batch: int, frames: int, threads: int) -> dict[str, bool]:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
        providers = ["CPUExecutionProvider"]
        self.session = onnxruntime.InferenceSession(path, options, providers=providers)
        rng = np.random.default_rng(1)
        self.inputs = {
            "x": rng.standard_normal((batch, frames, CHANNELS), dtype=np.float32),
            "t": rng.integers(1000, size=batch),
            "audio": rng.standard_normal((batch, frames, FEATURES), dtype=np.float32),
        }
        return {"ok": True}

    def forward(self) -> dict[str, float]:
        clock = Clock()
        self.session.run(None, self.inputs)
        return clock.read()


def main() -> None:
    serve({"pytorch": Torch, "onnxruntime": Onnxruntime}[sys.argv[1]]())


if __name__ == "__main__":
    main()
