//! Fusion: poses that agree best with everything that was decoded of them.
//!
//! A decoder says where the body is (p̂), how fast it moves (v̂) and how its speed changes (â), each with an
//! error of its own. Taken as measurements of one path p with independent errors of the variances σ², the
//! path of maximum likelihood is, axis by axis,
//!
//! `p = argmin Σ (p[t] - p̂[t])² / σ_p² + Σ ((Dp)[t] - v̂[t])² / σ_v² + Σ ((D²p)[t] - â[t])² / σ_a²`,
//!
//! `(Dp)[t] = (p[t+1] - p[t]) FPS`. Of orientation q̂ and angular velocity ω̂, in world axes,
//!
//! `q = argmin Σ |log(q[t] q̂[t]*)|² / σ_q² + Σ |FPS log(q[t+1] q[t]*) - ω̂[t]|² / σ_ω²`,
//!
//! with `log` the rotation vector and the squares weighted axis by axis. The last v̂ and ω̂, and the last two
//! â, repeat the ones before them and are left out. Source: least squares for positions; for rotations,
//! Gauss-Newton on the tangent space, Barfoot, State Estimation for Robotics, Cambridge 2017, sections 7.1
//! and 8.2 (a discrete-time batch trajectory).
//!
//! What is solved for is the shift from what was decoded: poses that are held have none, so that they keep
//! their bits. Equations with a value that is not finite are left out, and a pose that is not finite, or an
//! orientation without direction, stays as it is: motion falls apart into two there.

use ndarray::Array2;

use super::turning::Turning;
use super::variances::{AxisVariances, FusionVariances};
use crate::motion::banded::{Equation, SPAN, Solution};
use crate::motion::quaternion::{Quaternion, angular_velocity, normalize};
use crate::units::FPS;

/// Poses that fusion leaves as they are, such as those that constraints ask for.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct HeldPoses {
    /// Axes x, y, z by frame; frames past the last are free.
    pub position: Vec<[bool; 3]>,
    /// By frame; frames past the last are free.
    pub orientation: Vec<bool>,
}

/// How far poses were moved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Displacement {
    /// Root mean square over frames, mm.
    pub position_rms_mm: f64,
    /// Of the frame that was moved farthest, mm.
    pub position_max_mm: f64,
    /// Root mean square over frames, degrees.
    pub orientation_rms_deg: f64,
    /// Of the frame that was turned farthest, degrees.
    pub orientation_max_deg: f64,
}

impl Displacement {
    /// Returns the displacement of frames by shifts, m, and turns, rad.
    pub(super) fn new(shifts_m: &[[f64; 3]], turns_rad: &[f64]) -> Self {
        let sizes_m: Vec<f64> = shifts_m.iter().map(|d| size(*d)).collect();
        let rms = |x: &[f64]| (x.iter().map(|x| x * x).sum::<f64>() / x.len().max(1) as f64).sqrt();
        let max = |x: &[f64]| x.iter().copied().fold(0.0, f64::max);
        Self {
            position_rms_mm: 1e3 * rms(&sizes_m),
            position_max_mm: 1e3 * max(&sizes_m),
            orientation_rms_deg: rms(turns_rad).to_degrees(),
            orientation_max_deg: max(turns_rad).to_degrees(),
        }
    }

    /// Returns the angle of the turn between two orientations, rad; 0 where one has no direction.
    pub(super) fn angle(from: &Quaternion, to: &Quaternion) -> f64 {
        let angle = size(angular_velocity(normalize(*from), normalize(*to), 1.0));
        if angle.is_finite() { angle } else { 0.0 }
    }
}

/// The decoded channels of a motion, frame by frame, as measurements to fuse; all of one length.
pub(super) struct FusionMeasurements {
    /// p̂, m.
    pub position: Vec<[f64; 3]>,
    /// v̂, m/s.
    pub velocity: Vec<[f64; 3]>,
    /// â, m/s².
    pub acceleration: Vec<[f64; 3]>,
    /// q̂
    pub orientation: Vec<Quaternion>,
    /// ω̂, rad/s.
    pub angular_velocity: Vec<[f64; 3]>,
}

impl FusionMeasurements {
    /// Returns how far fusion moves each position, m; 0 where it is held or not finite.
    pub fn shifts(&self, variances: &FusionVariances, held: &HeldPoses) -> Vec<[f64; 3]> {
        let axes: [Vec<f64>; 3] =
            std::array::from_fn(|axis| self.position_solution(axis, variances, held).x);
        (0..self.position.len()).map(|t| std::array::from_fn(|axis| axes[axis][t])).collect()
    }

