#!/usr/bin/env python3
"""Makes the golden files for the training engine.

    pip install -r benches/requirements-engine.txt
    python tests/golden/engine/make.py [NAME…]

PyTorch runs the networks of network.py in float64 and without dropout, with the parameters and
inputs of weights.py; README.md says what is in the files. Before a file is written, gradients are
compared with central differences of the loss.
"""

import json
import math
import pathlib
import sys
from dataclasses import dataclass, replace

import group
import network
import numpy as np
import ops
import planner
import tokens
import torch
import weights
from safetensors.numpy import save as to_bytes
from safetensors.torch import save_file
from torch import Tensor, nn

HERE = pathlib.Path(__file__).resolve().parent
N_SAMPLES = 16
MAX_BYTES = 1_500_000
# Of central differences along a probe of norm 1; the error is relative to the whole gradient.
DIFFERENCE_STEP = 1e-5
DIFFERENCE_TOLERANCE = 1e-8
# Networks up to this size are checked in every parameter, larger ones in eight.
CHECKED_IN_FULL = 500_000


@dataclass
class Case:
    """A network with its inputs, the arguments of its forward, and what it should give."""

    network: nn.Module
    inputs: dict[str, Tensor]
    target: Tensor
    # Of central differences.
    tolerance: float = DIFFERENCE_TOLERANCE

    def loss(self) -> tuple[Tensor, Tensor]:
        """Returns the output and its mean squared distance from the target."""
        output = self.network(*self.inputs.values())
        return output, ((output - self.target) ** 2).mean()


def drawn(name: str, *shape: int) -> Tensor:
    return torch.from_numpy(weights.given(name, shape)).double()


def unet_case(
    config: network.UNetConfig,
    frames: int,
    steps: list[int],
    drop: list[int] | None = None,
    n_valid: list[int] | None = None,
) -> Case:
    made = network.UNet1D(config).double().eval()
    weights.fill(made)
    batch = len(steps)
    inputs = {
        "x": drawn("input.x", batch, frames, config.in_channels),
        "t": torch.tensor(steps),
        "audio": drawn("input.audio", batch, frames, config.audio_cond_dim),
        "drop": None if drop is None else torch.tensor(drop).double(),
        "mask": None,
        "style": drawn("input.style", batch, config.style_dim) if config.style_dim else None,
    }
    if n_valid:
        inputs["mask"] = (torch.arange(frames) < torch.tensor(n_valid)[:, None]).double()
    return Case(made, inputs, drawn("input.target", batch, frames, config.out_channels))


def decoder_case() -> Case:
    made = network.MotionDecoder().double().eval()
    weights.fill(made)
    return Case(made, {"x": drawn("input.x", 2, 13, 25)}, drawn("input.target", 2, 13, 25))


class GroupCase(Case):
    """Both networks of a group: the distance of the estimate, and how it is told from mixed groups."""

    def loss(self) -> tuple[Tensor, Tensor]:
        """Returns the estimate, and mean squared distance + 0.5 cross-entropy."""
        x0, w, logits = self.network(*self.inputs.values())
        self.more = {"w": w, "logits": logits}
        present = self.inputs["present"][:, :, None, None]
        squares = (present * (x0 - self.target) ** 2).sum()
        simple = squares / (present.sum() * x0.shape[2] * x0.shape[3])
        labels = torch.zeros(len(logits), dtype=torch.long)
        return x0, simple + 0.5 * nn.functional.cross_entropy(logits, labels)


def group_case() -> GroupCase:
    config = group.GroupConfig()
    made = group.Group(config).double().eval()
    weights.fill(made)
    batch, n, frames = 2, 3, 9
    inputs = {
        "x": drawn("input.x", batch, n, frames, config.motion_dim),
        "t": torch.tensor([3, 750]),
        "audio": drawn("input.audio", batch, frames, config.condition_dim),
        "drop": torch.tensor([0.0, 1.0]).double(),
        "number": torch.tensor([2, 1]),
        "z": drawn("input.z", batch, config.width),
        # The third dancer of the second group is not there.
        "present": torch.tensor([[1, 1, 1], [1, 1, 0]]).double(),
        "negatives": torch.tensor([[[0, 3, 2], [3, 4, 1]], [[0, 4, 5], [1, 2, 5]]]),
    }
    return GroupCase(made, inputs, drawn("input.target", batch, n, frames, config.motion_dim))


class TokensCase(Case):
    """A tokenizer with what training makes small; at a fixed step no gradient of the target is looked at."""

    def loss(self) -> tuple[Tensor, Tensor]:
        """Returns the estimate, and smooth L1 (of the draft too, where there is one) + 0.02 commitment."""
        found = self.network(*self.inputs.values())
        self.more = {key: value for key, value in found.items() if key not in ("estimate", "loss")}
        return found["estimate"], found["loss"]


