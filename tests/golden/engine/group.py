"""The networks of a group in PyTorch: a denoiser, and a score of how well motion fits its group.

Written from the paper (Le et al., "Controllable Group Choreography using Contrastive Diffusion", ACM TOG 42(6), 2023)
and from the layers that docs/groups.md lists, with torch's own attention (one mask for each sample, as the paper
draws it) where the Rust network folds dancers into the batch. Names in the state dicts are those of the Rust
networks. Motion is [B, N, T, C] here.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from network import time_table
from torch import Tensor, nn

MAPPING_LAYERS = 8
TOKENS = 2


@dataclass(frozen=True)
class GroupConfig:
    """The sizes of both networks."""

    width: int = 48
    heads: int = 4
    expansion: int = 2
    music_layers: int = 1
    blocks: int = 2
    score_layers: int = 1
    score_patch_frames: int = 4
    motion_dim: int = 25
    condition_dim: int = 173
    add_audio: bool = True
    max_dancers: int = 5
    n_steps: int = 1000


def rotary(x: Tensor, places: Tensor) -> Tensor:
    """Turns channels 2i and 2i + 1 of [..., L, d] by place * 10000^(-2i / d)."""
    d = x.shape[-1]
    rate = 10_000 ** (-torch.arange(0, d, 2, dtype=torch.float64) / d)
    angle = places[:, None].double() * rate
    turned = torch.view_as_complex(x.reshape(*x.shape[:-1], d // 2, 2)) * torch.polar(
        torch.ones_like(angle), angle
    )
    return torch.view_as_real(turned).reshape(x.shape)


def attend(q: Tensor, k: Tensor, v: Tensor, heads: int, places: tuple[Tensor, Tensor], allowed: Tensor | None) -> Tensor:
    """Attention of [B, L, d]; allowed [B, L, S] is True where a query may look."""

    def split(x: Tensor) -> Tensor:
        return x.unflatten(-1, (heads, -1)).transpose(1, 2)

    q, k, v = rotary(split(q), places[0]), rotary(split(k), places[1]), split(v)
    mask = None if allowed is None else allowed[:, None]
    y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    return y.transpose(1, 2).flatten(-2)


class FeedForward(nn.Module):
    def __init__(self, d: int, expansion: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(d)
        self.add_module("0", nn.Linear(d, expansion * d))
        self.add_module("1", nn.Linear(expansion * d, d))

    def forward(self, x: Tensor) -> Tensor:
        first, last = self.get_submodule("0"), self.get_submodule("1")
        return last(F.gelu(first(self.norm(x))))


class SelfAttention(nn.Module):
    def __init__(self, d: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(d)
        self.qkv = nn.Linear(d, 3 * d)
        self.proj = nn.Linear(d, d)

    def forward(self, x: Tensor, places: Tensor, allowed: Tensor | None = None) -> Tensor:
        q, k, v = self.qkv(self.norm(x)).chunk(3, -1)
        return self.proj(attend(q, k, v, self.heads, (places, places), allowed))


class CrossAttention(nn.Module):
    def __init__(self, d: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(d)
        self.q = nn.Linear(d, d)
        self.kv = nn.Linear(d, 2 * d)
        self.proj = nn.Linear(d, d)

    def forward(self, x: Tensor, places: Tensor, memory: Tensor, memory_places: Tensor) -> Tensor:
        k, v = self.kv(memory).chunk(2, -1)
        return self.proj(attend(self.q(self.norm(x)), k, v, self.heads, (places, memory_places), None))


class Layer(nn.Module):
    """A pre-norm transformer layer."""

    def __init__(self, d: int, heads: int, expansion: int) -> None:
        super().__init__()
        self.attn = SelfAttention(d, heads)
        self.ff = FeedForward(d, expansion)

    def forward(self, x: Tensor, places: Tensor, allowed: Tensor | None = None) -> Tensor:
        x = x + self.attn(x, places, allowed)
        return x + self.ff(x)


class Step(nn.Module):
    def __init__(self, config: GroupConfig, *, has_tokens: bool) -> None:
        super().__init__()
        d = config.width
        self.register_buffer("table", time_table(config.n_steps, d), persistent=False)
        self.hidden = nn.Linear(d, 4 * d)
        self.embedding = nn.Linear(4 * d, d)
        if has_tokens:
            self.tokens = nn.ModuleList([nn.Linear(4 * d, d), nn.Linear(4 * d, d)])

    def latent(self, t: Tensor) -> Tensor:
        return F.mish(self.hidden(self.table[t.long()]))


class Projection(nn.Module):
    def __init__(self, d: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(d)
        self.add_module("0", nn.Linear(d, d))
        self.add_module("1", nn.Linear(d, d))

    def forward(self, x: Tensor) -> Tensor:
        return self.get_submodule("1")(F.silu(self.get_submodule("0")(self.norm(x))))


class Embedding(nn.Module):
    def __init__(self, config: GroupConfig) -> None:
        super().__init__()
        d = config.width
        self.mapping = nn.ModuleList(nn.Linear(d, d) for _ in range(MAPPING_LAYERS))
        self.numbers = nn.Parameter(torch.empty(config.max_dancers, d))

    def forward(self, z: Tensor, mean: Tensor, number: Tensor) -> Tensor:
        h = F.normalize(z + mean, dim=-1, eps=1e-8) * math.sqrt(z.shape[-1])
        for layer in self.mapping:
            h = F.leaky_relu(layer(h), 0.2)
        return h + self.numbers[number.long()]


def film(x: Tensor, scale_shift: Tensor, bias: float) -> Tensor:
    s, h = scale_shift[:, None].chunk(2, -1)
    return (bias + s) * x + h


class Block(nn.Module):
    def __init__(self, config: GroupConfig) -> None:
        super().__init__()
        d = config.width
        self.attn = SelfAttention(d, config.heads)
        self.cross = CrossAttention(d, config.heads)
        self.ff = FeedForward(d, config.expansion)
        self.films = nn.ModuleList(nn.Linear(d, 2 * d) for _ in range(3))
        self.add_module("global", Layer(d, config.heads, config.expansion))
        self.modulation = nn.Linear(d, 2 * d)


class GroupDenoiser(nn.Module):
    """Predicts clean motion of B groups of N dancers."""

    def __init__(self, config: GroupConfig) -> None:
        super().__init__()
        d = config.width
        self.config = config
        self.time = Step(config, has_tokens=True)
        self.music_in = nn.Linear(config.condition_dim, d)
        self.music = nn.ModuleList(
            Layer(d, config.heads, config.expansion) for _ in range(config.music_layers)
        )
        self.null_music = nn.Parameter(torch.empty(d))
        self.memory_norm = nn.LayerNorm(d)
        self.context = Projection(d)
        self.embedding = Embedding(config)
        self.motion_in = nn.Linear(config.motion_dim, d)
        if config.add_audio:
            self.audio_in = nn.Linear(d, d)
        self.number_token = Projection(d)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.blocks))
        self.out = nn.Linear(d, config.motion_dim)

    def forward(
        self,
        x: Tensor,
        t: Tensor,
        audio: Tensor,
        drop: Tensor,
        number: Tensor,
        z: Tensor,
        present: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """x [B, N, T, C], audio [B, T, F], z [B, d], present [B, N] of 1 and 0; returns x0 and w."""
        batch, n, frames, _ = x.shape
        time = torch.arange(frames)
        music = self.music_in(audio)
        for layer in self.music:
            music = layer(music, time)
        w = self.embedding(z, music.mean(1), number)
        music = torch.where(drop[:, None, None] > 0, self.null_music, music)
        latent = self.time.latent(t)
        context = F.mish(self.time.embedding(latent) + self.context(music.mean(1)))
        step = torch.stack([token(latent) for token in self.time.tokens], 1)
        memory = self.memory_norm(torch.cat([music, step], 1))
        memory_places = torch.cat([time, torch.zeros(2)])

        h = self.motion_in(x)
        if self.config.add_audio:
            h = h + self.audio_in(music)[:, None]
        h = h.flatten(1, 2)
        dancer = torch.arange(n).repeat_interleave(frames)
        places = time.repeat(n)
        own = (dancer[:, None] == dancer).expand(batch, -1, -1)
        counts = present[:, dancer] > 0
        all_places = torch.cat([torch.zeros(TOKENS), places])
        everyone = torch.cat([torch.ones(batch, TOKENS, dtype=torch.bool), counts], 1)[:, None]
        everyone = everyone.expand(-1, TOKENS + n * frames, -1)
        token = self.number_token(self.embedding.numbers[number.long()])
        for block in self.blocks:
            h = h + film(block.attn(h, places, own), block.films[0](context), 1)
            h = h + film(block.cross(h, places, memory, memory_places), block.films[1](context), 1)
            h = h + film(block.ff(h), block.films[2](context), 1)
            rows = torch.cat([token[:, None], w[:, None], h], 1)
            rows = block.get_submodule("global")(rows, all_places, everyone)
            token, h = rows[:, 0], rows[:, TOKENS:]
            weights = (counts.double() / counts.sum(1, keepdim=True))[..., None]
            mean = (weights * h).sum(1, keepdim=True)
            variance = (weights * (h - mean) ** 2).sum(1, keepdim=True)
            h = film((h - mean) / torch.sqrt(variance + 1e-8), block.modulation(w), 0)
        return self.out(h).unflatten(1, (n, frames)), w


class Patches(nn.Module):
    def __init__(self, config: GroupConfig) -> None:
        super().__init__()
        p = config.score_patch_frames
        self.weight = nn.Parameter(torch.empty(config.width, config.motion_dim, p))
        self.bias = nn.Parameter(torch.empty(config.width))
        self.taps = p

    def forward(self, x: Tensor) -> Tensor:
        missing = -x.shape[-2] % self.taps
        x = torch.cat([x, x[..., -1:, :].expand(*x.shape[:-2], missing, -1)], -2)
        y = F.conv1d(x.flatten(0, 1).transpose(1, 2), self.weight, self.bias, stride=self.taps)
        return y.transpose(1, 2).unflatten(0, x.shape[:2])


class GroupScore(nn.Module):
    """log f of B groups of N dancers."""

    def __init__(self, config: GroupConfig) -> None:
        super().__init__()
        d = config.width
        self.patches = Patches(config)
        self.time = Step(config, has_tokens=False)
        self.group = nn.Linear(d, d)
        self.numbers = nn.Parameter(torch.empty(config.max_dancers, d))
        self.layers = nn.ModuleList(
            nn.ModuleDict(
                {
                    "local": Layer(d, config.heads, config.expansion),
                    "global": Layer(d, config.heads, config.expansion),
                }
            )
            for _ in range(config.score_layers)
        )
        self.out = nn.Linear(d, 1)
        self.agreement = nn.Linear(d, d)

    def forward(self, x: Tensor, t: Tensor, w: Tensor, number: Tensor, present: Tensor) -> Tensor:
        """x [B, N, T, C], t [B, N], present [B, N]; returns [B]."""
        x = self.patches(x)
        batch, n, frames, _ = x.shape
        group = self.group(w)
        token = self.time.embedding(self.time.latent(t)) + group[:, None]
        dancer = torch.arange(n).repeat_interleave(frames)
        counts = present[:, dancer] > 0
        everyone = torch.cat([torch.ones(batch, TOKENS, dtype=torch.bool), counts], 1)[:, None]
        everyone = everyone.expand(-1, TOKENS + n * frames, -1)
        places = torch.cat([torch.zeros(TOKENS), torch.arange(frames).repeat(n)])
        for layer in self.layers:
            rows = torch.cat([token[:, :, None], x], 2).flatten(0, 1)
            rows = layer["local"](rows, torch.arange(frames + 1))
            alone = rows[:, 1:].unflatten(0, (batch, n))
            x = alone.flatten(1, 2)
            rows = torch.cat([group[:, None], self.numbers[number.long()][:, None], x], 1)
            x = layer["global"](rows, places, everyone)[:, TOKENS:].unflatten(1, (n, frames))
        weights = (counts.double() / counts.sum(1, keepdim=True))[..., None]
        fit = self.out((weights * x.flatten(1, 2)).sum(1))[:, 0]
        u = F.normalize(self.agreement(alone), dim=-1, eps=1e-8)
        share = (present.double() / present.sum(1, keepdim=True))[..., None, None]
        length = (share * u).sum(1).square().sum(-1)
        return fit + 10 * length.mean(1)


class Group(nn.Module):
    """Both networks, and the losses of training that need both."""

    def __init__(self, config: GroupConfig) -> None:
        super().__init__()
        self.denoiser = GroupDenoiser(config)
        self.score = GroupScore(config)

    def forward(
        self,
        x: Tensor,
        t: Tensor,
        audio: Tensor,
        drop: Tensor,
        number: Tensor,
        z: Tensor,
        present: Tensor,
        negatives: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns x0, w, and the logits [B, 1 + K] of the estimate and of K mixed groups.

        `negatives` [B, K, N] has the dancer, of all B N, who dances in place of each.
        """
        x0, w = self.denoiser(x, t, audio, drop, number, z, present)
        n = x.shape[1]
        dancers, steps = x0.flatten(0, 1), t.repeat_interleave(n)
        logits = [self.score(x0, t[:, None].expand(-1, n), w, number, present)]
        for k in range(negatives.shape[1]):
            taken = negatives[:, k].long()
            logits.append(self.score(dancers[taken], steps[taken], w, number, present))
        return x0, w, torch.stack(logits, 1)
