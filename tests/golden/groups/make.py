#!/usr/bin/env python3
"""Golden values of the measures of groups.

    python tests/golden/groups/make.py        (NumPy and SciPy alone; a second)

Writes group.npy, three dancers of whom the second is partly the first, and measures.json beside itself. Each
formula stands as its source has it, loops and all, and shares nothing with the program:

  GMR features  Le et al., "Music-Driven Group Choreography", CVPR 2023: ln(1 + m E), pooled over dancers
  GMC           the same; dynamic time warping over markers, then the mean dot product along the path
  TIF           the same, for discs of 0.35 m on the floor
  unison        correlation of velocities in the frames of the headings, lag of one half, value of the other
"""

import json
import math
import pathlib

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

HERE = pathlib.Path(__file__).resolve().parent
FPS = 30.0
RADIUS = 0.35
MARKER = 0.25
CHUNK = 75
PIECE = 150
BAR = 52.4


def dancers(rng, n):
    t = np.arange(n) / FPS

    def smooth(scale):
        return scale * sum(
            np.sin(2 * np.pi * rng.uniform(0.2, 1.6) * t[:, None] + rng.uniform(0, 6.28, (1, 3)))
            for _ in range(3)
        )

    own = [smooth(0.2) for _ in range(3)]
    turns = [smooth(0.2) + t[:, None] * np.array([[0.0, 0.4 * k, 0.0]]) for k in range(3)]
    group = np.zeros((3, n, 25), dtype=np.float32)
    quarter = Rotation.from_rotvec([0, 2.1, 0])
    for k in range(3):
        # The second does what the first did eleven frames ago, elsewhere, with something of its own.
        p, r = own[k], Rotation.from_rotvec(turns[k])
        if k == 1:
            p = quarter.apply(np.roll(own[0], 11, axis=0) + 0.15 * own[1])
            r = quarter * Rotation.from_rotvec(np.roll(turns[0], 11, axis=0))
        p = p + np.array([0.75 * k, 1.0, 0.2 * k * k])
        q = r.as_quat()[:, [3, 0, 1, 2]]
        for i in range(1, n):
            if q[i] @ q[i - 1] < 0:
                q[i] = -q[i]
        group[k, :, 0:3] = p
        group[k, :, 9:13] = q
    return group


def turn(frames):
    return Rotation.from_quat(frames[:, [10, 11, 12, 9]].astype(float))


def markers(frames):
    p = frames[:, 0:3].astype(float)
    return [p] + [p + MARKER * turn(frames).apply(np.eye(3)[i]) for i in range(3)]


def energies(frames):
    """[T - 1, 12]: energies of every frame from the second on, averaged over five frames."""
    out = []
    for x in markers(frames):
        n = len(x)
        for_marker = []
        for i in range(1, n):
            v, n_v, a, n_a = np.zeros(3), 0, np.zeros(3), 0
            for s in range(i - 2, i + 3):
                if 1 <= s < n:
                    v, n_v = v + (x[s] - x[s - 1]) * FPS, n_v + 1
                if 1 <= s < n - 1:
                    a, n_a = a + (x[s + 1] - 2 * x[s] + x[s - 1]) * FPS**2, n_a + 1
            v, a = v / n_v, a / n_a
            for_marker.append([v[0] ** 2 + v[2] ** 2, v[1] ** 2, np.linalg.norm(a)])
        out.append(for_marker)
    return np.concatenate(np.array(out), axis=1)


def log_energies(frames):
    e = energies(frames)
    return np.log(1 + 1.5 * np.concatenate([e[:1], e]))


def pair_mean(n, value):
    return float(np.mean([value(i, j) for i in range(n) for j in range(i + 1, n)]))


def warping_path(a, b):
    cost = np.full((len(a) + 1, len(b) + 1), np.inf)
    cost[0, 0] = 0
    for s in range(1, len(a) + 1):
        for t in range(1, len(b) + 1):
            here = np.sum((a[s - 1] - b[t - 1]) ** 2)
            cost[s, t] = here + min(cost[s - 1, t - 1], cost[s - 1, t], cost[s, t - 1])
    s, t, path = len(a), len(b), []
    while s > 0 and t > 0:
        path.append((s - 1, t - 1))
        s, t = min([(s - 1, t - 1), (s - 1, t), (s, t - 1)], key=lambda at: cost[at])
    return path


