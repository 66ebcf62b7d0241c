//! A motion trajectory `[T, 25]` and the checks every consumer may rely on.

use ndarray::{Array2, ArrayView2, s};
use thiserror::Error;

use super::channels::{BODY, CHANNEL_NAMES, Channel, MOTION_DIM};
use super::layout::ColumnGroup;

/// Largest allowed deviation of a quaternion norm from one.
pub const QUATERNION_NORM_TOLERANCE: f64 = 0.05;

/// Why a trajectory was refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum TrajectoryError {
    /// The array is not `[T, 25]` with `T >= 1`.
    #[error(
        "trajectory has shape [{n_frames}, {n_channels}], expected [T, {MOTION_DIM}] with T >= 1; \
         write one row per frame in the channel order of the format"
    )]
    Shape { n_frames: usize, n_channels: usize },
    /// A NaN or an infinity; the first in frame order.
    #[error(
        "channel {channel} is {value} at frame {frame} ({count} non-finite values in all); \
         repair or remove the phrase"
    )]
    NonFinite { channel: &'static str, frame: usize, value: f32, count: usize },
    /// A quaternion far from unit norm; the first in frame order.
    #[error(
        "quaternion norm is {norm:.4} at frame {frame}, expected 1 within {tolerance} \
         ({count} such frames in all); normalise the quaternions or remove the phrase"
    )]
    QuaternionNorm { frame: usize, norm: f64, tolerance: f64, count: usize },
    /// A value outside its channel's limits; the first in frame order.
    #[error(
        "channel {channel} is {value:?} {unit} at frame {frame}, allowed {low} to {high} {unit} \
         ({count} values outside their limits in all); correct the unit or remove the phrase"
    )]
    ChannelLimit {
        channel: &'static str,
        frame: usize,
        value: f32,
        low: f32,
        high: f32,
        unit: &'static str,
        count: usize,
    },
}

impl TrajectoryError {
    /// The kind of defect as one word for tables: `shape`, `non_finite`, `quaternion_norm` or
    /// `channel_limit`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Shape { .. } => "shape",
            Self::NonFinite { .. } => "non_finite",
            Self::QuaternionNorm { .. } => "quaternion_norm",
            Self::ChannelLimit { .. } => "channel_limit",
        }
    }
}

/// Which values a channel may take; the presets differ in angular velocity alone.
///
/// Position ±100 m, velocity ±50 m/s, acceleration ±100 m/s², phase 0 to 1 bar, style unbounded.
#[derive(
    Clone,
    Copy,
    Debug,
    PartialEq,
    Eq,
    Hash,
    Default,
    clap::ValueEnum,
    serde::Serialize,
    serde::Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum ChannelLimits {
    /// Angular velocity within ±20 rad/s: fast spins of captured dance reach 19.4.
    #[default]
    Wide,
    /// Angular velocity within ±10 rad/s, as the motion format was first written down.
    Reference,
}

impl ChannelLimits {
    /// Lowest and highest allowed value of a group of columns, in the group's unit.
    pub const fn of(self, group: &ColumnGroup) -> (f32, f32) {
        match self {
            Self::Wide => group.limits.wide,
            Self::Reference => group.limits.reference,
        }
    }

    /// Lowest and highest allowed value of a channel group, in the group's unit.
    pub const fn bounds(self, channel: Channel) -> (f32, f32) {
        self.of(channel.columns().group)
    }
}

/// A root trajectory of `T >= 1` frames at [`crate::units::FPS`], shape `[T, 25]`, in C order.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    frames: Array2<f32>,
}

impl Trajectory {
    /// Wraps an array of shape `[T, 25]`, `T >= 1`, without looking at its values.
    ///
    /// Errors: [`TrajectoryError::Shape`].
    pub fn new(frames: Array2<f32>) -> Result<Self, TrajectoryError> {
        let (n_frames, n_channels) = frames.dim();
        if n_frames == 0 || n_channels != MOTION_DIM {
            return Err(TrajectoryError::Shape { n_frames, n_channels });
        }
        let frames = if frames.is_standard_layout() {
            frames
        } else {
            frames.as_standard_layout().into_owned()
        };
        Ok(Self { frames })
    }

    /// Number of frames `T`.
    pub fn n_frames(&self) -> usize {
        self.frames.nrows()
    }

