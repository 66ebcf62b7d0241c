//! Motions that are as good as the captured one: mirrored, turned, a little faster or slower.
//!
//! Each changes every channel that it must, so that the identities between the channels stay.

use ndarray::{Array2, ArrayView2, ArrayViewMut2};

use crate::units::FPS;

use super::kinematics::{Poses, frames_in};
use super::layout::{ColumnRole, Layout};
use super::phase::unwrapped;
use super::placement::Placement;
use super::quaternion::{Quaternion, make_sign_continuous, normalize};
use super::spline::{CubicSpline, SplineError};

/// Mirrors motion in the plane x = 0, in place, `[n_frames, columns]`; see [`Layout::mirrored_in_x`].
pub fn mirror_x(layout: Layout, mut frames: ArrayViewMut2<f32>) {
    let flipped = layout.mirrored_in_x();
    for mut row in frames.rows_mut() {
        for &i in &flipped {
            row[i] = -row[i];
        }
    }
}

/// Turns motion about the vertical axis through the origin, in place, `[n_frames, columns]`.
pub fn rotate_yaw(layout: Layout, frames: &mut Array2<f32>, yaw_rad: f64) {
    Placement { x_m: 0.0, z_m: 0.0, yaw_rad }.restore_in(layout, frames);
}

/// Returns how many frames `n_frames` become at `rate` times the speed.
pub fn stretched_frames(n_frames: usize, rate: f64) -> usize {
    // A last frame that misses by rounding still counts.
    (n_frames.saturating_sub(1) as f64 / rate + 1e-9).floor() as usize + 1
}

/// Returns motion at `rate` times its speed: position and orientation at the times t · rate, everything
/// that follows from them anew, phases along the bar and free columns linearly. `[n_frames, columns]` becomes
/// `[stretched_frames - 2, columns]` (at least one frame): two are used up by the differences.
///
/// # Errors
/// [`SplineError`] when there are too few frames for a spline.
pub fn stretch_motion(
    layout: Layout,
    frames: ArrayView2<f32>,
    rate: f64,
) -> Result<Array2<f32>, SplineError> {
    let n_frames = frames.nrows();
    let times_s: Vec<f64> = (0..n_frames).map(|t| t as f64 / FPS).collect();
    let n_poses = stretched_frames(n_frames, rate);
    let end_s = times_s.last().copied().unwrap_or(0.0);
    let grid_s: Vec<f64> = (0..n_poses).map(|t| (t as f64 * rate / FPS).min(end_s)).collect();
    let resample = |i: usize| -> Result<Vec<f64>, SplineError> {
        let signal: Vec<f64> = frames.column(i).iter().map(|&x| f64::from(x)).collect();
        Ok(CubicSpline::fit(&times_s, &signal)?.evaluate(&grid_s))
    };
    let body = layout.body();
    let (p, q) = (body.position.first, body.orientation.first);
    let position = [resample(p)?, resample(p + 1)?, resample(p + 2)?];
    let turn = [resample(q)?, resample(q + 1)?, resample(q + 2)?, resample(q + 3)?];
    let mut orientation: Vec<Quaternion> =
        (0..n_poses).map(|t| normalize(std::array::from_fn(|c| turn[c][t]))).collect();
    make_sign_continuous(&mut orientation);
    let position_m = (0..n_poses).map(|t| std::array::from_fn(|axis| position[axis][t])).collect();
    let n_kept = n_poses.saturating_sub(2).max(1);
    let mut stretched = frames_in(layout, &Poses { position_m, orientation }, n_kept);
    let between = |t: usize| {
        let (before, share) = place(t, rate, n_frames);
        (before, (before + 1).min(n_frames - 1), share)
    };
    for phase in layout.with_role(ColumnRole::Phase).map(|columns| columns.first) {
        let in_bar: Vec<f64> = frames.column(phase).iter().map(|&x| f64::from(x)).collect();
        let bars = unwrapped(&in_bar);
        for (t, x) in stretched.column_mut(phase).iter_mut().enumerate() {
            let (before, after, share) = between(t);
            let bar = bars[before] + share * (bars[after] - bars[before]);
            // A phase that rounds to 1 in single precision is the downbeat it is about to reach.
            *x = match bar.rem_euclid(1.0) as f32 {
                x if x >= 1.0 => 0.0,
                x => x,
            };
        }
    }
    for i in layout.with_role(ColumnRole::Free).flat_map(|columns| columns.range()) {
        for (t, x) in stretched.column_mut(i).iter_mut().enumerate() {
            let (before, after, share) = between(t);
            let (a, b) = (frames[[before, i]], frames[[after, i]]);
            *x = a + share as f32 * (b - a);
        }
    }
    Ok(stretched)
}

