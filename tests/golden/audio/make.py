#!/usr/bin/env python3
"""Writes the clips beside this script and, with librosa, the features that each must give.

    python3 make.py            (librosa and soundfile as in benches/requirements.txt)

Cuts real music out of tests/data/music and draws the rest; nothing is random from run to run. For
each clip NAME there is a NAME.npz:

  features            float32 [163, T]: mel 128, chroma 12, mfcc 20, rms, spectral centroid and
                      onset strength, normalised over the file; 30 frames per second
  tempo               float64, beats per minute
  beat_times          float32, seconds; beat_frames int64
  tuning              float64, in bins of 1/36 octave
  n_samples           int64, length of the signal once decoded, mixed to mono and at 44.1 kHz
  y_mid, y_mid_at     float32, up to 512 of those samples, and the index of the first
  raw_rms, raw_centroid, raw_onset      float32 [T], before they are normalised
  raw_onset_median    float32 [T], the onset envelope that tempo and beats are found in

and an entry in manifest.json. There, tuning_votes are those of the first two candidates for the
tuning: clips in which they nearly tie are refused, as one vote more would give another chroma.
What is rounding noise in librosa is to be left out of comparisons: undefined_rows are whole feature
rows, undefined_chroma_frames are frames of the chroma at the edge of digital silence. Where its
kernels see nothing but zeros, the chroma is 0.
"""

import hashlib
import importlib.metadata
import json
import pathlib
import struct
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import librosa
import numpy as np
import reference
import soundfile
import soxr

HERE = pathlib.Path(__file__).resolve().parent
MUSIC = HERE.parents[1] / "data" / "music"
RATE_HZ = reference.SAMPLE_RATE_HZ
FADE_S = 0.02
N_MID = 512
LEAST_VOTE_MARGIN = 1.1
# Of the strongest bin of the constant-Q transform of the file; less is rounding.
LEAST_CHROMA = 1e-8
MAX_BYTES = 1_800_000
PACKAGES = ["librosa", "numpy", "scipy", "numba", "soxr", "soundfile"]


# Signals, [samples, channels], within -1 and 1.


def seconds(length_s: float) -> np.ndarray:
    return np.arange(round(length_s * RATE_HZ)) / RATE_HZ


def noise(seed: int, length: int, amplitude: float) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-amplitude, amplitude, length)


def clicks() -> np.ndarray:
    time_s = seconds(4.0)
    since_click_s = time_s % 0.5
    click = 0.8 * np.sin(2 * np.pi * 1000 * since_click_s) * np.exp(-since_click_s / 0.012)
    return np.where(since_click_s < 0.1, click, 0.0)[:, None]


def sine() -> np.ndarray:
    return 0.5 * np.sin(2 * np.pi * 440 * 2 ** (35 / 1200) * seconds(1.0))[:, None]


def silence() -> np.ndarray:
    return np.zeros((RATE_HZ, 2))


def short() -> np.ndarray:
    """0.2 s of a tone with partials, in noise."""
    time_s = seconds(0.2)
    tone = sum(0.3 / k * np.sin(2 * np.pi * 345 * k * time_s) for k in range(1, 6))
    return np.stack([tone, -0.2 * tone], axis=1) + noise(3, len(time_s), 0.05)[:, None]


def one_sample() -> np.ndarray:
    return np.array([[0.5]])


