//! What a track's motion must do: poses and values at frames, and the motion bent so that it does.

use ndarray::{Array2, ArrayView2};

use crate::motion::postprocess::HeldPoses;
use crate::motion::quaternion::{
    Quaternion, angular_velocity, dot, from_axis_angle, from_rotation_vector, make_sign_continuous,
    mul, normalize,
};
use crate::motion::{BODY, CHANNEL_NAMES, Channel, ChannelLimits, MOTION_DIM, Placement};
use crate::units::frames_to_s;

/// Frames over which a correction fades out on either side of what asked for it: half a second.
pub const REACH_FRAMES: usize = 15;

/// Two values of one channel nearer than this are one; smaller than what f32 keeps of 10 m.
const SAME: f64 = 1e-6;

/// A value that one channel must have at one frame; the channels of an orientation come together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WantedValue {
    /// A channel other than those of the orientation, by its place in a frame.
    Value { channel: usize, value: f64 },
    /// A unit quaternion.
    Orientation(Quaternion),
}

/// Why constraints cannot be kept.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    #[error(
        "a constraint on {what} is at frame {frame} ({:.2} s), but the track has {n_frames} frames \
         ({:.2} s); move it or leave it out", frames_to_s(*frame), frames_to_s(*n_frames)
    )]
    Outside { what: String, frame: usize, n_frames: usize },
    #[error("{what} at frame {frame} must be {first} and {second} at once; keep one of the two")]
    Contradiction { what: String, frame: usize, first: String, second: String },
    #[error(
        "{what} at frame {frame} is {value}, allowed {low} to {high} {unit}; correct the constraint"
    )]
    Limit { what: String, frame: usize, value: f64, low: f32, high: f32, unit: &'static str },
    #[error("the orientation at frame {frame} has length {length:.4}; a quaternion has length 1")]
    Length { frame: usize, length: f64 },
}

/// All constraints of a track, in the world: the track begins at the origin and faces +Z unless they say
/// otherwise.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Constraints {
    /// In order of frame.
    wanted: Vec<(usize, WantedValue)>,
}

/// How far a motion is from one constraint.
#[derive(Clone, Debug, PartialEq)]
pub struct Miss {
    pub frame: usize,
    pub what: &'static str,
    /// In the channel's unit; of an orientation the angle, rad.
    pub error: f64,
}

impl WantedValue {
    fn what(&self) -> &'static str {
        match self {
            Self::Value { channel, .. } => CHANNEL_NAMES[*channel],
            Self::Orientation(_) => Channel::Quaternion.name(),
        }
    }

    fn shown(&self) -> String {
        match self {
            Self::Value { value, .. } => format!("{value}"),
            Self::Orientation(q) => format!("{q:?}"),
        }
    }

    fn is_same_channel(&self, other: &Self) -> bool {
        self.what() == other.what()
    }

    fn is_same(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Value { value: a, .. }, Self::Value { value: b, .. }) => (a - b).abs() <= SAME,
            (Self::Orientation(a), Self::Orientation(b)) => 1.0 - dot(*a, *b).abs() <= SAME,
            _ => false,
        }
    }
}

impl Constraints {
    /// Checks constraints against a track of `n_frames` and each other; what is said twice is kept once.
    ///
    /// # Errors
    /// [`ControlError`] for the first that is outside the track or its channel's limits, or contradicts
    /// another.
    pub fn new(
        mut wanted: Vec<(usize, WantedValue)>,
        n_frames: usize,
        limits: ChannelLimits,
    ) -> Result<Self, ControlError> {
        wanted.sort_by_key(|(frame, wanted)| (*frame, wanted.what()));
        let mut kept: Vec<(usize, WantedValue)> = Vec::with_capacity(wanted.len());
        for (frame, wanted) in wanted {
            let what = || wanted.what().to_owned();
            if frame >= n_frames {
                return Err(ControlError::Outside { what: what(), frame, n_frames });
            }
            let wanted = match wanted {
                WantedValue::Value { channel, value } => {
                    let group = BODY.group_of(channel).map(|columns| columns.group);
                    let unit = group.map_or("", |group| group.unit);
                    let (low, high) = group.map_or((0.0, 0.0), |group| limits.of(group));
                    if !(f64::from(low)..=f64::from(high)).contains(&value) {
                        let what = what();
                        return Err(ControlError::Limit { what, frame, value, low, high, unit });
                    }
                    wanted
                }
                WantedValue::Orientation(q) => {
                    let length = dot(q, q).sqrt();
                    if (length - 1.0).abs() > 0.01 || !length.is_finite() {
                        return Err(ControlError::Length { frame, length });
                    }
                    WantedValue::Orientation(normalize(q))
                }
            };
            match kept.last() {
                Some((at, before)) if *at == frame && before.is_same_channel(&wanted) => {
                    if !before.is_same(&wanted) {
                        let (first, second) = (before.shown(), wanted.shown());
                        return Err(ControlError::Contradiction {
                            what: what(),
                            frame,
                            first,
                            second,
                        });
                    }
                }
                _ => kept.push((frame, wanted)),
            }
        }
        Ok(Self { wanted: kept })
    }

