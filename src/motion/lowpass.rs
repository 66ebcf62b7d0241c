//! Zero-phase Butterworth low-pass of order 4.
//!
//! The filter runs forwards and backwards over the oddly extended signal, so it delays nothing and
//! its gain is the square of one pass. Same result as `scipy.signal.sosfiltfilt` on
//! `butter(4, cutoff, output="sos")` with its default padding and initial state.

use std::f64::consts::PI;

const ORDER: usize = 4;
const N_SECTIONS: usize = ORDER / 2;

/// Samples of odd extension at each end: three times the taps of the whole cascade.
const PAD: usize = 3 * (2 * N_SECTIONS + 1);

/// Signals shorter than this are left as they are: the extension would outweigh the data.
pub const MIN_LOWPASS_SAMPLES: usize = 30;

/// A filter is applied only when the sampling rate exceeds this multiple of the cutoff.
pub const MIN_RATE_PER_CUTOFF: f64 = 2.2;

/// One second-order section `(b₀ + b₁z⁻¹ + b₂z⁻²) / (1 + a₁z⁻¹ + a₂z⁻²)` of unit gain at zero.
#[derive(Clone, Copy, Debug)]
struct Section {
    b: [f64; 3],
    a: [f64; 2],
}

/// Low-passes `signal` in place without delay; leaves it alone where a filter makes no sense.
///
/// Untouched when `cutoff_hz <= 0`, `rate_hz <= 2.2 cutoff_hz`, or under 30 samples. Source:
/// Gustafsson, Determining the initial states in forward-backward filtering, IEEE Trans. Signal
/// Processing 44(4), 1996, for forward-backward filtering; odd extension as in SciPy.
pub fn lowpass(signal: &mut [f64], cutoff_hz: f64, rate_hz: f64) {
    let sensible = cutoff_hz > 0.0 && rate_hz > MIN_RATE_PER_CUTOFF * cutoff_hz;
    if !sensible || signal.len() < MIN_LOWPASS_SAMPLES {
        return;
    }
    let sections = butterworth(cutoff_hz, rate_hz);
    let mut extended = odd_extension(signal);
    filter_from_rest(&sections, &mut extended);
    extended.reverse();
    filter_from_rest(&sections, &mut extended);
    extended.reverse();
    signal.copy_from_slice(&extended[PAD..PAD + signal.len()]);
}

/// Digital Butterworth low-pass as second-order sections, `0 < cutoff < rate / 2`.
///
/// Analogue prototype `Πₖ 1 / (s² + 2 sin((2k-1)π/2N) s + 1)`, `k = 1..N/2`, under the prewarped
/// bilinear transform `s = (1/K)(1 - z⁻¹)/(1 + z⁻¹)`, `K = tan(π f_c / f_s)`:
/// `b = K²(1, 2, 1)/D`, `a₁ = 2(K² - 1)/D`, `a₂ = (1 - dK + K²)/D`, `D = 1 + dK + K²`, with
/// `d = 2 sin((2k-1)π/2N)`. Source: Oppenheim and Schafer, Discrete-Time Signal Processing,
/// section 7.1 (bilinear transform) and appendix B (Butterworth poles).
fn butterworth(cutoff_hz: f64, rate_hz: f64) -> [Section; N_SECTIONS] {
    let k = (PI * cutoff_hz / rate_hz).tan();
    std::array::from_fn(|i| {
        let d = 2.0 * ((2 * i + 1) as f64 * PI / (2 * ORDER) as f64).sin();
        let denominator = 1.0 + d * k + k * k;
        let b = k * k / denominator;
        Section {
            b: [b, 2.0 * b, b],
            a: [2.0 * (k * k - 1.0) / denominator, (1.0 - d * k + k * k) / denominator],
        }
    })
}

