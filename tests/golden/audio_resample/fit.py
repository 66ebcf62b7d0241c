#!/usr/bin/env python3
"""Fits the filters of src/audio/resample.rs to the impulse responses of libsoxr (quality HQ).

    fit.py             prints the constants (needs NumPy, SciPy and soxr)

libsoxr converts most ratios in two or three stages. Their product is a Kaiser-windowed sinc times
the slow droop of the last, shorter stage, here a cosine series over half samples of the lower rate:

    h(z) = c0 k(z) + sum_j cj/2 (k(z - j/2) + k(z + j/2)),  k(z) = F sinc(F z) kaiser(z / L, beta)
"""

import numpy as np
import soxr
from scipy.optimize import least_squares
from scipy.special import i0

N_TERMS = 8
CUT_OFF = 0.9568718


def response(rate):
    """Returns times in samples of the lower rate, and the response to an impulse at time 0."""
    lower = min(rate, 44100)
    n = int(4096 * max(1, rate / 44100))
    times, values = [], []
    for shift in range(min(rate // np.gcd(rate, 44100), 40)):
        x = np.zeros(2 * n)
        x[n + shift] = 1
        y = soxr.resample(x, rate, 44100, quality="soxr_hq")
        t = (np.arange(len(y)) * rate / 44100 - (n + shift)) * lower / rate
        near = np.abs(t) < 150
        times.append(t[near])
        values.append(y[near] * rate / lower)
    t, h = np.concatenate(times), np.concatenate(values)
    thin = max(1, len(t) // 4000)
    return t[::thin], h[::thin]


def kernel(z, half_length, beta):
    inside = np.sqrt(np.maximum(0, 1 - (z / half_length) ** 2))
    window = np.where(np.abs(z) < half_length, i0(beta * inside) / i0(beta), 0)
    return CUT_OFF * np.sinc(CUT_OFF * z) * window


def terms(t, half_length, beta, n_terms):
    pairs = [(kernel(t - j / 2, half_length, beta) + kernel(t + j / 2, half_length, beta)) / 2
             for j in range(1, n_terms + 1)]
    return np.array([kernel(t, half_length, beta), *pairs]).T


def fit(rate, n_terms):
    t, h = response(rate)

    def solve(p):
        a = terms(t, *p, n_terms)
        c = np.linalg.lstsq(a, h, rcond=1e-9)[0] if n_terms else np.array([1.0])
        return c, a @ c - h

    starts = [[97.25, 13.0], [102.0, 13.7], [107.0, 14.4]]
    fits = [least_squares(lambda p: solve(p)[1], s, x_scale=[1, 0.1]) for s in starts]
    best = min(fits, key=lambda f: f.cost)
    c, error = solve(best.x)
    print(f"{rate} Hz: half length {best.x[0]:.3f}, beta {best.x[1]:.4f}, max. error "
          f"{np.abs(error).max():.1e}, droop {np.array2string(c, precision=9, suppress_small=True)}")


if __name__ == "__main__":
    print("one stage")
    for rate in (22050, 88200, 11025):
        fit(rate, 0)
    print("several stages: UP, FAR_UP, DOWN, FAR_DOWN")
    for rate in (32000, 8000, 48000, 192000):
        fit(rate, N_TERMS)
