#!/usr/bin/env python3
"""Makes the golden files for training and fine-tuning.

    pip install -r benches/requirements-engine.txt
    python tests/golden/training/make.py [codebook]

PyTorch runs the networks of tests/golden/engine in float64 and without dropout, on the losses and the
sampler of losses.py and diffusion.py; README.md says what is in the files. Before a file is written,
gradients are compared with central differences, and the inputs are made sure to lie beside no bend.
"""

import json
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
# Before this folder, so that `make` is the engine's.
sys.path.insert(0, str(HERE.parent / "engine"))

import codebook
import finetune
import given
import losses
import numpy as np
import step
import torch
from safetensors.numpy import save as to_bytes

MAX_BYTES = 300_000


def decoded_losses() -> dict[str, np.ndarray]:
    """Returns the losses of motion that is given, each with its gradient.

    The normalizer's numbers are few bits long, so that what motiongen computes of them in float32 is
    exact and float64 can be compared to the last digits. One frame is masked in the middle.
    """
    batch, frames = 3, 11
    mask = given.mask(frames, [11, 7, 2])
    mask[0, 4] = 0
    centre, scale = given.normalizer()
    normalized = given.motion("decoded_losses.motion", batch, frames)
    decoded = given.drawn("decoded_losses.decoded", 1.0, batch, frames, 25)
    decoded[..., losses.VELOCITY] *= 20
    decoded[..., losses.ACCELERATION] *= 100
    # Turns small enough that some keep to their target, from the side of either sign.
    decoded[..., losses.QUATERNION] += torch.tensor([0.5, -0.75, 1.0, 0.25])
    decoded[..., losses.QUATERNION] /= decoded[..., losses.QUATERNION].norm(dim=-1, keepdim=True)
    decoded[:, ::3, losses.QUATERNION] *= -1
    decoded[..., losses.PHASE] = (decoded[..., losses.PHASE] + 1) / 2
    decoded.requires_grad_()
    config = losses.Temporal(phase_weight=0.5, smoothness_weight=1.5, max_step_m=0.375)
    found = losses.reconstruction(decoded, normalized, centre, scale, mask)
    found |= losses.temporal(decoded, mask, config)
    arrays = {"mask": mask, "decoded": decoded, "motion": normalized}
    arrays |= {"centre": centre, "scale": scale}
    for name, loss in found.items():
        (gradient,) = torch.autograd.grad(loss, decoded, retain_graph=True)
        arrays |= {f"loss/{name}": loss, f"grad/{name}": gradient}
        print(f"decoded_losses: {name} {loss:.6g}, gradient {gradient.norm():.3g}")
        if not loss > 0:
            sys.exit(f"{name} is {loss}: it is not tried")
    return {name: tensor.detach().numpy() for name, tensor in arrays.items()}


def save(name: str, arrays: dict[str, np.ndarray], parameters: list[str] | None = None) -> None:
    """Writes a file; with several entries of metadata its bytes would depend on chance."""
    metadata = {"parameters": json.dumps(parameters)} if parameters else None
    path = HERE / f"{name}.safetensors"
    data = to_bytes({key: np.asarray(a, order="C") for key, a in arrays.items()}, metadata)
    print(f"{path.name}: {len(data):,} bytes")
    if len(data) > MAX_BYTES:
        sys.exit(f"{path.name} would have more than {MAX_BYTES:,} bytes; make the case shorter")
    path.write_bytes(data)


def main() -> None:
    # The order of sums, and with it the last bits, would depend on the number of threads.
    torch.set_num_threads(1)
    save("codebook", codebook.transcript())
    if sys.argv[1:] == ["codebook"]:
        return
    save("decoded_losses", decoded_losses())
    save("step_small", *step.small())
    for case in finetune.CASES:
        save(case.name, *finetune.run(case))


if __name__ == "__main__":
    main()
