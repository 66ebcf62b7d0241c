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

    /// Returns the same of a body that goes `x_m`, `z_m` beside: every position that is asked for is moved.
    ///
    /// # Errors
    /// [`ControlError`] where that leaves the limits.
    pub fn moved(
        &self,
        [x_m, z_m]: [f64; 2],
        n_frames: usize,
        limits: ChannelLimits,
    ) -> Result<Self, ControlError> {
        let first = Channel::Position.range().start;
        let move_one = |(frame, wanted): &(usize, WantedValue)| {
            let wanted = match *wanted {
                WantedValue::Value { channel, value } if channel == first => {
                    WantedValue::Value { channel, value: value + x_m }
                }
                WantedValue::Value { channel, value } if channel == first + 2 => {
                    WantedValue::Value { channel, value: value + z_m }
                }
                wanted => wanted,
            };
            (*frame, wanted)
        };
        Self::new(self.wanted.iter().map(move_one).collect(), n_frames, limits)
    }

    /// Returns where the track begins: what is asked of its first frame, and `otherwise` where nothing is.
    pub fn placement(&self, otherwise: Placement) -> Placement {
        let first = self.wanted.iter().take_while(|(frame, _)| *frame == 0);
        let mut position_m = [otherwise.x_m, 0.0, otherwise.z_m];
        let mut orientation = facing(otherwise.yaw_rad);
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
mod tests;
