#!/usr/bin/env python3
"""Golden files for the capture conversion, from an independent NumPy/SciPy statement of it.

    python3 make.py            (numpy and scipy; run in any directory; seed 20, fixed)

Inputs beside this script, real captures cut to their first frames, data otherwise untouched:

  cmu_01_01.bvh   first 331 of 2752 frames, 120 fps, Z-Y-X rotations, CMU units. Subject 1 trial 1,
                  "forward jumps, turn around". The data used in this project was obtained from
                  mocap.cs.cmu.edu; that database was created with funding from NSF EIA-0196217.
                  BVH conversion by B. Hahne; free for use in research and commercial projects.
  mocapbank.bvh   first 241 of 455 frames, 30 fps, Z-X-Y rotations, centimetres, tabs and CRLF.
                  MocapBank take, a test file of the crate bvh_anim 0.4.0
                  (MIT licence, copyright 2019 George Burton).

Written:

  waltz.beats.txt, plain.beats.txt     beat times, with and without beat numbers
  mocapbank_15fps.bvh                  the first 121 frames of mocapbank.bvh declared as 15 fps
  six_channels.bvh                     drawn: 60 fps, six channels on every joint in odd orders,
                                       a calibration pop after frame 3
  short.bvh                            drawn: 13 frames at 16 fps, 5 units high (feet), a root that keeps
                                       its offset on the axes it has no channel for
  <case>.expected.npy                  [T, 25] float64, before rounding to single precision
  lowpass.npy                          [2, cases, n]: inputs and outputs of the low-pass
  spline.npy                           [4, n]: knots, values, query times, values there
  style_root_only.npy                  [T, 8]: style of the mocapbank root without its joints

Frames are [position 3, velocity 3, acceleration 3, quaternion wxyz 4, angular velocity 3, phase 1,
style 8] at 30 fps; metres, +Y up, quaternion body to world, forward differences.
"""

import pathlib

import numpy as np
import scipy
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

HERE = pathlib.Path(__file__).resolve().parent
SEED = 20
FPS = 30.0
STYLE = [  # centre, scale
    (np.log(0.5), 1.5),
    (np.log(0.6), 1.2),
    (0.35, 0.35),
    (0.27, 0.06),
    (2.2, 1.0),
    (0.35, 0.3),
    (0.92, 0.08),
    (0.35, 0.2),
]


# Quaternions, Hamilton w, x, y, z.


def qmul(a, b):
    w1, x1, y1, z1 = np.moveaxis(a, -1, 0)
    w2, x2, y2, z2 = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        -1,
    )


def qconj(q):
    return q * np.array([1, -1, -1, -1.0])


def qrot(q, v):
    u = q[..., 1:]
    return v + 2 * np.cross(u, np.cross(u, v) + q[..., :1] * v)


def qnorm(q):
    return q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-12)


def qaxis(axis, angle):
    q = np.zeros(np.shape(angle) + (4,))
    q[..., 0] = np.cos(angle / 2)
    q[..., 1 + axis] = np.sin(angle / 2)
    return q


def qcont(q):
    q = q.copy()
    for t in range(1, len(q)):
        if np.dot(q[t], q[t - 1]) < 0:
            q[t] = -q[t]
    return -q if q[0, 0] < 0 else q


def angvel(q):
    d = qmul(q[1:], qconj(q[:-1]))
    d = np.where(d[:, :1] < 0, -d, d)
    s = np.linalg.norm(d[:, 1:], axis=1)
    a = 2 * np.arctan2(s, d[:, 0])
    return d[:, 1:] * np.where(s > 1e-9, a / np.maximum(s, 1e-12), 2.0)[:, None] * FPS


# Reading: times [N], nodes [N, J, 3] in file units, root orientation [N, 4], body height in file units.


