//! The DFT of long frames that advance by a short hop, updated from frame to frame.
//!
//! The low octaves of the constant-Q transform need 121 bins of frames of 4096 … 65,536 samples
//! that advance by 735. Only what enters and what leaves a frame changes its transform:
//!
//! D_t\[f\] = Σ_{n<N} y\[a + n\] · e^(−iθn), θ = 2πf/N, a = 735t − N/2
//! D_{t+1} = e^(735iθ) · (D_t + Σ_{n<735} d\[n\] · e^(−iθn)), d\[n\] = y\[a + N + n\] − y\[a + n\]
//!
//! because e^(−iθN) = 1. Around the middle of the block, n = 367 + m, the sum is
//! e^(−367iθ) · (Σ E\[m\] cos θm − i Σ O\[m\] sin θm) with the even and odd parts E, O of d. Over the
//! 121 neighbouring frequencies the cosines have low numerical rank: they are projected on an
//! orthonormal basis of 17 … 60 vectors first, the sines likewise. All of it is a product of
//! matrices in f64. Compared with one FFT per frame it takes a tenth of the operations.

use std::f64::consts::TAU;
use std::sync::{Arc, LazyLock};

use ndarray::linalg::general_mat_mul;
use ndarray::{Array1, Array2, ArrayView1, s};

use super::cqt::{DFT_BINS, N_DFT_BINS, Octave, Spectrum, octaves};
use crate::instructions::vectorized;

/// Samples by which a frame advances.
const HOP: usize = 735;
/// Samples on either side of a block's middle.
const HALF: usize = HOP / 2;
/// Frames that are updated by one product.
const BATCH: usize = 32;
/// Part of the longest wave that a basis may miss. Errors of this size stay in D for
/// ever, so it lies near the precision of f64.
const RANK_TOLERANCE: f64 = 1e-13;

/// A table of cosines or sines, one row per sample and one column per frequency, as basis · weights.
#[derive(Debug)]
struct Factors {
    /// [HALF + 1, rank], orthonormal columns.
    basis: Array2<f64>,
    /// [rank, N_DFT_BINS].
    weights: Array2<f64>,
}

impl Factors {
    /// Factors the transpose of a table, [N_DFT_BINS, HALF + 1], by Gram–Schmidt with pivoting,
    /// orthogonalised twice (Golub and Van Loan, Matrix Computations, sections 5.2.8 and 5.4.2).
    fn of(waves: &Array2<f64>) -> Self {
        let norm = |wave: ArrayView1<f64>| wave.dot(&wave).sqrt();
        let longest = |rest: &Array2<f64>| {
            let norms = rest.rows().into_iter().map(norm).enumerate();
            norms.fold((0, 0.0), |best, (i, n)| if n > best.1 { (i, n) } else { best })
        };
        let mut rest = waves.clone();
        let (_, scale) = longest(&rest);
        let mut basis: Vec<Array1<f64>> = Vec::new();
        loop {
            let (pivot, length) = longest(&rest);
            if length <= RANK_TOLERANCE * scale || basis.len() == waves.nrows() {
                break;
            }
            let mut q = rest.row(pivot).to_owned();
            for b in &basis {
                let overlap = b.dot(&q);
                q.scaled_add(-overlap, b);
            }
            q /= norm(q.view());
            for mut wave in rest.rows_mut() {
                let overlap = q.dot(&wave);
                wave.scaled_add(-overlap, &q);
            }
            basis.push(q);
        }
        let basis = Array2::from_shape_fn((waves.ncols(), basis.len()), |(m, r)| basis[r][m]);
        let weights = basis.t().dot(&waves.t());
        // Products below run faster over rows.
        let weights = weights.as_standard_layout().into_owned();
        Self { basis, weights }
    }
}

/// What does not depend on the signal.
#[derive(Debug)]
struct Plan {
    n_fft: usize,
    cosines: Factors,
    sines: Factors,
    /// e^(735iθ) and e^(368iθ).
    turns: [Spectrum; 2],
}

