//! The mel filter bank and decibels.
//!
//! Slaney's scale (Auditory Toolbox, 1998), as librosa's default: linear below 1 kHz, logarithmic
//! above.

use super::{N_FFT, SAMPLE_RATE_HZ};

/// Bands of a filter bank.
pub const N_MELS: usize = 128;

/// Mel per Hz below the break.
const MEL_PER_HZ: f64 = 3.0 / 200.0;
const BREAK_HZ: f64 = 1000.0;
const BREAK_MEL: f64 = BREAK_HZ * MEL_PER_HZ;
/// Mel for a factor of 6.4 above the break.
const MEL_PER_LOG: f64 = 27.0;
const LOG_BASE: f64 = 6.4;

/// Power below which decibels stay at the floor of −100 dB.
const MIN_POWER: f32 = 1e-10;
/// Dynamic range kept below the loudest value of a file, in dB.
pub const TOP_DB: f32 = 80.0;

/// m(f) = 3f/200 below 1 kHz, else 15 + 27·ln(f/1000)/ln 6.4.
pub fn hz_to_mel(hz: f64) -> f64 {
    if hz < BREAK_HZ {
        hz * MEL_PER_HZ
    } else {
        BREAK_MEL + MEL_PER_LOG * (hz / BREAK_HZ).ln() / LOG_BASE.ln()
    }
}

/// The inverse of [`hz_to_mel`].
pub fn mel_to_hz(mel: f64) -> f64 {
    if mel < BREAK_MEL {
        mel / MEL_PER_HZ
    } else {
        BREAK_HZ * (LOG_BASE.ln() * (mel - BREAK_MEL) / MEL_PER_LOG).exp()
    }
}

/// Returns the 130 band edges e, equally spaced in mel from `min_hz` to `max_hz`.
fn edges_hz(min_hz: f64, max_hz: f64) -> Vec<f64> {
    let (low, high) = (hz_to_mel(min_hz), hz_to_mel(max_hz));
    let step = (high - low) / (N_MELS + 1) as f64;
    (0..N_MELS + 2).map(|j| mel_to_hz(low + step * j as f64)).collect()
}

/// Returns the centre frequencies of the bands between `min_hz` and `max_hz`, in Hz.
pub fn centres_hz(min_hz: f64, max_hz: f64) -> Vec<f64> {
    edges_hz(min_hz, max_hz)[1..=N_MELS].to_vec()
}

/// A bank of triangular filters of equal area.
///
/// W[i, k] = max(0, min((f_k − eᵢ)/(eᵢ₊₁ − eᵢ), (eᵢ₊₂ − f_k)/(eᵢ₊₂ − eᵢ₊₁))) · 2/(eᵢ₊₂ − eᵢ)
pub struct MelBank {
    /// First bin and weights of every band; a triangle covers few bins.
    bands: Vec<(usize, Vec<f64>)>,
}

impl MelBank {
    /// Makes the bank for frames of [`N_FFT`] samples at 44.1 kHz.
    pub fn new(min_hz: f64, max_hz: f64) -> Self {
        let e = edges_hz(min_hz, max_hz);
        let hz = |k: usize| k as f64 * f64::from(SAMPLE_RATE_HZ) / N_FFT as f64;
        let band = |i: usize| {
            let weight = |k: usize| {
                let rising = (hz(k) - e[i]) / (e[i + 1] - e[i]);
                let falling = (e[i + 2] - hz(k)) / (e[i + 2] - e[i + 1]);
                let triangle = rising.min(falling).max(0.0) as f32;
                // librosa keeps the bank in f32 and scales it there.
                f64::from(triangle * (2.0 / (e[i + 2] - e[i])) as f32)
            };
            let mut bins = (0..=N_FFT / 2).filter(|&k| weight(k) > 0.0);
            let first = bins.next().unwrap_or(0);
            let n = bins.next_back().map_or(1, |last| last - first + 1);
            (first, (first..first + n).map(weight).collect())
        };
        Self { bands: (0..N_MELS).map(band).collect() }
    }

    /// Returns the power in every band: M = W·P for the power P of the bins.
    pub fn apply(&self, power: &[f64]) -> [f32; N_MELS] {
        let mut mel = [0.0; N_MELS];
        for (m, (first, weights)) in mel.iter_mut().zip(&self.bands) {
            let bins = &power[*first..first + weights.len()];
            *m = bins.iter().zip(weights).map(|(p, w)| p * w).sum::<f64>() as f32;
        }
        mel
    }
}

/// 10·log₁₀(max(10⁻¹⁰, power)), in dB.
pub fn power_to_db(power: f32) -> f32 {
    10.0 * power.max(MIN_POWER).log10()
}

/// Raises all values to at least `TOP_DB` below the highest, which is returned.
pub fn clip_below_top(db: &mut [f32]) -> f32 {
    let top = db.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    for value in db {
        *value = value.max(top - TOP_DB);
    }
    top
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_slaneys() {
        // librosa.hz_to_mel([60, 1000, 8000, 22050]) of its documentation and by hand.
        assert!((hz_to_mel(60.0) - 0.9).abs() < 1e-12);
        assert_eq!(hz_to_mel(1000.0), 15.0);
        assert!((hz_to_mel(6400.0) - 42.0).abs() < 1e-12);
        for hz in [0.0, 20.0, 999.9, 1000.1, 22_050.0] {
            assert!((mel_to_hz(hz_to_mel(hz)) - hz).abs() < 1e-9, "{hz}");
        }
    }

    #[test]
    fn bands_have_equal_area() {
        // ∫W df = 1 for every triangle; the sum over bins of 21.5 Hz comes near it where the
        // triangle is wide.
        let bank = MelBank::new(0.0, 22_050.0);
        let bin_hz = f64::from(SAMPLE_RATE_HZ) / N_FFT as f64;
        for (first, weights) in &bank.bands[80..] {
            let area = weights.iter().sum::<f64>() * bin_hz;
            assert!((area - 1.0).abs() < 0.01, "band from bin {first}: {area}");
        }
    }

    #[test]
    fn decibels_have_a_floor_and_a_range() {
        assert_eq!(power_to_db(0.0), -100.0);
        assert_eq!(power_to_db(100.0), 20.0);
        let mut db = [-100.0, -20.0, 5.0];
        assert_eq!(clip_below_top(&mut db), 5.0);
        assert_eq!(db, [-75.0, -20.0, 5.0]);
    }
}
