//! Mel-frequency cepstral coefficients: the cosine transform of a mel spectrum in dB.

use std::f64::consts::PI;

use super::mel::N_MELS;

/// Coefficients that are kept.
pub const N_MFCC: usize = 20;

/// The orthonormal DCT-II of a frame's decibels.
///
/// c_k = s_k · Σₙ D\[n\] · cos(πk(2n + 1)/2N), N = 128, s₀ = √(1/N), s_k = √(2/N) (Davis and
/// Mermelstein 1980; scaled as in librosa).
pub struct Dct {
    rows: Vec<[f64; N_MELS]>,
}

impl Dct {
    pub fn new() -> Self {
        let n_mels = N_MELS as f64;
        let row = |k: usize| {
            let scale = if k == 0 { (1.0 / n_mels).sqrt() } else { (2.0 / n_mels).sqrt() };
            let angle = PI * k as f64 / (2.0 * n_mels);
            std::array::from_fn(|n| scale * (angle * (2 * n + 1) as f64).cos())
        };
        Self { rows: (0..N_MFCC).map(row).collect() }
    }

    /// Returns the coefficients of one frame of [`N_MELS`] decibels.
    pub fn of(&self, db: &[f32]) -> [f32; N_MFCC] {
        let mut coefficients = [0.0; N_MFCC];
        for (c, row) in coefficients.iter_mut().zip(&self.rows) {
            *c = row.iter().zip(db).map(|(w, &d)| w * f64::from(d)).sum::<f64>() as f32;
        }
        coefficients
    }
}

impl Default for Dct {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_basis_function_has_one_coefficient() {
        for k in [0, 1, 7, 19] {
            let wave: Vec<f32> = (0..N_MELS)
                .map(|n| (PI * k as f64 * (2 * n + 1) as f64 / 256.0).cos() as f32)
                .collect();
            for (i, c) in Dct::new().of(&wave).into_iter().enumerate() {
                // The norm of a cosine over 128 points is √64, of a constant √128.
                let expected = match (i == k, k) {
                    (true, 0) => 128f32.sqrt(),
                    (true, _) => 8.0,
                    (false, _) => 0.0,
                };
                assert!((c - expected).abs() < 1e-5, "k {k}: c_{i} = {c}");
            }
        }
    }
}
