"""One training step of the UNet `small`."""

from dataclasses import replace

import diffusion
import given
import losses
import network
import numpy as np
import torch
import weights
from make import statistics
from torch import nn

FRAMES, VALID = 37, [37, 37, 29]
STEPS, DROP = [12, 487, 951], [0, 1, 0]
PREDICTIONS, COSTS, GAMMAS = ("epsilon", "x0", "v"), ("mse", "l1", "huber"), (None, 5.0)


def small() -> tuple[dict[str, np.ndarray], list[str]]:
    """Returns what a step of AdamW does, and the loss as each objective has it."""
    config = replace(network.unet("small").config, dropout=0.0)
    unet = network.UNet1D(config).double()
    weights.fill(unet)
    named = dict(unet.named_parameters())
    start = {name: p.detach().clone() for name, p in named.items()}
    batch = len(STEPS)
    x0 = given.drawn("step_small.x0", 1.5, batch, FRAMES, 25)
    noise = given.drawn("step_small.noise", 1.75, batch, FRAMES, 25)
    audio = given.drawn("step_small.audio", 1.0, batch, FRAMES, config.audio_cond_dim)
    mask = given.mask(FRAMES, VALID)
    t, drop = torch.tensor(STEPS), torch.tensor(DROP)
    alpha_bar = diffusion.alpha_bars("cosine")[t]
    prediction = unet(diffusion.noised(x0, noise, alpha_bar), t, audio, drop, mask)

    def loss(kind: str, cost: str, gamma: float | None) -> torch.Tensor:
        weight = None if gamma is None else diffusion.min_snr(kind, alpha_bar, gamma)
        wanted = diffusion.target(kind, x0, noise, alpha_bar)
        return losses.objective(cost, prediction, wanted, mask, weight)

    objectives = [[[loss(p, c, g).item() for g in GAMMAS] for c in COSTS] for p in PREDICTIONS]
    trained = loss("epsilon", "mse", None)
    trained.backward()
    gradients = {name: p.grad.clone() for name, p in named.items()}
    decaying = [p for p in named.values() if p.ndim >= 2]
    others = [p for p in named.values() if p.ndim < 2]
    optimizer = torch.optim.AdamW(
        [{"params": decaying}, {"params": others, "weight_decay": 0.0}],
        lr=1e-4, betas=(0.9, 0.999), eps=1e-8, weight_decay=1e-4, foreach=False,
    )  # fmt: skip
    norm = nn.utils.clip_grad_norm_(named.values(), 1.0, foreach=False)
    optimizer.step()
    print(f"step_small: loss {trained:.6g}, norm of the gradient {norm:.4g}")
    arrays = {
        "t": np.array(STEPS, dtype=float),
        "drop": np.array(DROP, dtype=float),
        "mask": mask.numpy(),
        "loss": trained.detach().numpy(),
        "objectives": np.array(objectives),
        "grad_norm": norm.numpy(),
        **statistics("grad", gradients),
        **statistics("weight", named),
        **statistics("change", {name: p - start[name] for name, p in named.items()}),
    }
    return arrays, list(named)
