//! Kernels of the constant-Q transform (Brown and Puckette 1992; Schörkhuber and Klapuri 2010), as
//! librosa's `cqt` with 252 bins, 36 per octave, from C1 on, makes and thins them.
//!
//! Seven octaves of 36 bins. The highest is taken from the signal at 44.1 kHz, the others from the
//! signal at half that rate, each with its own transform length N = 2048 … 65,536. A bin of the
//! constant-Q transform is a weighted sum of 10 to 24 bins of the *unwindowed* DFT of N samples.

use std::f64::consts::{PI, TAU};
use std::ops::RangeInclusive;
use std::sync::{Arc, Mutex, PoisonError};

use realfft::num_complex::Complex64;

use super::tuning::{BINS_PER_OCTAVE, Tuning};
use super::{HOP, SAMPLE_RATE_HZ};
use crate::instructions::vectorized;

/// Octaves from C1 on.
pub const N_OCTAVES: usize = 7;
/// DFT bins that kernels of any octave and tuning use; a test keeps it.
pub const DFT_BINS: RangeInclusive<usize> = 88..=208;
/// How many they are.
pub const N_DFT_BINS: usize = *DFT_BINS.end() - *DFT_BINS.start() + 1;
/// Share of a kernel's total magnitude that is left out, from the smallest bins up.
const SPARSITY: f64 = 0.01;
/// What librosa's transform of the kernels in single precision adds to a row's cumulative share, all
/// the way up from bins that hold nothing but its rounding: at an octave's lowest row, and how much
/// more (less) at its highest. Highest octave first.
///
/// Without it one row in a thousand keeps a bin less, which moves chroma by 10⁻³. Fitted so that
/// all rows of all 100 tunings keep what librosa keeps, with a margin of 2·10⁻⁷
/// (`tests/golden/audio_kernels`).
const ROUNDING_SHARE: [(f64, f64); N_OCTAVES] = [
    (1.785e-7, -1.078e-7),
    (1.785e-7, -1.078e-7),
    (4.260e-7, -2.499e-7),
    (1.176e-6, -3.162e-7),
    (1.906e-6, -7.147e-7),
    (2.639e-6, -9.136e-7),
    (3.815e-6, -9.427e-7),
];
/// Bins around a kernel's centre whose magnitudes are summed exactly; what lies beyond is less
/// than 10⁻⁵ of the total, and estimated.
const EXACT_BINS: usize = 384;
/// Bins on either side of a kernel's centre among which its weights are sought; it keeps 24 at most.
const REACH_BINS: usize = 24;

/// Where an octave is taken from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Octave {
    /// 0 is the highest.
    pub index: usize,
    pub rate_hz: f64,
    /// Samples between frames, at the octave's rate: 1/30 s.
    pub hop: usize,
    /// Length of the transform.
    pub n_fft: usize,
}

/// Returns the octaves, highest first. The lengths hold for every tuning.
pub fn octaves() -> [Octave; N_OCTAVES] {
    std::array::from_fn(|index| {
        let decimation = if index == 0 { 1 } else { 2 };
        Octave {
            index,
            rate_hz: f64::from(SAMPLE_RATE_HZ) / decimation as f64,
            hop: HOP / decimation,
            n_fft: 2048 << index.saturating_sub(1),
        }
    })
}

/// The bins [`DFT_BINS`] of one frame, real and imaginary parts apart so that sums vectorise.
#[derive(Clone, Debug, PartialEq)]
pub struct Spectrum {
    pub re: [f64; N_DFT_BINS],
    pub im: [f64; N_DFT_BINS],
}

impl Default for Spectrum {
    fn default() -> Self {
        Self { re: [0.0; N_DFT_BINS], im: [0.0; N_DFT_BINS] }
    }
}

/// Terms that a kernel sums side by side.
const LANES: usize = 4;

/// One row of the transform: C = |Σ_f B\[f\] · D\[f\]|.
#[derive(Clone, Debug, PartialEq)]
pub struct Kernel {
    /// Index of the first weight's DFT bin, counted from the start of [`DFT_BINS`].
    first: usize,
    /// Real and imaginary parts of the weights, padded with zeros to whole lanes.
    re: Vec<[f64; LANES]>,
    im: Vec<[f64; LANES]>,
}