/// `x` with `PAD` samples of `2x[0] - x[k]` before and `2x[n-1] - x[n-1-k]` after; `n > PAD`.
fn odd_extension(x: &[f64]) -> Vec<f64> {
    let n = x.len();
    let before = (1..=PAD).rev().map(|k| 2.0 * x[0] - x[k]);
    let after = (1..=PAD).map(|k| 2.0 * x[n - 1] - x[n - 1 - k]);
    before.chain(x.iter().copied()).chain(after).collect()
}

/// Runs the cascade over `x` in place, started as if `x[0]` had lasted for ever.
///
/// Transposed direct form II: `y = b₀x + z₁`, `z₁ = b₁x - a₁y + z₂`, `z₂ = b₂x - a₂y`; at rest with
/// `y = x` these give `z₂ = (b₂ - a₂)x` and `z₁ = (b₁ - a₁)x + z₂`.
fn filter_from_rest(sections: &[Section], x: &mut [f64]) {
    let Some(&first) = x.first() else { return };
    for Section { b, a } in sections {
        let mut z2 = (b[2] - a[1]) * first;
        let mut z1 = (b[1] - a[0]) * first + z2;
        for sample in x.iter_mut() {
            let input = *sample;
            let output = b[0] * input + z1;
            z1 = b[1] * input - a[0] * output + z2;
            z2 = b[2] * input - a[1] * output;
            *sample = output;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(n: usize, frequency_hz: f64, rate_hz: f64) -> Vec<f64> {
        (0..n).map(|t| (2.0 * PI * frequency_hz * t as f64 / rate_hz).sin()).collect()
    }

    #[test]
    fn gain_is_the_squared_butterworth_magnitude_and_the_phase_is_zero() {
        for (frequency_hz, cutoff_hz, rate_hz) in
            [(2.0, 8.0, 120.0), (8.0, 8.0, 120.0), (11.0, 8.0, 47.0), (5.0, 3.0, 30.0)]
        {
            let x = sine(1501, frequency_hz, rate_hz);
            let mut y = x.clone();
            lowpass(&mut y, cutoff_hz, rate_hz);
            let ratio = (PI * frequency_hz / rate_hz).tan() / (PI * cutoff_hz / rate_hz).tan();
            let gain = 1.0 / (1.0 + ratio.powi(2 * ORDER as i32));
            // Far from both ends the start-up transient has decayed below rounding.
            for t in 600..900 {
                assert!((y[t] - gain * x[t]).abs() < 1e-12, "{frequency_hz} Hz at {t}");
            }
        }
    }

    #[test]
    fn a_constant_passes_unchanged() {
        let mut y = vec![-3.7; 41];
        lowpass(&mut y, 8.0, 120.0);
        // Rounding of a recursion with poles near one.
        assert!(y.iter().all(|v| (v + 3.7).abs() < 1e-12));
    }

    #[test]
    fn time_reversal_commutes_with_the_filter() {
        let x: Vec<f64> = (0..301).map(|t| ((t * t) as f64 * 0.013).sin()).collect();
        let mut forwards = x.clone();
        lowpass(&mut forwards, 6.0, 60.0);
        let mut backwards: Vec<f64> = x.into_iter().rev().collect();
        lowpass(&mut backwards, 6.0, 60.0);
        backwards.reverse();
        // Away from the ends the order of the two passes does not matter.
        for t in 120..180 {
            assert!((forwards[t] - backwards[t]).abs() < 1e-12);
        }
    }

    #[test]
    fn short_or_slow_signals_are_left_alone() {
        for (n, cutoff_hz, rate_hz) in
            [(29, 8.0, 120.0), (100, 8.0, 17.6), (100, 0.0, 30.0), (0, 8.0, 120.0)]
        {
            let x = sine(n, 3.0, 30.0);
            let mut y = x.clone();
            lowpass(&mut y, cutoff_hz, rate_hz);
            assert_eq!(x, y);
        }
        let x = sine(30, 9.0, 30.0);
        let mut y = x.clone();
        lowpass(&mut y, 3.0, 30.0);
        assert_ne!(x, y);
    }
}