def gap() -> np.ndarray:
    """White noise, and digital silence in the middle, longer than the longest kernel (3 s)."""
    y = noise(25, 4 * RATE_HZ, 0.02)
    y[RATE_HZ // 4 : -RATE_HZ // 4] = 0.0
    return y[:, None]


def quiet_tail() -> np.ndarray:
    """A loud chord, and after half a second only tones and noise about 100 dB below it."""
    time_s = seconds(2.0)
    chord = sum(0.3 * np.sin(2 * np.pi * f * time_s) for f in (220.5, 277.8, 330.4))
    tones = sum(4e-6 * np.sin(2 * np.pi * f * time_s) for f in (98.0, 524.0, 1976.0))
    tail = tones + noise(5, len(time_s), 4e-6)
    loud = np.where(time_s < 0.5, np.exp(-3 * time_s), 0.0)
    return (chord * loud + tail)[:, None]


@dataclass
class Cut:
    """Four seconds or more of a song of the demo library."""

    song: str
    start_s: float
    length_s: float = 4.0
    rate_hz: int = RATE_HZ
    is_mono: bool = False
    gain: float = 1.0

    def __call__(self) -> np.ndarray:
        y, rate_hz = soundfile.read(MUSIC / self.song, always_2d=True)
        start = round(self.start_s * rate_hz)
        y = self.gain * y[start : start + round(self.length_s * rate_hz)]
        if self.is_mono:
            y = y.mean(axis=1, keepdims=True)
        elif y.shape[1] == 1:
            sys.exit(f"{self.song} is mono and cannot become a stereo clip; take another song")
        if self.rate_hz != rate_hz:
            y = soxr.resample(y, rate_hz, self.rate_hz)
            # A resampler may differ from librosa's in the first few samples of a file that begins
            # with a jump.
            n = round(FADE_S * self.rate_hz)
            y[:n] *= np.linspace(0, 1, n)[:, None]
        return np.clip(y, -1, 1)

    def says(self) -> str:
        text = f"tests/data/music/{self.song}, {self.length_s:g} s from {self.start_s:g} s"
        changes = [
            "mixed to mono" if self.is_mono else "",
            f"gain {self.gain:g}" if self.gain != 1 else "",
            f"resampled to {self.rate_hz} Hz, faded in" if self.rate_hz != RATE_HZ else "",
        ]
        return ", ".join([text, *filter(None, changes)])


@dataclass
class Clip:
    file: str
    make: Callable[[], np.ndarray]
    subtype: str
    licence: str = "as the rest of this project"
    options: dict = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.file.partition(".")[0]

    @property
    def rate_hz(self) -> int:
        return self.make.rate_hz if isinstance(self.make, Cut) else RATE_HZ

    def source(self) -> str:
        return self.make.says() if isinstance(self.make, Cut) else "drawn by make.py"


KENTA_CHO = "BSD-2-Clause, Kenta Cho (tests/data/licenses/BSD-2-Clause-Kenta-Cho.txt)"
CARLOS_VIOLA = "MIT, Carlos Viola Iborra (tests/data/licenses/MIT-Carlos-Viola-Iborra.txt)"
LEZAARTH = "CC0-1.0, lezaarth (https://freesound.org/people/lezaarth/sounds/242591/)"
SMALLEST = {"compression_level": 1.0}

CLIPS = [
    Clip("clicks_120bpm.flac", clicks, "PCM_16", options=SMALLEST),
    Clip("sine_440_plus_35_cents.flac", sine, "PCM_16", options=SMALLEST),
    Clip("silence_stereo.flac", silence, "PCM_16", options=SMALLEST),
    Clip("short_200ms_stereo.wav", short, "PCM_16"),
    Clip("one_sample.wav", one_sample, "PCM_16"),
    Clip("noise_with_gap.flac", gap, "PCM_16", options=SMALLEST),
    Clip("quiet_tail.flac", quiet_tail, "PCM_24", options=SMALLEST),
    Clip(
        "music_22k_mono_s16.wav",
        Cut("mu-cade/mcd1.ogg", 15.0, rate_hz=22_050, is_mono=True),
        "PCM_16",
        KENTA_CHO,
    ),
    Clip(
        "music_44k_stereo_s24.flac",
        Cut("sonic-pi/tabla.flac", 0.0, gain=0.02),
        "PCM_24",
        LEZAARTH,
        SMALLEST,
    ),
    Clip(
        "music_48k_stereo.ogg",
        Cut("noiz2sa/stg0.ogg", 12.5, rate_hz=48_000),
        "VORBIS",
        KENTA_CHO,
        {"compression_level": 0.7},
    ),
    Clip(
        "music_44k_stereo.mp3",
        Cut("frets-on-fire/metal_madness.ogg", 18.5),
        "MPEG_LAYER_III",
        CARLOS_VIOLA,
        {"bitrate_mode": "CONSTANT", "compression_level": 0.7},
    ),
    Clip(
        "music_32k_mono_f32.wav",
        Cut("parsec47/ptn0.ogg", 54.0, rate_hz=32_000, is_mono=True),
        "FLOAT",
        KENTA_CHO,
    ),
]


# Clips on disk, the same bytes every time.


def ogg_crc(page: bytes) -> int:
    crc = 0
    for byte in page:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1) ^ (0x04C11DB7 if crc & 0x8000_0000 else 0)
            crc &= 0xFFFF_FFFF
    return crc


def without_chance(data: bytes) -> bytes:
    """Takes out the random stream number of an Ogg file and the time in a float WAV."""
    data = bytearray(data)
    if data.startswith(b"OggS"):
        at = 0
        while at < len(data):
            n_segments = data[at + 26]
            end = at + 27 + n_segments + sum(data[at + 27 : at + 27 + n_segments])
            data[at + 14 : at + 18] = struct.pack("<I", 1)
            data[at + 22 : at + 26] = bytes(4)
            data[at + 22 : at + 26] = struct.pack("<I", ogg_crc(data[at:end]))
            at = end
    elif data.startswith(b"RIFF") and (peak := data.find(b"PEAK", 0, 256)) >= 0:
        data[peak + 12 : peak + 16] = bytes(4)
    return bytes(data)