impl Kernel {
    fn new(first: usize, weights: &[Complex64]) -> Self {
        let padded = weights.len().next_multiple_of(LANES);
        // Padding must not reach beyond the bins.
        let first_padded = first.min(N_DFT_BINS - padded);
        let weight = |i: usize| {
            let at = (first_padded + i).checked_sub(first);
            at.and_then(|at| weights.get(at)).copied().unwrap_or_default()
        };
        let lanes = |part: fn(Complex64) -> f64| {
            let lane = |chunk: usize| std::array::from_fn(|l| part(weight(chunk * LANES + l)));
            (0..padded / LANES).map(lane).collect()
        };
        Self { first: first_padded, re: lanes(|w| w.re), im: lanes(|w| w.im) }
    }

    /// Writes the lanes of the bin's real and imaginary part in a frame of its octave.
    #[inline(always)]
    fn add_up(&self, spectrum: &Spectrum, re: &mut [f64; LANES], im: &mut [f64; LANES]) {
        let bins = self.first..self.first + self.re.len() * LANES;
        let d_re = spectrum.re[bins.clone()].as_chunks::<LANES>().0;
        let d_im = spectrum.im[bins].as_chunks::<LANES>().0;
        let (mut re_lanes, mut im_lanes) = ([0.0; LANES], [0.0; LANES]);
        for (((b_re, b_im), d_re), d_im) in self.re.iter().zip(&self.im).zip(d_re).zip(d_im) {
            for l in 0..LANES {
                re_lanes[l] += b_re[l] * d_re[l] - b_im[l] * d_im[l];
            }
            for l in 0..LANES {
                im_lanes[l] += b_re[l] * d_im[l] + b_im[l] * d_re[l];
            }
        }
        *re = re_lanes;
        *im = im_lanes;
    }

    /// Returns the weights with their DFT bins.
    #[cfg(test)]
    fn weights(&self) -> impl Iterator<Item = (usize, Complex64)> {
        let parts = self.re.iter().flatten().zip(self.im.iter().flatten());
        let weights = parts.map(|(&re, &im)| Complex64::new(re, im));
        (DFT_BINS.start() + self.first..).zip(weights).filter(|(_, w)| w.norm() > 0.0)
    }
}

/// The kernels of one octave, lowest first.
pub type OctaveKernels = Vec<Kernel>;

vectorized! {
    /// Writes the magnitudes of an octave's bins in one of its frames, lowest first.
    pub fn magnitudes(
        kernels: &[Kernel], spectrum: &Spectrum, magnitudes: &mut [f64; BINS_PER_OCTAVE],
    ) {
        // Lanes that lie in memory are added to as vectors; sums across them come after.
        let mut re = [[0.0; LANES]; BINS_PER_OCTAVE];
        let mut im = [[0.0; LANES]; BINS_PER_OCTAVE];
        for ((kernel, re), im) in kernels.iter().zip(&mut re).zip(&mut im) {
            kernel.add_up(spectrum, re, im);
        }
        for ((magnitude, re), im) in magnitudes.iter_mut().zip(re).zip(im) {
            let sum = |[a, b, c, d]: [f64; LANES]| a + b + c + d;
            let (re, im) = (sum(re), sum(im));
            *magnitude = (re * re + im * im).sqrt();
        }
    }
}

/// Returns the kernels of all octaves for a tuning, highest octave first.
///
/// Tunings are cached: an estimate has only 100 possible values.
pub fn kernels(tuning: Tuning) -> Arc<Vec<OctaveKernels>> {
    type CachedKernels = (Tuning, Arc<Vec<OctaveKernels>>);
    static MADE: Mutex<Vec<CachedKernels>> = Mutex::new(Vec::new());
    /// An estimated tuning is one of 100; more are kept of none that a user may give.
    const MAX_MADE: usize = 128;
    let find = |made: &[CachedKernels]| {
        made.iter().find(|(of, _)| *of == tuning).map(|(_, kernels)| Arc::clone(kernels))
    };
    let lock = || MADE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(kernels) = find(&lock()) {
        return kernels;
    }
    // Made outside the lock, so that other threads find theirs meanwhile.
    let kernels = Arc::new(octaves().map(|octave| octave_kernels(octave, tuning)).to_vec());
    let mut made = lock();
    if made.len() < MAX_MADE && find(&made).is_none() {
        made.push((tuning, Arc::clone(&kernels)));
    }
    kernels
}

