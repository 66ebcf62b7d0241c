#!/usr/bin/env python3
"""Makes motions whose verdict is known, from real motion of a library.

    python tests/adversaries/make.py TAKES OUT

TAKES has one folder for each song, named by its number, with takes of real motion to that song, all from the song's
first frame on: `TAKES/SONG/0.npy`, `1.npy`, … ([T, 25], float32), and its bars, `TAKES/SONG/bars.npy` ([T]): how many
bars have passed at each frame. Take 0 is the one that is told apart: every case is made of it, and `OUT/CASE/SONG.npy`
is what becomes of it. Whoever runs it gets the same bytes.
"""

import argparse
import pathlib

import numpy as np

FPS = 30.0
HEIGHT_M = 0.95


def quaternion_product(a, b):
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


def continuous(q):
    """Signs such that neighbours are near, the first w >= 0."""
    q = q.copy()
    if q[0, 0] < 0:
        q = -q
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0))
    q[1:] *= flips[:, None]
    return q


def turn_rates(q):
    """World-frame angular velocity from frame to frame: log(q[t+1] conj(q[t])) FPS."""
    turn = quaternion_product(q[1:], q[:-1] * np.array([1, -1, -1, -1.0]))
    turn *= np.where(turn[:, :1] < 0, -1.0, 1.0)
    size = np.linalg.norm(turn[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(size, turn[:, :1])
    return np.where(size > 1e-9, turn[:, 1:] / np.maximum(size, 1e-9), 0.0) * angle * FPS


def from_poses(position, q, phase, style):
    """All channels of poses, by forward differences; two frames fewer, as the library makes them."""
    q = continuous(q / np.linalg.norm(q, axis=1, keepdims=True))
    velocity = np.diff(position, axis=0) * FPS
    acceleration = np.diff(velocity, axis=0) * FPS
    n = len(acceleration)
    frames = np.zeros((n, 25))
    frames[:, 0:3] = position[:n]
    frames[:, 3:6] = velocity[:n]
    frames[:, 6:9] = acceleration
    frames[:, 9:13] = q[:n]
    frames[:, 13:16] = turn_rates(q)[:n]
    frames[:, 16] = phase[:n]
    frames[:, 17:25] = style[:n]
    return frames.astype(np.float32)


def poses(take):
    take = take.astype(float)
    return take[:, 0:3], take[:, 9:13], take[:, 16], take[:, 17:25]


def real(song, songs, rng):
    return songs[song]["takes"][0]


def upside_down(song, songs, rng):
    """Turned by half a circle about the z axis, at the height of a body."""
    p, q, phase, style = poses(songs[song]["takes"][0])
    over = p * np.array([-1, -1, 1.0]) + np.array([0, 2 * HEIGHT_M, 0])
    half_turn = np.broadcast_to(np.array([0, 0, 0, 1.0]), q.shape)
    return from_poses(over, quaternion_product(half_turn, q), phase, style)


def faster(song, songs, rng):
    """The same motion at 1.2 × its speed; the music is as fast as it was."""
    p, q, phase, style = poses(songs[song]["takes"][0])
    t = np.arange(0, len(p) - 1, 1.2)
    at = np.arange(len(p))
    p = np.stack([np.interp(t, at, x) for x in p.T], 1)
    q = np.stack([np.interp(t, at, x) for x in continuous(q).T], 1)
    return from_poses(p, q, phase[: len(p)], style[: len(p)])


def jitter(song, songs, rng):
    """3 cm of noise on every position."""
    p, q, phase, style = poses(songs[song]["takes"][0])
    return from_poses(p + rng.normal(0, 0.03, p.shape), q, phase, style)


def reversed_in_time(song, songs, rng):
    p, q, phase, style = poses(songs[song]["takes"][0])
    return from_poses(p[::-1], q[::-1], phase, style[::-1])


def beat_early(song, songs, rng):
    """Real motion that is a beat ahead of its music; the phase channel is the music's."""
    p, q, phase, style = poses(songs[song]["takes"][0])
    bars = songs[song]["bars"]
    beat = int(round(len(bars) / (bars[-1] - bars[0]) / songs[song]["beats_per_bar"]))
    return from_poses(p[beat:], q[beat:], phase, style)


def other_song(song, songs, rng):
    """Real motion of the next song of another tempo."""
    own = songs[song]["bar_frames"]
    names = list(songs)
    order = names[names.index(song) + 1 :] + names
    other = next(name for name in order if abs(songs[name]["bar_frames"] / own - 1) > 0.03)
    n = len(songs[song]["takes"][0])
    return songs[other]["takes"][0][:n]


def one_for_all(song, songs, rng):
    """One good motion for all songs."""
    return songs[next(iter(songs))]["takes"][0]


def mixed_takes(song, songs, rng):
    """Positions of one take and velocities of another."""
    take, other = (take.copy() for take in songs[song]["takes"][:2])
    take[:, 3:6] = other[:, 3:6]
    return take


def still(song, songs, rng):
    p, q, phase, style = poses(songs[song]["takes"][0])
    return from_poses(np.repeat(p[:1], len(p), 0), np.repeat(q[:1], len(q), 0), phase, style)


def mean(song, songs, rng):
    """The mean of all channels, the same for every frame of every song."""
    all_frames = np.concatenate([songs[name]["takes"][0] for name in songs]).astype(float)
    constant = all_frames.mean(0)
    constant[9:13] /= np.linalg.norm(constant[9:13])
    n = len(songs[song]["takes"][0])
    return np.repeat(constant[None], n, 0).astype(np.float32)


def noise(song, songs, rng, filtered):
    """Poses of noise that has the mean and the deviation of real motion."""
    p, q, phase, style = poses(songs[song]["takes"][0])
    x = rng.normal(size=(len(p), 7))
    if filtered:
        # 1.6 to 2.4 Hz, where beats are.
        spectrum = np.fft.rfft(x, axis=0)
        hz = np.fft.rfftfreq(len(p), 1 / FPS)
        spectrum[(hz < 1.6) | (hz > 2.4)] = 0
        x = np.fft.irfft(spectrum, len(p), axis=0)
        x /= x.std(0)
    p = p.mean(0) + x[:, :3] * p.std(0)
    q = continuous(q)
    return from_poses(p, q.mean(0) + x[:, 3:] * q.std(0), phase, style)


def white_noise(song, songs, rng):
    return noise(song, songs, rng, False)


def band_noise(song, songs, rng):
    return noise(song, songs, rng, True)


def r2_of_bars(take, bars):
    """R² of the vertical velocity with four free harmonics of the bar."""
    y = np.diff(take[:, 1].astype(float)) * FPS
    phi = bars[: len(y)]
    waves = [f(2 * np.pi * n * phi) for n in range(1, 5) for f in (np.cos, np.sin)]
    x = np.stack([np.ones_like(phi), *waves], 1)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return 1 - (rest**2).sum() / ((y - y.mean()) ** 2).sum()


def best_of_8(song, songs, rng):
    """Of eight pieces of real motion of other songs, from anywhere in them, the one that locks best to this one."""
    own = songs[song]["takes"][0]
    pieces = []
    for _ in range(8):
        other = rng.choice([name for name in songs if name != song])
        takes = songs[other]["takes"]
        take = takes[rng.integers(len(takes))]
        start = int(rng.integers(0, max(1, len(take) // 2)))
        n = min(len(own), len(take) - start)
        piece = take[start : start + n].copy()
        pieces.append(piece)
    n = min(len(piece) for piece in pieces)
    return max((piece[:n] for piece in pieces), key=lambda piece: r2_of_bars(piece, songs[song]["bars"]))


CASES = {
    "real": real,
    "upside_down": upside_down,
    "faster": faster,
    "jitter": jitter,
    "reversed": reversed_in_time,
    "beat_early": beat_early,
    "other_song": other_song,
    "one_for_all": one_for_all,
    "mixed_takes": mixed_takes,
    "still": still,
    "mean": mean,
    "white_noise": white_noise,
    "band_noise": band_noise,
    "best_of_8": best_of_8,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("takes", type=pathlib.Path, help="folders of takes, one for each song")
    parser.add_argument("out", type=pathlib.Path, help="folder for the cases")
    args = parser.parse_args()
    songs = {}
    for folder in sorted(path for path in args.takes.iterdir() if path.is_dir()):
        takes = sorted((path for path in folder.glob("[0-9]*.npy")), key=lambda path: int(path.stem))
        bars = np.load(folder / "bars.npy")
        songs[folder.name] = {
            "takes": [np.load(path) for path in takes],
            "bars": bars,
            "bar_frames": (len(bars) - 1) / (bars[-1] - bars[0]),
            "beats_per_bar": 4,
        }
    for name, make in CASES.items():
        for number, song in enumerate(songs):
            rng = np.random.default_rng([7, sorted(CASES).index(name), number])
            (args.out / name).mkdir(parents=True, exist_ok=True)
            np.save(args.out / name / f"{song}.npy", np.ascontiguousarray(make(song, songs, rng)))


if __name__ == "__main__":
    main()
