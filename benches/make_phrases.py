#!/usr/bin/env python3
"""Writes synthetic phrases of 120 frames in the phrase layout, fast and the same for a seed.

    python make_phrases.py FOLDER --count 10000 [--features]

Motion obeys the identities that ingest and training rely on: velocity and acceleration are forward
differences of position, angular velocity is that of the quaternion. With --features, every phrase
also has a features.npz as librosa would give it (121 frames: its windows are centred).
"""

import argparse
import io
import pathlib

import numpy as np

FPS = 30
N_FRAMES = 120
N_FEATURE_FRAMES = 121
BPM = 120
BEATS_PER_BAR = 4
# Phrases drawn at a time; bounds memory, not the result for a given count.
CHUNK = 256


def waves(rng: np.random.Generator, n: int, n_frames: int, amplitude: float) -> np.ndarray:
    """Returns [n, n_frames] sums of three slow sines, at most `amplitude` from 0."""
    time_s = np.arange(n_frames) / FPS
    frequency_hz = rng.uniform(0.05, 1.0, (n, 3, 1))
    phase = rng.uniform(0, 2 * np.pi, (n, 3, 1))
    weight = rng.dirichlet(np.ones(3), n)[..., None] * amplitude
    return (weight * np.sin(2 * np.pi * frequency_hz * time_s + phase)).sum(axis=1)


def motions(rng: np.random.Generator, n: int) -> np.ndarray:
    """Returns [n, 120, 25] float32: position, velocity, acceleration, quaternion (w, x, y, z),
    angular velocity, bar phase, style."""
    # Two frames more than are kept, so that every kept frame has its differences.
    position = np.stack(
        [
            waves(rng, n, N_FRAMES + 2, 1.0),
            0.95 + waves(rng, n, N_FRAMES + 2, 0.1),
            waves(rng, n, N_FRAMES + 2, 1.0),
        ],
        axis=-1,
    )
    velocity = np.diff(position, axis=1) * FPS
    acceleration = np.diff(velocity, axis=1) * FPS
    yaw = waves(rng, n, N_FRAMES + 1, 1.5)
    zero = np.zeros((n, N_FRAMES))
    half = yaw[:, :N_FRAMES] / 2
    quaternion = np.stack([np.cos(half), zero, np.sin(half), zero], axis=-1)
    turn = np.stack([zero, np.diff(yaw, axis=1) * FPS, zero], axis=-1)
    bars = np.arange(N_FRAMES) / FPS * BPM / 60 / BEATS_PER_BAR
    phase = np.broadcast_to(bars % 1.0, (n, N_FRAMES))[..., None]
    style = np.stack([waves(rng, n, N_FRAMES, 0.8) for _ in range(8)], axis=-1)
    kept = (position[:, :N_FRAMES], velocity[:, :N_FRAMES], acceleration)
    return np.concatenate([*kept, quaternion, turn, phase, style], axis=-1).astype("<f4")


def features(rng: np.random.Generator) -> dict[str, np.ndarray]:
    frames = N_FEATURE_FRAMES
    return {
        "mel": -40 + 10 * rng.standard_normal((128, frames), dtype=np.float32),
        "chroma": rng.random((12, frames), dtype=np.float32),
        "mfcc": 20 * rng.standard_normal((20, frames), dtype=np.float32),
        "rms": rng.random(frames, dtype=np.float32),
        "spectral_centroid": 2000 + 500 * rng.standard_normal(frames, dtype=np.float32),
        "onset_strength": rng.random(frames, dtype=np.float32),
        "tempo": np.array(BPM, dtype=np.float64),
        "beat_times": np.arange(0, N_FRAMES / FPS, 60 / BPM),
    }


def write(folder: pathlib.Path, count: int, with_features: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    header = io.BytesIO()
    described = np.lib.format.header_data_from_array_1_0(np.zeros((N_FRAMES, 25), "<f4"))
    np.lib.format.write_array_header_1_0(header, described)
    for first in range(0, count, CHUNK):
        for i, motion in enumerate(motions(rng, min(CHUNK, count - first)), start=first):
            name = f"phrase_{i:06}"
            place = folder / "motion" / name
            place.mkdir(parents=True)
            (place / "trajectory.npy").write_bytes(header.getvalue() + motion.tobytes())
            if with_features:
                place = folder / "audio_features" / name
                place.mkdir(parents=True)
                np.savez(place / "features.npz", **features(rng))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=pathlib.Path, help="folder to make; must not exist")
    parser.add_argument("--count", type=int, default=10_000, help="phrases (default %(default)s)")
    parser.add_argument("--features", action="store_true", help="write features.npz too")
    parser.add_argument("--seed", type=int, default=1, help="(default %(default)s)")
    arguments = parser.parse_args()
    if arguments.folder.exists():
        parser.error(f"{arguments.folder} exists; remove it or name another folder")
    write(arguments.folder, arguments.count, arguments.features, arguments.seed)


if __name__ == "__main__":
    main()
