//! Steps joined into one path: no jump in position, velocity or orientation.

use super::primitive::{Repertoire, UP, lowpass_orientation};
use super::selection::DanceStep;
use crate::motion::kinematics::Poses;
use crate::motion::lowpass::lowpass;
use crate::motion::quaternion::{
    Quaternion, from_axis_angle, make_sign_continuous, mul, rotate, slerp,
};
use crate::units::{FPS, frames_to_s};

/// A join bends at most this much time on either side of its beat, s.
const MAX_JOIN_S: f64 = 0.2;
/// And at most this share of either step, so that the joins at its two ends do not meet.
const MAX_JOIN_PER_STEP: f64 = 0.4;
/// Half the interval of the difference that gives the velocity at a join, s.
const VELOCITY_STEP_S: f64 = 1.0 / 120.0;
/// Cutoff of the low-pass on the joined path, Hz: a cubic join is bent at its two ends.
const JOINED_LOWPASS_HZ: f64 = 6.0;

/// A step with its place in the dance.
struct PlacedStep<'a> {
    step: &'a DanceStep,
    repertoire: &'a Repertoire,
    /// Where it begins on the floor, m.
    origin: [f64; 2],
    heading_rad: f64,
}

impl PlacedStep<'_> {
    /// Returns the poses at times of the song, also a little before and after the step itself.
    fn poses(&self, times_s: &[f64]) -> Poses {
        let [x, z] = self.origin;
        let turn = from_axis_angle(UP, self.heading_rad);
        let Some(primitive) = self.step.primitive.map(|i| &self.repertoire.primitives()[i]) else {
            let n = times_s.len();
            return Poses { position_m: vec![[x, 0.0, z]; n], orientation: vec![turn; n] };
        };
        let at_s: Vec<f64> =
            times_s.iter().map(|t| (t - self.step.start_s) * self.step.rate).collect();
        let mut poses = self.repertoire.path(primitive, &at_s);
        for p in &mut poses.position_m {
            let [dx, height, dz] = rotate(turn, *p);
            *p = [x + dx, height, z + dz];
        }
        poses.orientation.iter_mut().for_each(|q| *q = mul(turn, *q));
        poses
    }

    fn pose(&self, time_s: f64) -> ([f64; 3], Quaternion) {
        let poses = self.poses(&[time_s]);
        (poses.position_m[0], poses.orientation[0])
    }

    fn velocity_m_s(&self, time_s: f64) -> [f64; 3] {
        let around = self.poses(&[time_s - VELOCITY_STEP_S, time_s + VELOCITY_STEP_S]).position_m;
        std::array::from_fn(|i| (around[1][i] - around[0][i]) / (2.0 * VELOCITY_STEP_S))
    }
}

/// Returns the path of `n_frames` at 30 fps from time 0: each step begins where and as the one before
/// it ends.
///
/// Within ±0.2 s of a beat at which two steps meet (less for short ones) the position is the cubic
/// Hermite curve between the positions and velocities of both sides, and the orientation the slerp
/// `q_a (q_a* q_b)^s`, `s = 3u² - 2u³`, from the step that ends to the one that begins. The whole is
/// low-passed at 6 Hz. Heights are above the captures' medians.
pub fn path(steps: &[DanceStep], repertoire: &Repertoire, n_frames: usize) -> Poses {
    let mut poses = Poses::default();
    let mut placed: Vec<PlacedStep> = Vec::with_capacity(steps.len());
    let (mut origin, mut heading_rad) = ([0.0; 2], 0.0);
    for step in steps {
        let next = PlacedStep { step, repertoire, origin, heading_rad };
        let ([x, _, z], _) = next.pose(step.end_s);
        origin = [x, z];
        let turn_rad = step.primitive.map_or(0.0, |i| repertoire.primitives()[i].turn_rad);
        heading_rad = (heading_rad + turn_rad).rem_euclid(2.0 * std::f64::consts::TAU);
        placed.push(next);
    }
    let times_s: Vec<f64> = (0..n_frames).map(frames_to_s).collect();
    let mut first = 0;
    for (k, here) in placed.iter().enumerate() {
        let is_last = k + 1 == placed.len();
        let within = |t: &&f64| is_last || **t < here.step.end_s;
        let n = times_s[first..].iter().take_while(within).count();
        let times = &times_s[first..first + n];
        first += n;
        let mut part = here.poses(times);
        let joins = [
            k.checked_sub(1).map(|before| Join::new(&placed[before], here)),
            placed.get(k + 1).map(|after| Join::new(here, after)),
        ];
        for join in joins.iter().flatten() {
            join.bend(times, &mut part);
        }
        poses.position_m.extend(part.position_m);
        poses.orientation.extend(part.orientation);
    }
    make_sign_continuous(&mut poses.orientation);
    for axis in 0..3 {
        let mut x: Vec<f64> = poses.position_m.iter().map(|p| p[axis]).collect();
        lowpass(&mut x, JOINED_LOWPASS_HZ, FPS);
        poses.position_m.iter_mut().zip(x).for_each(|(p, x)| p[axis] = x);
    }
    lowpass_orientation(&mut poses.orientation, JOINED_LOWPASS_HZ);
    poses
}

