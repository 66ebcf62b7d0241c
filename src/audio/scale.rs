//! Features in units of their own spread, as networks take them.

use ndarray::{ArrayView2, ArrayViewMut2};
use serde::{Deserialize, Serialize};

/// A feature that spreads less counts as constant, and keeps its unit.
const MIN_SPREAD: f64 = 1e-4;

/// Centre and scale of every feature: `z = (x - centre) / scale`.
///
/// Onset strength is near 0 but for its peaks, mel bands lie around 0.5, MFCC spread by 1: as they are, the
/// feature that tells the beat is the one a network hears least.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FeatureScale {
    pub centre: Vec<f32>,
    pub scale: Vec<f32>,
}

impl FeatureScale {
    /// Leaves `n` features as they are.
    pub fn identity(n: usize) -> Self {
        Self { centre: vec![0.0; n], scale: vec![1.0; n] }
    }

    /// Fits mean and standard deviation of each column of `[n_frames, n_features]`; constant features keep
    /// their unit.
    ///
    /// # Panics
    /// When there are no frames.
    pub fn fit(frames: ArrayView2<f32>) -> Self {
        let n = frames.nrows() as f64;
        assert!(n > 0.0, "a scale is fitted to frames");
        let mut fitted = Self::identity(frames.ncols());
        for (i, column) in frames.columns().into_iter().enumerate() {
            let mean = column.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
            let variance = column.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n;
            fitted.centre[i] = mean as f32;
            if variance.sqrt() >= MIN_SPREAD {
                fitted.scale[i] = variance.sqrt() as f32;
            }
        }
        fitted
    }

    /// Turns features into units of their spread, in place, `[n_frames, n_features]`.
    ///
    /// # Panics
    /// When there is another number of features.
    pub fn apply(&self, mut frames: ArrayViewMut2<f32>) {
        assert_eq!(frames.ncols(), self.centre.len(), "features of the scale");
        for mut row in frames.rows_mut() {
            for ((x, centre), scale) in row.iter_mut().zip(&self.centre).zip(&self.scale) {
                *x = (*x - centre) / scale;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn columns_get_mean_zero_and_spread_one_and_constants_their_unit() {
        let mut frames = array![[1.0, 7.0, -2.0], [3.0, 7.0, 2.0], [8.0, 7.0, 0.0]];
        let fitted = FeatureScale::fit(frames.view());
        assert_eq!(fitted.centre, [4.0, 7.0, 0.0]);
        // Variances (9 + 1 + 16) / 3 and 8 / 3.
        let wanted = [(26.0_f32 / 3.0).sqrt(), 1.0, (8.0_f32 / 3.0).sqrt()];
        for (scale, wanted) in fitted.scale.iter().zip(wanted) {
            assert!((scale - wanted).abs() < 1e-6, "{scale}, {wanted}");
        }
        fitted.apply(frames.view_mut());
        assert!((frames[[2, 0]] - 4.0 / wanted[0]).abs() < 1e-6);
        assert_eq!(frames.column(1).to_vec(), [0.0; 3]);
    }
}