impl Plan {
    fn new(n_fft: usize) -> Self {
        let theta = |i: usize| TAU * (DFT_BINS.start() + i) as f64 / n_fft as f64;
        let waves = |wave: fn(f64) -> f64| {
            Array2::from_shape_fn((N_DFT_BINS, HALF + 1), |(i, m)| wave(theta(i) * m as f64))
        };
        let turn = |samples: usize| {
            let angle = |i: usize| theta(i) * samples as f64;
            Spectrum {
                re: std::array::from_fn(|i| angle(i).cos()),
                im: std::array::from_fn(|i| angle(i).sin()),
            }
        };
        Self {
            n_fft,
            cosines: Factors::of(&waves(f64::cos)),
            sines: Factors::of(&waves(f64::sin)),
            turns: [turn(HOP), turn(HOP - HALF)],
        }
    }

    /// Returns the plan of an octave that is not among the two highest.
    fn of(octave: Octave) -> Option<Arc<Self>> {
        static MADE: LazyLock<Vec<Arc<Plan>>> = LazyLock::new(|| {
            octaves().iter().skip(2).map(|o| Arc::new(Plan::new(o.n_fft))).collect()
        });
        MADE.iter().find(|plan| plan.n_fft == octave.n_fft).cloned()
    }
}

/// Follows the bins [`DFT_BINS`] of a stream's frames; frame t is centred at sample 735t.
pub struct SlidingDft {
    plan: Arc<Plan>,
    /// D of the latest frame.
    spectrum: Spectrum,
    /// Samples from the start of the latest frame on.
    buffer: Vec<f32>,
    /// Samples at the buffer's start that the latest frame has left behind.
    start: usize,
    /// Frames that come before the first that counts; the very first sees only zeros.
    n_before: usize,
    /// Zeros at the end of the latest frame.
    n_zeros: usize,
    n_in: usize,
    n_out: usize,
    work: Work,
}

struct Work {
    even: Array2<f64>,
    odd: Array2<f64>,
    projected: Array2<f64>,
    cosine_sums: Array2<f64>,
    sine_sums: Array2<f64>,
}

impl SlidingDft {
    /// Starts a stream for an octave; `None` for the two highest, whose frames are too short.
    pub fn new(octave: Octave) -> Option<Self> {
        let plan = Plan::of(octave)?;
        let half = plan.n_fft / 2;
        let n_before = half.div_ceil(HOP);
        let rank = plan.cosines.weights.nrows().max(plan.sines.weights.nrows());
        Some(Self {
            spectrum: Spectrum::default(),
            // Frame −n_before ends at or before sample 0.
            buffer: vec![0.0; HOP * n_before + half],
            start: 0,
            n_before,
            n_zeros: plan.n_fft,
            n_in: 0,
            n_out: 0,
            work: Work {
                even: Array2::zeros((BATCH, HALF + 1)),
                odd: Array2::zeros((BATCH, HALF + 1)),
                projected: Array2::zeros((BATCH, rank)),
                cosine_sums: Array2::zeros((BATCH, N_DFT_BINS)),
                sine_sums: Array2::zeros((BATCH, N_DFT_BINS)),
            },
            plan,
        })
    }

    /// Takes the next samples and calls `visit` with the spectra that are ready, frame by frame.
    pub fn push(&mut self, samples: &[f32], mut visit: impl FnMut(&Spectrum)) {
        self.n_in += samples.len();
        self.buffer.extend_from_slice(samples);
        while self.buffer.len() - self.start >= self.plan.n_fft + HOP * BATCH {
            self.advance(BATCH, &mut visit);
        }
        self.forget();
    }