def frame_time(text):
    """The interval of the only usual rate that is written so, rounded or cut; else the number."""
    value = float(text)
    last = 10.0 ** -len(text.partition(".")[2])
    if abs(round(1 / value) * value - 1) < 1e-12:
        return value
    usual = (r for r in range(1, 10001) if r % 5 == 0 or r % 12 == 0)
    rates = [r for r in usual if value - 0.5 * last <= 1 / r <= value + last]
    return 1 / rates[0] if len(rates) == 1 else value


def body_height(names, parents, P):
    """Along bones from ankles over the pelvis to the top of the head; else the greatest extent."""
    bone = [0.0 if p < 0 else np.median(np.linalg.norm(P[:, j] - P[:, p], axis=1)) for j, p in enumerate(parents)]

    def above(j):
        return [] if j < 0 else [j] + above(parents[j])

    heads = [j for j, n in enumerate(names) if "head" in n]
    feet = [j for j, n in enumerate(names) if "foot" in n]
    feet = [j for j in feet if not set(above(parents[j])) & set(feet)]
    if heads and feet:
        head = heads[0]
        ways = [sum(bone[j] for j in set(above(head)) ^ set(above(foot))) for foot in feet]
        top = max(sum(bone[k] for k in above(j) if k not in above(head)) for j in range(len(names)) if head in above(j))
        return float(np.mean(ways)) + top
    extents = np.percentile((P.max(1) - P.min(1)).max(1), 90)
    ends = [j for j in range(len(names)) if j not in parents] + [0]
    longest = max(sum(bone[k] for k in set(above(a)) ^ set(above(b))) for a in ends for b in ends)
    return float(max(extents, 0.62 * longest))


def read_bvh(path):
    tok = path.read_text(errors="replace").split()
    names, parents, offs, chans, stack = [], [], [], [], []
    i = 0
    while tok[i] != "MOTION":
        t = tok[i]
        if t in ("ROOT", "JOINT", "End"):
            names.append("" if t == "End" else tok[i + 1].lower())
            parents.append(stack[-1] if stack else -1)
            offs.append([0, 0, 0])
            chans.append([])
            cur = len(parents) - 1
            i += 2
        elif t == "{":
            stack.append(cur)
            i += 1
        elif t == "}":
            stack.pop()
            i += 1
        elif t == "OFFSET":
            offs[stack[-1]] = [float(x) for x in tok[i + 1 : i + 4]]
            i += 4
        elif t == "CHANNELS":
            n = int(tok[i + 1])
            chans[stack[-1]] = tok[i + 2 : i + 2 + n]
            i += 2 + n
        else:
            i += 1
    assert tok[i + 1] == "Frames:"
    n = int(tok[i + 2])
    dt = frame_time(tok[i + 5])
    i += 6
    nch = sum(map(len, chans))
    data = np.array(tok[i : i + n * nch], float).reshape(n, nch)
    offs = np.array(offs)
    P = np.zeros((n, len(parents), 3))
    Q = np.zeros((n, len(parents), 4))
    c = 0
    for j, parent in enumerate(parents):
        pos = np.tile(offs[j], (n, 1)).astype(float)
        q = np.tile([1.0, 0, 0, 0], (n, 1))
        for ch in chans[j]:
            axis = "XYZ".index(ch[0])
            if ch[1:] == "position":
                pos[:, axis] = data[:, c]
            else:
                q = qmul(q, qaxis(axis, np.radians(data[:, c])))
            c += 1
        if parent < 0:
            P[:, j], Q[:, j] = pos, q
        else:
            P[:, j] = P[:, parent] + qrot(Q[:, parent], pos)
            Q[:, j] = qmul(Q[:, parent], q)
    height = body_height(names, parents, P)
    start = 0
    if n > 20:
        jump = np.linalg.norm(np.diff(P, axis=0), axis=2).max(1)
        k = max(2, int(min(1.0 / dt, n * 0.1)))
        near = np.maximum(np.r_[0, jump[:-1]], np.r_[jump[1:], 0])
        is_pop = (jump > max(15 * np.median(jump), 6 * height * dt)) & (jump > 3 * near)
        big = np.nonzero(is_pop[:k])[0]
        if len(big):
            start = int(big[-1]) + 1
    return np.arange(start, n) * dt - start * dt, P[start:], Q[start:, 0], start, height


