"""End-to-end fine-tuning: all losses through five steps of DDIM, and one step of AdamW."""

import sys
from dataclasses import dataclass, field, replace

import diffusion
import given
import losses
import network
import numpy as np
import torch
import weights
from make import probe, statistics
from torch import Tensor, nn

FRAMES, VALID = 13, [13, 9, 13]
HIDDEN, BLOCKS = 48, 2
# A hundred times the defaults, so that a change is above float32's rounding of weights near 1.
LR_UNET, LR_DECODER = 1e-4, 5e-3
# Within this of a bend float32 may take another slope: a hundred times its rounding of numbers near 1.
MARGIN = 1e-4
# Of central differences along a probe of norm 1; the error is relative to the whole gradient.
DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 1e-5
MAX_DRAWS = 200


@dataclass(frozen=True)
class Case:
    """What is trained, and the weights of its losses."""

    name: str
    steps: list[int]
    prediction: str = "epsilon"
    schedule: str = "cosine"
    clip_range: float = 5.0
    style_dim: int = 0
    cost: str = "mse"
    gamma: float | None = None
    n_steps: int = 5
    diffusion_weight: float = 0.1
    decoder_weight: float = 1.0
    temporal_weight: float = 10.0
    temporal: losses.Temporal = field(default_factory=losses.Temporal)


CASES = [
    # The defaults. The UNet's numbers are as good as random, so that most estimates are clipped.
    Case("finetune_tiny", [3, 500, 871]),
    # Estimates of v are never far out: with a narrow clip, gradients pass in part through every step.
    Case(
        "finetune_tiny_v", [44, 7, 630], "v", "linear", 1.0, 8, "huber", 5.0, 4, 2.0, 0.75, 0.125,
    ),
]  # fmt: skip


class Pipeline(nn.Module):
    """Both networks; a name begins with `unet.` or `decoder.`, and its numbers are of the rest."""

    def __init__(self, style_dim: int) -> None:
        super().__init__()
        config = replace(network.unet("tiny").config, dropout=0.0, style_dim=style_dim)
        self.unet = network.UNet1D(config)
        self.decoder = network.MotionDecoder(HIDDEN, BLOCKS, dropout=0.0)
        weights.fill(self.unet)
        weights.fill(self.decoder)


class Run:
    """The losses of a case with some draw of its inputs."""

    def __init__(self, case: Case, pipeline: Pipeline, draw: int) -> None:
        self.case, self.pipeline = case, pipeline
        batch = len(case.steps)
        self.motion = given.motion(f"{case.name}.{draw}.motion", batch, FRAMES)
        self.noise = given.drawn(f"{case.name}.{draw}.noise", 1.75, batch, FRAMES, 25)
        self.audio = given.drawn(f"{case.name}.{draw}.audio", 1.0, batch, FRAMES, 163)
        style = given.drawn(f"{case.name}.{draw}.style", 1.0, batch, 8)
        self.style = style if case.style_dim else None
        self.mask = given.mask(FRAMES, VALID)

    def losses(self) -> dict[str, Tensor]:
        """Returns all losses, the total last; keeps estimates and decoded motion."""
        case, unet = self.case, self.pipeline.unet
        t = torch.tensor(case.steps)
        every = diffusion.alpha_bars(case.schedule)
        weight = None
        if case.gamma is not None:
            weight = diffusion.min_snr(case.prediction, every[t], case.gamma)
        x_t = diffusion.noised(self.motion, self.noise, every[t])
        prediction = unet(x_t, t, self.audio, None, self.mask, self.style)
        wanted = diffusion.target(case.prediction, self.motion, self.noise, every[t])
        of_noise = losses.objective(case.cost, prediction, wanted, self.mask, weight)

        def predict(x: Tensor, t: int) -> Tensor:
            return unet(x, torch.full((len(x),), t), self.audio, None, self.mask, self.style)

        # The sample begins with the same noise, from its last number to its first.
        start = self.noise.flatten().flip(0).reshape(self.noise.shape)
        latent, self.estimates = diffusion.ddim(
            predict, start, case.prediction, every, case.n_steps, case.clip_range
        )
        decoded = self.pipeline.decoder(latent)
        self.decoded = decoded.detach()
        centre, scale = given.normalizer()
        distances = losses.reconstruction(decoded, self.motion, centre, scale, self.mask)
        of_motion = {name: distances[name] for name in ("position", "quaternion")}
        of_time = losses.temporal(decoded, self.mask, case.temporal)
        total = (
            case.diffusion_weight * of_noise
            + case.decoder_weight * sum(of_motion.values())
            + case.temporal_weight * sum(of_time.values())
        )
        return {"diffusion": of_noise, **of_motion, **of_time, "total": total}

    def bends(self) -> dict[str, float]:
        """Returns how near each number comes to where a slope changes, in units of its margin."""
        found = losses.margins(self.decoded, self.mask, self.case.temporal)
        centre, scale = given.normalizer()
        wanted = (self.motion * scale + centre)[..., losses.QUATERNION]
        dot = (self.decoded[..., losses.QUATERNION] * wanted).sum(-1)[self.mask != 0]
        found["either sign"] = dot.abs().min().item()
        found = {name: x / MARGIN for name, x in found.items()}
        for t, x0 in zip(diffusion.linspace_steps(self.case.n_steps), self.estimates, strict=True):
            nearest = (x0.abs() - self.case.clip_range).abs().min().item()
            # An estimate from ε is divided by √ᾱ, 5e-5 at the first step, and so is its rounding.
            grown = diffusion.alpha_bars(self.case.schedule)[t].rsqrt().item()
            grown = grown if self.case.prediction == "epsilon" else 1.0
            found[f"clip at step {t}"] = nearest / (MARGIN * grown)
        return found


