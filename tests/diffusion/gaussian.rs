//! A Gaussian, whose denoiser is known exactly, and what is expected of samples of it.

use motiongen::diffusion::{DiffusionError, Level, Prediction, Schedule};
use ndarray::{Array2, Array3, ArrayView3};

/// Channels of the Gaussian.
pub const D: usize = 5;
/// The two channels that are correlated.
pub const PAIR: (usize, usize) = (1, 4);

/// N(mean, U diag(variances) Uᵀ), U a turn by `angle` in the plane of [`PAIR`].
#[derive(Clone, Debug)]
pub struct Gaussian {
    pub mean: [f64; D],
    /// Along the axes of U.
    pub variances: [f64; D],
    pub angle: f64,
}

impl Gaussian {
    /// Deviations from 0.2 to 1.4; a correlation of 0.79 between the channels of [`PAIR`].
    pub fn new() -> Self {
        Self {
            mean: [0.7, -1.2, 0.3, 0.0, 1.5],
            variances: [0.25, 1.9, 1.0, 0.04, 0.2],
            angle: 0.6,
        }
    }

    /// Returns Uᵀ x.
    pub fn on_axes(&self, x: [f64; D]) -> [f64; D] {
        self.turn(x, self.angle)
    }

    /// Returns U y.
    pub fn off_axes(&self, y: [f64; D]) -> [f64; D] {
        self.turn(y, -self.angle)
    }

    fn turn(&self, x: [f64; D], angle: f64) -> [f64; D] {
        let (sin, cos) = angle.sin_cos();
        let (i, j) = PAIR;
        let mut y = x;
        y[i] = cos * x[i] + sin * x[j];
        y[j] = cos * x[j] - sin * x[i];
        y
    }

    /// Returns U diag(`variances`) Uᵀ.
    pub fn covariance_of(&self, variances: [f64; D]) -> Array2<f64> {
        let mut covariance = Array2::zeros((D, D));
        for k in 0..D {
            let mut unit = [0.0; D];
            unit[k] = 1.0;
            let axis = self.off_axes(unit);
            for i in 0..D {
                for j in 0..D {
                    covariance[[i, j]] += variances[k] * axis[i] * axis[j];
                }
            }
        }
        covariance
    }

    pub fn covariance(&self) -> Array2<f64> {
        self.covariance_of(self.variances)
    }

    /// Returns p and q along each axis, of E\[x0 | x_t\] = p x_t + q.
    ///
    /// p = √ᾱ s / (ᾱ s + 1 − ᾱ), q = (1 − √ᾱ p) m, for variance s and mean m of the axis.
    pub fn estimate(&self, level: Level) -> ([f64; D], [f64; D]) {
        let Level { signal: a, noise } = level;
        let mean = self.on_axes(self.mean);
        let p = self.variances.map(|s| a * s / (a * a * s + noise * noise));
        let q = std::array::from_fn(|k| (1.0 - a * p[k]) * mean[k]);
        (p, q)
    }

    /// Predicts as a perfectly trained network does.
    pub fn denoise(
        &self,
        schedule: &Schedule,
        x: ArrayView3<'_, f32>,
        t: usize,
    ) -> Result<Array3<f32>, DiffusionError> {
        let level = schedule.level(Some(t));
        let Level { signal: a, noise } = level;
        let (p, q) = self.estimate(level);
        let mut predicted = x.to_owned();
        for mut row in predicted.rows_mut() {
            let x = self.on_axes(std::array::from_fn(|k| f64::from(row[k])));
            let y = std::array::from_fn(|k| {
                let x0 = p[k] * x[k] + q[k];
                let epsilon = (x[k] - a * x0) / noise;
                match schedule.prediction() {
                    Prediction::Epsilon => epsilon,
                    Prediction::Sample => x0,
                    Prediction::Velocity => a * epsilon - noise * x0,
                }
            });
            for (target, y) in row.iter_mut().zip(self.off_axes(y)) {
                *target = y as f32;
            }
        }
        Ok(predicted)
    }
}

/// Mean and covariance, of samples or as they should be.
#[derive(Clone, Debug)]
pub struct Moments {
    pub mean: [f64; D],
    pub covariance: Array2<f64>,
}

impl Moments {
    /// Returns the moments of samples \[n, 1, D\].
    pub fn of(samples: &Array3<f32>) -> Self {
        let n = samples.dim().0 as f64;
        let rows = || samples.rows().into_iter();
        let mut mean = [0.0; D];
        for row in rows() {
            for k in 0..D {
                mean[k] += f64::from(row[k]) / n;
            }
        }
        let mut covariance = Array2::zeros((D, D));
        for row in rows() {
            for i in 0..D {
                for j in 0..D {
                    let product = (f64::from(row[i]) - mean[i]) * (f64::from(row[j]) - mean[j]);
                    covariance[[i, j]] += product / (n - 1.0);
                }
            }
        }
        Self { mean, covariance }
    }

    /// Asserts that n samples of a Gaussian with these moments could have the moments `got`: every
    /// entry within five standard errors, √(Σ_ii/n) of the mean and √((Σ_ii Σ_jj + Σ_ij²)/n) of the
    /// covariance. `extra` is granted on top.
    pub fn assert_seen(&self, got: &Moments, n: usize, extra: f64, case: &str) {
        let sigma = &self.covariance;
        for i in 0..D {
            let bound = 5.0 * (sigma[[i, i]] / n as f64).sqrt() + extra;
            let (got_mean, want) = (got.mean[i], self.mean[i]);
            assert!(
                (got_mean - want).abs() < bound,
                "{case}: mean of {i} is {got_mean}, wanted {want} within {bound}"
            );
            for j in 0..D {
                let product = sigma[[i, i]] * sigma[[j, j]] + sigma[[i, j]].powi(2);
                let bound = 5.0 * (product / n as f64).sqrt() + extra;
                let (got, want) = (got.covariance[[i, j]], sigma[[i, j]]);
                assert!(
                    (got - want).abs() < bound,
                    "{case}: covariance of {i} and {j} is {got}, wanted {want} within {bound}"
                );
            }
        }
    }
}