def unit_scale(height):
    units = [(0.01, 0.15), (1.0, 0.15), (0.0254, 0), (0.001, 0), (0.3048, 0), (0.0254 / 0.45, 0)]
    found = [(abs(np.log(height * u / 1.65)) - bonus, u) for u, bonus in units if 0.9 <= height * u <= 2.4]
    return min(found)[1] if found else 1.7 / height


# Filtering, resampling, style, phase.


def lowpass(x, fs, fc):
    if not fc or fs <= 2.2 * fc or len(x) < 30:
        return x
    return sosfiltfilt(butter(4, fc, fs=fs, output="sos"), x, axis=0)


def resample(t, x, tt):
    return CubicSpline(t, x, axis=0)(tt)


def win_mean(x, n):
    k = np.hanning(n + 2)[1:-1]
    k /= k.sum()
    pad = n // 2
    y = np.concatenate([np.repeat(x[:1], pad, 0), x, np.repeat(x[-1:], n - 1 - pad, 0)])
    return np.apply_along_axis(lambda c: np.convolve(c, k, "valid"), 0, y)


def style8(p, v, a, q, J):
    T = len(p)
    n = min(60, T)
    sp2 = (v**2).sum(1)
    S = np.zeros((T, 8))
    jer = np.vstack([np.diff(a, axis=0) * FPS, np.zeros((1, 3))])
    jer[-1] = jer[-2]
    S[:, 0] = np.log(np.sqrt(win_mean(sp2, n)) + 1e-3)
    if J is not None:
        R = J - p[:, None]
        lv = np.gradient(R, 1 / FPS, axis=0)
        e = (lv**2).sum(2).mean(1)
        H = np.percentile(J[..., 1] - J[..., 1].min(1, keepdims=True), 99)
        S[:, 3] = win_mean(np.linalg.norm(R, axis=2).mean(1) / H, n)
        la = np.gradient(lv, 1 / FPS, axis=0).reshape(T, -1)
    else:
        e = (a**2).sum(1) / 16
        var = win_mean(p[:, 1] ** 2, n) - win_mean(p[:, 1], n) ** 2
        S[:, 3] = 0.2 + np.sqrt(np.maximum(var, 0))
        la = a
    S[:, 1] = np.log(np.sqrt(win_mean(e, n)) + 1e-3)
    xz = p[:, [0, 2]]
    S[:, 2] = np.sqrt(np.maximum((win_mean(xz**2, n) - win_mean(xz, n) ** 2).sum(1), 0))
    rms_jerk, rms_speed = np.sqrt(win_mean((jer**2).sum(1), n)), np.sqrt(win_mean(sp2, n))
    S[:, 4] = np.log(rms_jerk * 0.0625 / (rms_speed + 0.02) + 1e-3)
    env = np.sqrt(e + sp2)[:, None]
    env = env - win_mean(env, n)
    den = win_mean(env**2, n)[:, 0] + 1e-6
    best = np.zeros(T)
    for lag in range(8, 38):
        if lag >= T:
            break
        pr = np.zeros((T, 1))
        pr[: T - lag] = env[: T - lag] * env[lag:]
        pr[T - lag :] = pr[T - lag - 1]
        best = np.maximum(best, win_mean(pr, n)[:, 0] / den)
    S[:, 5] = win_mean(np.clip(best, 0, 1), n)
    up = qrot(q, np.array([0, 1.0, 0]))[:, 1]
    height = win_mean(p[:, 1] / max(np.percentile(p[:, 1], 95), 1e-6), n)
    S[:, 6] = height - (1 - win_mean(up, n)) * 0.5
    aa = np.hstack([a, la])
    high = aa - lowpass(aa, FPS, 3.0)
    S[:, 7] = win_mean((high**2).sum(1), n) / (win_mean((aa**2).sum(1), n) + 0.05)
    return np.stack([np.tanh((S[:, k] - c) / s) for k, (c, s) in enumerate(STYLE)], 1)


