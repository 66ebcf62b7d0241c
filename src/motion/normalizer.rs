//! Motion in units of its own spread, in which diffusion runs.

use ndarray::{ArrayView2, ArrayViewMut2};
use serde::{Deserialize, Serialize};

use super::channels::{CHANNEL_NAMES, Channel, MOTION_DIM};
use super::quantile::percentile;

/// Share of the values at either end that does not stretch the scale, in percent.
const OUTLIERS_PERCENT: f64 = 0.1;
/// A channel that spreads less, in its own unit, counts as constant.
const MIN_SPREAD: f64 = 1e-6;
/// Least scale of a component of the quaternion, 6° of a tilt: a body that hardly tilts in a library is not
/// blown up to the weight of one that does.
const MIN_QUATERNION_SCALE: f32 = 0.05;
/// Least scale of a style channel, all of which lie in (-1, 1): one that hardly moves in a library is
/// not blown up to the weight of one that does.
const MIN_STYLE_SCALE: f32 = 0.1;

/// Centre and scale of every channel: `z = (x - centre) / scale`.
///
/// Position, velocity, acceleration, angular velocity and phase: mean and standard deviation of values
/// held within the 0.1 and 99.9 percentiles, so that a few wild frames stretch nothing. Quaternion: centre
/// 0, so that `q` and `-q` stay opposite, and as scale the root mean square of each component, at least 0.05.
/// With one scale of 1/2 for all four, tilts were a fifth of a unit, drowned in noise until the last steps of a
/// sampler, and came out at 0.63 of real motion's angular velocity. Style: like the first, with a scale of at
/// least 0.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Normalizer {
    pub centre: [f32; MOTION_DIM],
    pub scale: [f32; MOTION_DIM],
}

impl Normalizer {
    /// Leaves motion as it is.
    pub fn identity() -> Self {
        Self { centre: [0.0; MOTION_DIM], scale: [1.0; MOTION_DIM] }
    }

    /// Fits centre and scale to frames of motion, `[n_frames, 25]`; returns the names of the channels that
    /// are constant as well, whose scale is 1.
    ///
    /// # Panics
    /// When there are no frames, or they have another number of channels.
    pub fn fit(frames: ArrayView2<f32>) -> (Self, Vec<&'static str>) {
        assert_eq!(frames.ncols(), MOTION_DIM, "channels of motion");
        assert!(frames.nrows() > 0, "a normalizer is fitted to frames");
        let mut fitted = Self::identity();
        let mut constant = Vec::new();
        for channel in Channel::ALL {
            for i in channel.range() {
                let mut values: Vec<f64> = frames.column(i).iter().map(|&x| f64::from(x)).collect();
                let (mean, spread) = robust_moments(&mut values);
                if channel == Channel::Quaternion {
                    fitted.scale[i] = (mean.hypot(spread) as f32).max(MIN_QUATERNION_SCALE);
                    continue;
                }
                fitted.centre[i] = mean as f32;
                if spread < MIN_SPREAD {
                    constant.push(CHANNEL_NAMES[i]);
                    continue;
                }
                let least = if channel == Channel::Style { MIN_STYLE_SCALE } else { 0.0 };
                fitted.scale[i] = (spread as f32).max(least);
            }
        }
        (fitted, constant)
    }

    /// Turns metres and the like into units of spread, in place, `[n_frames, 25]`.
    pub fn normalize(&self, mut frames: ArrayViewMut2<f32>) {
        for mut row in frames.rows_mut() {
            for (i, x) in row.iter_mut().enumerate() {
                *x = (*x - self.centre[i]) / self.scale[i];
            }
        }
    }

    /// Undoes [`Normalizer::normalize`].
    pub fn denormalize(&self, mut frames: ArrayViewMut2<f32>) {
        for mut row in frames.rows_mut() {
            for (i, x) in row.iter_mut().enumerate() {
                *x = *x * self.scale[i] + self.centre[i];
            }
        }
    }
}

/// Returns mean and standard deviation of the values held within their outer percentiles.
fn robust_moments(values: &mut [f64]) -> (f64, f64) {
    let low = percentile(values, OUTLIERS_PERCENT).unwrap_or(0.0);
    let high = percentile(values, 100.0 - OUTLIERS_PERCENT).unwrap_or(0.0);
    let n = values.len() as f64;
    let held = || values.iter().map(|x| x.clamp(low, high));
    let mean = held().sum::<f64>() / n;
    let variance = held().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use proptest::prelude::*;

    /// Channel i runs through ±(i + 1) around i / 2, evenly.
    fn even(n: usize) -> Array2<f32> {
        Array2::from_shape_fn((n, MOTION_DIM), |(t, i)| {
            let u = 2.0 * (t as f32 + 0.5) / n as f32 - 1.0;
            0.5 * i as f32 + (i + 1) as f32 * u
        })
    }

    #[test]
    fn an_even_spread_has_a_closed_form() {
        let (fitted, constant) = Normalizer::fit(even(2001).view());
        assert!(constant.is_empty());
        for i in 0..MOTION_DIM {
            let (middle, spread) = (0.5 * i as f32, (i + 1) as f32 / 3.0_f32.sqrt());
            let is_quaternion = Channel::Quaternion.range().contains(&i);
            let (centre, scale) =
                if is_quaternion { (0.0, middle.hypot(spread)) } else { (middle, spread) };
            // Holding 0.2 % of an even spread in changes its deviation by less than 0.3 %.
            assert!((fitted.centre[i] - centre).abs() < 1e-4, "{i}: {}", fitted.centre[i]);
            assert!((fitted.scale[i] / scale - 1.0).abs() < 3e-3, "{i}: {}", fitted.scale[i]);
        }
    }

    #[test]
    fn wild_frames_stretch_nothing_and_constant_channels_keep_their_unit() {
        let mut frames = even(5003);
        frames.row_mut(17).fill(1e6);
        frames.column_mut(Channel::Phase.range().start).fill(0.25);
        frames.column_mut(3).fill(-2.0);
        frames.column_mut(18).map_inplace(|x| *x *= 1e-3);
        frames.column_mut(10).fill(-0.01);
        let (wild, constant) = Normalizer::fit(frames.view());
        let (tame, _) = Normalizer::fit(even(5003).view());
        assert_eq!(constant, ["velocity_x", "phase"]);
        assert_eq!((wild.centre[3], wild.scale[3], wild.centre[16]), (-2.0, 1.0, 0.25));
        assert_eq!((wild.scale[18], wild.centre[10], wild.scale[10]), (0.1, 0.0, 0.05));
        for i in [0, 8, 13, 24] {
            assert!((wild.scale[i] / tame.scale[i] - 1.0).abs() < 2e-3, "{i}");
        }
    }

    proptest! {
        #[test]
        fn denormalizing_undoes_normalizing(values in prop::collection::vec(-50.0..50.0f32, 75)) {
            let (fitted, _) = Normalizer::fit(even(301).view());
            let frames = Array2::from_shape_vec((3, MOTION_DIM), values).expect("3 × 25");
            let mut there_and_back = frames.clone();
            fitted.normalize(there_and_back.view_mut());
            fitted.denormalize(there_and_back.view_mut());
            for (a, b) in there_and_back.iter().zip(&frames) {
                // A few roundings of numbers up to 100.
                prop_assert!((a - b).abs() < 4e-5, "{a} against {b}");
            }
        }
    }
}
