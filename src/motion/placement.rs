//! Where a phrase stands and which way it faces: taken off before learning, put back after.
//!
//! A dancer who starts two metres to the left and faces the window dances the same dance. What a
//! model should not have to learn is one translation of the floor and one turn about +Y, and these
//! two are a [`Placement`].

use std::f64::consts::{PI, TAU};

use ndarray::{Array2, ArrayView2};

use super::channels::BODY;
use super::layout::{ColumnRole, Columns, Layout};
use super::quaternion::{Quaternion, from_axis_angle, make_sign_continuous, mul, rotate};

/// A point of the floor and a heading.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Placement {
    /// Position along +X, m.
    pub x_m: f64,
    /// Position along +Z, m.
    pub z_m: f64,
    /// Turn about +Y, rad, in (-π, π]; 0 faces +Z and π/2 faces +X.
    pub yaw_rad: f64,
}

impl Placement {
    /// Returns the placement of a pose: its point on the floor and its twist about +Y.
    ///
    /// `yaw = 2 atan2(q_y, q_w)`, 0 where both vanish (upside down, so that no heading is nearer
    /// than another). Source of the twist: Dobrowolski, Swing-twist decomposition in Clifford
    /// algebra, arXiv:1506.05481.
    pub fn of(position_m: [f64; 3], orientation: Quaternion) -> Self {
        let [w, _, y, _] = orientation;
        let yaw_rad = if w == 0.0 && y == 0.0 { 0.0 } else { wrapped(2.0 * y.atan2(w)) };
        Self { x_m: position_m[0], z_m: position_m[2], yaw_rad }
    }

    /// Returns the placement of the first frame of [`BODY`], `None` without frames; shape `[T, 25]`.
    pub fn of_first(frames: ArrayView2<'_, f32>) -> Option<Self> {
        Self::of_first_in(BODY, frames)
    }

    /// Returns the placement of the first frame, `None` without frames; shape `[T, columns]`.
    pub fn of_first_in(layout: Layout, frames: ArrayView2<'_, f32>) -> Option<Self> {
        let first = frames.rows().into_iter().next()?;
        let at = |columns: Columns, i: usize| f64::from(first[columns.first + i]);
        let body = layout.body();
        Some(Self::of(
            std::array::from_fn(|i| at(body.position, i)),
            std::array::from_fn(|i| at(body.orientation, i)),
        ))
    }

    /// Returns a placement that is given within this one as the world has it.
    ///
    /// `(x, z)' = (x, z) + R(yaw) (x_in, z_in)`, `yaw' = yaw + yaw_in`.
    pub fn of_inner(&self, inner: Self) -> Self {
        let turn = from_axis_angle([0.0, 1.0, 0.0], self.yaw_rad);
        let [x, _, z] = rotate(turn, [inner.x_m, 0.0, inner.z_m]);
        Self {
            x_m: self.x_m + x,
            z_m: self.z_m + z,
            yaw_rad: wrapped(self.yaw_rad + inner.yaw_rad),
        }
    }

    /// Takes the placement off frames of [`BODY`], in place; see [`Placement::remove_in`]. Shape `[T, 25]`.
    pub fn remove(&self, frames: &mut Array2<f32>) {
        self.remove_in(BODY, frames);
    }

    /// Takes the placement off, in place: what stood here and faced this way stands over the origin
    /// and faces +Z. Shape `[T, columns]`.
    ///
    /// Places: `p' = R(-yaw) (p - (x, 0, z))`. Vectors turn by `R(-yaw)`, orientations become `q(-yaw) ⊗ q` with
    /// continuous signs and the first `w >= 0`. Other columns and heights stay, and so does every identity between
    /// the channels.
    pub fn remove_in(&self, layout: Layout, frames: &mut Array2<f32>) {
        move_by(layout, frames, -self.yaw_rad, |p| [p[0] - self.x_m, p[1], p[2] - self.z_m], |p| p);
    }

    /// Puts the placement back on frames of [`BODY`], in place; see [`Placement::restore_in`]. Shape `[T, 25]`.
    pub fn restore(&self, frames: &mut Array2<f32>) {
        self.restore_in(BODY, frames);
    }

    /// Puts the placement back, in place: the inverse of [`Placement::remove_in`], up to the common sign
    /// of the quaternions. Shape `[T, columns]`.
    pub fn restore_in(&self, layout: Layout, frames: &mut Array2<f32>) {
        move_by(layout, frames, self.yaw_rad, |p| p, |p| [p[0] + self.x_m, p[1], p[2] + self.z_m]);
    }
}