def bar_phase(tt, beats, beats_per_bar):
    b = np.loadtxt(beats, ndmin=2)
    times = b[:, 0]
    first = 0 if b.shape[1] < 2 else int(np.argmax(b[:, 1] == 1))
    k = np.arange(len(times)) - first
    period = np.median(np.diff(times))
    x = np.interp(tt, times, k)
    x = np.where(tt < times[0], k[0] + (tt - times[0]) / period, x)
    x = np.where(tt > times[-1], k[-1] + (tt - times[-1]) / period, x)
    return np.mod(x / beats_per_bar, 1.0)


def convert(path, beats=None, beats_per_bar=4, root_only=False):
    t, J, q, start, height = read_bvh(path)
    scale = unit_scale(height)
    J = J * scale
    fs = 1 / np.median(np.diff(t))
    q = qcont(qnorm(q))
    cut = 8.0 if fs > FPS * 1.05 else min(8.0, 0.4 * fs)
    p = lowpass(J[:, 0], fs, cut)
    q = qnorm(lowpass(q, fs, cut))
    J = lowpass(J.reshape(len(J), -1), fs, cut).reshape(J.shape)
    tt = np.arange(int(np.floor(t[-1] * FPS + 1e-6)) + 1) / FPS
    P = resample(t, p, tt)
    Q = qcont(qnorm(resample(t, q, tt)))
    off = np.array([P[0, 0], np.percentile(J[..., 1], 1), P[0, 2]])
    P, J = P - off, J - off
    V = np.diff(P, axis=0) * FPS
    A = np.diff(V, axis=0) * FPS
    W = angvel(Q)
    T = len(A)
    P, V, Q, W, tk = P[:T], V[:T], Q[:T], W[:T], tt[:T]
    JJ = resample(t, J.reshape(len(J), -1), tk).reshape(T, J.shape[1], 3)
    S = style8(P, V, A, Q, None if root_only else JJ)
    phase = np.zeros(T) if beats is None else bar_phase(tk, beats, beats_per_bar)
    print(f"{path.name}: {len(t)} at {fs:.3f} fps, {start} dropped, {height * scale:.2f} m in {scale:g} m, cutoff {cut:g} Hz -> {T}")
    return np.hstack([P, V, A, Q, W, phase[:, None], S])


# Drawn inputs.


def write_beats(rng):
    times = 1.1 + np.cumsum(0.61 + rng.normal(0, 0.015, 9))
    lines = [f"{t:.4f}\t{(i + 1) % 3 + 1}" for i, t in enumerate(times)]
    waltz = "# waltz, begins on the second beat\n\n" + "\n".join(lines) + "\n"
    (HERE / "waltz.beats.txt").write_text(waltz)
    plain = "\n".join(f"{t:.4f}" for t in 0.2 + np.cumsum(rng.uniform(0.2, 0.5, 4)))
    (HERE / "plain.beats.txt").write_text(plain)


def write_15_fps():
    head, motion = (HERE / "mocapbank.bvh").read_bytes().decode().split("MOTION\r\n")
    rows = motion.split("\r\n")[2:123]
    text = head + "MOTION\r\nFrames: 121\r\nFrame Time: 0.0666667\r\n" + "\r\n".join(rows)
    (HERE / "mocapbank_15fps.bvh").write_bytes(text.encode())