/// Returns the first `n_frames` of features at `rate` times their speed, interpolated linearly; those
/// beyond the last repeat it.
pub fn stretch_features(features: ArrayView2<f32>, rate: f64, n_frames: usize) -> Array2<f32> {
    let last = features.nrows() - 1;
    Array2::from_shape_fn((n_frames, features.ncols()), |(t, i)| {
        let (before, share) = place(t, rate, features.nrows());
        let (a, b) = (features[[before, i]], features[[(before + 1).min(last), i]]);
        a + share as f32 * (b - a)
    })
}

/// Returns the frame before the time t · rate, and how far on it lies between that and the next.
fn place(t: usize, rate: f64, n_frames: usize) -> (usize, f64) {
    let at = t as f64 * rate;
    let before = (at.floor() as usize).min(n_frames - 1);
    (before, (at - before as f64).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::BODY;
    use crate::motion::kinematics::frames_of;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::quaternion::{from_axis_angle, mul};
    use proptest::prelude::*;

    /// A swaying, turning, nodding walk with every channel; n frames, all exact.
    fn walk(n: usize) -> Array2<f32> {
        let time = |t: usize| t as f64 / FPS;
        let position_m = (0..n + 2)
            .map(|t| [0.4 * (2.1 * time(t)).sin(), 0.9 + 0.05 * (5.0 * time(t)).cos(), time(t)])
            .collect();
        let orientation = (0..n + 2)
            .map(|t| {
                let yaw = from_axis_angle([0.0, 1.0, 0.0], 0.8 * time(t));
                mul(yaw, from_axis_angle([1.0, 0.0, 0.0], 0.2 * (3.0 * time(t)).sin()))
            })
            .collect();
        let mut frames = frames_of(&Poses { position_m, orientation }, n);
        for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
            row[16] = (0.3 + 0.5 * time(t)).fract() as f32;
            for k in 0..8 {
                row[17 + k] = 0.1 * k as f32 + 0.01 * t as f32;
            }
        }
        frames
    }

    /// Largest deviations from the identities of velocity, acceleration and angular velocity.
    fn incoherence(frames: &Array2<f32>) -> [f64; 3] {
        let poses = Poses {
            position_m: frames
                .rows()
                .into_iter()
                .map(|row| std::array::from_fn(|i| f64::from(row[i])))
                .collect(),
            orientation: frames
                .rows()
                .into_iter()
                .map(|row| normalize(std::array::from_fn(|i| f64::from(row[9 + i]))))
                .collect(),
        };
        let derived = frames_of(&poses, frames.nrows());
        let inner = frames.nrows() - 2;
        let worst = |columns: std::ops::Range<usize>| {
            let mut worst = 0.0_f64;
            for t in 0..inner {
                for i in columns.clone() {
                    worst = worst.max(f64::from((frames[[t, i]] - derived[[t, i]]).abs()));
                }
            }
            worst
        };
        [worst(3..6), worst(6..9), worst(13..16)]
    }

    /// Positions of 1 m in single precision have steps of 6e-8 m, 900 times which are 1e-4 m/s².
    fn assert_coherent(frames: &Array2<f32>) {
        let [velocity, acceleration, turn] = incoherence(frames);
        assert!(velocity < 2e-5 && acceleration < 6e-4 && turn < 5e-5, "{:?}", incoherence(frames));
    }

    #[test]
    fn a_mirrored_walk_is_the_walk_of_the_mirrored_poses() {
        let frames = walk(53);
        let mut mirrored = frames.clone();
        mirror_x(BODY, mirrored.view_mut());
        assert_coherent(&mirrored);
        for (row, was) in mirrored.rows().into_iter().zip(frames.rows()) {
            assert_eq!((row[0], row[1], row[2]), (-was[0], was[1], was[2]));
            // Forward in the mirror is the mirror image of forward.
            let forward = |row: ndarray::ArrayView1<f32>| {
                let q = std::array::from_fn(|i| f64::from(row[9 + i]));
                crate::motion::quaternion::rotate(q, [0.0, 0.0, 1.0])
            };
            let (a, b) = (forward(row), forward(was));
            assert!((a[0] + b[0]).abs() + (a[1] - b[1]).abs() + (a[2] - b[2]).abs() < 1e-6);
            assert_eq!(row.slice(ndarray::s![16..]), was.slice(ndarray::s![16..]));
        }
        mirror_x(BODY, mirrored.view_mut());
        assert_eq!(mirrored, frames);
    }

    #[test]
    fn a_turned_walk_turns_its_velocities() {
        let frames = walk(41);
        let mut turned = frames.clone();
        rotate_yaw(BODY, &mut turned, std::f64::consts::FRAC_PI_2);
        assert_coherent(&turned);
        for (row, was) in turned.rows().into_iter().zip(frames.rows()) {
            // A quarter turn takes +Z to +X and +X to -Z.
            assert!((row[3] - was[5]).abs() < 1e-6 && (row[5] + was[3]).abs() < 1e-6);
            assert_eq!(row[1], was[1]);
        }
    }

    #[test]
    fn a_faster_walk_has_closed_forms() {
        let frames = walk(121);
        let fast = stretch_motion(BODY, frames.view(), 1.1).expect("enough frames");
        assert_eq!(fast.nrows(), stretched_frames(121, 1.1) - 2);
        assert_eq!(fast.nrows(), 108);
        assert_coherent(&fast);
        for (t, row) in fast.rows().into_iter().enumerate() {
            let time_s = 1.1 * t as f64 / FPS;
            let phase = (0.3 + 0.5 * time_s).fract();
            let gap = (f64::from(row[16]) - phase).abs();
            // Single precision of the phase, and of its wrap.
            assert!(gap.min(1.0 - gap) < 1e-6, "{t}: {} against {phase}", row[16]);
            assert!((f64::from(row[2]) - time_s).abs() < 1e-6);
            assert!((f64::from(row[5]) - 1.1).abs() < 1e-4, "speed {}", row[5]);
            assert!((f64::from(row[20]) - (0.3 + 0.011 * t as f64)).abs() < 1e-5);
        }
    }

    /// The columns of the body that the root alone has.
    fn root_of(frames: &Array2<f32>) -> Array2<f32> {
        let columns: Vec<usize> = (0..6).chain(9..16).collect();
        frames.select(ndarray::Axis(1), &columns)
    }

    #[test]
    fn the_root_alone_is_augmented_as_within_a_body() {
        let body = walk(53);
        let (mut mirrored, mut of_root) = (body.clone(), root_of(&body));
        mirror_x(BODY, mirrored.view_mut());
        mirror_x(ROOT, of_root.view_mut());
        assert_eq!(of_root, root_of(&mirrored));
        let was = root_of(&body);
        // By hand: (-x, y, z), (w, x, -y, -z), (ωx, -ωy, -ωz).
        let row = of_root.row(7).to_vec();
        let w = was.row(7).to_vec();
        let wanted =
            [-w[0], w[1], w[2], -w[3], w[4], w[5], w[6], w[7], -w[8], -w[9], w[10], -w[11], -w[12]];
        assert_eq!(row, wanted);

        let (mut turned, mut of_root) = (body.clone(), was.clone());
        rotate_yaw(BODY, &mut turned, 0.7);
        rotate_yaw(ROOT, &mut of_root, 0.7);
        assert_eq!(of_root, root_of(&turned));
        let stretched = stretch_motion(BODY, body.view(), 1.1).expect("enough frames");
        let of_root = stretch_motion(ROOT, was.view(), 1.1).expect("enough frames");
        assert_eq!(of_root, root_of(&stretched));
    }

    #[test]
    fn features_follow() {
        let features = Array2::from_shape_fn((7, 3), |(t, i)| (10 * i + t) as f32);
        let slow = stretch_features(features.view(), 0.75, 10);
        assert_eq!(slow.column(1).to_vec()[..4], [10.0, 10.75, 11.5, 12.25]);
        assert_eq!(slow[[8, 2]], 26.0);
        assert_eq!(slow[[9, 2]], 26.0, "beyond the last frame it stays");
    }

    proptest! {
        #[test]
        fn any_stretch_stays_coherent(rate in 0.8..1.25f64, n in 5usize..90) {
            let frames = walk(n);
            let other = stretch_motion(BODY, frames.view(), rate).expect("enough frames");
            prop_assert!(other.nrows() >= 1);
            if other.nrows() > 2 {
                let [velocity, acceleration, turn] = incoherence(&other);
                prop_assert!(velocity < 3e-5 && acceleration < 9e-4 && turn < 9e-5);
            }
        }
    }
}
