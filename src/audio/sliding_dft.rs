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

use ndarray::{Array1, Array2, ArrayView1};

use super::cqt::{DFT_BINS, N_DFT_BINS, Octave, Spectrum, octaves};
use super::product::Panels;
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
    #[cfg(test)]
    rank: usize,
    /// [HALF + 1, rank], orthonormal columns.
    basis: Panels,
    /// [rank, N_DFT_BINS].
    weights: Panels,
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
        Self {
            #[cfg(test)]
            rank: basis.ncols(),
            basis: Panels::new(basis.nrows(), basis.ncols(), |m, r| basis[[m, r]]),
            weights: Panels::new(weights.nrows(), weights.ncols(), |r, i| weights[[r, i]]),
        }
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

/// Matrices of [`BATCH`] rows; those of sums are padded.
struct Work {
    /// Rows of HALF + 1.
    even: Vec<f64>,
    odd: Vec<f64>,
    projected: Vec<f64>,
    cosine_sums: Vec<f64>,
    sine_sums: Vec<f64>,
}

impl SlidingDft {
    /// Starts a stream for an octave; `None` for the two highest, whose frames are too short.
    pub fn new(octave: Octave) -> Option<Self> {
        let plan = Plan::of(octave)?;
        let half = plan.n_fft / 2;
        let n_before = half.div_ceil(HOP);
        let n_projected = plan.cosines.basis.n_columns().max(plan.sines.basis.n_columns());
        let n_sums = plan.cosines.weights.n_columns();
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
                even: vec![0.0; BATCH * (HALF + 1)],
                odd: vec![0.0; BATCH * (HALF + 1)],
                projected: vec![0.0; BATCH * n_projected],
                cosine_sums: vec![0.0; BATCH * n_sums],
                sine_sums: vec![0.0; BATCH * n_sums],
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
        let rows = work.even.chunks_exact_mut(HALF + 1).zip(work.odd.chunks_exact_mut(HALF + 1));
        for (step, (even, odd)) in rows.take(n_steps).enumerate() {
            let at = *start + HOP * step;
            let leaving = &buffer[at..at + HOP];
            let entering = &buffer[at + n_fft..at + n_fft + HOP];
            fold(leaving, entering, even, odd);
        }
        for (parts, factors, sums) in [
            (&work.even, &plan.cosines, &mut work.cosine_sums),
            (&work.odd, &plan.sines, &mut work.sine_sums),
        ] {
            let Factors { basis, weights, .. } = factors;
            basis.multiply(parts, HALF + 1, n_steps, &mut work.projected);
            weights.multiply(&work.projected, basis.n_columns(), n_steps, sums);
        }
        let n_sums = plan.cosines.weights.n_columns();
        for step in 0..n_steps {
            let at = self.start + HOP * step;
            let entering = &self.buffer[at + n_fft..at + n_fft + HOP];
            self.n_zeros = match entering.iter().rposition(|&y| y != 0.0) {
                Some(last) => HOP - 1 - last,
                None => self.n_zeros + HOP,
            };
            let sums = n_sums * step..n_sums * (step + 1);
            let (cosines, sines) =
                (&self.work.cosine_sums[sums.clone()], &self.work.sine_sums[sums]);
            turn(&mut self.spectrum, &self.plan.turns, cosines, sines);
            if self.n_zeros >= n_fft {
                // A window of zeros has a spectrum of zeros: rounding errors of what came before end here.
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
        even[0] = f64::from(entering[HALF]) - f64::from(leaving[HALF]);
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
mod tests;
