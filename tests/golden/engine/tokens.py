"""The tokenizer of motion in PyTorch: encoder, codebook, signal decoder, diffusion decoder, and what training makes small.

Written from the paper (Gu et al., arXiv 2603.19227) and the layers that docs/tokens.md lists, with torch's own modules
over [B, channels, frames]. Names in the state dict are those of the Rust network. The codebook is a parameter, so that
it lies in the file of names; no gradient reaches it.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from network import time_table
from torch import Tensor, nn

COMMITMENT = 0.02
EPSILON = 1e-6


@dataclass(frozen=True)
class TokensConfig:
    """The sizes of the networks."""

    width: int = 48
    conv_width: int = 32
    depth: int = 2
    codes: int = 32
    frames_per_token: int = 4
    blocks: int = 2
    taps: int = 5
    motion_dim: int = 25
    n_steps: int = 1000
    draft: bool = False

    @property
    def n_levels(self) -> int:
        return self.frames_per_token.bit_length() - 1


def same(inputs: int, outputs: int, taps: int, dilation: int = 1) -> nn.Conv1d:
    return nn.Conv1d(inputs, outputs, taps, padding=taps // 2 * dilation, dilation=dilation)


class Residual(nn.Module):
    def __init__(self, c: int, dilation: int) -> None:
        super().__init__()
        self.wide = same(c, c, 3, dilation)
        self.point = nn.Conv1d(c, c, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.point(F.relu(self.wide(F.relu(x))))


class Level(nn.Module):
    """Residual blocks, and the convolution before (encoder) or behind them (decoder)."""

    def __init__(self, conv: nn.Conv1d, c: int, depth: int, *, is_encoder: bool) -> None:
        super().__init__()
        self.conv = conv
        self.res = nn.ModuleList(Residual(c, 3 ** (depth - 1 - i)) for i in range(depth))
        self.is_encoder = is_encoder

    def forward(self, x: Tensor) -> Tensor:
        if self.is_encoder:
            return nn.Sequential(self.conv, *self.res)(x)
        return self.conv(F.interpolate(nn.Sequential(*self.res)(x), scale_factor=2, mode="nearest"))


class Encoder(nn.Module):
    def __init__(self, config: TokensConfig) -> None:
        super().__init__()
        c = config.conv_width
        self.first = same(config.motion_dim, c, 3)
        self.levels = nn.ModuleList(
            Level(nn.Conv1d(c, c, 4, stride=2, padding=1), c, config.depth, is_encoder=True)
            for _ in range(config.n_levels)
        )
        self.last = same(c, config.width, 3)
        self.rate = config.frames_per_token

    def forward(self, x: Tensor) -> Tensor:
        """[B, T, C] to [B, N, d]."""
        x = x.transpose(1, 2)
        missing = -x.shape[-1] % self.rate
        x = torch.cat([x, x[..., -1:].expand(-1, -1, missing)], -1)
        h = F.relu(self.first(x))
        for level in self.levels:
            h = level(h)
        return self.last(h).transpose(1, 2)


class Decoder(nn.Module):
    def __init__(self, config: TokensConfig) -> None:
        super().__init__()
        c = config.conv_width
        self.first = same(config.width, c, 3)
        self.levels = nn.ModuleList(
            Level(same(c, c, 3), c, config.depth, is_encoder=False) for _ in range(config.n_levels)
        )
        self.middle = same(c, c, 3)
        self.last = same(c, config.width, 3)

    def forward(self, q: Tensor, frames: int) -> Tensor:
        """[B, N, d] to [B, T, d]."""
        h = F.relu(self.first(q.transpose(1, 2)))
        for level in self.levels:
            h = level(h)
        h = self.last(F.relu(self.middle(h)))
        return h[..., :frames].transpose(1, 2)


class Block(nn.Module):
    def __init__(self, d: int, taps: int) -> None:
        super().__init__()
        self.conv = same(d, d, taps)
        self.norm = nn.LayerNorm(d, EPSILON)
        self.modulation = nn.Linear(d, 3 * d)
        self.mlp = nn.ModuleList([nn.Linear(d, d), nn.Linear(d, d)])

    def forward(self, h: Tensor, e: Tensor) -> Tensor:
        h = h + self.conv(F.silu(h).transpose(1, 2)).transpose(1, 2)
        scale, shift, gate = self.modulation(F.silu(e)).chunk(3, -1)
        r = self.norm(h) * (1 + scale) + shift
        return h + gate * self.mlp[1](F.silu(self.mlp[0](r)))


class Denoiser(nn.Module):
    def __init__(self, config: TokensConfig) -> None:
        super().__init__()
        d = config.width
        self.register_buffer("table", time_table(config.n_steps, d), persistent=False)
        self.time = nn.ModuleList([nn.Linear(d, d), nn.Linear(d, d)])
        self.input = nn.Linear(config.motion_dim, d)
        self.blocks = nn.ModuleList(Block(d, config.taps) for _ in range(config.blocks))
        self.modulation = nn.Linear(d, 2 * d)
        self.out = nn.Linear(d, config.motion_dim)

    def forward(self, x: Tensor, t: Tensor, s: Tensor) -> Tensor:
        t_emb = self.time[1](F.silu(self.time[0](self.table[t.long()])))
        e = t_emb[:, None] + s
        h = self.input(x)
        for block in self.blocks:
            h = block(h, e)
        scale, shift = self.modulation(F.silu(e)).chunk(2, -1)
        h = F.layer_norm(h, h.shape[-1:], eps=EPSILON)
        return self.out(h * (1 + scale) + shift)


class Tokenizer(nn.Module):
    def __init__(self, config: TokensConfig) -> None:
        super().__init__()
        self.rate = config.frames_per_token
        self.encoder = Encoder(config)
        self.codebook = nn.Parameter(torch.empty(config.codes, config.width))
        self.decoder = Decoder(config)
        self.draft = nn.Linear(config.width, config.motion_dim) if config.draft else None
        self.denoiser = Denoiser(config)
        # Tokens, rows and their distance from the latents, where gradients are taken: straight through is the
        # derivative of what these are held fixed in, which central differences can be held against.
        self.fixed: tuple[Tensor, Tensor, Tensor] | None = None

    def nearest(self, h: Tensor) -> Tensor:
        """Returns the nearest row for each latent; refuses latents that are as near to two of them."""
        distances = (h.detach()[:, :, None] - self.codebook.detach()).square().sum(-1)
        two = distances.topk(2, largest=False).values
        if not ((two[..., 1] - two[..., 0]) > 1e-4 * two[..., 1]).all():
            raise ValueError("two codes are about as near; change the inputs")
        return distances.argmin(-1)

    def forward(self, motion: Tensor, x: Tensor, t: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """motion, x [B, T, C], t [B], mask [B, T] of frames that count."""
        h = self.encoder(motion)
        if self.fixed is None:
            z = self.nearest(h)
            q = self.codebook[z].detach()
            self.fixed = z, q, (q - h).detach()
        z, q, step = self.fixed
        s = self.decoder(h + step, motion.shape[1])
        x0 = self.denoiser(x, t, s)

        def of_frames(x0: Tensor) -> Tensor:
            loss = F.smooth_l1_loss(x0, motion, reduction="none").mean(-1)
            return (mask * loss).sum() / mask.sum()

        drafted = {}
        if self.draft is not None:
            draft = self.draft(s)
            x0 = draft + x0
            drafted = {"draft": draft, "draft_loss": of_frames(draft)}
        simple = of_frames(x0)
        # A token counts where its first frame does.
        counts = mask[:, :: self.rate]
        commitment = (h - q).square().mean(-1)
        commitment = (counts * commitment).sum() / counts.sum()
        return {
            "latents": h,
            "tokens": z.double(),
            "signal": s,
            "estimate": x0,
            "simple": simple,
            "commitment": commitment,
            **drafted,
            "loss": simple + drafted.get("draft_loss", 0.0) + COMMITMENT * commitment,
        }
