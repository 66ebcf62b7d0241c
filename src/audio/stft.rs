//! The discrete Fourier transform of one frame, in f64 as librosa computes it.

use std::f64::consts::TAU;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};

use realfft::num_complex::{Complex32, Complex64};
use realfft::{RealFftPlanner, RealToComplex};

/// Returns the planner of this process, which keeps its plans: short files spend more on planning
/// than on transforming.
pub fn planner() -> MutexGuard<'static, RealFftPlanner<f64>> {
    static PLANNER: LazyLock<Mutex<RealFftPlanner<f64>>> =
        LazyLock::new(|| Mutex::new(RealFftPlanner::new()));
    PLANNER.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Transforms frames of a fixed even length.
///
/// D\[k\] = Σₙ y\[n\] · e^(−2πikn/N), k = 0 … N/2, without a window.
pub struct Dft {
    fft: Arc<dyn RealToComplex<f64>>,
    frame: Vec<f64>,
    spectrum: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl Dft {
    /// Plans the transform of `n` samples.
    pub fn new(n: usize) -> Self {
        let fft = planner().plan_fft_forward(n);
        let (frame, spectrum) = (fft.make_input_vec(), fft.make_output_vec());
        let scratch = fft.make_scratch_vec();
        Self { fft, frame, spectrum, scratch }
    }

    /// Returns the spectrum of `frame`, which has the planned length.
    pub fn of(&mut self, frame: &[f32]) -> &[Complex64] {
        for (to, &from) in self.frame.iter_mut().zip(frame) {
            *to = f64::from(from);
        }
        self.fft
            .process_with_scratch(&mut self.frame, &mut self.spectrum, &mut self.scratch)
            .expect("invariant: all buffers come from the plan");
        &self.spectrum
    }
}

/// Writes the power |X\[k\]|² of a frame under a periodic Hann window, from its unwindowed spectrum.
///
/// The window ½ − ½cos(2πn/N) in time is X\[k\] = ½D\[k\] − ¼(D\[k−1\] + D\[k+1\]) in frequency, which
/// lets the constant-Q transform share the transform of the same frame. X is rounded to single
/// precision, as librosa stores it; the square is taken in f64.
pub fn hann_power(spectrum: &[Complex64], power: &mut [f64]) {
    let rounded = |x: Complex64| {
        let x = Complex32::new(x.re as f32, x.im as f32);
        let (re, im) = (f64::from(x.re), f64::from(x.im));
        re * re + im * im
    };
    let last = spectrum.len() - 1;
    // The spectrum of a real signal goes on as its own mirror image.
    let below = spectrum[1].conj();
    let above = spectrum[last - 1].conj();
    power[0] = rounded(spectrum[0] * 0.5 - (below + spectrum[1]) * 0.25);
    power[last] = rounded(spectrum[last] * 0.5 - (spectrum[last - 1] + above) * 0.25);
    for (p, d) in power[1..last].iter_mut().zip(spectrum.windows(3)) {
        *p = rounded(d[1] * 0.5 - (d[0] + d[2]) * 0.25);
    }
}

/// Returns sample n of the periodic Hann window of length N: ½ − ½cos(2πn/N).
pub fn hann(n: usize, length: usize) -> f64 {
    0.5 - 0.5 * (TAU * n as f64 / length as f64).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_may_be_applied_in_frequency() {
        let n = 94;
        let y: Vec<f32> = (0..n).map(|i| ((i * i) as f32 * 0.37).sin() + 0.2).collect();
        let mut power = vec![0.0; n / 2 + 1];
        hann_power(Dft::new(n).of(&y), &mut power);
        for (k, p) in power.iter().enumerate() {
            let naive: Complex64 = (0..n)
                .map(|i| {
                    let angle = -TAU * (k * i) as f64 / n as f64;
                    Complex64::from_polar(hann(i, n) * f64::from(y[i]), angle)
                })
                .sum();
            // X is rounded to 24 bits, so its square is good to about 2⁻²³ of itself.
            assert!((p - naive.norm_sqr()).abs() <= 3e-7 * naive.norm_sqr() + 1e-20, "bin {k}");
        }
    }
}
