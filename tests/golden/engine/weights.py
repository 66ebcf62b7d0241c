"""Values of parameters and inputs that every language computes alike, so that none are stored.

The number of flat index i (C order, PyTorch's shape) of the tensor called `name` is

    z = splitmix64(fnv1a64(name) + i * 0x9E3779B97F4A7C15)    modulo 2^64
    u = (z >> 40) * 2^-24 * 2 - 1                             in [-1, 1), exact in float32

fnv1a64 is the FNV-1a hash of the name in UTF-8, splitmix64 the finaliser of that generator. A
parameter is made of u in float64 and rounded to float32:

    weight of a norm                 1 + 0.1 u
    bias, null context               0.1 u
    weight of two or more axes       u / sqrt(fan_in), fan_in the product of all axes but the first
"""

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import nn

MASK = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15
# What multiplies u in an input; 1 for those that are not here.
INPUT_SCALE = {"input.x": 1.5}
# The steps of the diffusion, which "input.t" is drawn from.
N_STEPS = 1000


def fnv1a64(name: str) -> int:
    digest = 0xCBF29CE484222325
    for byte in name.encode():
        digest = (digest ^ byte) * 0x100000001B3 & MASK
    return digest


def bits(name: str, count: int) -> np.ndarray:
    """Returns z >> 40 for the first `count` flat indices."""
    z = np.arange(count, dtype=np.uint64) * np.uint64(GOLDEN) + np.uint64(fnv1a64(name))
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (z ^ (z >> np.uint64(31))) >> np.uint64(40)


def uniform(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Returns u, float64."""
    u = bits(name, math.prod(shape)).astype(np.float64) * 2.0**-23 - 1
    return u.reshape(shape)


def parameter(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the value of a parameter, float32."""
    u = uniform(name, shape)
    if len(shape) >= 2:
        value = u / math.sqrt(math.prod(shape[1:]))
    elif name.endswith(".weight"):
        value = 1 + 0.1 * u
    else:
        value = 0.1 * u
    return value.astype(np.float32)


def given(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Returns an input, a target or any other numbers that are no parameter, float32."""
    return (INPUT_SCALE.get(name, 1.0) * uniform(name, shape)).astype(np.float32)


def steps(batch: int) -> list[int]:
    """Returns a step of the diffusion for each sample: (z >> 40) * 1000 >> 24 of "input.t"."""
    return [int(z) * N_STEPS >> 24 for z in bits("input.t", batch)]


def fill(network: "nn.Module") -> None:
    """Sets every parameter of a network; in float64 they are the rounded ones."""
    import torch

    with torch.no_grad():
        for name, tensor in network.named_parameters():
            tensor.copy_(torch.from_numpy(parameter(name, tuple(tensor.shape))))