    /// Ends the signal and calls `visit` with the rest of its 1 + ⌊n/735⌋ spectra.
    pub fn finish(&mut self, mut visit: impl FnMut(&Spectrum)) {
        let n_frames = 1 + self.n_in / HOP;
        while self.n_out < n_frames {
            let n_steps = (n_frames - self.n_out + self.n_before.saturating_sub(1)).min(BATCH);
            let needed = self.start + self.plan.n_fft + HOP * n_steps;
            if self.buffer.len() < needed {
                self.buffer.resize(needed, 0.0);
            }
            self.advance(n_steps, &mut visit);
            self.forget();
        }
    }

    fn forget(&mut self) {
        self.buffer.drain(..self.start);
        self.start = 0;
    }

    /// Advances by `n_steps` frames, at most [`BATCH`].
    fn advance(&mut self, n_steps: usize, visit: &mut impl FnMut(&Spectrum)) {
        let Self { plan, work, buffer, start, .. } = self;
        let n_fft = plan.n_fft;
        for step in 0..n_steps {
            let at = *start + HOP * step;
            let leaving = &buffer[at..at + HOP];
            let entering = &buffer[at + n_fft..at + n_fft + HOP];
            let (mut even, mut odd) = (work.even.row_mut(step), work.odd.row_mut(step));
            let (even, odd) = (even.as_slice_mut(), odd.as_slice_mut());
            if let (Some(even), Some(odd)) = (even, odd) {
                fold(leaving, entering, even, odd);
            }
        }
        let rows = s![..n_steps, ..];
        for (parts, factors, sums) in [
            (&work.even, &plan.cosines, &mut work.cosine_sums),
            (&work.odd, &plan.sines, &mut work.sine_sums),
        ] {
            let mut projected = work.projected.slice_mut(s![..n_steps, ..factors.weights.nrows()]);
            general_mat_mul(1.0, &parts.slice(rows), &factors.basis, 0.0, &mut projected);
            general_mat_mul(1.0, &projected, &factors.weights, 0.0, &mut sums.slice_mut(rows));
        }
        for step in 0..n_steps {
            let at = self.start + HOP * step;
            let entering = &self.buffer[at + n_fft..at + n_fft + HOP];
            self.n_zeros = match entering.iter().rposition(|&y| y != 0.0) {
                Some(last) => HOP - 1 - last,
                None => self.n_zeros + HOP,
            };
            let (cosines, sines) = (self.work.cosine_sums.row(step), self.work.sine_sums.row(step));
            if let (Some(cosines), Some(sines)) = (cosines.to_slice(), sines.to_slice()) {
                turn(&mut self.spectrum, &self.plan.turns, cosines, sines);
            }
            if self.n_zeros >= n_fft {
                // Of silence nothing remains, not even rounding.
                self.spectrum = Spectrum::default();
            }
            if self.n_before > 1 {
                self.n_before -= 1;
            } else {
                self.n_before = 0;
                self.n_out += 1;
                visit(&self.spectrum);
            }
        }
        self.start += HOP * n_steps;
    }
}