    /// Returns all that is asked for, in order of frame.
    pub fn wanted(&self) -> &[(usize, WantedValue)] {
        &self.wanted
    }

    /// Returns whether nothing is asked for.
    pub fn is_empty(&self) -> bool {
        self.wanted.is_empty()
    }

    /// Returns whether a part of a track is bent.
    pub fn touch(&self, frames: &std::ops::Range<usize>) -> bool {
        let reach = frames.start.saturating_sub(REACH_FRAMES)..frames.end + REACH_FRAMES;
        self.wanted.iter().any(|(frame, _)| reach.contains(frame))
    }

    /// Returns where the track begins: what is asked of its first frame, the origin otherwise.
    pub fn placement(&self) -> Placement {
        let first = self.wanted.iter().take_while(|(frame, _)| *frame == 0);
        let (mut position_m, mut orientation) = ([0.0; 3], [1.0, 0.0, 0.0, 0.0]);
        for (_, wanted) in first {
            match *wanted {
                WantedValue::Value { channel, value }
                    if Channel::Position.range().contains(&channel) =>
                {
                    position_m[channel] = value;
                }
                WantedValue::Orientation(q) => orientation = q,
                WantedValue::Value { .. } => {}
            }
        }
        Placement::of(position_m, orientation)
    }

    /// Bends motion so that it does what is asked, or goes `strength` (0 to 1) of the way there.
    ///
    /// The correction of a channel is that of each constraint at its frame and fades to the next one, or to
    /// nothing over [`REACH_FRAMES`], by 1 − 3u² + 2u³; orientations are turned by the rotation that is
    /// missing, in the same shares. Velocities are not touched: they follow from the positions later.
    ///
    /// # Shapes
    /// `frames`: \[T, 25\] in the world, of which the first is frame `first` of the track
    pub fn bend(&self, frames: &mut Array2<f32>, first: usize, strength: f64) {
        for channel in (0..MOTION_DIM).filter(|i| !Channel::Quaternion.range().contains(i)) {
            let errors =
                self.in_range(first, frames.nrows()).filter_map(|(t, wanted)| match wanted {
                    WantedValue::Value { channel: of, value } if of == channel => {
                        Some((t, [value - f64::from(frames[[t, channel]])]))
                    }
                    _ => None,
                });
            for (t, [x]) in spread(&errors.collect::<Vec<_>>(), frames.nrows()) {
                frames[[t, channel]] = (f64::from(frames[[t, channel]]) + strength * x) as f32;
            }
        }
        let errors = self.in_range(first, frames.nrows()).filter_map(|(t, wanted)| match wanted {
            WantedValue::Orientation(q) => {
                Some((t, rotation_vector(q, orientation(frames.view(), t))))
            }
            WantedValue::Value { .. } => None,
        });
        let corrections = spread(&errors.collect::<Vec<_>>(), frames.nrows());
        if corrections.is_empty() {
            return;
        }
        let mut turned: Vec<Quaternion> =
            (0..frames.nrows()).map(|t| orientation(frames.view(), t)).collect();
        for (t, v) in corrections {
            turned[t] = mul(from_rotation_vector(v.map(|x| strength * x)), turned[t]);
        }
        make_sign_continuous(&mut turned);
        for (mut row, q) in frames.rows_mut().into_iter().zip(turned) {
            for (i, x) in Channel::Quaternion.range().zip(q) {
                row[i] = x as f32;
            }
        }
    }

    /// Returns the poses that are asked for, which post-processing may leave as they are once motion is bent
    /// to them.
    pub fn held(&self, n_frames: usize) -> HeldPoses {
        let mut held =
            HeldPoses { position: vec![[false; 3]; n_frames], orientation: vec![false; n_frames] };
        for (t, wanted) in self.in_range(0, n_frames) {
            match wanted {
                WantedValue::Value { channel, .. }
                    if Channel::Position.range().contains(&channel) =>
                {
                    held.position[t][channel - Channel::Position.range().start] = true;
                }
                WantedValue::Orientation(_) => held.orientation[t] = true,
                WantedValue::Value { .. } => {}
            }
        }
        held
    }

    /// Returns how far a track's motion, `[T, 25]` in the world, is from each constraint.
    pub fn errors(&self, frames: ArrayView2<f32>) -> Vec<Miss> {
        self.errors_from(frames, 0)
    }