def tokens_case(frames_per_token: int, taps: int, *, draft: bool = False) -> TokensCase:
    config = tokens.TokensConfig(frames_per_token=frames_per_token, taps=taps, draft=draft)
    made = tokens.Tokenizer(config).double().eval()
    weights.fill(made)
    batch, frames = 3, 22
    inputs = {
        "motion": drawn("input.motion", batch, frames, config.motion_dim),
        "x": drawn("input.x", batch, frames, config.motion_dim),
        "t": torch.tensor([3, 500, 999]),
        # The third has seventeen frames; of its last token only the first counts.
        "mask": (torch.arange(frames) < torch.tensor([22, 22, 17])[:, None]).double(),
    }
    # A step may pass the kink of a ReLU, which costs up to its length.
    return TokensCase(made, inputs, torch.zeros(()), tolerance=1e-6)


class PlannerCase(Case):
    """A planner with the cross-entropy that training makes small."""

    def loss(self) -> tuple[Tensor, Tensor]:
        """Returns logits and loss."""
        return self.network(*self.inputs.values())


def planner_case(*, is_causal: bool, constraint_dim: int = 0) -> PlannerCase:
    config = planner.PlannerConfig(is_causal=is_causal)
    if constraint_dim:
        # Fewer features, which keeps the file small.
        config = replace(config, constraint_dim=constraint_dim, condition_dim=20)
    made = planner.Planner(config).double().eval()
    weights.fill(made)
    batch, frames, n_tokens = 3, 22, 6
    labels = torch.arange(batch * n_tokens).reshape(batch, n_tokens) * 7 % config.codes
    # The third has seventeen frames, of which the fifth token has the last.
    mask = (torch.arange(n_tokens) < torch.tensor([6, 6, 5])[:, None]).double()
    hidden = mask * (torch.arange(batch * n_tokens).reshape(batch, n_tokens) % 3 != 1)
    inputs = {
        "tokens": labels if is_causal else torch.where(hidden > 0, config.codes, labels),
        "audio": drawn("input.audio", batch, frames, config.condition_dim),
        "drop": torch.tensor([0.0, 1.0, 0.0]).double(),
        "style": drawn("input.style", batch, config.style_dim),
        "mask": mask,
        "labels": labels,
        "weights": mask if is_causal else hidden,
    }
    if constraint_dim:
        inputs["constraints"] = drawn("input.constraints", batch, frames, constraint_dim)
        inputs["drop_constraints"] = torch.tensor([0.0, 0.0, 1.0]).double()
    # A step may pass the kink of a ReLU, which costs up to its length.
    return PlannerCase(made, inputs, torch.zeros(()), tolerance=1e-6)


def probe(name: str, tensor: Tensor) -> Tensor:
    return torch.from_numpy(weights.uniform(f"probe.{name}", tuple(tensor.shape)))