    /// Solves for the shifts of an axis; groups are position, velocity, acceleration.
    fn position_solution(
        &self,
        axis: usize,
        variances: &FusionVariances,
        held: &HeldPoses,
    ) -> Solution {
        let n = self.position.len();
        let p = |t: usize| self.position[t][axis];
        let mut equations = Vec::with_capacity(3 * n);
        let mut add = |first, coefficients: [f64; 3], value: f64, group| {
            let mut padded = [0.0; SPAN];
            padded[..3].copy_from_slice(&coefficients);
            if value.is_finite() {
                equations.push(Equation { first, coefficients: padded, value, group });
            }
        };
        for t in 0..n {
            add(t, [1.0, 0.0, 0.0], 0.0 * p(t), 0);
            if t + 1 < n {
                let v = (p(t + 1) - p(t)) * FPS;
                add(t, [-FPS, FPS, 0.0], self.velocity[t][axis] - v, 1);
            }
            if t + 2 < n {
                let a = (p(t + 2) - 2.0 * p(t + 1) + p(t)) * FPS * FPS;
                let c = FPS * FPS;
                add(t, [c, -2.0 * c, c], self.acceleration[t][axis] - a, 2);
            }
        }
        let is_held = |t: usize| held.position.get(t).is_some_and(|axes| axes[axis]);
        let is_free = (0..n).map(|t| p(t).is_finite() && !is_held(t)).collect();
        let sigma2 = [
            variances.position_m2.of_axis(axis),
            variances.velocity_m2_s2.of_axis(axis),
            variances.acceleration_m2_s4.of_axis(axis),
        ];
        Solution::new(&equations, &sigma2, is_free, 2)
    }

    /// Returns the orientations that fusion arrives at, on the side of what was decoded.
    pub fn orientations(&self, variances: &FusionVariances, held: &HeldPoses) -> Vec<Quaternion> {
        let turning = Turning::new(self, held);
        let mut q = turning.q_hat.clone();
        turning.settle(&mut q, variances);
        let kept = turning.is_free().iter().zip(&self.orientation);
        q.into_iter()
            .zip(kept)
            .map(|(q, (free, decoded))| if *free { q } else { *decoded })
            .collect()
    }
}

/// Frames on either side that the filters of fusion see whole: all of a window of four seconds.
const FILTER_WHOLE_FRAMES: usize = 120;
/// Frames on either side that they see at all. In between they fade: a filter that ends in a step of a hundredth of a
/// second moves every pose by the noise of one frame, a millimetre, and jerk becomes three times as large.
const FILTER_HALF_FRAMES: usize = 240;

/// Fusion far from the ends of a motion, where the solution of its equations is a filter.
///
/// With r_v = v̂ − Dp̂ and r_a = â − D²p̂ the shift of positions is h_v ∗ r_v + h_a ∗ r_a, and with
/// r_ω = ω̂ − FPS log(q̂\[t+1\] q̂\[t\]*) the turn of orientations, to first order, h_ω ∗ r_ω;
/// (h ∗ r)\[t\] = Σ_j h\[j\] r\[t + j − m\] over 2m + 1 taps. Axis by axis, \[3, taps\].
#[derive(Clone, Debug, PartialEq)]
pub struct FusionFilters {
    /// h_v, s.
    pub velocity: Array2<f64>,
    /// h_a, s².
    pub acceleration: Array2<f64>,
    /// h_ω, s.
    pub angular_velocity: Array2<f64>,
}

impl FusionFilters {
    /// Returns the filters of variances: what one residual moves in a motion without any other.
    pub fn new(variances: &FusionVariances) -> Self {
        let m = FILTER_HALF_FRAMES;
        // Shifts are wanted m frames to either side of the residual, where the ends no longer tell.
        let (n, middle) = (4 * m + 1, 2 * m);
        let filter = |variances: &FusionVariances, is_velocity: bool| {
            let still = vec![[0.0; 3]; n];
            let mut residual = still.clone();
            residual[middle] = [1.0; 3];
            let (velocity, acceleration) =
                if is_velocity { (residual, still.clone()) } else { (still.clone(), residual) };
            let measured = FusionMeasurements {
                position: still.clone(),
                velocity,
                acceleration,
                orientation: Vec::new(),
                angular_velocity: Vec::new(),
            };
            let shifts = measured.shifts(variances, &HeldPoses::default());
            let fade = |lag: usize| {
                let past = lag.saturating_sub(FILTER_WHOLE_FRAMES) as f64;
                let length = (FILTER_HALF_FRAMES - FILTER_WHOLE_FRAMES) as f64;
                0.5 * (1.0 + (std::f64::consts::PI * past / length).cos())
            };
            Array2::from_shape_fn((3, 2 * m + 1), |(axis, j)| {
                fade(j.abs_diff(m)) * shifts[middle + m - j][axis]
            })
        };
        // Rotation vectors are to angular velocities what positions are to velocities; nothing is known of their
        // second differences.
        let turns = FusionVariances {
            position_m2: variances.orientation_rad2,
            velocity_m2_s2: variances.angular_velocity_rad2_s2,
            acceleration_m2_s4: AxisVariances::even(f64::INFINITY),
            ..*variances
        };
        Self {
            velocity: filter(variances, true),
            acceleration: filter(variances, false),
            angular_velocity: filter(&turns, true),
        }
    }
}

pub(super) fn size(x: [f64; 3]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests;
