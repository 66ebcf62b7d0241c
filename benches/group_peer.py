#!/usr/bin/env python3
"""A peer of training.py: the same step of training a model of groups in PyTorch, driven by lines of JSON.

Each line of standard input is a request, {"cmd": ...}, and gets one line on standard output:

  init   preset, batch, dancers, frames, threads; makes both networks and their inputs
  step   distance of the estimate, markers, and telling each group from eight mixed ones; backward, clipping, AdamW;
         wall_s, cpu_s
  quit

The networks are those of the golden files (tests/golden/engine/group.py), made fast as their users would: dancers are
folded into the batch where they see their own frames alone, so that attention needs no mask and takes PyTorch's fused
kernel; rotations are of float32 and made once; all mixed groups are scored in one call.
"""

import pathlib
import sys
import time
from typing import Any

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden"
sys.path[:0] = [str(GOLDEN / "engine"), str(GOLDEN / "training")]

import diffusion  # noqa: E402
import group  # noqa: E402
import torch  # noqa: E402
import torch.nn.functional as F  # noqa: E402
from peer import serve  # noqa: E402
from torch import Tensor  # noqa: E402

CHANNELS, CONDITION, NEGATIVES = 25, 173, 8
PRESETS = {
    "tiny": group.GroupConfig(),
    "small": group.GroupConfig(width=112, music_layers=2, blocks=3),
    "base": group.GroupConfig(
        width=512, heads=8, music_layers=2, blocks=5, score_layers=2, score_patch_frames=1
    ),
}
MARKERS = torch.tensor([[0.35, 0.0, 0.0], [-0.35, 0.0, 0.0], [0.0, 0.35, 0.0], [0.0, 0.0, 0.35]])
ANGLES: dict[tuple[int, bytes], tuple[Tensor, Tensor]] = {}


def rotary(x: Tensor, places: Tensor) -> Tensor:
    """As group.rotary, in float32, with cosines and sines that are made once."""
    d = x.shape[-1]
    key = (d, places.numpy().tobytes())
    if key not in ANGLES:
        rate = 10_000 ** (-torch.arange(0, d, 2, dtype=torch.float64) / d)
        angle = places[:, None].double() * rate
        ANGLES[key] = (angle.cos().float(), angle.sin().float())
    cos, sin = ANGLES[key]
    a, b = x[..., 0::2], x[..., 1::2]
    return torch.stack([a * cos - b * sin, a * sin + b * cos], -1).flatten(-2)


group.rotary = rotary


def film(x: Tensor, scale_shift: Tensor, n: int, bias: float) -> Tensor:
    """FiLM of dancers who are folded into the batch."""
    s, h = scale_shift.repeat_interleave(n, 0)[:, None].chunk(2, -1)
    return (bias + s) * x + h


