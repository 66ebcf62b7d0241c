"""Inputs of the golden files: numbers by the rule of tests/golden/engine/weights.py."""

import numpy as np
import torch
import weights
from torch import Tensor


def drawn(name: str, scale: float, *shape: int) -> Tensor:
    """Returns scale × u of a name, rounded to float32."""
    return torch.from_numpy((scale * weights.uniform(name, shape)).astype(np.float32)).double()


def motion(name: str, batch: int, frames: int) -> Tensor:
    """Returns normalized motion, 1.5 u rounded to 1/256."""
    return (256 * 1.5 * drawn(name, 1.0, batch, frames, 25)).round() / 256


def normalizer() -> tuple[Tensor, Tensor]:
    """Returns centre and scale: multiples of 1/64 and powers of two, a quaternion's 0 and 1/2."""
    centre = (16 * drawn("normalizer.centre", 1.0, 25)).round() / 64
    scale = 2.0 ** (1.5 * drawn("normalizer.scale", 1.0, 25)).round()
    centre[9:13], scale[9:13] = 0.0, 0.5
    return centre, scale


def mask(frames: int, n_valid: list[int]) -> Tensor:
    return (torch.arange(frames) < torch.tensor(n_valid)[:, None]).double()
