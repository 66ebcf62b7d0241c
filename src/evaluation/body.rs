//! The body of a motion in double precision, and what differences say of it.
//!
//! Measures look at positions and orientations and difference them anew: the velocity that a network
//! says need not be the one at which its body moves.

use std::ops::Range;

use ndarray::ArrayView2;

use crate::motion::quaternion::{
    Quaternion, angular_velocity, dot, make_sign_continuous, normalize,
};
use crate::motion::vector::Vector;
use crate::motion::{Channel, MOTION_DIM, Poses};
use crate::units::FPS;

/// Distance at which turns count as movement, m: about that of a body's surface from its axis.
pub const BODY_RADIUS_M: f64 = 0.25;

/// Quaternions shorter than this stand for no rotation.
const MIN_QUATERNION_NORM: f64 = 1e-6;

/// Returns positions and unit orientations of motion, `[T, 25]`, with continuous signs.
///
/// None where a position or an orientation is not finite, or a quaternion is zero.
///
/// # Panics
/// When there are other than 25 channels.
pub fn poses(frames: ArrayView2<f32>) -> Option<Poses> {
    assert_eq!(frames.ncols(), MOTION_DIM, "channels of motion");
    let first = Channel::Quaternion.range().start;
    let mut poses =
        Poses { position_m: vectors(frames, Channel::Position), orientation: Vec::new() };
    if poses.position_m.iter().flatten().any(|x| !x.is_finite()) {
        return None;
    }
    for row in frames.rows() {
        let q: Quaternion = std::array::from_fn(|i| f64::from(row[first + i]));
        let norm = dot(q, q).sqrt();
        if !norm.is_finite() || norm < MIN_QUATERNION_NORM {
            return None;
        }
        poses.orientation.push(normalize(q));
    }
    make_sign_continuous(&mut poses.orientation);
    Some(poses)
}

/// Returns some frames of poses.
///
/// # Panics
/// When the frames are not all there.
pub fn part(poses: &Poses, frames: Range<usize>) -> Poses {
    Poses {
        position_m: poses.position_m[frames.clone()].to_vec(),
        orientation: poses.orientation[frames].to_vec(),
    }
}

/// Returns a channel of three columns, `[T][3]`.
pub fn vectors(frames: ArrayView2<f32>, channel: Channel) -> Vec<Vector> {
    let first = channel.range().start;
    frames
        .rows()
        .into_iter()
        .map(|row| std::array::from_fn(|i| f64::from(row[first + i])))
        .collect()
}

/// Returns world-frame angular velocities from frame to frame, rad/s, one frame fewer.
pub fn turn_rates(orientation: &[Quaternion]) -> Vec<Vector> {
    orientation.windows(2).map(|q| angular_velocity(q[0], q[1], FPS)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    /// Turns a quarter radian a frame about the vertical, moving 0.1 m a frame along x.
    fn frames(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, MOTION_DIM));
        for t in 0..n {
            let half = 0.125 * t as f32;
            frames[[t, 0]] = 0.1 * t as f32;
            // Twice as long as a unit quaternion, and of changing sign.
            let length = if t % 2 == 0 { 2.0 } else { -2.0 };
            frames[[t, 9]] = length * half.cos();
            frames[[t, 11]] = length * half.sin();
        }
        frames
    }

    #[test]
    fn orientations_become_unit_and_their_signs_continuous() {
        let poses = poses(frames(7).view()).expect("finite");
        assert_eq!(poses.len(), 7);
        for q in poses.orientation.windows(2) {
            assert!((dot(q[0], q[0]) - 1.0).abs() < 1e-12);
            // Single precision of the quaternions.
            assert!((dot(q[0], q[1]) - 0.125_f64.cos()).abs() < 1e-6);
        }
        for turn in turn_rates(&poses.orientation) {
            assert!((turn[1] - 0.25 * FPS).abs() < 1e-4, "{turn:?}");
        }
        assert_eq!(part(&poses, 2..5).position_m[..], poses.position_m[2..5]);
    }

    #[test]
    fn what_is_not_finite_or_no_rotation_has_no_poses() {
        for (i, x) in [(2, f32::NAN), (0, f32::INFINITY), (9, f32::NAN), (11, f32::NEG_INFINITY)] {
            let mut frames = frames(5);
            frames[[3, i]] = x;
            assert_eq!(poses(frames.view()), None, "{i}");
        }
        let mut frames = frames(5);
        frames.row_mut(4).fill(0.0);
        assert_eq!(poses(frames.view()), None);
        assert_eq!(poses(Array2::zeros((0, MOTION_DIM)).view()), Some(Poses::default()));
    }
}