def published(group):
    values = []
    for first in range(0, group.shape[1] - PIECE + 1, PIECE):
        piece = group[:, first : first + PIECE]
        f = [log_energies(x) for x in piece]
        x = [np.concatenate(markers(p), axis=1) - np.tile(p[:, 0:3].astype(float).mean(axis=0), 4) for p in piece]

        def value(i, j):
            return np.mean([f[i][s] @ f[j][t] for s, t in warping_path(x[i], x[j])])

        values.append(pair_mean(len(piece), value))
    return float(np.mean(values))


def correlation(group):
    f = [log_energies(x) for x in group]
    f = [x - x.mean(axis=0) for x in f]
    return pair_mean(len(f), lambda i, j: np.sum(f[i] * f[j]) / math.sqrt(np.sum(f[i] ** 2) * np.sum(f[j] ** 2)))


def own_velocities(frames):
    q = frames[:-1, 9:13].astype(float)
    yaw = 2 * np.arctan2(q[:, 2], q[:, 0])
    v = np.diff(frames[:, 0:3].astype(float), axis=0) * FPS
    return Rotation.from_rotvec(np.outer(-yaw, [0, 1, 0])).apply(v)


def unison(group, bar_frames):
    bar = round(bar_frames)
    u = [own_velocities(x) for x in group]

    def r(a, b, lag, half):
        t = np.array([t for t in range(len(a)) if t // bar % 2 == half and 0 <= t + lag < len(b)])
        x, y = a[t] - a[t].mean(axis=0), b[t + lag] - b[t + lag].mean(axis=0)
        return np.sum(x * y) / math.sqrt(np.sum(x**2) * np.sum(y**2))

    def value(i, j):
        lags = sorted(range(-bar, bar + 1), key=abs)
        best = [max(lags, key=lambda lag: r(u[i], u[j], lag, half)) for half in (0, 1)]
        return (r(u[i], u[j], best[0], 1) + r(u[i], u[j], best[1], 0)) / 2

    return pair_mean(len(u), value)


def main():
    group = dancers(np.random.default_rng(5), 317)
    np.save(HERE / "group.npy", group)
    floor = group[:, :, [0, 2]].astype(float)
    n, n_frames = floor.shape[:2]
    distances = np.array([np.linalg.norm(floor[i] - floor[j], axis=1) for i in range(n) for j in range(i + 1, n)])
    # No distance lies where rounding would decide whether bodies touch.
    assert np.min(np.abs(distances - 2 * RADIUS)) > 1e-6
    features = [
        np.log(1 + 1.5 * np.mean([energies(x[t : t + CHUNK]).mean(axis=0) for x in group], axis=0))
        for t in range(0, n_frames - CHUNK + 1, CHUNK)
    ]
    pieces = [group[:, t : t + PIECE] for t in range(0, n_frames - PIECE + 1, PIECE)]
    f = [[np.log(1 + 1.5 * energies(x).mean(axis=0)) for x in piece] for piece in pieces]
    u = [own_velocities(x) for x in group]
    middle = floor.mean(axis=0)
    golden = {
        "bar_frames": BAR,
        "radius_m": RADIUS,
        "kinetic_features": [[float(x) for x in row] for row in features],
        "gmc_published": published(group),
        "gmc_correlation": correlation(group),
        "unison": unison(group, BAR),
        "tif": float(np.mean(distances < 2 * RADIUS)),
        "touching_pairs_per_frame": float(np.sum(distances < 2 * RADIUS) / n_frames),
        "least_separation_m": float(distances.min()),
        "coverage_m2": float(np.mean([ConvexHull(floor[:, t]).volume for t in range(n_frames)])),
        "spread_m": float(np.mean(np.sqrt(np.mean(np.sum((floor - middle) ** 2, axis=2), axis=0)))),
        "dancer_diversity": float(
            np.mean([pair_mean(n, lambda i, j: np.linalg.norm(p[i] - p[j])) for p in f])
        ),
        "dancer_velocity_difference_m_s": pair_mean(
            n, lambda i, j: np.mean(np.linalg.norm(u[i] - u[j], axis=1))
        ),
    }
    (HERE / "measures.json").write_text(json.dumps(golden, indent=1) + "\n")


if __name__ == "__main__":
    main()
