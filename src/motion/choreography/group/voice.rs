//! Voices: choreographies that stay about one place and face forward, to be danced by several.

use crate::motion::choreography::joining;
use crate::motion::choreography::primitive::{Repertoire, UP, headings};
use crate::motion::choreography::selection::DanceStep;
use crate::motion::kinematics::Poses;
use crate::motion::quaternion::{Quaternion, from_axis_angle, mul, normalize, rotate};
use crate::motion::spline::CubicSpline;
use crate::motion::style::Window;
use crate::units::frames_to_s;

/// Length of the Hann window over which a dancer comes back to its place and heading, frames: 4 s. Odd, so
/// that it is centred on a frame.
const RETURN_FRAMES: usize = 121;

/// A choreography in a frame of its own: about the origin, on average facing +Z.
pub struct Voice {
    position: [CubicSpline; 3],
    orientation: [CubicSpline; 4],
    end_s: f64,
}

impl Voice {
    /// Joins steps and gathers the path about its place; `n_poses` at 30 fps, at least two.
    pub fn new(steps: &[DanceStep], repertoire: &Repertoire, n_poses: usize) -> Self {
        let mut poses = joining::path(steps, repertoire, n_poses);
        gather(&mut poses);
        let times_s: Vec<f64> = (0..n_poses).map(frames_to_s).collect();
        let curve = |values: Vec<f64>| {
            CubicSpline::fit(&times_s, &values)
                .expect("invariant: a path has at least two finite poses, at increasing times")
        };
        Self {
            position: std::array::from_fn(|i| {
                curve(poses.position_m.iter().map(|p| p[i]).collect())
            }),
            orientation: std::array::from_fn(|i| {
                curve(poses.orientation.iter().map(|q| q[i]).collect())
            }),
            end_s: times_s.last().copied().unwrap_or(0.0),
        }
    }

    /// Returns the poses at times of the voice, s; its first or last pose beyond its ends.
    pub fn poses(&self, at_s: &[f64]) -> Poses {
        let at_s: Vec<f64> = at_s.iter().map(|t| t.clamp(0.0, self.end_s)).collect();
        let [x, y, z] = self.position.each_ref().map(|curve| curve.evaluate(&at_s));
        let q = self.orientation.each_ref().map(|curve| curve.evaluate(&at_s));
        let orientation = |i: usize| -> Quaternion { normalize(std::array::from_fn(|c| q[c][i])) };
        Poses {
            position_m: (0..at_s.len()).map(|i| [x[i], y[i], z[i]]).collect(),
            orientation: (0..at_s.len()).map(orientation).collect(),
        }
    }
}

/// Takes the slow part off a path: where it goes and which way it turns over seconds; heights stay.
///
/// With `W` the mean over a Hann window of 4 s and `θ` the heading, the body turns by `ψ = -Wθ`, and its
/// steps with it: `p[t+1] = p[t] + R(ψ[t]) d[t]`. Then the path is `p - W p`. So quick steps and swings
/// stay as they were captured, and what would leave the place comes back to it.
fn gather(poses: &mut Poses) {
    let window = Window::hann(RETURN_FRAMES.min(poses.len()));
    let turns_rad: Vec<f64> =
        window.mean(&headings(&poses.orientation)).into_iter().map(|usual| -usual).collect();
    let (mut x, mut z) = (Vec::with_capacity(poses.len()), Vec::with_capacity(poses.len()));
    let mut at = [0.0, 0.0];
    for (t, &turn_rad) in turns_rad.iter().enumerate() {
        x.push(at[0]);
        z.push(at[1]);
        let turn = from_axis_angle(UP, turn_rad);
        poses.orientation[t] = mul(turn, poses.orientation[t]);
        if let Some(next) = poses.position_m.get(t + 1) {
            let here = poses.position_m[t];
            let step = rotate(turn, [next[0] - here[0], 0.0, next[2] - here[2]]);
            at = [at[0] + step[0], at[1] + step[2]];
        }
    }
    let (usual_x, usual_z) = (window.mean(&x), window.mean(&z));
    for (t, p) in poses.position_m.iter_mut().enumerate() {
        *p = [x[t] - usual_x[t], p[1], z[t] - usual_z[t]];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::FPS;
    use std::f64::consts::TAU;

    #[test]
    fn a_walk_in_circles_stays_at_its_place_and_faces_forward() {
        let mut poses = Poses::default();
        let (mut x, mut z) = (4.0, -3.0);
        // A turn in 20 s at 0.5 m/s, swaying by 0.1 m and 0.3 rad once a second.
        for t in 0..600 {
            let s = f64::from(t) / FPS;
            let yaw = TAU * s / 20.0;
            let (sin, cos) = yaw.sin_cos();
            let sway = 0.1 * (TAU * s).sin();
            poses.position_m.push([x + sway * cos, 0.2, z - sway * sin]);
            poses.orientation.push(from_axis_angle(UP, yaw + 0.3 * (TAU * s).sin()));
            x += 0.5 * sin / FPS;
            z += 0.5 * cos / FPS;
        }
        gather(&mut poses);
        for t in 100..500 {
            let s = t as f64 / FPS;
            let sway = (TAU * s).sin();
            let p = poses.position_m[t];
            // The window passes 1/s with a gain of 6e-4 at this offset from its zero, and a swinging
            // heading bends the steps by up to 0.3 rad for a quarter of a second.
            assert!((p[0] - 0.1 * sway).abs() < 0.01 && p[2].abs() < 0.01, "{t}: {p:?}");
            assert_eq!(p[1], 0.2);
            let yaw = 2.0 * poses.orientation[t][2].atan2(poses.orientation[t][0]);
            assert!((yaw - 0.3 * sway).abs() < 0.01, "{t}: {yaw}");
        }
    }
}