fn octave_kernels(octave: Octave, tuning: Tuning) -> OctaveKernels {
    let lowest = BINS_PER_OCTAVE * (N_OCTAVES - 1 - octave.index);
    (lowest..lowest + BINS_PER_OCTAVE).map(|k| Wavelet::new(octave, tuning, k).kernel()).collect()
}

/// |b|, without the guard against overflow that makes `norm` slow.
fn magnitude(b: &Complex64) -> f64 {
    b.norm_sqr().sqrt()
}

/// A Hann-windowed complex exponential of about Q periods.
struct Wavelet {
    n_fft: usize,
    /// Frequency in cycles per sample.
    frequency: f64,
    /// K: number of samples.
    n: usize,
    /// Position of the first sample in the frame of N.
    offset: usize,
    /// What librosa multiplies a row by, and divides the result by.
    scale: f64,
    /// The row's part of [`ROUNDING_SHARE`].
    rounding_share: f64,
    /// Sine and cosine of π/K.
    window_turn: (f64, f64),
}

impl Wavelet {
    /// Bin k of the transform: f = f_min · 2^(k/36), Q = 1/α, α = (2^(1/18) − 1)/(2^(1/18) + 1).
    fn new(octave: Octave, tuning: Tuning, k: usize) -> Self {
        let per_octave = BINS_PER_OCTAVE as f64;
        // C1 lies 45 semitones below A4.
        let min_hz = 440.0 * 2f64.powf(-45.0 / 12.0) * 2f64.powf(tuning.bins() / per_octave);
        let hz = min_hz * 2f64.powf(k as f64 / per_octave);
        let ratio = 2f64.powf(2.0 / per_octave);
        let q = (ratio + 1.0) / (ratio - 1.0);
        let length = q * octave.rate_hz / hz;
        let n = ((length / 2.0).floor() - (-length / 2.0).floor()) as usize;
        let n_fft = octave.n_fft as f64;
        let rate_hz = f64::from(SAMPLE_RATE_HZ);
        let (lowest, more) = ROUNDING_SHARE[octave.index];
        let position = (k % BINS_PER_OCTAVE) as f64 / (BINS_PER_OCTAVE - 1) as f64;
        Self {
            rounding_share: lowest + more * position,
            window_turn: (PI / n as f64).sin_cos(),
            n_fft: octave.n_fft,
            frequency: hz / octave.rate_hz,
            n,
            offset: (octave.n_fft - n) / 2,
            // L1 norm of the window, K/2; L/N; the octave's rate; √L at 44.1 kHz.
            scale: 2.0 / n as f64 * (length / n_fft) * (rate_hz / octave.rate_hz).sqrt()
                / (q * rate_hz / hz).sqrt(),
        }
    }

    /// The phase advance per sample relative to DFT bin m: φ = 2π(f − m/N).
    fn phi(&self, m: usize) -> f64 {
        TAU * (self.frequency - m as f64 / self.n_fft as f64)
    }

    /// DFT bin m of the wavelet in its frame, but for a phase that all bins share.
    ///
    /// e^(−2πi·m·offset/N) · W(φ), W(φ) = ½S(φ) − ¼S(φ + 2π/K) − ¼S(φ − 2π/K),
    /// S(φ) = Σⱼ e^(iφj) = e^(iφ(K−1)/2) · sin(Kφ/2)/sin(φ/2)
    fn spectrum(&self, m: usize) -> Complex64 {
        let n = self.n as f64;
        let phi = self.phi(m);
        // S(φ ± 2π/K) has the same sin(Kφ/2) but for its sign, so one sine serves all three.
        let (sin, cos) = (phi / 2.0).sin_cos();
        let (turn_sin, turn_cos) = self.window_turn;
        let above = sin * turn_cos + cos * turn_sin;
        let below = sin * turn_cos - cos * turn_sin;
        if sin.abs().min(above.abs()).min(below.abs()) < 1e-7 {
            return self.spectrum_at_peak(m);
        }
        let (a, b) = (0.25 / above, 0.25 / below);
        let window = Complex64::new(0.5 / sin - turn_cos * (a + b), turn_sin * (a - b));
        // Reduced before it becomes an angle, which keeps it exact.
        let turns = (m * self.offset % self.n_fft) as f64 / self.n_fft as f64;
        let phase = phi / 2.0 * (n - 1.0) - TAU * turns;
        window * Complex64::from_polar((n * phi / 2.0).sin(), phase)
    }