SIX = """HIERARCHY
ROOT hips
{
  OFFSET 10 -4 3
  CHANNELS 6 Yrotation Zposition Xrotation Yposition Zrotation Xposition
  JOINT left leg
  {
    OFFSET 0.1 0 0
    CHANNELS 6 Xrotation Xposition Yrotation Yposition Zrotation Zposition
    End Site
    {
      OFFSET 0 -0.5 0.05
    }
  }
  JOINT head
  {
    OFFSET 0 0.4 0
    CHANNELS 3 Xrotation Zrotation Yrotation
    End Site
    {
      OFFSET 0 0.35 0.02
    }
  }
}
MOTION
"""

SHORT = """HIERARCHY
ROOT base
{
  OFFSET 0.5 3 -1
  CHANNELS 5 Zposition Xposition Zrotation Yrotation Xrotation
  JOINT top
  {
    OFFSET 0 2 0
    CHANNELS 2 Xrotation Zrotation
    End Site
    {
      OFFSET 0 0.2 0
    }
  }
  End Site
  {
    OFFSET 0 -3 0
  }
}
MOTION
"""


def waves(rng, n, rate, columns):
    """Sums of three sines per column: [n, columns], column = (mean, size)."""
    t = np.arange(n)[:, None] / rate
    out = []
    for mean, size in columns:
        f, ph = rng.uniform(0.2, 4.0, 3), rng.uniform(0, 2 * np.pi, 3)
        out.append(mean + size * np.sin(2 * np.pi * f * t + ph).sum(1) / 3)
    return np.stack(out, 1)


def write_drawn(path, head, rows, rate):
    body = "\n".join(" ".join(f"{x:.5f}" for x in row) for row in rows)
    path.write_text(f"{head}Frames: {len(rows)}\nFrame Time: {1 / rate:.7f}\n{body}\n")


def main():
    print(f"numpy {np.__version__}, scipy {scipy.__version__}, seed {SEED}")
    rng = np.random.default_rng(SEED)
    write_beats(rng)
    write_15_fps()
    six = [(170, 70), (0, 1), (5, 20), (0.9, 0.1), (0, 15), (2, 1)]
    six += [(0, 40), (0.1, 0.01), (0, 20), (-0.4, 0.05), (0, 20), (0, 0.02)] + [(0, 30)] * 3
    rows = waves(rng, 157, 60.0, six)
    rows[:3] = 0.0
    rows[:3, 3] = 0.9
    write_drawn(HERE / "six_channels.bvh", SIX, rows, 60.0)
    short = [(0, 2), (1, 2), (0, 10), (90, 60), (0, 10), (0, 30), (0, 30)]
    write_drawn(HERE / "short.bvh", SHORT, waves(rng, 13, 16.0, short), 16.0)

    cases = [
        ("cmu_01_01", None, 4),
        ("mocapbank", "waltz", 3),
        ("mocapbank_15fps", None, 4),
        ("six_channels", "plain", 4),
        ("short", None, 4),
    ]
    for case, beats, beats_per_bar in cases:
        beats = beats and HERE / f"{beats}.beats.txt"
        np.save(HERE / f"{case}.expected.npy", convert(HERE / f"{case}.bvh", beats, beats_per_bar))
    root = convert(HERE / "mocapbank.bvh", root_only=True)
    np.save(HERE / "style_root_only.npy", root[:, 17:])

    pairs = []
    for fs, fc in ((120.0, 8.0), (30.0, 8.0), (30.0, 3.0), (15.0, 6.0), (97.3, 1.7)):
        x = np.cumsum(rng.normal(0, 1, 67)) + 5.0
        pairs.append((x, lowpass(x, fs, fc)))
    np.save(HERE / "lowpass.npy", np.ascontiguousarray(np.array(pairs).transpose(1, 0, 2)))

    knots = np.cumsum(rng.uniform(0.05, 1.0, 23))
    values = rng.normal(0, 2, 23)
    query = np.linspace(knots[0] - 0.3, knots[-1] + 0.3, 23)
    curve = CubicSpline(knots, values)(query)
    np.save(HERE / "spline.npy", np.stack([knots, values, query, curve]))


if __name__ == "__main__":
    main()
