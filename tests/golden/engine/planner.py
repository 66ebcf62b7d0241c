"""A planner of tokens in PyTorch, of both kinds, and the cross-entropy that training makes small.

Written from the paper (Gu et al., arXiv 2603.19227, section 3.2) and the layers that docs/tokens.md lists, with torch's
own attention and a mask for each position; positions are turned as complex numbers. Names in the state dict are those
of the Rust network.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tokens import Encoder, TokensConfig
from torch import Tensor, nn


@dataclass(frozen=True)
class PlannerConfig:
    """The sizes of the network."""

    is_causal: bool
    codes: int = 32
    frames_per_token: int = 4
    width: int = 48
    heads: int = 4
    expansion: int = 4
    layers: int = 2
    conv_width: int = 32
    depth: int = 1
    condition_dim: int = 173
    style_dim: int = 8
    constraint_dim: int = 0


def turned(x: Tensor) -> Tensor:
    """Rotary position embedding of [B, heads, positions, dim]."""
    *_, positions, dim = x.shape
    rates = 10_000.0 ** (-torch.arange(0, dim, 2).double() / dim)
    angles = torch.arange(positions).double()[:, None] * rates
    pairs = torch.view_as_complex(x.reshape(*x.shape[:-1], dim // 2, 2).contiguous())
    return torch.view_as_real(pairs * torch.polar(torch.ones_like(angles), angles)).flatten(-2)


class Attention(nn.Module):
    def __init__(self, config: PlannerConfig) -> None:
        super().__init__()
        d = config.width
        self.norm = nn.LayerNorm(d)
        self.qkv = nn.Linear(d, 3 * d)
        self.proj = nn.Linear(d, d)
        self.heads = config.heads

    def forward(self, h: Tensor, allowed: Tensor) -> Tensor:
        """h [B, n, d]; allowed [B, n, n], whether a query may see a key."""
        b, n, d = h.shape
        parts = self.qkv(self.norm(h)).chunk(3, -1)
        q, k, v = (x.reshape(b, n, self.heads, d // self.heads).transpose(1, 2) for x in parts)
        y = F.scaled_dot_product_attention(turned(q), turned(k), v, allowed[:, None])
        return self.proj(y.transpose(1, 2).reshape(b, n, d))


class FeedForward(nn.Module):
    def __init__(self, config: PlannerConfig) -> None:
        super().__init__()
        d, inner = config.width, config.expansion * config.width
        self.norm = nn.LayerNorm(d)
        self.add_module("0", nn.Linear(d, inner))
        self.add_module("1", nn.Linear(inner, d))

    def forward(self, h: Tensor) -> Tensor:
        first, last = self.get_submodule("0"), self.get_submodule("1")
        return last(F.gelu(first(self.norm(h))))


class Layer(nn.Module):
    def __init__(self, config: PlannerConfig) -> None:
        super().__init__()
        self.attn = Attention(config)
        self.ff = FeedForward(config)

    def forward(self, h: Tensor, allowed: Tensor) -> Tensor:
        h = h + self.attn(h, allowed)
        return h + self.ff(h)


class Planner(nn.Module):
    def __init__(self, config: PlannerConfig) -> None:
        super().__init__()
        d = config.width
        self.table = nn.Parameter(torch.empty(config.codes + (not config.is_causal), d))

        def encoder(inputs: int) -> Encoder:
            return Encoder(
                TokensConfig(
                    width=d,
                    conv_width=config.conv_width,
                    depth=config.depth,
                    frames_per_token=config.frames_per_token,
                    motion_dim=inputs,
                )
            )

        self.music = encoder(config.condition_dim)
        self.null_music = nn.Parameter(torch.empty(d))
        # "global" is a word of the language.
        self.add_module("global", nn.Linear(d, d))
        self.style = nn.Linear(config.style_dim, d)
        if config.constraint_dim:
            self.constraints = encoder(config.constraint_dim)
            self.null_constraints = nn.Parameter(torch.empty(d))
        self.layers = nn.ModuleList(Layer(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(d)
        self.out = nn.Linear(d, config.codes)
        self.is_causal = config.is_causal

    def forward(
        self,
        tokens: Tensor,
        audio: Tensor,
        drop: Tensor,
        style: Tensor,
        mask: Tensor,
        labels: Tensor,
        weights: Tensor,
        constraints: Tensor | None = None,
        drop_constraints: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """tokens, mask, labels, weights [B, N], audio [B, T, C], drop [B], style [B, S]: logits and their loss.

        Of a network that takes constraints: [B, T, 12], and the windows that go without, [B].
        """
        music = torch.where(drop[:, None, None] > 0, self.null_music, self.music(audio))
        mean = (music * mask[:, :, None]).sum(1) / mask.sum(1)[:, None]
        top = self.get_submodule("global")(mean) + self.style(style)
        rows = self.table[tokens]
        local = music
        if constraints is not None and drop_constraints is not None:
            asked = self.constraints(constraints)
            gone = drop_constraints[:, None, None] > 0
            local = music + torch.where(gone, self.null_constraints, asked)
        if self.is_causal:
            h = torch.cat([top[:, None], rows[:, :-1]], 1) + local
            counts = mask
        else:
            h = torch.cat([top[:, None], rows + local], 1)
            counts = torch.cat([torch.ones_like(mask[:, :1]), mask], 1)
        n = h.shape[1]
        allowed = (counts[:, None] > 0).expand(-1, n, -1)
        if self.is_causal:
            allowed = allowed & torch.ones(n, n, dtype=torch.bool).tril()
        for layer in self.layers:
            h = layer(h, allowed)
        h = h if self.is_causal else h[:, 1:]
        logits = self.out(self.norm(h))
        costs = F.cross_entropy(logits.transpose(1, 2), labels, reduction="none")
        return logits, (weights * costs).sum() / weights.sum()