    /// [`Wavelet::spectrum`] where a term is 0/0: at the middle or a first zero of the window.
    fn spectrum_at_peak(&self, m: usize) -> Complex64 {
        let n = self.n as f64;
        let sum = |phi: f64| {
            let half = phi / 2.0;
            let ratio = if half.sin().abs() < 1e-12 { n } else { (n * half).sin() / half.sin() };
            Complex64::from_polar(1.0, half * (n - 1.0)) * ratio
        };
        let phi = self.phi(m);
        let window = sum(phi) * 0.5 - (sum(phi + TAU / n) + sum(phi - TAU / n)) * 0.25;
        let turns = (m * self.offset % self.n_fft) as f64 / self.n_fft as f64;
        window * Complex64::from_polar(1.0, -TAU * turns)
    }

    /// Returns Σ |W| over the DFT bins of `bins`, none of them near the wavelet's frequency.
    ///
    /// |W| = |sin(Kφ/2)| · |½/sin(φ/2) − ¼e^(−iπ/K)/sin(φ/2 + π/K) − ¼e^(iπ/K)/sin(φ/2 − π/K)|.
    /// Both sines advance by rotation from bin to bin.
    fn magnitude_sum(&self, bins: std::ops::Range<usize>) -> f64 {
        let n = self.n as f64;
        let half = self.phi(bins.start) / 2.0;
        let mut slow = Complex64::from_polar(1.0, half);
        let mut fast = Complex64::from_polar(1.0, n * half);
        let slow_step = Complex64::from_polar(1.0, -PI / self.n_fft as f64);
        let fast_step = Complex64::from_polar(1.0, -PI * n / self.n_fft as f64);
        let (sin, cos) = self.window_turn;
        let mut sum = 0.0;
        for _ in bins {
            let above = slow.im * cos + slow.re * sin;
            let below = slow.im * cos - slow.re * sin;
            let (a, b) = (1.0 / above, 1.0 / below);
            let re = 0.5 / slow.im - 0.25 * cos * (a + b);
            let im = 0.25 * sin * (a - b);
            sum += fast.im.abs() * (re * re + im * im).sqrt();
            slow *= slow_step;
            fast *= fast_step;
        }
        sum
    }

    /// Returns the wavelet's sparse spectrum: the bins that hold all but [`SPARSITY`] of its
    /// magnitude.
    fn kernel(&self) -> Kernel {
        // Bins further from the wavelet's frequency than this are below any threshold.
        let centre = (self.frequency * self.n_fft as f64).round() as usize;
        let start = centre.saturating_sub(REACH_BINS).max(*DFT_BINS.start());
        let end = (centre + REACH_BINS).min(*DFT_BINS.end()) + 1;
        let bins: Vec<Complex64> = (start..end).map(|m| self.spectrum(m)).collect();
        let mut magnitudes: Vec<f64> = bins.iter().map(magnitude).collect();
        let near: f64 = magnitudes.iter().sum();
        let far = self.magnitude_sum(0..start) + self.magnitude_above(end);
        // librosa sorts all magnitudes of the row and keeps those from the one on at which the
        // cumulative sum reaches the share.
        let total = near + far;
        magnitudes.sort_unstable_by(f64::total_cmp);
        let mut cumulative = far;
        let mut threshold = 0.0;
        for magnitude in &magnitudes {
            cumulative += magnitude;
            if cumulative / total + self.rounding_share >= SPARSITY {
                threshold = *magnitude;
                break;
            }
        }
        let is_kept = |b: &Complex64| magnitude(b) >= threshold;
        let first = bins.iter().position(is_kept).unwrap_or(0);
        let last = bins.iter().rposition(is_kept).unwrap_or(0);
        let weight = |b: &Complex64| if is_kept(b) { b * self.scale } else { Complex64::default() };
        Kernel::new(
            start - DFT_BINS.start() + first,
            &bins[first..=last].iter().map(weight).collect::<Vec<_>>(),
        )
    }

