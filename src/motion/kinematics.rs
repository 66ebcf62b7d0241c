//! From poses to the channels that follow from them: the one place where motion is differenced.

use ndarray::Array2;

use crate::units::FPS;

use super::channels::BODY;
use super::layout::{Columns, Layout};
use super::quaternion::{Quaternion, angular_velocity};

/// Where a rigid body is and how it is turned, frame by frame at [`FPS`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Poses {
    /// Root position, m.
    pub position_m: Vec<[f64; 3]>,
    /// Root orientation, unit, body to world, signs continuous.
    pub orientation: Vec<Quaternion>,
}

impl Poses {
    /// Returns the number of frames.
    pub fn len(&self) -> usize {
        self.position_m.len().min(self.orientation.len())
    }

    /// Returns whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Returns `(x[t+1] - x[t]) FPS`, one frame fewer.
pub fn forward_differences(x: &[[f64; 3]]) -> Vec<[f64; 3]> {
    x.windows(2).map(|w| std::array::from_fn(|axis| (w[1][axis] - w[0][axis]) * FPS)).collect()
}

/// Writes frames of [`BODY`]; see [`frames_in`]. Phase and style stay 0. Shape `[n_frames, 25]`.
///
/// # Panics
/// When there are fewer than `n_frames` poses.
pub fn frames_of(poses: &Poses, n_frames: usize) -> Array2<f32> {
    frames_in(BODY, poses, n_frames)
}

/// Writes position, orientation and what a layout has of their derivatives for the first `n_frames` frames; all other
/// columns stay 0. Shape `[n_frames, columns]`.
///
/// `v[t] = (p[t+1] - p[t]) FPS`, `a[t] = (v[t+1] - v[t]) FPS`, `ω[t] = 2 log(q[t+1] q[t]*) FPS`. With two
/// frames more than `n_frames` every frame obeys them; a difference that would need a frame beyond the
/// last repeats the one before it (0 where there is none).
///
/// # Panics
/// When there are fewer than `n_frames` poses.
pub fn frames_in(layout: Layout, poses: &Poses, n_frames: usize) -> Array2<f32> {
    assert!(poses.len() >= n_frames, "{n_frames} frames of {} poses", poses.len());
    let (p, q) = (&poses.position_m[..poses.len()], &poses.orientation);
    let v = forward_differences(p);
    let a = forward_differences(&v);
    let held = |x: &[[f64; 3]], t: usize| x.get(t).or(x.last()).copied().unwrap_or([0.0; 3]);
    let turn = |t: usize| angular_velocity(q[t], q[t + 1], FPS);
    let body = layout.body();
    let mut frames = Array2::zeros((n_frames, layout.width()));
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        let mut write = |columns: Option<Columns>, values: &[f64]| {
            let range = columns.map(|columns| columns.range()).unwrap_or_default();
            for (i, &x) in range.zip(values) {
                row[i] = x as f32;
            }
        };
        write(Some(body.position), &p[t]);
        write(body.velocity, &held(&v, t));
        write(body.acceleration, &held(&a, t));
        write(Some(body.orientation), &q[t]);
        let last_turn = (t + 1).min(poses.len() - 1);
        let omega = if last_turn == 0 { [0.0; 3] } else { turn(last_turn - 1) };
        write(body.angular_velocity, &omega);
    }
    frames
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::channels::MOTION_DIM;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::quaternion::from_axis_angle;

    /// Position (0.1 t², 1, -0.2 t), turning 0.05 rad a frame about the vertical.
    fn poses(n: usize) -> Poses {
        let position_m = (0..n).map(|t| [0.1 * (t * t) as f64, 1.0, -0.2 * t as f64]).collect();
        let turn = |t: usize| from_axis_angle([0.0, 1.0, 0.0], 0.05 * t as f64);
        Poses { position_m, orientation: (0..n).map(turn).collect() }
    }

    #[test]
    fn two_frames_more_make_every_frame_exact() {
        let frames = frames_of(&poses(9), 7);
        assert_eq!(frames.dim(), (7, MOTION_DIM));
        for (t, row) in frames.rows().into_iter().enumerate() {
            let t = t as f32;
            // Δ(0.1 t²) = 0.1 (2t + 1), Δ² = 0.2; single precision of values up to 180.
            let want = [3.0 * (2.0 * t + 1.0), 0.0, -6.0, 180.0, 0.0, 0.0];
            for (i, want) in want.into_iter().enumerate() {
                assert!((row[3 + i] - want).abs() < 1e-3, "{i} at {t}: {}", row[3 + i]);
            }
            assert!((row[14] - 1.5).abs() < 1e-6, "{}", row[14]);
            assert_eq!((row[13], row[15], row[16]), (0.0, 0.0, 0.0));
        }
    }

    #[test]
    fn the_root_alone_has_the_same_numbers_in_its_own_columns() {
        let (root, body) = (frames_in(ROOT, &poses(9), 7), frames_of(&poses(9), 7));
        assert_eq!(root.dim(), (7, 13));
        let same = (0..6).zip(0..6).chain((6..10).zip(9..13)).chain((10..13).zip(13..16));
        for (mine, theirs) in same {
            assert_eq!(root.column(mine), body.column(theirs), "{mine}");
        }
    }

    #[test]
    fn the_last_difference_is_held() {
        let frames = frames_of(&poses(4), 4);
        let velocity_x: Vec<f32> = frames.column(3).to_vec();
        let wanted = [3.0, 9.0, 15.0, 15.0];
        assert!(velocity_x.iter().zip(wanted).all(|(v, w)| (v - w).abs() < 1e-5));
        assert!(frames.column(6).iter().all(|a| (a - 180.0).abs() < 1e-3));
        assert!(frames.column(14).iter().all(|w| (w - 1.5).abs() < 1e-6));
        assert_eq!(frames_of(&poses(1), 1).column(14)[0], 0.0);
    }
}
