//! Motion in units of its own spread, in which diffusion runs.

use ndarray::{ArrayView2, ArrayViewMut2};
use serde::{Deserialize, Serialize};

use super::channels::BODY;
use super::layout::{ColumnRole, Layout};
use super::quantile::percentile;

/// Share of the values at either end that does not stretch the scale, in percent.
const OUTLIERS_PERCENT: f64 = 0.1;
/// A channel that spreads less, in its own unit, counts as constant.
const MIN_SPREAD: f64 = 1e-6;
/// Least scale of a component of the quaternion, 6° of a tilt: a body that hardly tilts in a library is not
/// blown up to the weight of one that does.
const MIN_QUATERNION_SCALE: f32 = 0.05;
/// Least scale of a free channel such as a style, which lies in (-1, 1): one that hardly moves in a library is
/// not blown up to the weight of one that does.
const MIN_FREE_SCALE: f32 = 0.1;

/// Centre and scale of every column of a layout: `z = (x - centre) / scale`.
///
/// Places, vectors and phases: mean and standard deviation of values held within the 0.1 and 99.9
/// percentiles, so that a few wild frames stretch nothing. Turns: centre 0, so that `q` and `-q` stay opposite,
/// and as scale the root mean square of each component, at least 0.05. With one scale of 1/2 for all four, tilts
/// were a fifth of a unit, drowned in noise until the last steps of a sampler, and came out at 0.63 of real
/// motion's angular velocity. Free columns: like the first, with a scale of at least 0.1.
///
/// Files have `centre` and `scale` alone, those of [`BODY`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "StoredNormalizer")]
pub struct Normalizer {
    #[serde(skip_serializing)]
    layout: Layout,
    pub centre: Vec<f32>,
    pub scale: Vec<f32>,
}

/// A normalizer as it stands in a file.
#[derive(Deserialize)]
struct StoredNormalizer {
    centre: Vec<f32>,
    scale: Vec<f32>,
}

impl TryFrom<StoredNormalizer> for Normalizer {
    type Error = String;

    fn try_from(stored: StoredNormalizer) -> Result<Self, String> {
        let StoredNormalizer { centre, scale } = stored;
        for (name, values) in [("centre", &centre), ("scale", &scale)] {
            if values.len() != BODY.width() {
                let (n, expected) = (values.len(), BODY.width());
                return Err(format!("{name} of a normalizer has {n} numbers, expected {expected}"));
            }
        }
        Ok(Self { layout: BODY, centre, scale })
    }
}

impl Normalizer {
    /// Leaves motion of [`BODY`] as it is.
    pub fn identity() -> Self {
        Self::identity_of(BODY)
    }

    /// Leaves motion of a layout as it is.
    pub fn identity_of(layout: Layout) -> Self {
        Self { layout, centre: vec![0.0; layout.width()], scale: vec![1.0; layout.width()] }
    }

    /// Returns the layout of the frames that are scaled.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Fits centre and scale to frames of [`BODY`], `[n_frames, 25]`; see [`Normalizer::fit_to`].
    ///
    /// # Panics
    /// As [`Normalizer::fit_to`].
    pub fn fit(frames: ArrayView2<f32>) -> (Self, Vec<&'static str>) {
        Self::fit_to(BODY, frames)
    }

    /// Fits centre and scale to frames, `[n_frames, columns]`; returns the names of the columns that are constant as
    /// well, whose scale is 1.
    ///
    /// # Panics
    /// When there are no frames, or they have another number of columns.
    pub fn fit_to(layout: Layout, frames: ArrayView2<f32>) -> (Self, Vec<&'static str>) {
        assert_eq!(frames.ncols(), layout.width(), "channels of motion");
        assert!(frames.nrows() > 0, "a normalizer is fitted to frames");
        let mut fitted = Self::identity_of(layout);
        let mut constant = Vec::new();
        for columns in layout.groups() {
            for (i, name) in columns.range().zip(columns.group.columns) {
                let mut values: Vec<f64> = frames.column(i).iter().map(|&x| f64::from(x)).collect();
                let (mean, spread) = robust_moments(&mut values);
                let least = match columns.group.role {
                    ColumnRole::Turn => {
                        fitted.scale[i] = (mean.hypot(spread) as f32).max(MIN_QUATERNION_SCALE);
                        continue;
                    }
                    ColumnRole::Free => MIN_FREE_SCALE,
                    ColumnRole::Place | ColumnRole::Vector | ColumnRole::Phase => 0.0,
                };
                fitted.centre[i] = mean as f32;
                if spread < MIN_SPREAD {
                    constant.push(*name);
                    continue;
                }
                fitted.scale[i] = (spread as f32).max(least);
            }
        }
        (fitted, constant)
    }

    /// Turns metres and the like into units of spread, in place, `[n_frames, columns]`.
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
    use crate::motion::channels::{Channel, MOTION_DIM};
    use crate::motion::layout::tests::ROOT;
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

    #[test]
    fn the_root_alone_is_scaled_by_its_own_roles() {
        let frames = Array2::from_shape_fn((2001, ROOT.width()), |(t, i)| {
            let u = 2.0 * (t as f32 + 0.5) / 2001.0 - 1.0;
            0.5 + (i + 1) as f32 * u
        });
        let (fitted, constant) = Normalizer::fit_to(ROOT, frames.view());
        assert!(constant.is_empty());
        assert_eq!((fitted.layout(), fitted.scale.len()), (ROOT, 13));
        for i in 0..13 {
            let spread = (i + 1) as f32 / 3.0_f32.sqrt();
            let is_turn = (6..10).contains(&i);
            let (centre, scale) =
                if is_turn { (0.0, 0.5_f32.hypot(spread)) } else { (0.5, spread) };
            assert!((fitted.centre[i] - centre).abs() < 1e-4, "{i}: {}", fitted.centre[i]);
            assert!((fitted.scale[i] / scale - 1.0).abs() < 3e-3, "{i}: {}", fitted.scale[i]);
        }
        let mut scaled = frames.clone();
        fitted.normalize(scaled.view_mut());
        assert_eq!(scaled[[7, 12]], (frames[[7, 12]] - fitted.centre[12]) / fitted.scale[12]);
        fitted.denormalize(scaled.view_mut());
        assert!((scaled[[7, 12]] - frames[[7, 12]]).abs() < 1e-5);
    }

    #[test]
    fn files_have_the_numbers_of_the_body() {
        let text = serde_json::to_string(&Normalizer::identity()).expect("numbers");
        assert!(text.starts_with("{\"centre\":[0.0,") && text.ends_with(",1.0]}"), "{text}");
        let read: Normalizer = serde_json::from_str(&text).expect("as written");
        assert_eq!(read, Normalizer::identity());
        let short = text.replacen("0.0,", "", 1);
        let error = serde_json::from_str::<Normalizer>(&short).expect_err("24 centres");
        let wanted = "centre of a normalizer has 24 numbers, expected 25";
        assert!(error.to_string().starts_with(wanted), "{error}");
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
