//! What a model hears of a track: the features of its music and, beside them, the clock.

use ndarray::{Array2, ArrayView2, Axis, concatenate};

use crate::audio::FeatureScale;
use crate::motion::CLOCK_DIM;

use super::unet::UNetConfig;

/// The numbers of a frame of music that a network hears.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConditionConfig {
    /// Features of a frame.
    pub audio_cond_dim: usize,
    /// Whether the clock comes behind them.
    pub clock: bool,
}

impl ConditionConfig {
    /// Returns the numbers of a frame: features, then the clock.
    pub fn dim(self) -> usize {
        self.audio_cond_dim + if self.clock { CLOCK_DIM } else { 0 }
    }
}

impl From<&UNetConfig> for ConditionConfig {
    fn from(config: &UNetConfig) -> Self {
        Self { audio_cond_dim: config.audio_cond_dim, clock: config.clock }
    }
}

/// Returns the condition of a network for features, \[T, 163\], and a clock, \[T, 10\]: \[T, condition_dim\].
///
/// A network without a clock hears the features alone; one with a clock hears zeros where none is known.
///
/// # Panics
/// When features and clock have other numbers of frames.
pub fn condition(
    config: impl Into<ConditionConfig>,
    features: ArrayView2<f32>,
    clock: Option<ArrayView2<f32>>,
) -> Array2<f32> {
    if !config.into().clock {
        return features.to_owned();
    }
    let unknown = Array2::zeros((features.nrows(), CLOCK_DIM));
    let clock = clock.unwrap_or(unknown.view());
    concatenate(Axis(1), &[features, clock]).expect("invariant: a clock for each frame of features")
}

/// Returns the scale of a network's condition: that of the features; the clock keeps its unit.
pub fn condition_scale(
    config: impl Into<ConditionConfig>,
    features: &FeatureScale,
) -> FeatureScale {
    let mut scale = features.clone();
    let n = config.into().dim();
    scale.centre.resize(n, 0.0);
    scale.scale.resize(n, 1.0);
    scale
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::audio::FEATURE_DIM;
    use crate::model::unet::Preset;

    #[test]
    fn the_clock_comes_behind_the_features_and_keeps_its_unit() {
        let features = Array2::from_shape_fn((3, FEATURE_DIM), |(t, j)| (t * 1000 + j) as f32);
        let clock = Array2::from_shape_fn((3, CLOCK_DIM), |(t, j)| -((t * 100 + j) as f32));
        let with = UNetConfig { clock: true, ..Preset::Tiny.config() };
        let without = UNetConfig { clock: false, ..with.clone() };
        assert_eq!(condition(&without, features.view(), Some(clock.view())), features);
        let heard = condition(&with, features.view(), Some(clock.view()));
        assert_eq!((heard[[2, 162]], heard[[2, 163]], heard[[2, 172]]), (2162.0, -200.0, -209.0));
        let unknown = condition(&with, features.view(), None);
        assert_eq!(unknown.ncols(), with.condition_dim());
        assert!(unknown.columns().into_iter().skip(FEATURE_DIM).all(|c| c.sum() == 0.0));
        let mut scale = FeatureScale::identity(FEATURE_DIM);
        (scale.centre[7], scale.scale[7]) = (3.0, 2.0);
        let mut scaled = heard.clone();
        condition_scale(&with, &scale).apply(scaled.view_mut());
        assert_eq!(scaled[[1, 7]], (1007.0 - 3.0) / 2.0);
        assert_eq!(scaled.column(170), heard.column(170));
        assert_eq!(condition_scale(&without, &scale), scale);
    }
}
