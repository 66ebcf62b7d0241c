//! Halving the sample rate, for the lower octaves of the constant-Q transform.

use std::f64::consts::PI;
use std::sync::{Arc, OnceLock};

use realfft::num_complex::Complex64;
use rustfft::Fft;

use super::stft::complex_planner;
use crate::instructions::vectorized;

/// Taps of the filter, symmetric around the middle one.
pub const N_TAPS: usize = 389;
const CENTRE: usize = N_TAPS / 2;
/// Cut-off relative to the higher rate's Nyquist frequency, and Kaiser's β: libsoxr's half-band
/// filter at quality HQ, fitted to its impulse response (max. error 3·10⁻⁸).
pub const CUT_OFF: f64 = 0.478_435_9;
pub const BETA: f64 = 13.040_03;
/// Half the length of the window, half a sample more than the filter's.
pub const HALF_LENGTH: f64 = CENTRE as f64 + 0.5;

/// Length of one block's transform; a block has this many samples less the filter's overlap.
const N_FFT: usize = 4096;
const OVERLAP: usize = N_TAPS - 1;
/// Even, so that every block starts on a sample that is kept.
const BLOCK: usize = N_FFT - OVERLAP;

/// h\[i\] = F_c · sinc(F_c z) · I₀(β√(1 − (z/194.5)²)) / I₀(β), z = i − 194.
pub fn taps() -> Vec<f64> {
    let window = Kaiser::new(BETA);
    (0..N_TAPS)
        .map(|i| {
            let z = i as f64 - CENTRE as f64;
            CUT_OFF * sinc(CUT_OFF * z) * window.at(z / HALF_LENGTH)
        })
        .collect()
}

/// sin(πx)/(πx), 1 at 0.
pub fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) }
}

/// Kaiser's window I₀(β√(1 − x²))/I₀(β) for |x| < 1, else 0.
#[derive(Clone, Debug, PartialEq)]
pub struct Kaiser {
    beta: f64,
    /// I₀(β).
    middle: f64,
}

impl Kaiser {
    pub fn new(beta: f64) -> Self {
        Self { beta, middle: bessel_i0(beta) }
    }

    /// Returns the window's value at x.
    pub fn at(&self, x: f64) -> f64 {
        if x.abs() < 1.0 { bessel_i0(self.beta * (1.0 - x * x).sqrt()) / self.middle } else { 0.0 }
    }
}

/// The modified Bessel function of order 0: Σ ((x/2)ᵏ/k!)².
fn bessel_i0(x: f64) -> f64 {
    let quarter = x * x / 4.0;
    let (mut term, mut sum, mut k) = (1.0, 1.0, 1.0);
    while term > sum * f64::EPSILON / 4.0 {
        term *= quarter / (k * k);
        sum += term;
        k += 1.0;
    }
    sum
}

/// Halves the rate of a stream: y₂\[m\] = √2 · Σᵢ h\[i\] · y\[2m + 194 − i\], ⌈n/2⌉ samples.
///
/// Blocks are convolved by overlap-save, two at once: the filter is real, so that of the complex signal
/// z = a + ib it makes h∗a + i h∗b. The spectrum is folded at half the rate,
/// Y\[k\] = Z\[k\] H\[k\] + Z\[k + N/2\] H\[k + N/2\], so the inverse transform is half as long. H is real,
/// because the taps are symmetric around sample 0 of the transform. Where the filter sees nothing but
/// zeros the result is exactly 0.
pub struct Halver {
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
    /// H.
    response: &'static [f64],
    /// The last samples that were not yet filtered, after the overlap with the block before.
    pending: Vec<f32>,
    time: Vec<Complex64>,
    spectrum: Vec<Complex64>,
    folded: Vec<Complex64>,
    halved: Vec<Complex64>,
    scratch: Vec<Complex64>,
    n_in: usize,
    n_out: usize,
}

/// Samples that two blocks take.
const PAIR: usize = N_FFT + BLOCK;

/// Returns the transform of the taps, scaled by √2 and the transforms' own factor.
fn response(forward: &dyn Fft<f64>) -> Vec<f64> {
    let mut h = vec![Complex64::default(); N_FFT];
    // √2 keeps the energy; 1/N_FFT undoes the two transforms' gain of N_FFT/2 and the fold of 2.
    let scale = 2f64.sqrt() / N_FFT as f64;
    for (i, tap) in taps().into_iter().enumerate() {
        h[(N_FFT + i - CENTRE) % N_FFT].re = tap * scale;
    }
    forward.process(&mut h);
    h.into_iter().map(|h| h.re).collect()
}