    /// All values, shape `[T, 25]`.
    pub fn view(&self) -> ArrayView2<'_, f32> {
        self.frames.view()
    }

    /// The columns of one channel group, shape `[T, width]`.
    pub fn channel(&self, channel: Channel) -> ArrayView2<'_, f32> {
        self.frames.slice(s![.., channel.range()])
    }

    /// The array itself, shape `[T, 25]`.
    pub fn into_array(self) -> Array2<f32> {
        self.frames
    }

    /// Checks finiteness, quaternion norms and channel limits, in this order of report.
    ///
    /// Errors: the first [`TrajectoryError::NonFinite`], else the first
    /// [`TrajectoryError::QuaternionNorm`], else the first [`TrajectoryError::ChannelLimit`].
    pub fn check(&self, limits: &ChannelLimits) -> Result<(), TrajectoryError> {
        if self.is_sound(limits) {
            return Ok(());
        }
        // Only a trajectory that will be refused pays for the passes that name the defect.
        self.check_finite()?;
        self.check_quaternion_norms()?;
        self.check_limits(limits)
    }

    /// One pass without early exit or report: true only if [`Self::check`] has nothing to say.
    fn is_sound(&self, limits: &ChannelLimits) -> bool {
        let Some(values) = self.frames.as_slice() else { return false };
        let mut low = [0.0; MOTION_DIM];
        let mut high = [0.0; MOTION_DIM];
        for columns in BODY.groups() {
            let (l, h) = limits.of(columns.group);
            low[columns.range()].fill(l);
            high[columns.range()].fill(h);
        }
        let (min_norm2, max_norm2) = norm2_bounds();
        let mut sound = true;
        for frame in values.as_chunks::<MOTION_DIM>().0 {
            for i in 0..MOTION_DIM {
                // A NaN fails both comparisons, an infinity one of them.
                sound &= (frame[i] >= low[i]) & (frame[i] <= high[i]);
            }
            let norm2: f64 =
                frame[Channel::Quaternion.range()].iter().map(|&c| f64::from(c).powi(2)).sum();
            sound &= (norm2 >= min_norm2) & (norm2 <= max_norm2);
        }
        sound
    }

    /// Refuses NaN and infinities alone.
    pub(super) fn check_finite(&self) -> Result<(), TrajectoryError> {
        let mut bad = self.frames.indexed_iter().filter(|(_, v)| !v.is_finite());
        let Some(((frame, i), &value)) = bad.next() else { return Ok(()) };
        let count = 1 + bad.count();
        Err(TrajectoryError::NonFinite { channel: CHANNEL_NAMES[i], frame, value, count })
    }

    fn check_quaternion_norms(&self) -> Result<(), TrajectoryError> {
        let (min_norm2, max_norm2) = norm2_bounds();
        let mut bad = self
            .channel(Channel::Quaternion)
            .rows()
            .into_iter()
            .map(|q| q.iter().map(|&c| f64::from(c).powi(2)).sum::<f64>())
            .enumerate()
            .filter(|(_, norm2)| !(min_norm2..=max_norm2).contains(norm2))
            .collect::<Vec<_>>()
            .into_iter();
        let Some((frame, norm2)) = bad.next() else { return Ok(()) };
        let (norm, tolerance) = (norm2.sqrt(), QUATERNION_NORM_TOLERANCE);
        Err(TrajectoryError::QuaternionNorm { frame, norm, tolerance, count: 1 + bad.len() })
    }

    fn check_limits(&self, limits: &ChannelLimits) -> Result<(), TrajectoryError> {
        let outside = BODY.groups().flat_map(|columns| {
            let (low, high) = limits.of(columns.group);
            self.frames
                .slice(s![.., columns.range()])
                .indexed_iter()
                .filter(|(_, v)| !(low..=high).contains(*v))
                .map(|((frame, i), &v)| (frame, columns.first + i, v, columns.group))
                .collect::<Vec<_>>()
        });
        let outside: Vec<_> = outside.collect();
        let Some(&(frame, i, value, group)) = outside.iter().min_by_key(|(f, i, ..)| (*f, *i))
        else {
            return Ok(());
        };
        let (low, high) = limits.of(group);
        Err(TrajectoryError::ChannelLimit {
            channel: CHANNEL_NAMES[i],
            frame,
            value,
            low,
            high,
            unit: group.unit,
            count: outside.len(),
        })
    }
}