/// Turns frames about +Y by `yaw_rad`; positions are changed by `before` and `after` the turn.
fn move_by(
    layout: Layout,
    frames: &mut Array2<f32>,
    yaw_rad: f64,
    before: impl Fn([f64; 3]) -> [f64; 3],
    after: impl Fn([f64; 3]) -> [f64; 3],
) {
    let turn = from_axis_angle([0.0, 1.0, 0.0], yaw_rad);
    for columns in layout.spatial() {
        for mut row in frames.rows_mut() {
            let v: [f64; 3] = std::array::from_fn(|i| f64::from(row[columns.first + i]));
            let v = match columns.group.role {
                ColumnRole::Place => after(rotate(turn, before(v))),
                _ => rotate(turn, v),
            };
            for (i, x) in columns.range().zip(v) {
                row[i] = x as f32;
            }
        }
    }
    for columns in layout.with_role(ColumnRole::Turn) {
        let turned = |row: ndarray::ArrayView1<f32>| {
            mul(turn, std::array::from_fn(|i| f64::from(row[columns.first + i])))
        };
        let mut orientation: Vec<Quaternion> = frames.rows().into_iter().map(turned).collect();
        make_sign_continuous(&mut orientation);
        for (mut row, q) in frames.rows_mut().into_iter().zip(orientation) {
            for (i, c) in columns.range().zip(q) {
                row[i] = c as f32;
            }
        }
    }
}

