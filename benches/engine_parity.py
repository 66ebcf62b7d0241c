"""Compares every gradient of the training engine with PyTorch's, number by number.

All three (the engine and PyTorch in float32, PyTorch in float64) have the parameters and inputs of
tests/golden/engine/weights.py, and no dropout. The error of a parameter is the norm of the
difference, divided by the norm of the float64 gradient, or by a millionth of the norm of the
whole gradient where that is more: some gradients are zero but for rounding.
"""

import math
import pathlib
from typing import TYPE_CHECKING

import numpy as np
from bench import table
from safetensors import safe_open

if TYPE_CHECKING:
    from engine import Bench

OURS, TORCH = "motiongen", "PyTorch"
# Presets, and a step of the diffusion for each sample of the batch.
STEPS = {"small": [417, 803], "base": [417]}
LIMIT = 1e-4
FLOOR = 1e-6


class Gradients:
    """A file of gradients, of which one is read at a time, and the loss."""

    def __init__(self, path: pathlib.Path, loss: float | None) -> None:
        self.path = path
        self.file = safe_open(path, "numpy")
        self.names = set(self.file.keys())
        self.loss = loss

    def get(self, name: str) -> np.ndarray:
        return self.file.get_tensor(name).astype(np.float64)


def norm(x: np.ndarray) -> float:
    return float(np.linalg.norm(x.ravel()))


def gradients(bench: "Bench", name: str, preset: str, dtype: str) -> Gradients:
    """Has a program write its gradients."""
    steps = STEPS[preset]
    path = bench.work / f"engine-gradients-{name.lower()}-{dtype}.safetensors"
    worker = bench.start(name)
    bench.init(name, worker, len(steps), preset=preset, golden=True)
    more = {"dtype": dtype} if name == TORCH else {}
    answer = worker.ask("gradients", path=str(path.resolve()), t=steps, **more)
    worker.close()
    return Gradients(path, answer.get("loss"))


def compare(ours: Gradients, single: Gradients, double: Gradients) -> tuple[list[list[str]], float]:
    """Returns lines of a table, and the largest error of ours against float64."""
    shapes_differ = [
        name
        for name in sorted(double.names & ours.names)
        if ours.get(name).shape != double.get(name).shape
    ]
    wrong = sorted(double.names - ours.names) + shapes_differ
    if wrong:
        raise SystemExit(f"{OURS} has no gradients of the right shape for {wrong[:5]}")
    norms = {name: norm(double.get(name)) for name in sorted(double.names)}
    whole = math.hypot(*norms.values())
    pairs = {
        f"{OURS} and {TORCH}, float64": (ours, double),
        f"{TORCH}, float32 and float64": (single, double),
        f"{OURS} and {TORCH}, float32": (ours, single),
    }
    rows, largest = [], []
    for title, (a, b) in pairs.items():
        distances = {name: norm(a.get(name) - b.get(name)) for name in norms}
        errors = {n: d / max(norms[n], FLOOR * whole) for n, d in distances.items()}
        worst = max(errors, key=errors.get)
        largest.append(errors[worst])
        row = [f"{errors[worst]:.1e}", f"`{worst}`", f"{np.median(list(errors.values())):.1e}"]
        row.append(f"{math.hypot(*distances.values()) / whole:.1e}")
        row.append("" if a.loss is None else f"{abs(a.loss - b.loss) / b.loss:.1e}")
        rows.append([title, *row])
    return rows, largest[0]


def parity(bench: "Bench") -> str:
    """Compares the gradients of every preset."""
    text = ""
    for preset, steps in STEPS.items():
        found = [
            gradients(bench, name, preset, dtype)
            for name, dtype in [(OURS, "float32"), (TORCH, "float32"), (TORCH, "float64")]
        ]
        rows, largest = compare(*found)
        for each in found:
            each.path.unlink()
        met = "met" if largest <= LIMIT else "MISSED"
        head = ["pair", "worst parameter", "its name", "median parameter", "all", "loss"]
        text += (
            f"### Gradients of `{preset}`, batch {len(steps)}, {len(found[0].names)} parameters: "
            f"relative errors\n\n{table(head, rows)}\n"
            f"- {OURS} and {TORCH}, float64: {largest:.1e}, target ≤ {LIMIT:.0e}: {met}\n\n"
        )
    return text