    /// The same of a part of a track that begins at frame `first`.
    pub(super) fn errors_from(&self, frames: ArrayView2<f32>, first: usize) -> Vec<Miss> {
        let error = |(t, wanted): (usize, WantedValue)| Miss {
            frame: t,
            what: wanted.what(),
            error: match wanted {
                WantedValue::Value { channel, value } => {
                    (value - f64::from(frames[[t, channel]])).abs()
                }
                WantedValue::Orientation(q) => {
                    let v = rotation_vector(q, orientation(frames, t));
                    v.iter().map(|x| x * x).sum::<f64>().sqrt()
                }
            },
        };
        self.in_range(first, frames.nrows()).map(error).collect()
    }

    /// The constraints of some frames, which are counted from `first`.
    pub(super) fn in_range(
        &self,
        first: usize,
        n: usize,
    ) -> impl Iterator<Item = (usize, WantedValue)> + '_ {
        let inside = move |&(frame, wanted): &(usize, WantedValue)| {
            frame.checked_sub(first).filter(|t| *t < n).map(|t| (t, wanted))
        };
        self.wanted.iter().filter_map(inside)
    }
}

/// Spreads errors at some frames over those beside them; returns frames that change, and by how much.
fn spread<const N: usize>(errors: &[(usize, [f64; N])], n_frames: usize) -> Vec<(usize, [f64; N])> {
    let (Some(first), Some(last)) = (errors.first(), errors.last()) else { return Vec::new() };
    let begin = first.0.saturating_sub(REACH_FRAMES);
    let end = (last.0 + REACH_FRAMES + 1).min(n_frames);
    let mut after = 0;
    let mut changes = Vec::with_capacity(end - begin);
    for t in begin..end {
        while after < errors.len() && errors[after].0 <= t {
            after += 1;
        }
        let (before, next) = (after.checked_sub(1).map(|i| errors[i]), errors.get(after).copied());
        let gap = match (before, next) {
            (Some(a), Some(b)) => (b.0 - a.0).min(REACH_FRAMES),
            _ => REACH_FRAMES,
        };
        let share = |distance: usize| {
            let u = (distance as f64 / gap as f64).min(1.0);
            1.0 - u * u * (3.0 - 2.0 * u)
        };
        let mut change = [0.0; N];
        for (at, x) in before.into_iter().chain(next) {
            let w = share(at.abs_diff(t));
            change.iter_mut().zip(x).for_each(|(sum, x)| *sum += w * x);
        }
        changes.push((t, change));
    }
    changes
}

pub(super) fn orientation(frames: ArrayView2<f32>, t: usize) -> Quaternion {
    let first = Channel::Quaternion.range().start;
    normalize(std::array::from_fn(|i| f64::from(frames[[t, first + i]])))
}

/// The rotation that turns `from` into `to`, as its axis times its angle, along the shorter arc.
pub(super) fn rotation_vector(to: Quaternion, from: Quaternion) -> [f64; 3] {
    angular_velocity(from, to, 1.0)
}

/// Returns constraints that make a track begin as another motion ends: its last `n` frames are the first.
///
/// `before`: \[T, 25\]; positions and orientations are taken as they are, so that the track stands where
/// that motion ended.
pub fn continuing(before: ArrayView2<f32>, n: usize) -> Vec<(usize, WantedValue)> {
    let first = before.nrows().saturating_sub(n);
    let mut wanted = Vec::new();
    for t in first..before.nrows() {
        for channel in Channel::Position.range() {
            let value = f64::from(before[[t, channel]]);
            wanted.push((t - first, WantedValue::Value { channel, value }));
        }
        wanted.push((t - first, WantedValue::Orientation(orientation(before, t))));
    }
    wanted
}

