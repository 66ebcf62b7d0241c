#!/usr/bin/env python3
"""Golden file for fusion, from SciPy's solvers.

    python3 fusion.py          (numpy and scipy; run in any directory; seed 21, fixed)

Written:

  fusion.npy    [47, 23] float64: decoded position 3, velocity 3, acceleration 3, quaternion wxyz 4 and
                angular velocity 3; fused position 3 and quaternion 4

Positions solve the pentadiagonal normal equations by `scipy.linalg.solveh_banded`, from the positions
themselves (not from shifts). Orientations minimise the sum over rotation vectors by
`scipy.optimize.least_squares` with numerical derivatives, rotations by `scipy.spatial.transform`.
"""

import pathlib

import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

HERE = pathlib.Path(__file__).resolve().parent
FPS = 30.0
N = 47
# Variances of x, y, z.
POSITION = np.array([4e-4, 1e-4, 4e-4])
VELOCITY = np.array([0.02, 0.05, 0.02])
ACCELERATION = np.array([3.0, 7.0, 3.0])
ORIENTATION = np.array([3e-3, 1e-2, 3e-3])
ANGULAR_VELOCITY = np.array([0.08, 0.03, 0.08])


def differences(n, order):
    d = np.eye(n)
    for _ in range(order):
        d = np.diff(d, axis=0) * FPS
    return d


def fuse_axis(p, v, a, axis):
    d1, d2 = differences(N, 1), differences(N, 2)
    A = (
        np.eye(N) / POSITION[axis]
        + d1.T @ d1 / VELOCITY[axis]
        + d2.T @ d2 / ACCELERATION[axis]
    )
    b = p / POSITION[axis] + d1.T @ v[: N - 1] / VELOCITY[axis]
    b = b + d2.T @ a[: N - 2] / ACCELERATION[axis]
    band = np.zeros((3, N))
    for k in range(3):
        band[k, : N - k] = np.diagonal(A, -k)
    return solveh_banded(band, b, lower=True)


def from_wxyz(q):
    return Rotation.from_quat(np.roll(q, -1, axis=1))


def fuse_orientations(q, omega):
    decoded = from_wxyz(q)

    def residuals(x):
        turned = Rotation.from_rotvec(x.reshape(N, 3)) * decoded
        error = (turned * decoded.inv()).as_rotvec() / np.sqrt(ORIENTATION)
        rate = FPS * (turned[1:] * turned[:-1].inv()).as_rotvec()
        missing = (rate - omega[: N - 1]) / np.sqrt(ANGULAR_VELOCITY)
        return np.concatenate([error.ravel(), missing.ravel()])

    found = least_squares(
        residuals, np.zeros(3 * N), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    turned = Rotation.from_rotvec(found.x.reshape(N, 3)) * decoded
    return np.roll(turned.as_quat(), 1, axis=1)


def main():
    rng = np.random.default_rng(21)
    t = np.arange(N + 2.0)
    p = np.stack([0.3 * np.sin(0.2 * t), 0.9 + 0.05 * np.sin(0.6 * t), 0.03 * t], 1)
    r = Rotation.from_euler("YXZ", np.stack([0.25 * t, 0.5 * np.sin(0.3 * t), 0.2 * np.cos(t)], 1))
    v = np.diff(p, axis=0) * FPS
    a = np.diff(v, axis=0) * FPS
    omega = (r[1:] * r[:-1].inv()).as_rotvec() * FPS

    def decoded(x, variance):
        return x[:N] + rng.normal(0, 1, (N, 3)) * np.sqrt(variance)

    p, v, a = decoded(p, POSITION), decoded(v, VELOCITY), decoded(a, ACCELERATION)
    omega = decoded(omega, ANGULAR_VELOCITY)
    error = Rotation.from_rotvec(rng.normal(0, 1, (N, 3)) * np.sqrt(ORIENTATION))
    q = np.roll((error * r[:N]).as_quat(), 1, axis=1)
    q *= rng.choice([-1.0, 1.0], (N, 1))
    fused = np.stack([fuse_axis(p[:, i], v[:, i], a[:, i], i) for i in range(3)], 1)
    np.save(HERE / "fusion.npy", np.hstack([p, v, a, q, omega, fused, fuse_orientations(q, omega)]))


if __name__ == "__main__":
    main()
