//! In-painting: values that are known are imposed at every step, the rest is sampled around them.
//!
//! A. Lugmayr et al., "RePaint: Inpainting using Denoising Diffusion Probabilistic Models", CVPR 2022,
//! arXiv 2201.09865, algorithm 1 without resampling.

use ndarray::{Array3, Zip};

use super::config::DiffusionError;
use super::process::epsilon_of;
use super::schedule::Level;

/// Values of a sample that are known, such as its first frames or its style channels.
///
/// The rest sees them only through the network and under the noise of the step, so that its mean moves
/// towards that of the conditional distribution but stops short of it: for two channels of one
/// Gaussian with a correlation of 0.79, half way with DDPM, a third of the way with DDIM and η = 0.
#[derive(Clone, Debug, PartialEq)]
pub struct KnownValues {
    values: Array3<f32>,
    mask: Array3<bool>,
}

impl KnownValues {
    /// Takes the values under a mask as known.
    ///
    /// # Shapes
    /// - `values`, `mask`: \[batch, frames, channels\]; `true` is known, and values elsewhere are
    ///   never read
    ///
    /// # Errors
    /// Shapes that differ; a known value that is not finite.
    pub fn new(values: Array3<f32>, mask: Array3<bool>) -> Result<Self, DiffusionError> {
        DiffusionError::check_shape(
            "the mask of known values",
            mask.shape(),
            "the values",
            values.shape(),
        )?;
        let known = values.indexed_iter().zip(&mask).filter(|(_, known)| **known);
        for (((sample, frame, channel), &value), _) in known {
            if !value.is_finite() {
                let index = [sample, frame, channel];
                return Err(DiffusionError::KnownNotFinite { value, index });
            }
        }
        Ok(Self { values, mask })
    }

    /// Returns the values, \[batch, frames, channels\].
    pub fn values(&self) -> &Array3<f32> {
        &self.values
    }

    /// Returns what is known of the values.
    pub fn mask(&self) -> &Array3<bool> {
        &self.mask
    }

    /// Sets the known part of a sample to its values, exactly.
    pub fn impose(&self, x0: &mut Array3<f32>) {
        Zip::from(x0).and(&self.values).and(&self.mask).for_each(|x0, &value, &known| {
            if known {
                *x0 = value;
            }
        });
    }

    /// Sets the known part of x_t to √ᾱ value + √(1−ᾱ) z.
    pub(super) fn impose_noisy(&self, x_t: &mut Array3<f32>, level: Level, z: &Array3<f32>) {
        let Level { signal, noise } = level;
        Zip::from(x_t).and(&self.values).and(&self.mask).and(z).for_each(
            |x_t, &value, &known, &z| {
                if known {
                    *x_t = (signal * f64::from(value) + noise * f64::from(z)) as f32;
                }
            },
        );
    }

    /// Sets the known part of the estimates: x̂0 to its values, ε̂ to what x_t then leaves for it.
    pub(super) fn impose_on_estimates(
        &self,
        x0: &mut Array3<f32>,
        epsilon: &mut Array3<f32>,
        x_t: &Array3<f32>,
        level: Level,
    ) {
        self.impose(x0);
        Zip::from(epsilon).and(x_t).and(&*x0).and(&self.mask).for_each(
            |epsilon, &x_t, &x0, &known| {
                if known {
                    *epsilon = epsilon_of(level, x_t, x0);
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use ndarray::arr3;

    use super::*;

    #[test]
    fn known_values_must_be_finite_under_the_mask_alone() {
        let values = arr3(&[[[1.0, f32::NAN], [f32::INFINITY, 2.0]]]);
        let mask = arr3(&[[[true, false], [false, true]]]);
        assert!(KnownValues::new(values.clone(), mask).is_ok());
        let mask = arr3(&[[[true, false], [true, true]]]);
        assert_eq!(
            KnownValues::new(values.clone(), mask).expect_err("infinite").to_string(),
            "the known value at [0, 1, 0] is inf; every value under the mask must be finite: give \
             it a number or take it out of the mask"
        );
        let mask = arr3(&[[[true, false]]]);
        assert_eq!(
            KnownValues::new(values, mask).expect_err("shapes").to_string(),
            "the mask of known values has shape [1, 1, 2]; [1, 2, 2] is needed, the shape of the \
             values"
        );
    }

    #[test]
    fn what_is_not_known_is_left_alone() {
        let known =
            KnownValues::new(arr3(&[[[3.0, 9.0]]]), arr3(&[[[true, false]]])).expect("known");
        let level = Level { signal: 0.6, noise: 0.8 };
        let mut x_t = arr3(&[[[7.0, 7.5]]]);
        known.impose_noisy(&mut x_t, level, &arr3(&[[[0.5, 0.5]]]));
        assert_eq!(x_t, arr3(&[[[2.2, 7.5]]]));
        let (mut x0, mut epsilon) = (arr3(&[[[0.1, 0.2]]]), arr3(&[[[0.3, 0.4]]]));
        known.impose_on_estimates(&mut x0, &mut epsilon, &x_t, level);
        assert_eq!(x0, arr3(&[[[3.0, 0.2]]]));
        assert!((epsilon[[0, 0, 0]] - 0.5).abs() < 1e-6 && epsilon[[0, 0, 1]] == 0.4);
    }
}