/// Returns the orientation that faces a heading, rad from +Z towards +X, upright.
pub fn facing(heading_rad: f64) -> Quaternion {
    from_axis_angle([0.0, 1.0, 0.0], heading_rad)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(frame: usize, channel: usize, value: f64) -> (usize, WantedValue) {
        (frame, WantedValue::Value { channel, value })
    }

    /// Standing at (1, 0.9, 0), facing +Z.
    fn standing(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, MOTION_DIM));
        frames.column_mut(0).fill(1.0);
        frames.column_mut(1).fill(0.9);
        frames.column_mut(9).fill(1.0);
        frames
    }

    fn constraints(wanted: Vec<(usize, WantedValue)>) -> Constraints {
        Constraints::new(wanted, 101, ChannelLimits::Wide).expect("constraints that can be kept")
    }

    #[test]
    fn motion_passes_through_what_is_asked_and_is_left_alone_elsewhere() {
        let turned = facing(1.2);
        let asked = constraints(vec![
            value(50, 0, 2.0),
            value(57, 0, 0.5),
            (30, WantedValue::Orientation(turned)),
        ]);
        let mut frames = standing(101);
        assert!((asked.errors(frames.view())[0].error - 1.2).abs() < 1e-6);
        asked.bend(&mut frames, 0, 1.0);
        for miss in asked.errors(frames.view()) {
            // Rounding of 2 m, and of a quaternion's components.
            assert!(miss.error < 1e-6, "{miss:?}");
        }
        assert_eq!((frames[[50, 0]], frames[[57, 0]]), (2.0, 0.5));
        // Half way between two constraints 7 apart, 3.5 is not a frame: 4 of 7 frames on from the first.
        let u = 4.0_f64 / 7.0;
        let w = 1.0 - u * u * (3.0 - 2.0 * u);
        let expected = 1.0 + 1.0 * w - 0.5 * (1.0 - w);
        assert!((f64::from(frames[[54, 0]]) - expected).abs() < 1e-6, "{}", frames[[54, 0]]);
        let held = asked.held(60);
        let frames_held =
            |axis: usize| (0..60).filter(|t| held.position[*t][axis]).collect::<Vec<_>>();
        assert_eq!((frames_held(0), frames_held(1)), (vec![50, 57], vec![]));
        assert!((0..60).all(|t| held.orientation[t] == (t == 30)));
        let before = standing(101);
        assert_eq!(frames[[35, 0]], 1.0, "15 frames before the first nothing is left of it");
        assert_eq!(frames.row(72), before.row(72));
        assert_eq!(frames.column(1), before.column(1));
        let turn = |t: usize| 2.0 * frames[[t, 11]].atan2(frames[[t, 9]]);
        assert!((turn(30) - 1.2).abs() < 1e-6 && turn(15).abs() < 1e-6 && turn(45).abs() < 1e-6);
        assert!(turn(24) > 0.1 && turn(24) < turn(28));
    }

    #[test]
    fn a_part_of_a_track_and_a_part_of_the_way() {
        let asked = constraints(vec![value(50, 1, 1.9), value(3, 1, 0.0)]);
        let mut frames = standing(20);
        asked.bend(&mut frames, 45, 0.25);
        assert!((frames[[5, 1]] - 1.15).abs() < 1e-6, "{}", frames[[5, 1]]);
        assert_eq!(frames[[5, 0]], 1.0);
    }

    #[test]
    fn the_first_frame_says_where_a_track_begins() {
        assert_eq!(constraints(vec![value(9, 0, 3.0)]).placement(), Placement::default());
        let asked = constraints(vec![
            value(0, 0, 3.0),
            value(0, 2, -1.0),
            (0, WantedValue::Orientation(facing(0.5))),
        ]);
        let placement = asked.placement();
        assert_eq!((placement.x_m, placement.z_m), (3.0, -1.0));
        assert!((placement.yaw_rad - 0.5).abs() < 1e-12);
    }

    #[test]
    fn a_motion_is_continued_from_its_last_frames() {
        let mut before = standing(40);
        for t in 0..40 {
            before[[t, 2]] = t as f32 * 0.1;
        }
        let asked = constraints(continuing(before.view(), 7));
        let mut frames = standing(101);
        asked.bend(&mut frames, 0, 1.0);
        for t in 0..7 {
            assert_eq!(frames[[t, 2]], before[[33 + t, 2]]);
        }
        assert_eq!(asked.errors(frames.view()).len(), 28);
    }

    #[test]
    fn constraints_that_cannot_be_kept_are_named() {
        let said = |wanted: Vec<(usize, WantedValue)>| {
            let refused = Constraints::new(wanted, 101, ChannelLimits::Wide);
            refused.expect_err("no constraints").to_string()
        };
        assert_eq!(
            said(vec![value(101, 1, 0.5)]),
            "a constraint on position_y is at frame 101 (3.37 s), but the track has 101 frames (3.37 s); move \
             it or leave it out"
        );
        assert_eq!(
            said(vec![value(7, 1, 0.5), value(8, 1, 0.5), value(7, 1, 0.75)]),
            "position_y at frame 7 must be 0.5 and 0.75 at once; keep one of the two"
        );
        assert_eq!(
            said(vec![value(7, 3, 60.0)]),
            "velocity_x at frame 7 is 60, allowed -50 to 50 m/s; correct the constraint"
        );
        assert_eq!(
            said(vec![(7, WantedValue::Orientation([1.0, 1.0, 0.0, 0.0]))]),
            "the orientation at frame 7 has length 1.4142; a quaternion has length 1"
        );
        let twice = constraints(vec![value(7, 1, 0.5), value(7, 1, 0.5)]);
        assert_eq!(twice.wanted.len(), 1);
    }
}