    /// Returns Σ |W| over the bins from `start` up to the Nyquist frequency.
    fn magnitude_above(&self, start: usize) -> f64 {
        let nyquist = self.n_fft / 2;
        let end = (start + EXACT_BINS).min(nyquist + 1);
        let exact = self.magnitude_sum(start..end);
        if end > nyquist {
            return exact;
        }
        // Beyond, |W| falls with the cube of the distance Δ from the centre, and |sin| averages to
        // 2/π: Σ A/Δ³ from Δ₀ to Δ₁ is about A/2 · (1/Δ₀² − 1/Δ₁²), with A from the last 64 bins.
        let centre = self.frequency * self.n_fft as f64;
        let recent = self.magnitude_sum(end - 64..end) / 64.0;
        let middle = end as f64 - 32.5 - centre;
        let a = recent * middle.powi(3);
        let distance = |bin: f64| 1.0 / (bin - centre).powi(2);
        exact + a / 2.0 * (distance(end as f64 - 0.5) - distance(nyquist as f64 + 0.5))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::audio::stft::hann;

    /// The definition: the wavelet in time, transformed bin by bin, thinned by sorting.
    fn naive(octave: Octave, tuning: Tuning, k: usize) -> Vec<(usize, f64)> {
        let w = Wavelet::new(octave, tuning, k);
        let first = -((w.n + 1) as isize / 2);
        let g: Vec<Complex64> = (0..w.n)
            .map(|j| {
                let angle = TAU * (first + j as isize) as f64 * w.frequency;
                Complex64::from_polar(hann(j, w.n), angle)
            })
            .collect();
        let bins: Vec<f64> = (0..=w.n_fft / 2)
            .map(|m| {
                let term = |j: usize| {
                    let turns = (m * (w.offset + j) % w.n_fft) as f64 / w.n_fft as f64;
                    g[j] * Complex64::from_polar(1.0, -TAU * turns)
                };
                (0..w.n).map(term).sum::<Complex64>().norm()
            })
            .collect();
        let mut sorted = bins.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let total: f64 = sorted.iter().sum();
        let mut cumulative = 0.0;
        let reaches = |b: &&f64| {
            cumulative += **b;
            cumulative / total + w.rounding_share >= SPARSITY
        };
        let threshold = *sorted.iter().find(reaches).expect("a bin reaches 1 %");
        let kept = bins.iter().enumerate().filter(|(_, b)| **b >= threshold);
        kept.map(|(m, b)| (m, b * w.scale)).collect()
    }

    #[test]
    fn kernels_are_the_thinned_spectra_of_their_wavelets() {
        // The naive transform takes N²/2 steps, so only the shorter octaves and few bins.
        for (octave, steps) in [(0, 5), (1, 7), (2, 17), (3, 35)] {
            let octave = octaves()[octave];
            for bins in [-0.5, -0.07, 0.0, 0.33, 0.49] {
                let tuning = Tuning::new(bins).expect("in range");
                let lowest = BINS_PER_OCTAVE * (N_OCTAVES - 1 - octave.index);
                let kernels = octave_kernels(octave, tuning);
                for (i, kernel) in kernels.iter().enumerate().step_by(steps) {
                    let found: Vec<_> = kernel.weights().map(|(m, w)| (m, w.norm())).collect();
                    let expected = naive(octave, tuning, lowest + i);
                    let members =
                        |row: &[(usize, f64)]| row.iter().map(|b| b.0).collect::<Vec<_>>();
                    assert_eq!(members(&found), members(&expected), "{octave:?} {bins} bin {i}");
                    for ((m, f), (_, e)) in found.iter().zip(&expected) {
                        assert!(
                            (f - e).abs() < 1e-9 * e,
                            "{octave:?} {bins} bin {i}, {m}: {f} {e}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn kernels_keep_the_bins_that_librosa_keeps() {
        let golden = include_str!("../../tests/golden/audio_kernels/kept.txt");
        let lines: Vec<_> = golden.lines().filter(|line| !line.starts_with('#')).collect();
        assert_eq!(lines.len(), 100);
        for (i, line) in lines.iter().enumerate() {
            let tuning = Tuning::new(i as f64 / 100.0 - 0.5).expect("in range");
            let kernels = kernels(tuning);
            let rows: Vec<_> = kernels.iter().rev().flatten().collect();
            let counts: Vec<_> =
                line.split(' ').map(|n| n.parse::<usize>().expect("a count")).collect();
            assert_eq!((rows.len(), counts.len()), (252, 252));
            for (k, (row, count)) in rows.iter().zip(counts).enumerate() {
                assert_eq!(row.weights().count(), count, "tuning {tuning}, row {k}");
                // A row that reached the end of the range might go on beyond it.
                assert!(row.weights().all(|(m, _)| m > *DFT_BINS.start() && m < *DFT_BINS.end()));
            }
        }
    }
}
