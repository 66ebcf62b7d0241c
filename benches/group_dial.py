#!/usr/bin/env python3
"""Measures what --consistency does to groups for songs that a model did not learn from.

    python benches/group_dial.py --bin target/debug/motiongen --model STORE/models/NAME SONG… [--form direction]

For every γ groups are generated, and within windows of 8 s the velocities of every two dancers are correlated, each in
the heading frame of its body: r0 at the same frame, r at the best lag up to 2.1 s. Means over groups with their standard
errors, how different dancers are, and the mean jerk, which tells what it costs; then Spearman's correlation of r0, r and the
difference with γ, of each song and of the means.
"""

import argparse
import pathlib
import subprocess
import tempfile

import numpy as np
from scipy.stats import spearmanr

FPS = 30
WINDOW_FRAMES = 240
LAGS = range(-64, 65, 4)


def heading_velocity(motion: np.ndarray) -> np.ndarray:
    """Velocities of [N, T, 25] turned by the heading of each body about the vertical, [N, T, 3]."""
    w, x, y, z = np.moveaxis(motion[..., 9:13], -1, 0)
    yaw = np.arctan2(2 * (w * y + x * z), 1 - 2 * (y * y + x * x))
    vx, vy, vz = np.moveaxis(motion[..., 3:6], -1, 0)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * vx - sin * vz, vy, sin * vx + cos * vz], -1)


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(0), b - b.mean(0)
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-12))


def lagged(a: np.ndarray, b: np.ndarray, lag: int) -> float:
    n = len(a)
    return correlation(a[max(0, lag) : n + min(0, lag)], b[max(0, -lag) : n - max(0, lag)])


def correlations(motion: np.ndarray) -> tuple[float, float]:
    """r0 and r of one group, means over its pairs and windows."""
    velocity = heading_velocity(motion)
    n, frames = velocity.shape[:2]
    found = [
        (correlation(a, b), max(lagged(a, b, lag) for lag in LAGS))
        for start in range(0, frames - WINDOW_FRAMES + 1, WINDOW_FRAMES)
        for i in range(n)
        for j in range(i + 1, n)
        for a, b in [velocity[[i, j], start : start + WINDOW_FRAMES]]
    ]
    r0, r = np.mean(found, axis=0)
    return float(r0), float(r)


def jerk(motion: np.ndarray) -> float:
    """Mean of |Δ acceleration| · 30 over frames, dancers and axes, m/s³."""
    return float(np.abs(np.diff(motion[..., 6:9], axis=1)).mean() * FPS)


def difference(motion: np.ndarray) -> float:
    """Root mean square difference of the heading velocities of two dancers, m/s."""
    velocity = heading_velocity(motion)
    pairs = [(i, j) for i in range(len(velocity)) for j in range(i + 1, len(velocity))]
    return float(np.sqrt(np.mean([((velocity[i] - velocity[j]) ** 2).mean() for i, j in pairs])))


def with_error(values: list[float]) -> str:
    return f"{np.mean(values):.3f} ± {np.std(values) / np.sqrt(len(values)):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="the executable motiongen")
    parser.add_argument("--model", required=True, help="folder of a model of the family group")
    parser.add_argument("songs", nargs="+", help="songs that it did not learn from")
    parser.add_argument("--gamma", nargs="+", type=float, default=[-1, -0.5, 0, 0.5, 1])
    parser.add_argument("--form", default="direction")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--dancers", type=int, default=4)
    parser.add_argument("--samples", type=int, default=2)
    arguments = parser.parse_args()
    print("| γ | groups | r0 | r | difference, m/s | jerk, m/s³ |\n|---|---|---|---|---|---|")
    by_song: dict[str, list[np.ndarray]] = {}
    for gamma in arguments.gamma:
        with tempfile.TemporaryDirectory() as folder:
            options = {
                "model": arguments.model,
                "output": folder,
                "format": "npy",
                "dancers": arguments.dancers,
                "samples": arguments.samples,
                "steps": 20,
                "consistency": gamma,
                "consistency-form": arguments.form,
                "consistency-scale": arguments.scale,
            }
            flags = [f"--{name}={value}" for name, value in options.items()]
            command = [arguments.bin, "generate", *flags, "--audio", *arguments.songs]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            files = sorted(pathlib.Path(folder).rglob("*.npy"))
            motions = [np.load(file).astype(np.float64) for file in files]
            songs = [file.name.split(".")[0] for file in files]
        pairs = [correlations(motion) for motion in motions]
        r0, r = ([pair[k] for pair in pairs] for k in range(2))
        apart = [difference(motion) for motion in motions]
        jerks = np.mean([jerk(motion) for motion in motions])
        print(
            f"| {gamma:g} | {len(motions)} | {with_error(r0)} | {with_error(r)} | {with_error(apart)} | {jerks:.1f} |",
            flush=True,
        )
        numbers = np.array([r0, r, apart])
        for song in sorted(set(songs)):
            of_song = numbers[:, [name == song for name in songs]].mean(axis=1)
            by_song.setdefault(song, []).append(of_song)
    print("\n| song | ρ of r0 | ρ of r | ρ of difference |\n|---|---|---|---|")
    rows = by_song | {"means": list(np.mean(list(by_song.values()), axis=0))}
    for song, found in rows.items():
        rho = [spearmanr(arguments.gamma, [of_gamma[k] for of_gamma in found]).statistic for k in range(3)]
        print(f"| {song} | " + " | ".join(f"{x:.2f}" for x in rho) + " |")


if __name__ == "__main__":
    main()