vectorized! {
    /// Writes the even and odd parts of d = entering − leaving around its middle sample.
    fn fold(leaving: &[f32], entering: &[f32], even: &mut [f64], odd: &mut [f64]) {
        let d = |n: usize| f64::from(entering[n]) - f64::from(leaving[n]);
        even[0] = d(HALF);
        odd[0] = 0.0;
        let (entering_before, entering_after) = (&entering[..HALF], &entering[HALF + 1..HOP]);
        let (leaving_before, leaving_after) = (&leaving[..HALF], &leaving[HALF + 1..HOP]);
        let (even, odd) = (&mut even[1..=HALF], &mut odd[1..=HALF]);
        for m in 0..HALF {
            let mirror = HALF - 1 - m;
            let after = f64::from(entering_after[m]) - f64::from(leaving_after[m]);
            let before = f64::from(entering_before[mirror]) - f64::from(leaving_before[mirror]);
            even[m] = after + before;
            odd[m] = after - before;
        }
    }

    /// D ← e^(735iθ) · D + e^(368iθ) · (C − iS) with the sums C of cosines and S of sines.
    fn turn(spectrum: &mut Spectrum, turns: &[Spectrum; 2], cosines: &[f64], sines: &[f64]) {
        let [whole, half] = turns;
        let (cosines, sines) = (&cosines[..N_DFT_BINS], &sines[..N_DFT_BINS]);
        for i in 0..N_DFT_BINS {
            let (re, im) = (spectrum.re[i], spectrum.im[i]);
            let (c, s) = (cosines[i], -sines[i]);
            spectrum.re[i] =
                (re * whole.re[i] - im * whole.im[i]) + (half.re[i] * c - half.im[i] * s);
            spectrum.im[i] =
                (re * whole.im[i] + im * whole.re[i]) + (half.re[i] * s + half.im[i] * c);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::audio::framing::Framer;
    use crate::audio::stft::PairDft;

    fn check(y: &[f32], block: usize, tolerance: f64) {
        for octave in octaves().into_iter().skip(2) {
            let mut expected = Vec::new();
            let mut framer = Framer::new(octave.n_fft, HOP);
            let mut dft = PairDft::new(octave.n_fft);
            let mut add = |frame: &[f32]| {
                let mut bins = Spectrum::default();
                dft.transform(frame, None);
                dft.bins(0, *DFT_BINS.start(), &mut bins.re, &mut bins.im);
                expected.push(bins);
            };
            framer.push(y, &mut add);
            framer.finish(&mut add);
            let mut sliding = SlidingDft::new(octave).expect("a low octave");
            let mut found = Vec::new();
            for samples in y.chunks(block) {
                sliding.push(samples, |spectrum| found.push(spectrum.clone()));
            }
            sliding.finish(|spectrum| found.push(spectrum.clone()));
            assert_eq!(found.len(), expected.len(), "N {}", octave.n_fft);
            for (t, (found, expected)) in found.iter().zip(&expected).enumerate() {
                let parts = |of: &Spectrum| of.re.into_iter().zip(of.im).collect::<Vec<_>>();
                for (f, e) in parts(found).into_iter().zip(parts(expected)) {
                    let error = (f.0 - e.0).hypot(f.1 - e.1);
                    assert!(error <= tolerance, "N {}, frame {t}: {f:?} {e:?}", octave.n_fft);
                }
            }
        }
    }

    #[test]
    fn spectra_are_those_of_whole_frames() {
        let noise = |i: usize| ((i as f64 * 78.233).sin() * 43_758.547).fract() as f32;
        for n in [0, 1, 734, 735, 50_001, 120_000] {
            let y: Vec<f32> = (0..n).map(noise).collect();
            // |D| is about √N = 256; the basis is good to 10⁻¹³ of it, and 160 frames add up.
            check(&y, 10_007, 1e-9);
        }
    }

    #[test]
    fn quiet_after_loud_is_still_exact_and_silence_is_zero() {
        let mut y: Vec<f32> = (0..60_000).map(|i| (i as f32 * 0.01).sin()).collect();
        y.extend((0..80_000).map(|i| 1e-7 * (i as f32 * 0.013).sin()));
        check(&y, 65_536, 1e-9);
        y.truncate(60_000);
        y.extend(vec![0.0; 140_000]);
        for octave in octaves().into_iter().skip(2) {
            let mut sliding = SlidingDft::new(octave).expect("a low octave");
            let mut last = Spectrum { re: [f64::NAN; N_DFT_BINS], ..Spectrum::default() };
            sliding.push(&y, |spectrum| last = spectrum.clone());
            sliding.finish(|spectrum| last = spectrum.clone());
            assert_eq!(last, Spectrum::default());
        }
    }

    #[test]
    fn ranks_are_low_enough_to_pay() {
        for octave in octaves().into_iter().skip(2) {
            let plan = Plan::of(octave).expect("a low octave");
            let rank = plan.cosines.weights.nrows().max(plan.sines.weights.nrows());
            assert!(rank <= 64, "N {}: {rank}", octave.n_fft);
        }
    }
}