def denoise(net: group.GroupDenoiser, x: Tensor, t: Tensor, audio: Tensor, number: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """The denoiser where every dancer is there and nothing is withheld; x [B, N, T, C]."""
    batch, n, frames, _ = x.shape
    places = torch.arange(frames)
    music = net.music_in(audio)
    for layer in net.music:
        music = layer(music, places)
    w = net.embedding(z, music.mean(1), number)
    latent = net.time.latent(t)
    context = F.mish(net.time.embedding(latent) + net.context(music.mean(1)))
    step = torch.stack([token(latent) for token in net.time.tokens], 1)
    memory = net.memory_norm(torch.cat([music, step], 1))
    memory_places = torch.cat([places, torch.zeros(2, dtype=torch.long)])
    h = net.motion_in(x.flatten(0, 1))
    if net.config.add_audio:
        h = h + net.audio_in(music).repeat_interleave(n, 0)
    token = net.number_token(net.embedding.numbers[number])
    everyone = torch.cat([torch.zeros(group.TOKENS, dtype=torch.long), places.repeat(n)])
    for block in net.blocks:
        h = h + film(block.attn(h, places), block.films[0](context), n, 1)
        # All dancers of a group ask the same memory: keys and values are made once.
        asked = h.unflatten(0, (batch, n)).flatten(1, 2)
        heard = block.cross(asked, places.repeat(n), memory, memory_places)
        heard = heard.unflatten(1, (n, frames)).flatten(0, 1)
        h = h + film(heard, block.films[1](context), n, 1)
        h = h + film(block.ff(h), block.films[2](context), n, 1)
        rows = h.unflatten(0, (batch, n)).flatten(1, 2)
        rows = torch.cat([token[:, None], w[:, None], rows], 1)
        rows = block.get_submodule("global")(rows, everyone)
        token, rows = rows[:, 0], rows[:, group.TOKENS :]
        variance, mean = torch.var_mean(rows, 1, correction=0, keepdim=True)
        rows = group.film((rows - mean) / torch.sqrt(variance + 1e-8), block.modulation(w), 0)
        h = rows.unflatten(1, (n, frames)).flatten(0, 1)
    return net.out(h).unflatten(0, (batch, n)), w


def score(net: group.GroupScore, x: Tensor, t: Tensor, w: Tensor, number: Tensor) -> Tensor:
    """log f where every dancer is there; x [B, N, T, C], t [B, N]."""
    x = net.patches(x)
    batch, n, frames, _ = x.shape
    within = net.group(w)
    token = (net.time.embedding(net.time.latent(t)) + within[:, None]).flatten(0, 1)
    e_n = net.numbers[number]
    places = torch.cat([torch.zeros(group.TOKENS, dtype=torch.long), torch.arange(frames).repeat(n)])
    x = x.flatten(0, 1)
    for layer in net.layers:
        rows = layer["local"](torch.cat([token[:, None], x], 1), torch.arange(frames + 1))
        alone = rows[:, 1:]
        rows = torch.cat([within[:, None], e_n[:, None], alone.unflatten(0, (batch, n)).flatten(1, 2)], 1)
        x = layer["global"](rows, places)[:, group.TOKENS :].unflatten(1, (n, frames)).flatten(0, 1)
    fit = net.out(x.unflatten(0, (batch, n)).flatten(1, 2).mean(1))[:, 0]
    u = F.normalize(net.agreement(alone), dim=-1, eps=1e-8).unflatten(0, (batch, n))
    return fit + 10 * u.mean(1).square().sum(-1).mean(1)


def markers(x: Tensor) -> Tensor:
    """Where four points of a body are; x [..., 25] normalised with a scale of 0.5."""
    q = F.normalize(0.5 * x[..., 9:13], dim=-1, eps=1e-6)
    w, u = q[..., None, :1], q[..., None, 1:].expand(*q.shape[:-1], 4, 3)
    m = MARKERS.expand_as(u)
    crossed = torch.cross(u, m, dim=-1)
    turned = m + 2 * w * crossed + 2 * torch.cross(u, crossed, dim=-1)
    return 0.5 * x[..., None, :3] + turned


class GroupStep:
    """PyTorch as its users run it: eager, float32, fused AdamW."""

    def init(self, preset: str, batch: int, dancers: int, frames: int, threads: int, **_: Any) -> dict[str, Any]:
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        config = PRESETS[preset]
        self.net = group.Group(config).float()
        for parameter in self.net.parameters():
            torch.nn.init.normal_(parameter, std=0.02)
        decaying = [p for p in self.net.parameters() if p.ndim >= 2]
        others = [p for p in self.net.parameters() if p.ndim < 2]
        groups = [{"params": decaying}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=1e-4, weight_decay=1e-4, fused=True)
        shape = (batch, dancers, frames, CHANNELS)
        self.motion, self.noise = torch.randn(*shape), torch.randn(*shape)
        self.audio = torch.randn(batch, frames, CONDITION)
        self.t = ((torch.arange(batch) + 0.5) / batch * diffusion.N_STEPS).long()
        self.number = torch.full((batch,), dancers - 1)
        self.alpha_bar = diffusion.alpha_bars("cosine").float()
        return {"parameters": sum(p.numel() for p in self.net.parameters())}

    def mixed(self) -> Tensor:
        """Who dances in each group and its mixed ones, [B, 1 + K, N]: half swap members with the partner, half are others."""
        batch, n = self.motion.shape[:2]
        own = torch.arange(batch * n).unflatten(0, (batch, 1, n)).expand(-1, NEGATIVES // 2, -1)
        partner = own[torch.arange(batch) ^ 1]
        swapped = torch.where(torch.rand(own.shape) < 0.5, partner, own)
        whole = own[(torch.arange(batch) + 1) % batch]
        return torch.cat([own[:, :1], swapped, whole], 1)

    def step(self) -> dict[str, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        self.net.train()
        batch, n = self.motion.shape[:2]
        x_t = diffusion.noised(
            self.motion.flatten(0, 1), self.noise.flatten(0, 1), self.alpha_bar[self.t.repeat_interleave(n)]
        ).unflatten(0, (batch, n))
        z = torch.randn(batch, self.net.denoiser.config.width)
        x0, w = denoise(self.net.denoiser, x_t, self.t, self.audio, self.number, z)
        loss = F.mse_loss(x0, self.motion) + F.mse_loss(markers(x0), markers(self.motion))
        dancers = self.mixed()
        rows = dancers.flatten(0, 1)
        steps = self.t.repeat_interleave(n)
        taken, of_group = x0.flatten(0, 1)[rows], torch.arange(batch).repeat_interleave(1 + NEGATIVES)
        logits = score(self.net.score, taken, steps[rows], w[of_group], self.number[of_group])
        loss = loss + 1e-2 * F.cross_entropy(logits.unflatten(0, (batch, -1)), torch.zeros(batch).long())
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()
        return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu, "loss": loss.item()}


def main() -> None:
    serve(GroupStep())


if __name__ == "__main__":
    main()
