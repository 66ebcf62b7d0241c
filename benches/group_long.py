#!/usr/bin/env python3
"""Measures a long dance of a group: seams, identities and memory.

    python benches/group_long.py --bin target/release/motiongen --model STORE/models/NAME --audio song.wav

The song should last three minutes or more. Seams are the frames at which a window begins, evenly spaced as generate has
them, so that they fall on any place of the bar; what happens there is held against all other frames.
"""

import argparse
import pathlib
import resource
import subprocess
import tempfile

import numpy as np

OVERLAP_FRAMES = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=pathlib.Path, required=True)
    parser.add_argument("--model", required=True)
    parser.add_argument("--audio", type=pathlib.Path, required=True)
    parser.add_argument("--dancers", type=int, default=5)
    parser.add_argument("--window-frames", type=int, default=120, help="of the model")
    parser.add_argument("--steps", type=int, default=20)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [
            arguments.bin, "generate", "--quiet", "--model", arguments.model, "--audio", arguments.audio,
            "--dancers", str(arguments.dancers), "--consistency", "0.5", "--steps", str(arguments.steps),
            "--overlap", str(OVERLAP_FRAMES), "--format", "npy", "--output", folder,
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        motion = np.load(pathlib.Path(folder) / f"{arguments.audio.stem}.npy")
    place = motion[..., :3]
    last = motion.shape[1] - arguments.window_frames
    n_steps = -(-last // (arguments.window_frames - OVERLAP_FRAMES))
    starts = [i * last // n_steps for i in range(1, n_steps + 1)]
    print(f"{motion.shape[0]} dancers, {motion.shape[1]} frames, {peak_mb:.0f} MB")
    for order, name in ((1, "step"), (2, "acceleration"), (3, "jerk")):
        size = np.linalg.norm(np.diff(place, order, axis=1), axis=-1)
        seam = np.isin(np.arange(size.shape[1]) + 1, starts)
        above = (size[:, seam] > np.percentile(size[:, ~seam], 95)).mean()
        print(f"{name}: {above:.1%} of {seam.sum() * len(size)} seams above the 95th percentile elsewhere")
    floor = place[..., [0, 2]]
    apart = np.linalg.norm(floor[:, None] - floor[None], axis=-1)[np.triu_indices(len(floor), 1)]
    step = np.linalg.norm(np.diff(floor, axis=1), axis=-1).max()
    # Two who changed names would go the way between them within a frame.
    print(f"least separation {apart.min():.3f} m, longest step of a frame {step:.3f} m")


if __name__ == "__main__":
    main()
