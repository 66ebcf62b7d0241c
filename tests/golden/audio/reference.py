"""The 163 audio features as librosa computes them: what `motiongen extract` must equal.

`features(y)` takes a mono signal at 44.1 kHz and returns the normalised blocks, their stack, tempo
and beats. make.py writes the golden files with it, benches/librosa_peer.py times it.
"""

import librosa
import numpy as np

SAMPLE_RATE_HZ = 44_100
FPS = 30.0
HOP = int(SAMPLE_RATE_HZ / FPS)
BINS_PER_OCTAVE = 36


def load(path) -> np.ndarray:
    return librosa.load(path, sr=SAMPLE_RATE_HZ, mono=True)[0]


def features(y: np.ndarray) -> dict[str, np.ndarray]:
    at = {"sr": SAMPLE_RATE_HZ, "hop_length": HOP}
    out = {}

    mel = librosa.feature.melspectrogram(y=y, n_mels=128, fmin=20.0, fmax=8000.0, **at)
    mel_db = librosa.power_to_db(mel, ref=np.max)
    out["mel"] = (mel_db - mel_db.min()) / (mel_db.max() - mel_db.min() + 1e-8)

    out["chroma"] = librosa.feature.chroma_cqt(y=y, n_chroma=12, **at)

    mfcc = librosa.feature.mfcc(y=y, n_mfcc=20, **at)
    mean, std = mfcc.mean(axis=1, keepdims=True), mfcc.std(axis=1, keepdims=True)
    out["mfcc"] = (mfcc - mean) / (std + 1e-8)

    rms = librosa.feature.rms(y=y, hop_length=HOP)[0]
    out["rms"] = rms / (rms.max() + 1e-8)

    centroid = librosa.feature.spectral_centroid(y=y, **at)[0]
    low, high = centroid.min(), centroid.max()
    out["spectral_centroid"] = (centroid - low) / (high - low + 1e-8)

    onset = librosa.onset.onset_strength(y=y, **at)
    out["onset_strength"] = onset / (onset.max() + 1e-8)

    tempo, beats = librosa.beat.beat_track(y=y, **at)
    out = {name: block.astype(np.float32) for name, block in out.items()}
    out["features"] = np.vstack(list(out.values()))
    # An array of one element, or a plain 0.0 when there is no onset at all.
    out["tempo"] = np.float64(np.atleast_1d(tempo)[0])
    out["beat_frames"] = np.asarray(beats, dtype=np.int64)
    out["beat_times"] = librosa.frames_to_time(beats, **at).astype(np.float32)
    return out


def tuning(y: np.ndarray) -> tuple[float, list[int]]:
    """Returns the tuning that the chroma is built on, in bins of 1/36 octave, and how many votes
    the first two candidates got: one vote decides when they are close."""
    value = librosa.estimate_tuning(y=y, sr=SAMPLE_RATE_HZ, bins_per_octave=BINS_PER_OCTAVE)
    pitch, magnitude = librosa.piptrack(y=y, sr=SAMPLE_RATE_HZ)
    is_peak = pitch > 0
    if not is_peak.any():
        return float(value), [0, 0]
    loud = pitch[is_peak & (magnitude >= np.median(magnitude[is_peak]))]
    offset = np.mod(BINS_PER_OCTAVE * librosa.hz_to_octs(loud), 1.0)
    offset[offset >= 0.5] -= 1.0
    edges = np.linspace(-0.5, 0.5, 101)
    votes, _ = np.histogram(offset, edges)
    assert edges[votes.argmax()] == value
    return float(value), sorted((int(n) for n in votes), reverse=True)[:2]
