"""The networks of motiongen in PyTorch: what the Rust engine is compared with, in value and speed.

`UNet1D` predicts the noise in motion from the noisy motion, the step and the music; `MotionDecoder`
maps a latent to the 25 channels of motion. Names in the state dicts are those of the Rust networks.
Inputs and outputs are channels-last, [batch, frames, channels]; inside, PyTorch's channels-first.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

EPSILON = 1e-5


@dataclass(frozen=True)
class UNetConfig:
    """The sizes of a UNet; each level has half the frames of the one above."""

    widths: tuple[int, ...]
    attention_levels: tuple[int, ...]
    in_channels: int = 25
    out_channels: int = 25
    num_heads: int = 8
    num_head_channels: int | None = None
    use_scale_shift_norm: bool = True
    audio_cond_dim: int = 163
    time_embed_dim: int = 256
    context_dim: int = 256
    add_audio: bool = True
    style_dim: int = 0
    dropout: float = 0.1
    n_steps: int = 1000

    def heads(self, width: int) -> int:
        return width // self.num_head_channels if self.num_head_channels else self.num_heads


PRESETS = {
    "tiny": UNetConfig((40, 48, 64), (1, 2), num_heads=4, time_embed_dim=32, context_dim=32),
    "small": UNetConfig((48, 96, 160, 192), (1, 2, 3), time_embed_dim=128, context_dim=128),
    "base": UNetConfig((256, 512, 1024, 1152), (1, 2, 3)),
    "large": UNetConfig((256, 512, 1024, 2048), (1, 2, 3)),
}
# Without the null context and the music at the first level, which the reference does not have.
COUNTS = {"base": 116_651_673, "large": 225_084_697}


def time_table(n_steps: int, dim: int) -> Tensor:
    """Returns the sinusoids of each step in float64, [n_steps, dim]: cosines, then sines."""
    half = dim // 2
    index = torch.arange(half, dtype=torch.float64)
    frequency = torch.exp(-math.log(10_000) * index / half)
    angle = torch.arange(n_steps, dtype=torch.float64)[:, None] * frequency
    return torch.cat([angle.cos(), angle.sin()], dim=1)


def group_norm(channels: int) -> nn.GroupNorm:
    groups = next(n for n in range(32, 0, -1) if channels % n == 0)
    return nn.GroupNorm(groups, channels, eps=EPSILON)


class ResBlock(nn.Module):
    """Two convolutions behind norms, the second scaled and shifted by time, around a skip."""

    def __init__(self, inputs: int, outputs: int, config: UNetConfig) -> None:
        super().__init__()
        self.scale_shift = config.use_scale_shift_norm
        self.norm1 = group_norm(inputs)
        self.conv1 = nn.Conv1d(inputs, outputs, 3, padding=1)
        outputs_of_time = 2 * outputs if self.scale_shift else outputs
        self.time_mlp = nn.Sequential(nn.SiLU(), nn.Linear(config.time_embed_dim, outputs_of_time))
        self.norm2 = group_norm(outputs)
        self.dropout = nn.Dropout(config.dropout)
        self.conv2 = nn.Conv1d(outputs, outputs, 3, padding=1)
        self.skip_conv = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """[B, inputs, T], [B, time_embed_dim] → [B, outputs, T]"""
        h = self.conv1(F.silu(self.norm1(x)))
        time = self.time_mlp(time)[:, :, None]
        if self.scale_shift:
            scale, shift = time.chunk(2, dim=1)
            h = self.norm2(h) * (1 + scale) + shift
        else:
            h = self.norm2(h + time)
        h = self.conv2(self.dropout(F.silu(h)))
        return h + self.skip_conv(x)


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
    """[B, heads, head_dim, T or S], mask [B, S] → [B, heads * head_dim, T]"""
    q, k, v = (part.transpose(2, 3) for part in (q, k, v))
    mask = None if mask is None else mask[:, None, None, :]
    out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    return out.transpose(2, 3).flatten(1, 2)


class AttentionBlock(nn.Module):
    """Attention of frames to each other and then to the music, each around a skip."""

    def __init__(self, width: int, heads: int, context_dim: int) -> None:
        super().__init__()
        self.heads, self.head_dim = heads, width // heads
        self.norm = group_norm(width)
        self.qkv = nn.Conv1d(width, 3 * width, 1)
        self.proj = nn.Conv1d(width, width, 1)
        self.cross_norm = group_norm(width)
        self.q_cross = nn.Conv1d(width, width, 1)
        self.kv_cross = nn.Conv1d(context_dim, 2 * width, 1)
        self.proj_cross = nn.Conv1d(width, width, 1)

    def split(self, x: Tensor) -> tuple[Tensor, ...]:
        """[B, n * width, T] → n times [B, heads, head_dim, T]"""
        batch, _, frames = x.shape
        return x.reshape(batch, -1, self.heads, self.head_dim, frames).unbind(1)

    def forward(
        self, x: Tensor, mask: Tensor | None, context: Tensor, context_mask: Tensor | None
    ) -> Tensor:
        """[B, width, T], [B, T], [B, context_dim, S], [B, S] → [B, width, T]; masks are of keys."""
        q, k, v = self.split(self.qkv(self.norm(x)))
        x = x + self.proj(attend(q, k, v, mask))
        (q,) = self.split(self.q_cross(self.cross_norm(x)))
        k, v = self.split(self.kv_cross(context))
        return x + self.proj_cross(attend(q, k, v, context_mask))


class Level(nn.Module):
    """Residual blocks, then attention where the level has it, and the change to the next level."""

    def __init__(self, blocks: list[ResBlock], attention: AttentionBlock | None) -> None:
        super().__init__()
        self.res = nn.ModuleList(blocks)
        self.attn = attention

    def forward(self, x: Tensor, time: Tensor, *attended: Tensor | None) -> Tensor:
        for block in self.res:
            x = block(x, time)
        return x if self.attn is None else self.attn(x, *attended)


class Bottleneck(Level):
    """A residual block on either side of attention."""

    def forward(self, x: Tensor, time: Tensor, *attended: Tensor | None) -> Tensor:
        x = self.attn(self.res[0](x, time), *attended)
        return self.res[1](x, time)


class UNet1D(nn.Module):
    """Predicts the noise in motion."""

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        widths, time_dim = config.widths, config.time_embed_dim
        last = len(widths) - 1

        def attention(width: int) -> AttentionBlock:
            return AttentionBlock(width, config.heads(width), config.context_dim)

        self.register_buffer("time_table", time_table(config.n_steps, time_dim), persistent=False)
        self.time_mlp = nn.Sequential(
            nn.Linear(time_dim, time_dim), nn.SiLU(), nn.Linear(time_dim, time_dim)
        )
        if config.style_dim > 0:
            self.style_proj = nn.Linear(config.style_dim, time_dim)
        self.audio_proj = nn.Linear(config.audio_cond_dim, config.context_dim)
        self.null_context = nn.Parameter(torch.zeros(config.context_dim))
        if config.add_audio:
            self.audio_in = nn.Linear(config.context_dim, widths[0])
        self.conv_in = nn.Conv1d(config.in_channels, widths[0], 3, padding=1)

        self.encoder, self.decoder = nn.ModuleList(), nn.ModuleList()
        for level, width in enumerate(widths):
            above = widths[max(level - 1, 0)]
            attends = level in config.attention_levels
            blocks = [ResBlock(above, width, config), ResBlock(width, width, config)]
            self.encoder.append(Level(blocks, attention(width) if attends else None))
            if level < last:
                self.encoder[level].down = nn.Conv1d(width, width, 3, stride=2, padding=1)

            # In the decoder attention takes the place of the second block, at inner levels only.
            attends = attends and level not in (0, last)
            blocks = [ResBlock(2 * width, above, config), ResBlock(above, above, config)]
            blocks = blocks[:1] if attends else blocks
            self.decoder.append(Level(blocks, attention(above) if attends else None))
            if level > 0:
                self.decoder[level].up = nn.Conv1d(above, above, 3, padding=1)
        blocks = [ResBlock(width, width, config), ResBlock(width, width, config)]
        self.bottleneck = Bottleneck(blocks, attention(width))
        conv = nn.Conv1d(widths[0], config.out_channels, 3, padding=1)
        self.out = nn.ModuleDict({"norm": group_norm(widths[0]), "conv": conv})
        for zero in conv.parameters():
            nn.init.zeros_(zero)

    def forward(
        self,
        x: Tensor,
        t: Tensor,
        audio: Tensor,
        drop: Tensor | None = None,
        mask: Tensor | None = None,
        style: Tensor | None = None,
    ) -> Tensor:
        """Returns the noise, [B, T, out_channels].

        x is [B, T, in_channels], t [B] whole numbers, audio [B, T, audio_cond_dim]; drop [B] is 1
        for samples without music, mask [B, T] 1 for frames that count, style [B, style_dim].
        Frames up to a multiple of 2^(levels - 1) repeat the last one, are no keys of attention, and
        are cropped; attention to the music sees its own frames.
        """
        time = self.time_mlp(self.time_table[t].to(x.dtype))
        if style is not None:
            time = time + self.style_proj(style)
        context = self.audio_proj(audio)
        if drop is not None:
            context = torch.where(drop[:, None, None] != 0, self.null_context, context)
        added = self.audio_in(context) if self.config.add_audio else None
        context = context.transpose(1, 2)

        batch, frames, _ = x.shape
        keys = context_mask = None if mask is None else mask != 0
        n_held = -frames % 2 ** (len(self.encoder) - 1)
        if n_held:
            x = torch.cat([x, x[:, -1:].expand(-1, n_held, -1)], dim=1)
            if added is not None:
                added = torch.cat([added, added[:, -1:].expand(-1, n_held, -1)], dim=1)
            keys = torch.ones(batch, frames, dtype=torch.bool) if keys is None else keys
            keys = F.pad(keys, (0, n_held))
        masks = [None if keys is None else keys[:, :: 2**i] for i in range(len(self.encoder))]

        x = self.conv_in(x.transpose(1, 2))
        if added is not None:
            x = x + added.transpose(1, 2)
        skips = []
        for level, keys in zip(self.encoder, masks, strict=True):
            x = level(x, time, keys, context, context_mask)
            skips.append(x)
            if hasattr(level, "down"):
                x = level.down(x)
        x = self.bottleneck(x, time, masks[-1], context, context_mask)
        for level, skip, keys in reversed(list(zip(self.decoder, skips, masks, strict=True))):
            x = level(torch.cat([x, skip], dim=1), time, keys, context, context_mask)
            if hasattr(level, "up"):
                x = level.up(F.interpolate(x, scale_factor=2.0, mode="nearest"))
        return self.out["conv"](F.silu(self.out["norm"](x))).transpose(1, 2)[:, :frames]


class DecoderBlock(nn.Module):
    def __init__(self, hidden: int, inner: int, dropout: float) -> None:
        super().__init__()
        first = [nn.LayerNorm(hidden, eps=EPSILON), nn.Linear(hidden, inner), nn.GELU()]
        second = [nn.Dropout(dropout), nn.Linear(inner, hidden), nn.Dropout(dropout)]
        self.layers = nn.Sequential(*first, *second)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


# Width of each part of a frame of motion, and what keeps it in its range.
HEADS: dict[str, tuple[int, Callable[[Tensor], Tensor]]] = {
    "position": (3, lambda x: x),
    "velocity": (3, lambda x: 50 * torch.tanh(x)),
    "acceleration": (3, lambda x: 100 * torch.tanh(x)),
    "quaternion": (4, lambda x: F.normalize(x, dim=-1, eps=1e-12)),
    "angular_velocity": (3, lambda x: 20 * torch.tanh(x)),
    "phase": (1, torch.sigmoid),
    "style": (8, lambda x: x),
}


class MotionDecoder(nn.Module):
    """Maps a latent, frame by frame, to motion that keeps its channels' constraints."""

    def __init__(
        self, hidden: int = 256, n_blocks: int = 4, expansion: int = 4, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.input_proj = nn.Linear(25, hidden)
        blocks = [DecoderBlock(hidden, expansion * hidden, dropout) for _ in range(n_blocks)]
        self.blocks = nn.Sequential(*blocks)
        for name, (width, _) in HEADS.items():
            self.add_module(f"{name}_head", nn.Linear(hidden, width))

    def forward(self, latent: Tensor) -> Tensor:
        """[B, T, 25] → [B, T, 25]"""
        h = self.blocks(self.input_proj(latent))
        heads = [(getattr(self, f"{name}_head"), limit) for name, (_, limit) in HEADS.items()]
        return torch.cat([limit(head(h)) for head, limit in heads], dim=-1)


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def unet(preset: str) -> UNet1D:
    """Makes a UNet of a size with a name, and makes sure that it is that size."""
    network = UNet1D(PRESETS[preset])
    n_parameters = count(network) - network.null_context.numel() - count(network.audio_in)
    expected = COUNTS.get(preset, n_parameters)
    assert n_parameters == expected, f"{preset} has {n_parameters} parameters, not {expected}"
    return network
