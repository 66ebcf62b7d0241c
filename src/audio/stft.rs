//! The discrete Fourier transform of frames, in f64 as librosa computes it, two frames at a time.

use std::f64::consts::TAU;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};

use realfft::RealFftPlanner;
use realfft::num_complex::Complex64;
use rustfft::{Fft, FftPlanner};

use super::peak::peak;
use crate::instructions::vectorized;

/// Returns the planner of this process, which keeps its plans: short files spend more on planning
/// than on transforming.
pub fn planner() -> MutexGuard<'static, RealFftPlanner<f64>> {
    static PLANNER: LazyLock<Mutex<RealFftPlanner<f64>>> =
        LazyLock::new(|| Mutex::new(RealFftPlanner::new()));
    PLANNER.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the planner of complex transforms, which keeps its plans, too.
pub fn complex_planner() -> MutexGuard<'static, FftPlanner<f64>> {
    static PLANNER: LazyLock<Mutex<FftPlanner<f64>>> =
        LazyLock::new(|| Mutex::new(FftPlanner::new()));
    PLANNER.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Transforms real frames of a fixed even length N, two by one complex transform.
///
/// z\[n\] = w\[n\] · (g a\[n\] + i h b\[n\]), Z\[k\] = Σₙ z\[n\] · e^(−2πikn/N)
///
/// A\[k\] = (Z\[k\] + Z*\[N−k\]) / 2g, B\[k\] = (Z\[k\] − Z*\[N−k\]) / 2ih
///
/// Either frame carries rounding of the other's size, so the gains g and h level frames of which one is
/// far louder. They are powers of two, which round nothing. A frame of zeros has a spectrum of zeros.
pub struct PairDft {
    fft: Arc<dyn Fft<f64>>,
    /// w.
    window: Vec<f64>,
    /// What stands in for the second frame where there is one alone.
    silence: Vec<f32>,
    z: Vec<Complex64>,
    /// Z.
    spectrum: Vec<Complex64>,
    scratch: Vec<Complex64>,
    /// 1/2g and 1/2h; 0 for a frame of zeros.
    scales: [f64; 2],
}

/// Largest samples of two frames whose ratio exceeds this are levelled: a thousandth of the precision.
const MAX_RATIO: f64 = 1024.0;

impl PairDft {
    /// Plans the transform of `n` samples as they are: w = 1.
    pub fn new(n: usize) -> Self {
        Self::with_window(vec![1.0; n])
    }

    /// Plans the transform of `n` samples under the periodic Hann window.
    pub fn hann(n: usize) -> Self {
        Self::with_window((0..n).map(|i| hann(i, n)).collect())
    }

    fn with_window(window: Vec<f64>) -> Self {
        let n = window.len();
        let fft = complex_planner().plan_fft_forward(n);
        Self {
            window,
            silence: vec![0.0; n],
            z: vec![Complex64::default(); n],
            spectrum: vec![Complex64::default(); n],
            scratch: vec![Complex64::default(); fft.get_outofplace_scratch_len()],
            scales: [0.0; 2],
            fft,
        }
    }

    /// Transforms a frame and, if there is one, the next; both have the planned length.
    pub fn transform(&mut self, first: &[f32], second: Option<&[f32]>) {
        let Self { fft, window, silence, z, spectrum, scratch, scales } = self;
        let second = second.unwrap_or(silence);
        // What the window leaves nothing of is no peak.
        let n_unheard = window.iter().take_while(|w| **w == 0.0).count();
        let peaks = [first, second].map(|frame| f64::from(peak(&frame[n_unheard..])));
        let [low, high] = if peaks[0] < peaks[1] { peaks } else { [peaks[1], peaks[0]] };
        if high == 0.0 {
            *scales = [0.0; 2];
            return;
        }
        if low != 0.0 && low * MAX_RATIO < high {
            let powers = peaks.map(power_of_two_below);
            load(z, window, first, second);
            level(z, powers.map(|power| 1.0 / power));
            *scales = powers.map(|power| 0.5 * power);
        } else {
            load(z, window, first, second);
            *scales = peaks.map(|peak| if peak == 0.0 { 0.0 } else { 0.5 });
        }
        fft.process_outofplace_with_scratch(z, spectrum, scratch);
    }

    /// Writes |A\[k\]|² and |B\[k\]|², k = 0 … N/2, of the frames that were transformed last.
    ///
    /// A and B are rounded to single precision, as librosa stores them; the square is taken in f64.
    pub fn powers(&self, first: &mut [f64], second: &mut [f64]) {
        pair_powers(&self.spectrum, self.scales, first, second);
        for (power, scale) in [first, second].into_iter().zip(self.scales) {
            if scale == 0.0 {
                power.fill(0.0);
            }
        }
    }

