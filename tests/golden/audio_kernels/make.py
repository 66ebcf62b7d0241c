#!/usr/bin/env python3
"""How many DFT bins librosa keeps of every kernel of its constant-Q transform.

    make.py            writes kept.txt (needs librosa; 1 min)
    make.py --shares   also prints what single precision adds to the cumulative share of the rows

librosa 0.11 and 1.0 (`__vqt_filter_fft`, `util.sparsify_rows`) transform the kernels in complex64
with SciPy, sort a row's magnitudes and drop the smallest that make up 1 %. Where that share is
reached within 1e-6 of a bin, the rounding of the transform decides whether the bin stays. The
kernels are those of `chroma_cqt`: 252 rows, 36 per octave, hop 1470 at 44.1 kHz.

kept.txt has one line per tuning, -0.50 to 0.49, and in it one count per row, lowest first.
"""

import os
import sys

import librosa
import librosa.core.constantq
import numpy as np
import scipy
import scipy.fft
import scipy.optimize

N_OCTAVES, PER_OCTAVE = 7, 36
N_BINS = N_OCTAVES * PER_OCTAVE
SPARSITY = 0.01


def octaves(tuning):
    """Yields rate, frequencies and relative bandwidths of the octaves, highest first."""
    hz = librosa.cqt_frequencies(
        N_BINS, fmin=librosa.note_to_hz("C1") * 2.0 ** (tuning / PER_OCTAVE), bins_per_octave=PER_OCTAVE)
    alpha = librosa.filters._relative_bandwidth(freqs=hz)
    for octave in range(N_OCTAVES):
        rows = slice(N_BINS - PER_OCTAVE * (octave + 1), N_BINS - PER_OCTAVE * octave)
        yield (44100.0 if octave == 0 else 22050.0), hz[rows], alpha[rows]


def kept(rate, hz, alpha):
    """Returns how many bins each row keeps, asking librosa itself."""
    make = getattr(librosa.core.constantq, "__vqt_filter_fft")
    basis, _, _ = make(rate, hz, 1, 1, SPARSITY, alpha=alpha)
    return np.diff(basis.tocsr().indptr)


def added_shares(rate, hz, alpha):
    """Yields, per row, where the share is reached and what single precision adds to it there."""
    def magnitudes(dtype):
        rows, lengths = librosa.filters.wavelet(freqs=hz, sr=rate, alpha=alpha, pad_fft=True, dtype=dtype)
        rows *= lengths[:, np.newaxis] / rows.shape[1]
        return np.abs(scipy.fft.fft(rows, axis=1)[:, : rows.shape[1] // 2 + 1])

    single, double = magnitudes(np.complex64), magnitudes(np.complex128)
    for s, d in zip(single, double):
        s, d = (np.cumsum(np.sort(x) / x.sum()) for x in (s, d))
        at = int(np.argmin(d < SPARSITY))
        yield float(s[at]) - d[at], d[at - 1], d[at], len(d) - at


def line_through(points):
    """Returns the line over a row's position that keeps what librosa keeps, with the widest margin.

    A point is position, added share, cumulative share before and at the first bin that double
    precision keeps, the count that it keeps, and the count that librosa keeps.
    """
    slope, lowest = np.polyfit([p[0] for p in points], [p[1] for p in points], 1)
    unit = 1e6  # of the shares, for the solver's sake
    a, b = [], []
    for position, _, before, at, n_double, n_kept in points:
        if n_kept == n_double + 1:
            a, b = a + [[-1, -position, 1]], b + [-(SPARSITY - before) * unit]
        elif n_kept == n_double:
            a, b = a + [[1, position, 1]], b + [(SPARSITY - before) * unit]
            a, b = a + [[-1, -position, 1]], b + [-(SPARSITY - at) * unit]
        else:
            raise ValueError(f"librosa keeps {n_kept} bins where {n_double} are expected")
    near = [((1 - 0.2 * np.sign(x)) * x * unit, (1 + 0.2 * np.sign(x)) * x * unit) for x in (lowest, slope)]
    found = scipy.optimize.linprog([0, 0, -1], A_ub=a, b_ub=b, bounds=[*near, (0, None)])
    lowest, slope, margin = found.x / unit
    return f"({lowest:.3e}, {slope:.3e}), margin {margin:.1e}"


def main():
    here = os.path.dirname(os.path.abspath(__file__))
    added = {octave: [] for octave in range(N_OCTAVES)}
    with open(os.path.join(here, "kept.txt"), "w") as out:
        versions = f"librosa {librosa.__version__}, NumPy {np.__version__}, SciPy {scipy.__version__}"
        out.write(f"# made by make.py with {versions}\n")
        for tuning in np.linspace(-0.5, 0.5, 101)[:100]:
            counts = []
            for octave, of in enumerate(octaves(tuning)):
                counts.insert(0, kept(*of))
                if "--shares" in sys.argv:
                    added[octave] += [(k / (PER_OCTAVE - 1), *a, n) for k, (a, n) in
                                      enumerate(zip(added_shares(*of), counts[0]))]
            out.write(" ".join(map(str, np.concatenate(counts))) + "\n")
    for octave, points in added.items():
        if points:
            print(f"octave {octave}: {line_through(points)}")


if __name__ == "__main__":
    main()
