#!/usr/bin/env python3
"""A peer of training.py: the same step of end-to-end fine-tuning in PyTorch, driven by lines of JSON.

Each line of standard input is a request, {"cmd": ...}, and gets one line on standard output:

  init   preset, batch, frames, threads; makes both networks and their inputs
  step   all losses through five steps of DDIM, backward, clipping and AdamW; wall_s, cpu_s
  quit

Networks, sampler and losses are those that made the golden files of tests/golden, in float32.
"""

import pathlib
import sys
import time
from typing import Any

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden"
sys.path[:0] = [str(GOLDEN / "engine"), str(GOLDEN / "training")]

import diffusion  # noqa: E402
import losses  # noqa: E402
import network  # noqa: E402
import torch  # noqa: E402
from peer import serve  # noqa: E402

CHANNELS, FEATURES, N_STEPS = 25, 163, 5


class Finetune:
    """PyTorch as its users run it: eager, float32, fused AdamW."""

    def init(self, preset: str, batch: int, frames: int, threads: int) -> dict[str, Any]:
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        self.unet, self.decoder = network.unet(preset), network.MotionDecoder()
        groups = []
        for net, rate in ((self.unet, 1e-6), (self.decoder, 5e-5)):
            decaying = [p for p in net.parameters() if p.ndim >= 2]
            others = [p for p in net.parameters() if p.ndim < 2]
            groups += [{"params": decaying, "lr": rate}]
            groups += [{"params": others, "lr": rate, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=1e-4, fused=True)
        shape = (batch, frames)
        self.motion, self.noise = (torch.randn(*shape, CHANNELS) for _ in range(2))
        self.audio = torch.randn(*shape, FEATURES)
        self.t = ((torch.arange(batch) + 0.5) / batch * diffusion.N_STEPS).long()
        self.mask = torch.ones(*shape)
        self.alpha_bar = diffusion.alpha_bars("cosine").float()
        self.scale = torch.full((CHANNELS,), 0.5)
        count = network.count(self.unet) + sum(p.numel() for p in self.decoder.parameters())
        return {"parameters": count}

    def step(self) -> dict[str, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        self.unet.train(), self.decoder.train()
        x_t = diffusion.noised(self.motion, self.noise, self.alpha_bar[self.t])
        of_noise = torch.nn.functional.mse_loss(self.unet(x_t, self.t, self.audio), self.noise)

        def predict(x: torch.Tensor, t: int) -> torch.Tensor:
            return self.unet(x, torch.full((len(x),), t), self.audio)

        start = self.noise.flatten().flip(0).reshape(self.noise.shape)
        latent, _ = diffusion.ddim(predict, start, "epsilon", self.alpha_bar, N_STEPS, 5.0)
        decoded = self.decoder(latent)
        centre = torch.zeros(CHANNELS)
        distances = losses.reconstruction(decoded, self.motion, centre, self.scale, self.mask)
        of_time = losses.temporal(decoded, self.mask, losses.Temporal())
        total = 0.1 * of_noise + distances["position"] + distances["quaternion"]
        total = total + 10.0 * sum(of_time.values())
        total.backward()
        parameters = [*self.unet.parameters(), *self.decoder.parameters()]
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()
        return {
            "wall_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
            "loss": total.item(),
        }


def main() -> None:
    serve(Finetune())


if __name__ == "__main__":
    main()