    /// Writes the real and imaginary parts of bins `start` … of the frame transformed last that is
    /// the first, 0, or the second, 1; 1 ≤ k < N/2.
    pub fn bins(&self, frame: usize, start: usize, re: &mut [f64], im: &mut [f64]) {
        let scale = self.scales[frame];
        if scale == 0.0 {
            re.fill(0.0);
            im.fill(0.0);
            return;
        }
        let n_bins = re.len();
        let n = self.spectrum.len();
        let front = &self.spectrum[start..start + n_bins];
        let back = &self.spectrum[n + 1 - start - n_bins..=n - start];
        if frame == 0 {
            first_bins(front, back, scale, re, im);
        } else {
            second_bins(front, back, scale, re, im);
        }
    }
}

/// Returns the power of two at or below a positive normal number.
fn power_of_two_below(x: f64) -> f64 {
    const EXPONENT: u64 = 0x7ff << 52;
    f64::from_bits(x.to_bits() & EXPONENT)
}

vectorized! {
    /// Writes z = w (a + ib).
    fn load(z: &mut [Complex64], window: &[f64], first: &[f32], second: &[f32]) {
        let n = z.len();
        let (window, first, second) = (&window[..n], &first[..n], &second[..n]);
        for i in 0..n {
            let (a, b) = (f64::from(first[i]), f64::from(second[i]));
            z[i] = Complex64::new(window[i] * a, window[i] * b);
        }
    }

    /// Multiplies the real parts by g, the imaginary ones by h.
    fn level(z: &mut [Complex64], gains: [f64; 2]) {
        for z in z {
            *z = Complex64::new(gains[0] * z.re, gains[1] * z.im);
        }
    }

    /// Writes |A|² and |B|²; powers of two may be multiplied after rounding.
    fn pair_powers(
        spectrum: &[Complex64], scales: [f64; 2], first: &mut [f64], second: &mut [f64],
    ) {
        let rounded = |re: f64, im: f64, scale: f64| {
            let (re, im) = (f64::from(re as f32), f64::from(im as f32));
            (re * re + im * im) * scale
        };
        let scales = scales.map(|scale| scale * scale);
        let n = spectrum.len();
        let half = n / 2;
        // The ends are their own mirror images.
        for k in [0, half] {
            let z = spectrum[k];
            first[k] = rounded(2.0 * z.re, 0.0, scales[0]);
            second[k] = rounded(2.0 * z.im, 0.0, scales[1]);
        }
        let n_inner = half - 1;
        let (front, back) = (&spectrum[1..half], &spectrum[half + 1..]);
        let (first, second) = (&mut first[1..half], &mut second[1..half]);
        for i in 0..n_inner {
            let (z, mirror) = (front[i], back[n_inner - 1 - i]);
            let (a_re, a_im) = (z.re + mirror.re, z.im - mirror.im);
            let (b_re, b_im) = (z.im + mirror.im, mirror.re - z.re);
            first[i] = rounded(a_re, a_im, scales[0]);
            second[i] = rounded(b_re, b_im, scales[1]);
        }
    }

    /// Writes A, given Z\[k\] and Z\[N−k\], the latter backwards.
    fn first_bins(
        front: &[Complex64], back: &[Complex64], scale: f64, re: &mut [f64], im: &mut [f64],
    ) {
        let n = front.len();
        let (back, re, im) = (&back[..n], &mut re[..n], &mut im[..n]);
        for i in 0..n {
            let (z, mirror) = (front[i], back[n - 1 - i]);
            re[i] = scale * (z.re + mirror.re);
            im[i] = scale * (z.im - mirror.im);
        }
    }

    /// Writes B likewise.
    fn second_bins(
        front: &[Complex64], back: &[Complex64], scale: f64, re: &mut [f64], im: &mut [f64],
    ) {
        let n = front.len();
        let (back, re, im) = (&back[..n], &mut re[..n], &mut im[..n]);
        for i in 0..n {
            let (z, mirror) = (front[i], back[n - 1 - i]);
            re[i] = scale * (z.im + mirror.im);
            im[i] = scale * (mirror.re - z.re);
        }
    }
}

/// Returns sample n of the periodic Hann window of length N: ½ − ½cos(2πn/N).
pub fn hann(n: usize, length: usize) -> f64 {
    0.5 - 0.5 * (TAU * n as f64 / length as f64).cos()
}

#[cfg(test)]
mod tests;