def write(clip: Clip) -> pathlib.Path:
    path = HERE / clip.file
    soundfile.write(path, clip.make(), clip.rate_hz, subtype=clip.subtype, **clip.options)
    path.write_bytes(without_chance(path.read_bytes()))
    return path


def references(y: np.ndarray) -> dict[str, np.ndarray]:
    at = {"y": y, "sr": RATE_HZ, "hop_length": reference.HOP}
    found = reference.features(y)
    mid = max(0, (len(y) - N_MID) // 2)
    raw = {
        "raw_rms": librosa.feature.rms(y=y, hop_length=reference.HOP)[0],
        "raw_centroid": librosa.feature.spectral_centroid(**at)[0],
        "raw_onset": librosa.onset.onset_strength(**at),
        "raw_onset_median": librosa.onset.onset_strength(aggregate=np.median, **at),
    }
    kept = ["features", "tempo", "beat_times", "beat_frames"]
    return {
        **{name: found[name] for name in kept},
        "n_samples": np.int64(len(y)),
        **{name: array.astype(np.float32) for name, array in raw.items()},
        "y_mid": y[mid : mid + N_MID],
        "y_mid_at": np.int64(mid),
    }


def undefined_rows(y: np.ndarray, features: np.ndarray) -> list[int]:
    """Returns the rows of MFCC that are constant but for rounding, which normalising blows up."""
    mfcc = librosa.feature.mfcc(y=y, sr=RATE_HZ, n_mfcc=20, hop_length=reference.HOP)
    return [140 + i for i in np.flatnonzero(mfcc.std(axis=1) < 1e-3) if features[140 + i].any()]


def undefined_chroma_frames(y: np.ndarray, tuning: float) -> list[int]:
    at = {"sr": RATE_HZ, "hop_length": reference.HOP}
    bins = {"n_bins": 7 * reference.BINS_PER_OCTAVE, "bins_per_octave": reference.BINS_PER_OCTAVE}
    strongest = np.abs(librosa.cqt(y, tuning=tuning, **at, **bins)).max(axis=0)
    is_noise = (strongest > 0) & (strongest < LEAST_CHROMA * strongest.max())
    return [int(i) for i in np.flatnonzero(is_noise)]


def digest(path: pathlib.Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> None:
    # librosa warns of signals shorter than its windows, and of an empty set of pitches.
    warnings.simplefilter("ignore")
    for path in HERE.iterdir():
        if path.suffix in (".wav", ".flac", ".ogg", ".mp3", ".npz"):
            path.unlink()
    entries = []
    for clip in CLIPS:
        path = write(clip)
        y = reference.load(path)
        tuning, votes = reference.tuning(y)
        arrays = {**references(y), "tuning": np.float64(tuning)}
        target = HERE / f"{clip.name}.npz"
        np.savez_compressed(target, **arrays)
        n_frames = arrays["features"].shape[1]
        margin = votes[0] / max(votes[1], 1) if votes[0] else float("inf")
        print(
            f"{clip.name:24s} {n_frames:4d} frames, {float(arrays['tempo']):6.1f} bpm, "
            f"{len(arrays['beat_frames'])} beats, tuning {tuning:+.2f} by {votes[0]}:{votes[1]} "
            f"votes ({margin:.2f}), {path.stat().st_size:,} + {target.stat().st_size:,} bytes"
        )
        if margin < LEAST_VOTE_MARGIN:
            sys.exit(f"{clip.name}: the votes on its tuning nearly tie; choose another cut or seed")
        if not all(np.isfinite(a).all() for a in arrays.values()):
            sys.exit(f"{clip.name}: librosa gave values that are not finite")
        entries.append(
            {
                "name": clip.name,
                "file": clip.file,
                "sha256": digest(path),
                "npz_sha256": digest(target),
                "T": n_frames,
                "n_samples": len(y),
                "tuning": tuning,
                "tuning_votes": votes,
                "undefined_rows": undefined_rows(y, arrays["features"]),
                "undefined_chroma_frames": undefined_chroma_frames(y, tuning),
                "source": clip.source(),
                "licence": clip.licence,
            }
        )
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    versions["libsndfile"] = soundfile.__libsndfile_version__
    versions["python"] = sys.version.split()[0]
    manifest = {"made_with": versions, "clips": entries}
    (HERE / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    n_bytes = sum(path.stat().st_size for path in HERE.iterdir() if path.is_file())
    print(f"{n_bytes:,} bytes in all")
    if n_bytes > MAX_BYTES:
        sys.exit(f"more than {MAX_BYTES:,} bytes; cut shorter")


if __name__ == "__main__":
    main()