impl Halver {
    pub fn new() -> Self {
        static RESPONSE: OnceLock<Vec<f64>> = OnceLock::new();
        let (forward, inverse) = {
            let mut planner = complex_planner();
            (planner.plan_fft_forward(N_FFT), planner.plan_fft_inverse(N_FFT / 2))
        };
        let n_scratch =
            forward.get_outofplace_scratch_len().max(inverse.get_outofplace_scratch_len());
        let room = |n: usize| vec![Complex64::default(); n];
        Self {
            response: RESPONSE.get_or_init(|| response(forward.as_ref())),
            time: room(N_FFT),
            spectrum: room(N_FFT),
            folded: room(N_FFT / 2),
            halved: room(N_FFT / 2),
            scratch: room(n_scratch),
            // The filter's centre lies 194 taps behind its end: that much zero signal comes first.
            pending: vec![0.0; OVERLAP - CENTRE],
            n_in: 0,
            n_out: 0,
            forward,
            inverse,
        }
    }

    /// Takes the next samples and appends what is ready of the halved signal.
    pub fn push(&mut self, samples: &[f32], halved: &mut Vec<f32>) {
        self.n_in += samples.len();
        self.pending.extend_from_slice(samples);
        self.filter(halved);
    }

    /// Ends the signal and appends the rest.
    pub fn finish(&mut self, halved: &mut Vec<f32>) {
        let total = self.n_in.div_ceil(2);
        while self.n_out < total {
            let missing = PAIR.saturating_sub(self.pending.len());
            self.pending.resize(self.pending.len() + missing, 0.0);
            let first = halved.len();
            let before = self.n_out;
            self.filter(halved);
            halved.truncate(first + total.saturating_sub(before).min(halved.len() - first));
        }
    }

    fn filter(&mut self, halved: &mut Vec<f32>) {
        let pending = std::mem::take(&mut self.pending);
        let mut start = 0;
        while let Some(pair) = pending.get(start..start + PAIR) {
            let (first, second) = (&pair[..N_FFT], &pair[BLOCK..]);
            join(first, second, &mut self.time);
            self.convolve();
            let kept = &self.halved[CENTRE / 2..CENTRE / 2 + BLOCK / 2];
            let before = halved.len();
            halved.extend(kept.iter().map(|y| y.re as f32));
            silence(first, &mut halved[before..]);
            let before = halved.len();
            halved.extend(kept.iter().map(|y| y.im as f32));
            silence(second, &mut halved[before..]);
            self.n_out += BLOCK;
            start += 2 * BLOCK;
        }
        self.pending = pending;
        self.pending.drain(..start);
    }

    /// Filters `time` into `halved`. Results of circular convolution are valid where no tap reaches over
    /// an end.
    fn convolve(&mut self) {
        let Self { forward, inverse, response, time, spectrum, folded, halved, scratch, .. } = self;
        forward.process_outofplace_with_scratch(time, spectrum, scratch);
        fold(spectrum, response, folded);
        inverse.process_outofplace_with_scratch(folded, halved, scratch);
    }
}

vectorized! {
    /// Writes z = a + ib.
    fn join(a: &[f32], b: &[f32], z: &mut [Complex64]) {
        let n = z.len();
        let (a, b) = (&a[..n], &b[..n]);
        for i in 0..n {
            z[i] = Complex64::new(f64::from(a[i]), f64::from(b[i]));
        }
    }

    /// Keeping every second sample folds bin k + N/2 onto bin k.
    fn fold(spectrum: &[Complex64], response: &[f64], folded: &mut [Complex64]) {
        let half = folded.len();
        let (low, high) = spectrum.split_at(half);
        let (response_low, response_high) = response.split_at(half);
        let (high, response_high) = (&high[..half], &response_high[..half]);
        for k in 0..half {
            folded[k] = low[k] * response_low[k] + high[k] * response_high[k];
        }
    }

    /// Returns whether any whole lot of samples is nothing but zeros.
    fn has_silent_lot(block: &[f32]) -> bool {
        block.as_chunks::<LOT>().0.iter().any(|lot| {
            lot.iter().fold(0, |bits, y| bits | (y.to_bits() << 1)) == 0
        })
    }
}

/// Any run of zeros that fills the filter has a whole lot of this many samples in it.
const LOT: usize = 128;

/// Sets to 0 what the filter makes of nothing but zeros: output m sees samples 2m … 2m + 388.
fn silence(block: &[f32], halved: &mut [f32]) {
    if !has_silent_lot(block) {
        return;
    }
    let mut n_zeros = 0;
    let mut seen = 0;
    for (m, value) in halved.iter_mut().enumerate() {
        let end = 2 * m + N_TAPS;
        for &y in &block[seen..end] {
            n_zeros = if y == 0.0 { n_zeros + 1 } else { 0 };
        }
        seen = end;
        if n_zeros >= N_TAPS {
            *value = 0.0;
        }
    }
}

impl Default for Halver {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests;
