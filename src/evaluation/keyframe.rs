//! How far motion is from its keyframes: in place, in orientation and in time.

use ndarray::ArrayView2;

use super::control::rotation_error_deg;
use crate::motion::Channel;
use crate::motion::quaternion::Quaternion;
use crate::motion::vector::norm;
use crate::units::frames_to_s;

/// Frames on either side of a keyframe among which motion is looked for at its place: half a second.
pub const TIMING_REACH_FRAMES: usize = 15;
/// Two frames that are as near to a place up to this are as near, mm: a body that stands is on time.
pub const SAME_PLACE_MM: f64 = 1.0;

/// What a motion was asked to do at one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Keyframe {
    pub frame: usize,
    /// Where the body was asked to be, m; none along an axis that was left free.
    pub position_m: [Option<f64>; 3],
    pub orientation: Option<Quaternion>,
}

/// The misses of one motion at its keyframes; infinite where the motion has no such frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KeyframeMisses {
    /// |p̂_k − p_k| over the axes that were asked for, mm, of each keyframe with a position.
    pub position_mm: Vec<f64>,
    /// Angle between q̂_k and q_k, degrees, of each keyframe with an orientation.
    pub orientation_deg: Vec<f64>,
    /// How long before or after each keyframe with a position the body is nearest to it, s.
    pub timing_s: Vec<f64>,
}

/// Measures a motion at its keyframes.
///
/// Positions and orientations as in OmniControl (`calculate_trajectory_error`), for one rigid body. Timing is ours:
/// the least |Δ| of the frames k + Δ, |Δ| ≤ [`TIMING_REACH_FRAMES`], that are as near to p_k as any of them up to
/// [`SAME_PLACE_MM`].
///
/// `frames`: \[T, 25\] in the world
pub fn keyframe_misses(frames: ArrayView2<f32>, keyframes: &[Keyframe]) -> KeyframeMisses {
    let mut found = KeyframeMisses::default();
    let value = |frame: usize, channel: Channel, i: usize| {
        let column = channel.range().start + i;
        frames.get([frame, column]).map_or(f64::NAN, |&x| f64::from(x))
    };
    for keyframe in keyframes {
        let is_there = keyframe.frame < frames.nrows();
        if keyframe.position_m.iter().any(Option::is_some) {
            let distance_mm = |frame: usize| {
                let apart = std::array::from_fn(|i| {
                    let asked = keyframe.position_m[i];
                    asked.map_or(0.0, |asked| value(frame, Channel::Position, i) - asked)
                });
                1e3 * norm(apart)
            };
            let miss = if is_there { distance_mm(keyframe.frame) } else { f64::INFINITY };
            found.position_mm.push(miss);
            found.timing_s.push(timing_error_s(keyframe.frame, frames.nrows(), distance_mm));
        }
        if let Some(asked) = keyframe.orientation {
            let orientation =
                std::array::from_fn(|i| value(keyframe.frame, Channel::Quaternion, i));
            let miss =
                if is_there { rotation_error_deg(orientation, asked) } else { f64::INFINITY };
            found.orientation_deg.push(miss);
        }
    }
    found
}

/// Returns how far in time from `frame` the frame nearest to a place is, s; infinite where no frame near it is finite.
fn timing_error_s(frame: usize, n_frames: usize, distance_mm: impl Fn(usize) -> f64) -> f64 {
    let reach =
        frame.saturating_sub(TIMING_REACH_FRAMES)..n_frames.min(frame + TIMING_REACH_FRAMES + 1);
    let near: Vec<(usize, f64)> = reach
        .map(|t| (t.abs_diff(frame), distance_mm(t)))
        .filter(|(_, distance)| distance.is_finite())
        .collect();
    let least = near.iter().map(|(_, distance)| *distance).fold(f64::INFINITY, f64::min);
    let as_near = near.iter().filter(|(_, distance)| *distance <= least + SAME_PLACE_MM);
    as_near.map(|(apart, _)| *apart).min().map_or(f64::INFINITY, frames_to_s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use crate::motion::quaternion::{IDENTITY, from_axis_angle};
    use ndarray::Array2;

    /// Along x at 0.1 m a frame, upright.
    fn walking(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, MOTION_DIM));
        for t in 0..n {
            frames[[t, 0]] = 0.1 * t as f32;
            frames[[t, Channel::Quaternion.range().start]] = 1.0;
        }
        frames
    }

    fn at(frame: usize, position_m: [Option<f64>; 3]) -> Keyframe {
        Keyframe { frame, position_m, orientation: None }
    }

    #[test]
    fn misses_are_over_the_axes_that_were_asked_for() {
        let keyframes = [
            at(10, [Some(1.0), None, None]),
            at(10, [Some(1.3), Some(0.4), None]),
            at(7, [None, Some(-0.2), Some(0.0)]),
        ];
        let found = keyframe_misses(walking(31).view(), &keyframes);
        for (found, wanted) in found.position_mm.iter().zip([0.0, 500.0, 200.0]) {
            assert!((found - wanted).abs() < 1e-3, "{found} for {wanted}");
        }
        // 1.3 m is reached three frames later; along x, where it was not asked for, nothing is late.
        let wanted = [0.0, 0.1, 0.0];
        assert!(found.timing_s.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");
        assert!(found.orientation_deg.is_empty());
    }

    #[test]
    fn who_stands_is_on_time_and_who_comes_never_is_as_late_as_one_looks() {
        let mut frames = walking(50);
        frames.column_mut(0).fill(2.0);
        let near = keyframe_misses(frames.view(), &[at(20, [Some(2.5), None, None])]);
        assert_eq!((near.position_mm[0].round(), near.timing_s[0]), (500.0, 0.0));
        let far = keyframe_misses(walking(50).view(), &[at(20, [Some(9.0), None, None])]);
        assert_eq!(far.timing_s, [0.5]);
    }

    #[test]
    fn orientations_are_compared_as_turns() {
        let turned = from_axis_angle([0.0, 1.0, 0.0], 0.5);
        let asked =
            |orientation| Keyframe { frame: 3, orientation: Some(orientation), ..at(3, [None; 3]) };
        let keyframes = [asked(turned), asked(turned.map(|c| -c)), asked(IDENTITY)];
        let found = keyframe_misses(walking(9).view(), &keyframes);
        let half = 0.5_f64.to_degrees();
        for (found, wanted) in found.orientation_deg.iter().zip([half, half, 0.0]) {
            assert!((found - wanted).abs() < 1e-9, "{found} for {wanted}");
        }
        assert!(found.position_mm.is_empty() && found.timing_s.is_empty());
    }

    #[test]
    fn a_frame_that_is_not_there_or_not_finite_is_missed() {
        let mut frames = walking(9);
        let behind = Keyframe { orientation: Some(IDENTITY), ..at(30, [Some(0.0); 3]) };
        let found = keyframe_misses(frames.view(), &[behind]);
        assert_eq!(found.position_mm, [f64::INFINITY]);
        assert_eq!(
            (&*found.orientation_deg, &*found.timing_s),
            (&[f64::INFINITY][..], &[f64::INFINITY][..])
        );
        frames.column_mut(0).fill(f32::NAN);
        let found = keyframe_misses(frames.view(), &[at(4, [Some(0.4), None, None])]);
        assert!(found.position_mm[0].is_nan() && found.timing_s[0].is_infinite());
    }
}