def statistics(prefix: str, tensors: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Returns what stands for tensors: norm, dot product with a probe, and some numbers."""
    found = {"norm": [], "dot": [], "sample": []}
    for name, tensor in tensors.items():
        flat = tensor.detach().flatten()
        n = len(flat)
        at = [j * (n - 1) // (N_SAMPLES - 1) for j in range(N_SAMPLES)]
        at = list(range(n)) if n < N_SAMPLES else at
        found["norm"].append(flat.norm().item())
        found["dot"].append((tensor.detach() * probe(name, tensor)).sum().item())
        found["sample"].append(flat[at].tolist() + [math.nan] * (N_SAMPLES - len(at)))
    return {f"{prefix}.{name}": np.array(values) for name, values in found.items()}


def check(name: str, case: Case, gradients: dict[str, Tensor]) -> None:
    """Compares gradients along probes with central differences; ends the program if they differ."""
    total = math.sqrt(sum(g.square().sum().item() for g in gradients.values()))
    stride = 1 if network.count(case.network) <= CHECKED_IN_FULL else -(-len(gradients) // 8)
    worst = 0.0
    for key, parameter in list(case.network.named_parameters())[::stride]:
        direction = probe(key, parameter)
        direction /= direction.norm()
        start = parameter.detach().clone()
        losses = []
        with torch.no_grad():
            for sign in (1, -1):
                parameter.copy_(start + sign * DIFFERENCE_STEP * direction)
                losses.append(case.loss()[1].item())
            parameter.copy_(start)
        difference = (losses[0] - losses[1]) / (2 * DIFFERENCE_STEP)
        error = abs(difference - (gradients[key] * direction).sum().item()) / total
        worst = max(worst, error)
    print(f"{name}: gradient of norm {total:.3g}, within {worst:.1e} of central differences")
    if not worst < case.tolerance:
        sys.exit(f"{name}: the gradient differs from central differences; nothing was written")


def differentiated(name: str, case: Case) -> dict[str, np.ndarray]:
    """Returns output, loss and gradients of a case, and the inputs that have no rule."""
    for key, tensor in case.inputs.items():
        if key in ("x", "motion", "audio", "style", "constraints", "z") and tensor is not None:
            tensor.requires_grad_()
    output, loss = case.loss()
    # Before the check moves parameters.
    more = dict(case.more) if isinstance(case, (GroupCase, TokensCase)) else {}
    loss.backward()
    # The null context has no gradient where no sample goes without music: zeros, here.
    gradients = {
        key: torch.zeros_like(p) if p.grad is None else p.grad
        for key, p in case.network.named_parameters()
    }
    check(name, case, gradients)
    found = {
        "output": output.detach().contiguous().numpy(),
        "loss": loss.detach().numpy(),
        **statistics("grad", gradients),
    }
    found |= {key: value.detach().contiguous().numpy() for key, value in more.items()}
    is_large = network.count(case.network) > 10_000_000
    for key, tensor in case.inputs.items():
        if tensor is None:
            continue
        if tensor.grad is None:
            found[f"input/{key}"] = tensor.double().numpy()
        elif is_large:
            of_input = statistics(f"grad.input/{key}", {f"input.{key}": tensor.grad})
            found |= {name: values[0] for name, values in of_input.items()}
        else:
            found[f"grad.input/{key}"] = tensor.grad.numpy()
    return found


def trained(case: Case) -> dict[str, np.ndarray]:
    """Returns what three steps of AdamW do, each with a somewhat larger x."""
    named = dict(case.network.named_parameters())
    start = {name: p.detach().clone() for name, p in named.items()}
    x = case.inputs["x"]
    decaying = [p for p in named.values() if p.ndim >= 2]
    others = [p for p in named.values() if p.ndim < 2]
    groups = [{"params": decaying}, {"params": others, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(
        groups, lr=1e-3, betas=(0.9, 0.999), eps=1e-8, weight_decay=1e-2, foreach=False
    )
    steps = []
    for step in range(3):
        case.inputs["x"] = x * (1 + 0.25 * step)
        optimizer.zero_grad()
        _, loss = case.loss()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(named.values(), 1.0, foreach=False)
        optimizer.step()
        steps.append(
            {
                "loss": loss.detach().numpy(),
                "grad_norm": norm.numpy(),
                **statistics("weight", named),
                **statistics("change", {name: p - start[name] for name, p in named.items()}),
            }
        )
        print(f"adamw_tiny, step {step}: loss {loss:.4f}, norm of the gradient {norm:.3g}")
    case.inputs["x"] = x
    found = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    for name in ("t", "drop"):
        found[f"input/{name}"] = case.inputs[name].double().numpy()
    return found


def save(name: str, arrays: dict[str, np.ndarray], module: nn.Module | None = None) -> None:
    """Writes a file; with several entries of metadata its bytes would depend on chance."""
    names = [] if module is None else [key for key, _ in module.named_parameters()]
    metadata = {"parameters": json.dumps(names)} if names else None
    path = HERE / f"{name}.safetensors"
    data = to_bytes({key: np.asarray(a, order="C") for key, a in arrays.items()}, metadata)
    path.write_bytes(data)
    print(f"{path.name}: {len(data):,} bytes")


def main() -> None:
    # The order of sums, and with it the last bits, would depend on the number of threads.
    torch.set_num_threads(1)
    tiny, small, base = (network.unet(name).config for name in ("tiny", "small", "base"))
    # Widths with several channels in a group of a norm: a group of one forgets what is added to it.
    options = replace(
        tiny,
        widths=(40, 48, 80),
        add_audio=False,
        style_dim=8,
        use_scale_shift_norm=False,
        num_head_channels=8,
    )
    cases = {
        "unet_tiny": lambda: unet_case(tiny, 21, [3, 500, 999], [0, 1, 0], [21, 17, 21]),
        "unet_tiny_options": lambda: unet_case(options, 16, [0, 750]),
        "unet_small": lambda: unet_case(small, 37, weights.steps(2)),
        "unet_base": lambda: unet_case(base, 24, [417]),
        "decoder": decoder_case,
        "group_tiny": group_case,
        "tokens_tiny": lambda: tokens_case(4, 5),
        "tokens_halves": lambda: tokens_case(2, 7),
        "tokens_draft": lambda: tokens_case(4, 5, draft=True),
        "planner_masked": lambda: planner_case(is_causal=False),
        "planner_autoregressive": lambda: planner_case(is_causal=True),
        "constrained_masked": lambda: planner_case(is_causal=False, constraint_dim=12),
        "constrained_autoregressive": lambda: planner_case(is_causal=True, constraint_dim=12),
    }
    asked = sys.argv[1:]
    for name, make in cases.items():
        if asked and name not in asked:
            continue
        case = make()
        save(name, differentiated(name, case), case.network)
    if asked:
        return
    case = unet_case(tiny, 24, [3, 500, 999], [0, 1, 0])
    save("adamw_tiny", trained(case), case.network)
    save("ops", ops.goldens())
    # As a user would save it: the names and shapes of a state dict, in PyTorch's own float32.
    minimal = network.UNet1D(
        network.UNetConfig((8, 16), (1,), num_heads=2, time_embed_dim=8, context_dim=8)
    )
    weights.fill(minimal)
    save_file(minimal.state_dict(), HERE / "state_dict.safetensors")
    n_bytes = sum(path.stat().st_size for path in HERE.glob("*.safetensors"))
    print(f"{n_bytes:,} bytes in all")
    if n_bytes > MAX_BYTES:
        sys.exit(f"more than {MAX_BYTES:,} bytes; make the cases shorter")


if __name__ == "__main__":
    main()