def smooth_run(case: Case, pipeline: Pipeline) -> tuple[Run, int]:
    """Returns the first draw that lies beside no bend, and in which every loss is tried."""
    for draw in range(MAX_DRAWS):
        run = Run(case, pipeline, draw)
        with torch.no_grad():
            values = run.losses()
        bends = run.bends()
        if min(bends.values()) >= 1 and min(values.values()) > 0:
            nearest = min(bends, key=bends.get)
            print(f"{case.name}: draw {draw}, nearest to a bend: {nearest}, {bends[nearest]:.2g}")
            return run, draw
    sys.exit(f"{case.name}: every draw lies beside a bend")


def check(run: Run, named: dict[str, Tensor], gradients: dict[str, list[Tensor]]) -> None:
    """Compares all losses' gradients along a probe of each network with central differences."""
    for part in ("unet.", "decoder."):
        along = {name: probe(name, p) for name, p in named.items() if name.startswith(part)}
        size = sum(d.square().sum() for d in along.values()).sqrt()
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                for name, d in along.items():
                    named[name] += sign * DIFFERENCE_STEP * d / size
                ends.append(run.losses())
                for name, d in along.items():
                    named[name] -= sign * DIFFERENCE_STEP * d / size
        for loss, found in gradients.items():
            slope = (ends[0][loss] - ends[1][loss]) / (2 * DIFFERENCE_STEP)
            mine = {name: g for name, g in zip(named, found, strict=True) if name in along}
            wanted = sum((g * along[name]).sum() for name, g in mine.items()) / size
            norm = sum(g.square().sum() for g in found).sqrt()
            error = ((slope - wanted).abs() / norm).item()
            if not error < DIFFERENCE_TOLERANCE:
                sys.exit(f"{loss} of {part}: {slope} by differences, {wanted} by PyTorch")


def run(case: Case) -> tuple[dict[str, np.ndarray], list[str]]:
    """Returns losses, their gradients, and the change of the weights by one step."""
    pipeline = Pipeline(case.style_dim).double()
    made, draw = smooth_run(case, pipeline)
    named = dict(pipeline.named_parameters())
    values = made.losses()
    gradients = {}
    for name, loss in values.items():
        found = torch.autograd.grad(loss, named.values(), retain_graph=True, allow_unused=True)
        gradients[name] = [
            torch.zeros_like(p) if g is None else g
            for g, p in zip(found, named.values(), strict=True)
        ]
        size = torch.cat([g.flatten() for g in gradients[name]]).norm()
        print(f"{case.name}: {name} {loss:.6g}, norm of the gradient {size:.4g}")
    clipped = [(x0.abs() > case.clip_range).double().mean() for x0 in made.estimates]
    print(f"{case.name}: clipped at each step", ", ".join(f"{share:.1%}" for share in clipped))
    check(made, named, gradients)

    of_loss = {
        name: statistics("grad", dict(zip(named, found, strict=True)))
        for name, found in gradients.items()
    }
    arrays = {
        "draw": np.array(float(draw)),
        "t": np.array(case.steps, dtype=float),
        "mask": made.mask.numpy(),
        "decoded": made.decoded.contiguous().numpy(),
        "loss": np.array([loss.item() for loss in values.values()]),
        "losses.norm": np.stack([found["grad.norm"] for found in of_loss.values()]),
        "losses.dot": np.stack([found["grad.dot"] for found in of_loss.values()]),
        **of_loss["total"],
        **stepped(named, gradients["total"]),
    }
    return arrays, list(named)


def stepped(named: dict[str, Tensor], gradients: list[Tensor]) -> dict[str, np.ndarray]:
    """Takes one step of AdamW, and returns the norm of the gradient and the change of the weights."""
    start = {name: p.detach().clone() for name, p in named.items()}
    groups = []
    for part, rate in (("unet.", LR_UNET), ("decoder.", LR_DECODER)):
        own = [p for name, p in named.items() if name.startswith(part)]
        groups.append({"params": [p for p in own if p.ndim >= 2], "lr": rate})
        groups.append({"params": [p for p in own if p.ndim < 2], "lr": rate, "weight_decay": 0.0})
    optimizer = torch.optim.AdamW(
        groups, betas=(0.9, 0.999), eps=1e-8, weight_decay=1e-4, foreach=False
    )
    for p, g in zip(named.values(), gradients, strict=True):
        p.grad = g.clone()
    norm = nn.utils.clip_grad_norm_(named.values(), 1.0, foreach=False)
    optimizer.step()
    changes = {name: p - start[name] for name, p in named.items()}
    return {"grad_norm": norm.numpy(), **statistics("change", changes)}
