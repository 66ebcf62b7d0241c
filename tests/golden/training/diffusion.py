"""The diffusion in PyTorch, float64: schedules, the forward process, DDIM with gradients.

Written from the papers, and from what motiongen's documentation says where papers leave a choice:
Ho et al. 2020 (forward process), Nichol and Dhariwal 2021, eq. 17 (cosine), Song et al. 2021, eq. 12
(DDIM), Salimans and Ho 2022 (v). Steps are t = 0 … T - 1, samples [batch, frames, channels].
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

N_STEPS = 1000


def alpha_bars(schedule: str) -> Tensor:
    """Returns ᾱ of every step, [N_STEPS]."""
    if schedule == "linear":
        betas = np.linspace(1e-4, 0.02, N_STEPS)
    else:
        u = np.arange(N_STEPS + 1) / N_STEPS
        f = np.cos((u + 0.008) / 1.008 * np.pi / 2) ** 2
        betas = np.clip(1 - f[1:] / f[:-1], 1e-4, 0.9999)
    return torch.from_numpy(np.cumprod(1 - betas))


def noised(x0: Tensor, noise: Tensor, alpha_bar: Tensor) -> Tensor:
    """Returns x_t; alpha_bar is [batch]."""
    alpha_bar = alpha_bar[:, None, None]
    return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * noise


def target(prediction: str, x0: Tensor, noise: Tensor, alpha_bar: Tensor) -> Tensor:
    """Returns what a network should predict."""
    alpha_bar = alpha_bar[:, None, None]
    velocity = alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * x0
    return {"epsilon": noise, "x0": x0, "v": velocity}[prediction]


def min_snr(prediction: str, alpha_bar: Tensor, gamma: float) -> Tensor:
    """Returns the weight of each sample (Hang et al. 2023, section 3.4), [batch]."""
    snr = alpha_bar / (1 - alpha_bar)
    divisor = {"epsilon": snr, "x0": torch.ones_like(snr), "v": snr + 1}[prediction]
    return snr.clamp(max=gamma) / divisor


def linspace_steps(n: int) -> list[int]:
    """Returns n steps from T - 1 to 0, evenly spaced, halves rounded to even."""
    return np.round(np.linspace(N_STEPS - 1, 0, n)).astype(int).tolist()


def ddim(
    predict: Callable[[Tensor, int], Tensor],
    x: Tensor,
    prediction: str,
    alpha_bar: Tensor,
    n_steps: int,
    clip_range: float,
) -> tuple[Tensor, list[Tensor]]:
    """Returns x0 sampled from x by DDIM, η = 0, and each step's estimate of it before clipping.

    The estimate is clipped, and the noise taken anew from it, so that both still make x_t (reference
    8.1 keeps the network's noise); the last step leads to ᾱ = 1.
    """
    steps = linspace_steps(n_steps)
    estimates = []
    for i, t in enumerate(steps):
        a = alpha_bar[t]
        b = alpha_bar[steps[i + 1]] if i + 1 < n_steps else torch.ones_like(a)
        y = predict(x, t)
        if prediction == "epsilon":
            x0 = (x - (1 - a).sqrt() * y) / a.sqrt()
        else:
            x0 = a.sqrt() * x - (1 - a).sqrt() * y
        estimates.append(x0.detach())
        x0 = x0.clamp(-clip_range, clip_range)
        noise = (x - a.sqrt() * x0) / (1 - a).sqrt()
        x = b.sqrt() * x0 + (1 - b).sqrt() * noise
    return x, estimates
