"""Single operations in PyTorch, float64: inputs, outputs, and gradients for a given cotangent.

A case gives CASE/NAME for every input, CASE/output, CASE/cotangent (the gradient of the output) and
CASE/grad_NAME for every input that has one. Activations are channels-last, [batch, frames,
channels]; weights are as PyTorch has them. Indices, labels and masks are float64 too.
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
import weights
from torch import Tensor

HEADS = 3
GROUPS = 5


def frames_last(x: Tensor) -> Tensor:
    return x.transpose(1, 2)


def conv1d(stride: int, padding: int, dilation: int) -> Callable[..., Tensor]:
    def run(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return frames_last(F.conv1d(frames_last(x), weight, bias, stride, padding, dilation))

    return run


def group_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return frames_last(F.group_norm(frames_last(x), GROUPS, weight, bias, 1e-5))


def group_norm_film_silu(x: Tensor, weight: Tensor, bias: Tensor, film: Tensor) -> Tensor:
    scale, shift = film[:, None, :].chunk(2, dim=2)
    return F.silu(group_norm(x, weight, bias) * (1 + scale) + shift)


def layer_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return F.layer_norm(x, x.shape[-1:], weight, bias, 1e-5)


def attention(query: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
    """mask, [B, S] for keys or [T, S] for queries and keys, is 1 where attention is allowed."""
    q, k, v = (x.unflatten(2, (HEADS, -1)).transpose(1, 2) for x in (query, key, value))
    allowed = mask[:, None, None, :] if mask.shape[0] == len(query) else mask
    scores = q @ k.transpose(2, 3) / q.shape[-1] ** 0.5
    scores = scores.masked_fill(allowed == 0, -torch.inf)
    return (scores.softmax(-1) @ v).transpose(1, 2).flatten(2)


def cross_entropy(x: Tensor, label: Tensor) -> Tensor:
    return F.cross_entropy(x, label.long())


def embedding(index: Tensor, weight: Tensor) -> Tensor:
    return F.embedding(index.long(), weight)


KEY_MASK = np.array([[1.0] * 9, [1.0] * 4 + [0.0] * 2 + [1.0] + [0.0] * 2])
CAUSAL_MASK = np.tril(np.ones((7, 7)))
LABELS = np.array([3.0, 0.0, 8.0, 3.0])
INDICES = np.array([[4.0, 0.0, 4.0], [1.0, 4.0, 5.0]])

# The function, and its inputs: a shape to be drawn, or fixed numbers, which have no gradient. Drawn
# numbers are in ±2, so that losses and activations are seen on either side of their bends.
Inputs = dict[str, tuple[int, ...] | np.ndarray]
CASES: dict[str, tuple[Callable[..., Tensor], Inputs]] = {
    "conv1d_stride2": (conv1d(2, 1, 1), {"x": (2, 11, 5), "weight": (7, 5, 3), "bias": (7,)}),
    "conv1d_dilation3": (conv1d(1, 6, 3), {"x": (2, 13, 5), "weight": (7, 5, 5), "bias": (7,)}),
    "group_norm": (group_norm, {"x": (2, 7, 15), "weight": (15,), "bias": (15,)}),
    "group_norm_film_silu": (
        group_norm_film_silu,
        {"x": (2, 7, 15), "weight": (15,), "bias": (15,), "film": (2, 30)},
    ),
    "layer_norm": (layer_norm, {"x": (2, 5, 9), "weight": (9,), "bias": (9,)}),
    "attention_key_mask": (
        attention,
        {"query": (2, 7, 15), "key": (2, 9, 15), "value": (2, 9, 15), "mask": KEY_MASK},
    ),
    "attention_causal": (
        attention,
        {"query": (2, 7, 15), "key": (2, 7, 15), "value": (2, 7, 15), "mask": CAUSAL_MASK},
    ),
    "gelu": (F.gelu, {"x": (3, 17)}),
    "mish": (F.mish, {"x": (3, 17)}),
    "cross_entropy": (cross_entropy, {"x": (4, 9), "label": LABELS}),
    "smooth_l1": (F.smooth_l1_loss, {"x": (3, 11), "target": (3, 11)}),
    "huber": (
        lambda x, target: F.huber_loss(x, target, delta=0.5),
        {"x": (3, 11), "target": (3, 11)},
    ),
    "embedding": (embedding, {"index": INDICES, "weight": (6, 5)}),
}


def draw(name: str, shape: tuple[int, ...]) -> Tensor:
    """Returns the numbers of a name in ±2, exact in float32."""
    return torch.from_numpy(np.asarray(2 * weights.uniform(name, shape)))


def goldens() -> dict[str, np.ndarray]:
    """Runs every case."""
    found = {}
    for case, (run, given) in CASES.items():
        inputs = {}
        for name, how in given.items():
            is_drawn = isinstance(how, tuple)
            inputs[name] = draw(f"{case}/{name}", how) if is_drawn else torch.from_numpy(how)
            inputs[name].requires_grad_(is_drawn)
        output = run(*inputs.values())
        cotangent = draw(f"{case}/cotangent", tuple(output.shape))
        output.backward(cotangent)
        tensors = {**inputs, "output": output, "cotangent": cotangent}
        for name, tensor in inputs.items():
            if tensor.requires_grad:
                tensors[f"grad_{name}"] = tensor.grad
        for name, tensor in tensors.items():
            found[f"{case}/{name}"] = tensor.detach().contiguous().numpy()
    return found