/// The bend from one step into the next.
struct Join<'a> {
    before: &'a PlacedStep<'a>,
    after: &'a PlacedStep<'a>,
    beat_s: f64,
    half_s: f64,
    /// Position and velocity at its two ends.
    from: ([f64; 3], [f64; 3]),
    to: ([f64; 3], [f64; 3]),
}

impl<'a> Join<'a> {
    fn new(before: &'a PlacedStep<'a>, after: &'a PlacedStep<'a>) -> Self {
        let beat_s = after.step.start_s;
        let shorter_s = before.step.duration_s().min(after.step.duration_s());
        let half_s = MAX_JOIN_S.min(MAX_JOIN_PER_STEP * shorter_s);
        let end = |placed: &PlacedStep<'_>, t: f64| (placed.pose(t).0, placed.velocity_m_s(t));
        let (from, to) = (end(before, beat_s - half_s), end(after, beat_s + half_s));
        Self { before, after, beat_s, half_s, from, to }
    }

    /// Replaces the poses at those of `times_s` that lie in the bend.
    fn bend(&self, times_s: &[f64], poses: &mut Poses) {
        let length_s = 2.0 * self.half_s;
        let start_s = self.beat_s - self.half_s;
        let first = times_s.partition_point(|&t| t < start_s);
        let end = times_s.partition_point(|&t| t < start_s + length_s);
        let times_s = &times_s[first..end];
        let (a, b) = (self.before.poses(times_s), self.after.poses(times_s));
        for (i, t) in times_s.iter().enumerate() {
            let u = (t - start_s) / length_s;
            poses.position_m[first + i] = hermite(self.from, self.to, length_s, u);
            let s = u * u * (3.0 - 2.0 * u);
            poses.orientation[first + i] = slerp(a.orientation[i], b.orientation[i], s);
        }
    }
}

/// Cubic Hermite curve at `u` in [0, 1] between positions and velocities `length_s` apart.
fn hermite(
    (p0, v0): ([f64; 3], [f64; 3]),
    (p1, v1): ([f64; 3], [f64; 3]),
    length_s: f64,
    u: f64,
) -> [f64; 3] {
    let (u2, u3) = (u * u, u * u * u);
    let rise = 3.0 * u2 - 2.0 * u3;
    std::array::from_fn(|i| {
        p0[i]
            + (p1[i] - p0[i]) * rise
            + length_s * (v0[i] * (u3 - 2.0 * u2 + u) + v1[i] * (u3 - u2))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hermite_curves_meet_both_ends_with_their_velocities() {
        let (from, to) = (([1.0, 0.0, -2.0], [3.0, 0.5, 0.0]), ([2.0, 0.1, 0.0], [-1.0, 0.0, 4.0]));
        let at = |u: f64| hermite(from, to, 0.4, u);
        assert_eq!((at(0.0), at(1.0)), (from.0, to.0));
        let h = 1e-6;
        for i in 0..3 {
            // Second differences of a cubic over 1e-6 leave about 1e-5.
            let (start, end) = ((at(h)[i] - at(0.0)[i]) / h, (at(1.0)[i] - at(1.0 - h)[i]) / h);
            assert!((start / 0.4 - from.1[i]).abs() < 1e-4, "{start}");
            assert!((end / 0.4 - to.1[i]).abs() < 1e-4, "{end}");
        }
    }
}
