//! The mel filter bank and decibels.
//!
//! Slaney's scale (Auditory Toolbox, 1998), as librosa's default: linear below 1 kHz, logarithmic
//! above.

use std::f64::consts::{LOG10_2, LOG10_E};

use super::bank::Bank;
use super::{N_FFT, SAMPLE_RATE_HZ};
use crate::instructions::vectorized;

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
    /// One row per band; a triangle covers few bins.
    bands: Bank,
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
        Self { bands: Bank::new(N_FFT / 2 + 1, (0..N_MELS).map(band)) }
    }

    /// Writes the power in every band, for two frames: M = W·P for the power P of the bins.
    pub fn apply(&self, powers: &[[f64; N_FFT / 2 + 1]; 2], mel: &mut [[f32; N_MELS]; 2]) {
        let ([first, second], [first_mel, second_mel]) = (powers, mel);
        self.bands.apply([first, second], [first_mel, second_mel]);
    }
}

vectorized! {
    /// Replaces finite powers by 10·log₁₀(max(10⁻¹⁰, power)), in dB.
    pub fn powers_to_db(powers: &mut [f32]) {
        for x in powers {
            let power = if *x > MIN_POWER { *x } else { MIN_POWER };
            *x = 10.0 * log10(power);
        }
    }
}

/// log₁₀ x of a normal number, rounded from an approximation that is good to 10⁻¹² of itself.
///
/// x = 2ᵉ m, √½ ≤ m < √2; ln m = 2(s + s³/3 + s⁵/5 + …), s = (m − 1)/(m + 1), |s| < 0.172. Seven terms
/// leave less than 2s¹⁵/15 · 1.04 < 5·10⁻¹³.
#[inline(always)]
fn log10(x: f32) -> f32 {
    /// The bits of √½: numbers from here to twice that have the exponent 0.
    const START: i32 = 0x3f35_04f3;
    let bits = x.to_bits().cast_signed() - START;
    let exponent = bits >> 23;
    let m = f64::from(f32::from_bits(((bits & 0x7f_ffff) + START).cast_unsigned()));
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    let mut series = 1.0 / 13.0;
    for n in [11.0, 9.0, 7.0, 5.0, 3.0, 1.0] {
        series = series * square + 1.0 / n;
    }
    (f64::from(exponent) * LOG10_2 + s * series * (2.0 * LOG10_E)) as f32
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
        for (first, weights) in bank.bands.rows().skip(80) {
            let area = weights.iter().sum::<f64>() * bin_hz;
            assert!((area - 1.0).abs() < 0.01, "band from bin {first}: {area}");
        }
    }

    #[test]
    fn decibels_have_a_floor_and_a_range() {
        let mut db = [0.0, 100.0, 1e-10, 1e-11];
        powers_to_db(&mut db);
        assert_eq!(db, [-100.0, 20.0, -100.0, -100.0]);
        let mut db = [-100.0, -20.0, 5.0];
        assert_eq!(clip_below_top(&mut db), 5.0);
        assert_eq!(db, [-75.0, -20.0, 5.0]);
    }

    #[test]
    fn logarithms_are_those_of_f64_rounded_once() {
        // Every exponent and 61 of its numbers, with those around √½ and 1.
        let spread = (0x0080_0000..0x7f80_0000_u32).step_by(0x0080_0000 / 61);
        let near = [0.5f32.sqrt().to_bits(), 1f32.to_bits(), 2f32.sqrt().to_bits()];
        let near = near.into_iter().flat_map(|bits| bits - 300..bits + 300);
        for x in spread.chain(near).map(f32::from_bits) {
            let (found, expected) = (log10(x), f64::from(x).log10());
            // Half a unit of the last place, and what the approximation adds to it.
            let tolerance = expected.abs() * (2f64.powi(-24) + 1e-11);
            assert!((f64::from(found) - expected).abs() <= tolerance, "{x:e}: {found} {expected}");
        }
    }
}
