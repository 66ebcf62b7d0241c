"""The losses of training and fine-tuning in PyTorch, float64, written from their definitions.

Motion is [batch, frames, 25]; a mask, [batch, frames], is 1 for frames that count. The definitions are
those of reference 7.2, with what motiongen settles: masks, either sign of a quaternion, and the
phase's rule.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

FPS = 30.0
POSITION, VELOCITY, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
QUATERNION, PHASE = slice(9, 13), 16


@dataclass(frozen=True)
class Temporal:
    """Weights and targets, reference 7.2 and 14.1."""

    velocity_weight: float = 10.0
    acceleration_weight: float = 5.0
    jerk_weight: float = 1.0
    quaternion_delta_weight: float = 2.0
    phase_weight: float = 1.0
    smoothness_weight: float = 1.0
    target_velocity: float = 5.0
    target_acceleration: float = 100.0
    target_jerk: float = 50_000.0
    target_quaternion_dot: float = 0.95
    max_step_m: float = 0.5


def mean(values: Tensor, mask: Tensor) -> Tensor:
    """Returns the mean of the rows that count, [B, T] or [B, T, n]."""
    return values[mask != 0].mean()


def cost(kind: str, prediction: Tensor, wanted: Tensor) -> Tensor:
    of = {"mse": F.mse_loss, "l1": F.l1_loss, "huber": F.huber_loss}[kind]
    return of(prediction, wanted, reduction="none")


def objective(
    kind: str, prediction: Tensor, wanted: Tensor, mask: Tensor, weight: Tensor | None = None
) -> Tensor:
    """Returns the mean cost over frames that count, each sample's times its weight, [B]."""
    costs = cost(kind, prediction, wanted)
    if weight is not None:
        costs = weight[:, None, None] * costs
    return mean(costs, mask)


def reconstruction(
    decoded: Tensor, normalized: Tensor, centre: Tensor, scale: Tensor, mask: Tensor
) -> dict[str, Tensor]:
    """Returns squared distances of decoded motion from motion; quaternions take the nearer sign."""
    wanted = normalized * scale + centre

    def nearer(got: Tensor, wanted: Tensor) -> Tensor:
        """[B, T, 25] → [B, T, 25]: squares, those of a quaternion the smaller ones of two signs."""
        squares, turned = (got - wanted) ** 2, (got + wanted) ** 2
        either = squares[..., QUATERNION].sum(-1) <= turned[..., QUATERNION].sum(-1)
        signed = torch.where(either[..., None], squares[..., QUATERNION], turned[..., QUATERNION])
        return torch.cat([squares[..., :9], signed, squares[..., 13:]], dim=-1)

    squares = nearer(decoded, wanted)
    in_spreads = nearer((decoded - centre) / scale, normalized)
    return {
        "position": mean(squares[..., POSITION], mask),
        "quaternion": mean(squares[..., QUATERNION], mask),
        "all": mean(in_spreads, mask),
    }


def temporal(motion: Tensor, mask: Tensor, c: Temporal) -> dict[str, Tensor]:
    """Returns the losses of coherence, each with its weight, and in metres and the like."""
    pairs = mask[:, :-1] * mask[:, 1:]
    head, change = motion[:, :-1], motion[:, 1:] - motion[:, :-1]
    velocity = head[..., VELOCITY] - FPS * change[..., POSITION]
    acceleration = head[..., ACCELERATION] - FPS * change[..., VELOCITY]
    jerk = (FPS * change[..., ACCELERATION]).norm(dim=-1)
    dot = (motion[:, :-1, QUATERNION] * motion[:, 1:, QUATERNION]).sum(-1).abs()
    # A fall is a violation, but not that of a new bar.
    phase = torch.where(change[..., PHASE] < -0.5, 0.0, F.relu(-change[..., PHASE])) * pairs
    step = F.relu(change[..., POSITION].abs() - c.max_step_m)
    return {
        "velocity_coherence": c.velocity_weight * mean(velocity**2, pairs) / c.target_velocity**2,
        "acceleration_coherence": c.acceleration_weight
        * mean(acceleration**2, pairs)
        / c.target_acceleration**2,
        "jerk": c.jerk_weight * mean((jerk / c.target_jerk) ** 2, pairs),
        "quaternion_delta": c.quaternion_delta_weight
        * mean(F.relu(c.target_quaternion_dot - dot), pairs),
        "phase_monotonic": c.phase_weight * phase.sum(-1).mean(),
        "position_smoothness": c.smoothness_weight * mean(step, pairs),
    }


def margins(motion: Tensor, mask: Tensor, c: Temporal) -> dict[str, float]:
    """Returns how near the losses come to a bend, where rounding would choose another slope."""
    pairs = (mask[:, :-1] * mask[:, 1:]) != 0
    change = (motion[:, 1:] - motion[:, :-1])[pairs]
    dot = (motion[:, :-1, QUATERNION] * motion[:, 1:, QUATERNION]).sum(-1)[pairs].abs()
    phase, step = change[:, PHASE], change[:, POSITION].abs()

    def least(x: Tensor) -> float:
        return x.abs().min().item()

    return {
        "dot at its target": least(dot - c.target_quaternion_dot),
        "dot at 0": least(dot),
        "phase at a new bar": least(phase + 0.5),
        "phase at rest": least(phase),
        "step at the longest": least(step - c.max_step_m),
    }