/// Returns the angle in (-π, π] that turns as far.
fn wrapped(angle_rad: f64) -> f64 {
    let a = angle_rad.rem_euclid(TAU);
    if a > PI { a - TAU } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::channels::MOTION_DIM;
    use crate::motion::kinematics::{Poses, frames_of};
    use crate::motion::quaternion::{IDENTITY, angular_velocity, normalize};
    use crate::units::FPS;
    use proptest::prelude::*;
    use std::f64::consts::FRAC_PI_2;

    const UP: [f64; 3] = [0.0, 1.0, 0.0];

    /// A leaning, turning walk that starts at `(x, z)` with heading `yaw_rad`; n frames, all exact.
    fn walk(n: usize, x: f64, z: f64, yaw_rad: f64, turn_rad_s: f64) -> Array2<f32> {
        let pose = |t: usize| {
            let s = t as f64 / FPS;
            let p = [x + (1.3 * s).sin(), 0.9 + 0.04 * (9.0 * s).cos(), z + 0.7 * s];
            let lean = from_axis_angle([1.0, 0.0, 0.0], 0.2 * (3.0 * s).sin());
            (p, mul(from_axis_angle(UP, yaw_rad + turn_rad_s * s), lean))
        };
        let (position_m, mut orientation): (Vec<_>, Vec<_>) = (0..n + 2).map(pose).unzip();
        make_sign_continuous(&mut orientation);
        let mut frames = frames_of(&Poses { position_m, orientation }, n);
        for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
            row[16] = (t as f32 * 0.013).fract();
            for k in 17..MOTION_DIM {
                row[k] = k as f32 * 0.03;
            }
        }
        frames
    }

    #[test]
    fn the_placement_of_a_pose_is_its_floor_point_and_twist() {
        let placed = |yaw_rad: f64| {
            let tilt = from_axis_angle([1.0, 0.0, 0.0], 0.4);
            Placement::of([1.5, 0.9, -2.0], mul(from_axis_angle(UP, yaw_rad), tilt))
        };
        for yaw_rad in [-3.0, -FRAC_PI_2, 0.0, 0.25, FRAC_PI_2, 3.1] {
            let p = placed(yaw_rad);
            assert_eq!((p.x_m, p.z_m), (1.5, -2.0));
            assert!((p.yaw_rad - yaw_rad).abs() < 1e-12, "{yaw_rad}: {}", p.yaw_rad);
        }
        // q and -q are one rotation and one placement.
        let q = from_axis_angle(UP, 2.0);
        let (a, b) = (Placement::of([0.0; 3], q), Placement::of([0.0; 3], q.map(|c| -c)));
        assert!((a.yaw_rad - b.yaw_rad).abs() < 1e-12, "{a:?} {b:?}");
        // Upside down about x: no twist at all.
        assert_eq!(Placement::of([0.0; 3], [0.0, 1.0, 0.0, 0.0]).yaw_rad, 0.0);
        assert_eq!(Placement::of([0.0; 3], IDENTITY), Placement::default());
    }

    #[test]
    fn a_walk_towards_the_right_becomes_a_walk_forward() {
        // Facing +X and walking along it: x grows by 0.1 m a frame.
        let position_m = (0..6).map(|t| [4.0 + 0.1 * f64::from(t), 1.0, -3.0]).collect();
        let orientation = vec![from_axis_angle(UP, FRAC_PI_2); 6];
        let mut frames = frames_of(&Poses { position_m, orientation }, 4);
        let placement = Placement::of_first(frames.view()).unwrap();
        placement.remove(&mut frames);
        for (t, row) in frames.rows().into_iter().enumerate() {
            let want = [0.0, 1.0, 0.1 * t as f32, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
            for (i, want) in want.into_iter().enumerate() {
                // Single precision of 4 m and π/2, twice differenced (900 per s²) in acceleration.
                let tolerance = if (6..9).contains(&i) { 5e-4 } else { 1e-5 };
                assert!((row[i] - want).abs() < tolerance, "{i} at {t}: {}", row[i]);
            }
        }
    }

    #[test]
    fn no_frames_have_no_placement() {
        assert_eq!(Placement::of_first(Array2::zeros((0, MOTION_DIM)).view()), None);
        let mut none = Array2::zeros((0, MOTION_DIM));
        Placement { x_m: 1.0, z_m: 2.0, yaw_rad: 3.0 }.remove(&mut none);
        assert_eq!(none.dim(), (0, MOTION_DIM));
    }

    proptest! {
        #[test]
        fn restoring_undoes_removing(x in -7.0..7.0f64, z in -7.0..7.0f64, yaw in -3.1..3.1f64,
                                     turn in -9.0..9.0f64, n in 1..40usize) {
            let frames = walk(n, x, z, yaw, turn);
            let placement = Placement::of_first(frames.view()).unwrap();
            let mut moved = frames.clone();
            placement.remove(&mut moved);
            let first = Placement::of_first(moved.view()).unwrap();
            // Half an ulp of 7 m and of a quaternion's component, doubled by the half angle.
            prop_assert!(first.x_m.abs() < 1e-6 && first.z_m.abs() < 1e-6, "{first:?}");
            prop_assert!(first.yaw_rad.abs() < 1e-6, "{first:?}");
            prop_assert!(moved[[0, 9]] >= 0.0);
            placement.restore(&mut moved);
            for ((i, got), want) in moved.indexed_iter().zip(frames.iter()) {
                // Two roundings of values up to 30 (an acceleration), each half an ulp.
                prop_assert!((got - want).abs() <= 4e-6, "{i:?}: {got} for {want}");
            }
        }

        #[test]
        fn a_placement_within_another_is_where_both_lead(x in -7.0..7.0f64, z in -7.0..7.0f64,
                                                         yaw in -3.1..3.1f64, turn in -9.0..9.0f64) {
            let outer = Placement { x_m: x, z_m: z, yaw_rad: yaw };
            let inner = Placement { x_m: z, z_m: 1.0, yaw_rad: wrapped(turn) };
            let (mut one, mut other) = (walk(5, 0.3, 0.1, 0.2, turn), walk(5, 0.3, 0.1, 0.2, turn));
            inner.restore(&mut one);
            outer.restore(&mut one);
            outer.of_inner(inner).restore(&mut other);
            for (i, (a, b)) in one.iter().zip(other.iter()).enumerate() {
                // q and -q turn alike; rounding of values up to 30.
                let is_turn = (9..13).contains(&(i % MOTION_DIM));
                let off = if is_turn { (a.abs() - b.abs()).abs() } else { (a - b).abs() };
                prop_assert!(off <= 1e-5, "{i}: {a} and {b}");
            }
        }

        #[test]
        fn identities_survive(x in -7.0..7.0f64, z in -7.0..7.0f64, yaw in -3.1..3.1f64,
                              turn in -9.0..9.0f64) {
            let mut frames = walk(31, x, z, yaw, turn);
            Placement::of_first(frames.view()).unwrap().remove(&mut frames);
            let f = frames.mapv(f64::from);
            for t in 0..30 {
                for i in 0..6 {
                    let derived = (f[[t + 1, i]] - f[[t, i]]) * FPS;
                    let size = (f[[t, i]].abs() + f[[t + 1, i]].abs()) * FPS + derived.abs();
                    // Every value was rounded twice: from the pose, and after the turn, in which
                    // an axis also takes the rounding of the other one (up to 8 m, 60 m/s²).
                    let tolerance = 4.0 * f64::from(f32::EPSILON) * (size + 8.0 * FPS);
                    prop_assert!((f[[t, i + 3]] - derived).abs() <= tolerance, "{i} at {t}");
                }
                let q = |t: usize| normalize(std::array::from_fn(|c| f[[t, 9 + c]]));
                let omega = angular_velocity(q(t), q(t + 1), FPS);
                for axis in 0..3 {
                    // Rounding of quaternions (6e-8 each) times 2 · 30.
                    prop_assert!((f[[t, 13 + axis]] - omega[axis]).abs() < 3e-5, "{axis} at {t}");
                }
                let inner: f64 = (0..4).map(|c| f[[t, 9 + c]] * f[[t + 1, 9 + c]]).sum();
                prop_assert!(inner > 0.0, "the sign jumps at {t}");
            }
        }

        #[test]
        fn phase_style_and_height_stay(yaw in -3.0..3.0f64) {
            let frames = walk(9, 1.0, -1.0, yaw, 1.0);
            let mut moved = frames.clone();
            Placement::of_first(frames.view()).unwrap().remove(&mut moved);
            for i in (16..MOTION_DIM).chain([1]) {
                prop_assert_eq!(moved.column(i), frames.column(i));
            }
        }
    }
}