fn norm2_bounds() -> (f64, f64) {
    ((1.0 - QUATERNION_NORM_TOLERANCE).powi(2), (1.0 + QUATERNION_NORM_TOLERANCE).powi(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn still(n_frames: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n_frames, MOTION_DIM));
        frames.column_mut(Channel::Quaternion.range().start).fill(1.0);
        frames
    }

    fn refusal(frames: Array2<f32>, limits: ChannelLimits) -> TrajectoryError {
        Trajectory::new(frames).unwrap().check(&limits).unwrap_err()
    }

    #[test]
    fn shapes_other_than_t_by_25_are_refused() {
        for shape in [(0, 25), (7, 24), (25, 7)] {
            let error = Trajectory::new(Array2::zeros(shape)).unwrap_err();
            assert_eq!(error.kind(), "shape");
        }
        assert_eq!(
            Trajectory::new(Array2::zeros((7, 24))).unwrap_err().to_string(),
            "trajectory has shape [7, 24], expected [T, 25] with T >= 1; \
             write one row per frame in the channel order of the format"
        );
    }

    #[test]
    fn a_transposed_array_keeps_its_values_and_passes() {
        let trajectory = Trajectory::new(
            still(11).reversed_axes().as_standard_layout().into_owned().reversed_axes(),
        )
        .unwrap();
        assert_eq!(trajectory.view(), still(11));
        assert_eq!(trajectory.check(&ChannelLimits::Wide), Ok(()));
        assert_eq!(trajectory.channel(Channel::Style).dim(), (11, 8));
    }

    #[test]
    fn non_finite_values_are_named_and_counted_before_anything_else() {
        let mut frames = still(13);
        frames[[7, 4]] = f32::NAN;
        frames[[9, 0]] = f32::INFINITY;
        frames[[12, 24]] = f32::NEG_INFINITY;
        frames[[2, 9]] = 5.0;
        let error = refusal(frames, ChannelLimits::Wide);
        assert_eq!(error.kind(), "non_finite");
        assert_eq!(
            error.to_string(),
            "channel velocity_y is NaN at frame 7 (3 non-finite values in all); \
             repair or remove the phrase"
        );
    }

    #[test]
    fn quaternion_norms_may_be_off_by_five_percent() {
        let mut frames = still(5);
        frames[[1, 9]] = 1.049;
        frames[[2, 9]] = -0.951;
        assert_eq!(Trajectory::new(frames.clone()).unwrap().check(&ChannelLimits::Wide), Ok(()));
        frames[[3, 9]] = 0.0;
        frames[[4, 10]] = 0.75;
        let error = refusal(frames, ChannelLimits::Wide);
        assert_eq!(error.kind(), "quaternion_norm");
        assert_eq!(
            error.to_string(),
            "quaternion norm is 0.0000 at frame 3, expected 1 within 0.05 \
             (2 such frames in all); normalise the quaternions or remove the phrase"
        );
    }

    #[test]
    fn limits_are_inclusive_and_differ_in_angular_velocity() {
        let mut frames = still(3);
        for (i, v) in [(0, -100.0), (5, 50.0), (8, 100.0), (16, 1.0), (20, 1e30), (14, -15.5)] {
            frames[[1, i]] = v;
        }
        assert_eq!(Trajectory::new(frames.clone()).unwrap().check(&ChannelLimits::Wide), Ok(()));
        let error = refusal(frames.clone(), ChannelLimits::Reference);
        assert_eq!(error.kind(), "channel_limit");
        assert_eq!(
            error.to_string(),
            "channel angular_velocity_y is -15.5 rad/s at frame 1, allowed -10 to 10 rad/s \
             (1 values outside their limits in all); correct the unit or remove the phrase"
        );
        frames[[0, 16]] = -0.25;
        frames[[2, 3]] = 51.0;
        let TrajectoryError::ChannelLimit { channel, frame, low, count, .. } =
            refusal(frames, ChannelLimits::Wide)
        else {
            panic!("expected a channel limit");
        };
        assert_eq!((channel, frame, low, count), ("phase", 0, 0.0, 2));
    }

    proptest! {
        #[test]
        fn the_fast_pass_and_the_naming_passes_agree(
            cells in prop::collection::vec((0..4usize, 0..25usize, prop::num::f32::ANY), 0..4)
        ) {
            let mut frames = still(4);
            for (t, i, v) in cells {
                frames[[t, i]] = v;
            }
            let trajectory = Trajectory::new(frames).unwrap();
            for limits in [ChannelLimits::Wide, ChannelLimits::Reference] {
                let named = trajectory
                    .check_finite()
                    .and_then(|()| trajectory.check_quaternion_norms())
                    .and_then(|()| trajectory.check_limits(&limits));
                prop_assert_eq!(trajectory.is_sound(&limits), named.is_ok());
            }
        }
    }
}
