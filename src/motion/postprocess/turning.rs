//! Fusion of orientations with angular velocities: nonlinear least squares over rotations.

use std::f64::consts::TAU;

use super::fusion::{FusionMeasurements, HeldPoses, size};
use super::variances::{AxisVariances, FusionVariances};
use crate::motion::banded::{Equation, SPAN, Solution};
use crate::motion::quaternion::{
    Quaternion, angular_velocity, dot, from_rotation_vector, mul, normalize,
};
use crate::units::FPS;

/// Most Gauss-Newton steps; a dozen are many for errors below a radian.
const MAX_STEPS: usize = 30;
/// Steps below this, rad, are none.
const SMALL_STEP: f64 = 1e-12;
/// Most halvings of a step that makes the sum larger.
const MAX_HALVINGS: usize = 12;
/// Angles below this, rad, take the series of [`inverse_jacobian`].
const SMALL_ANGLE: f64 = 1e-3;
/// Norms below this are no orientation.
const MIN_NORM: f64 = 1e-6;

/// The least-squares problem of the orientations.
pub(super) struct Turning<'a> {
    /// q̂, unit; what has no direction stays.
    pub q_hat: Vec<Quaternion>,
    omega: &'a [[f64; 3]],
    has_direction: Vec<bool>,
    is_free: Vec<bool>,
}

impl<'a> Turning<'a> {
    pub fn new(measured: &'a FusionMeasurements, held: &HeldPoses) -> Self {
        let q = &measured.orientation;
        let norm = |q: &Quaternion| dot(*q, *q).sqrt();
        let has_direction: Vec<bool> =
            q.iter().map(|q| norm(q).is_finite() && norm(q) > MIN_NORM).collect();
        let is_held = |t: usize| held.orientation.get(t).copied().unwrap_or(false);
        let is_free = (0..q.len()).map(|t| has_direction[t] && !is_held(t)).collect();
        let unit = |(q, known): (&Quaternion, &bool)| if *known { normalize(*q) } else { *q };
        let q_hat = q.iter().zip(&has_direction).map(unit).collect();
        Self { q_hat, omega: &measured.angular_velocity, has_direction, is_free }
    }

    /// Returns which orientations may turn, by frame.
    pub fn is_free(&self) -> &[bool] {
        &self.is_free
    }

    /// Takes Gauss-Newton steps `q[t] <- exp(δ[t]) q[t]` from q until the sum does not fall any more.
    pub fn settle(&self, q: &mut Vec<Quaternion>, variances: &FusionVariances) {
        for _ in 0..MAX_STEPS {
            let before = self.sum(q, variances);
            let solution = self.step(q, variances);
            let mut share = 1.0;
            let stepped = (0..MAX_HALVINGS).find_map(|_| {
                let next = moved(q, &solution.x, share);
                share *= 0.5;
                (self.sum(&next, variances) < before).then_some(next)
            });
            let Some(next) = stepped else { return };
            *q = next;
            if solution.x.iter().all(|x| x.abs() < SMALL_STEP) {
                return;
            }
        }
    }

    /// Solves the problem that is linear about q for δ, three unknowns a frame; groups are orientation
    /// and angular velocity, each horizontal and vertical.
    ///
    /// `log(exp(δ) exp(φ)) ≈ φ + J(φ) δ` and `log(exp(φ) exp(-δ)) ≈ φ - J(-φ) δ`, J of
    /// [`inverse_jacobian`].
    fn step(&self, q: &[Quaternion], variances: &FusionVariances) -> Solution {
        let mut equations = Vec::with_capacity(6 * q.len());
        for t in 0..q.len() {
            if self.has_direction[t] {
                let e = angular_velocity(self.q_hat[t], q[t], 1.0);
                let j = inverse_jacobian(e);
                for axis in 0..3 {
                    let mut coefficients = [0.0; SPAN];
                    coefficients[..3].copy_from_slice(&j[axis]);
                    let group = usize::from(axis == 1);
                    equations.push(Equation { first: 3 * t, coefficients, value: -e[axis], group });
                }
            }
            let Some((phi, missing)) = self.turn(q, t) else { continue };
            let (before, after) = (inverse_jacobian(phi.map(|x| -x)), inverse_jacobian(phi));
            for axis in 0..3 {
                let mut coefficients = [0.0; SPAN];
                for i in 0..3 {
                    coefficients[i] = -FPS * before[axis][i];
                    coefficients[3 + i] = FPS * after[axis][i];
                }
                let group = 2 + usize::from(axis == 1);
                equations.push(Equation {
                    first: 3 * t,
                    coefficients,
                    value: missing[axis],
                    group,
                });
            }
        }
        let is_free = self.is_free.iter().flat_map(|free| [*free; 3]).collect();
        Solution::new(&equations, &groups(variances), is_free, 5)
    }

    /// φ = log(q[t+1] q[t]*), of the two ways round the one nearer to ω̂[t] / FPS, and ω̂[t] - FPS φ, where all of it is known.
    fn turn(&self, q: &[Quaternion], t: usize) -> Option<([f64; 3], [f64; 3])> {
        let is_known = self.has_direction[t] && self.has_direction.get(t + 1) == Some(&true);
        let omega = self.omega[t];
        if !is_known || omega.iter().any(|x| !x.is_finite()) {
            return None;
        }
        let missing = |phi: [f64; 3]| std::array::from_fn(|i| omega[i] - FPS * phi[i]);
        let short = angular_velocity(q[t], q[t + 1], 1.0);
        // About half a turn, which way round ω̂ tells.
        let other = short.map(|x| x * (1.0 - TAU / size(short)));
        let phi = if size(missing(other)) < size(missing(short)) { other } else { short };
        Some((phi, missing(phi)))
    }

    /// The sum that is made smallest.
    fn sum(&self, q: &[Quaternion], variances: &FusionVariances) -> f64 {
        let weigh = |x: [f64; 3], variances: &AxisVariances| -> f64 {
            (0..3).map(|axis| x[axis] * x[axis] / variances.of_axis(axis)).sum()
        };
        let weighted_error = |t: usize| {
            let error = angular_velocity(self.q_hat[t], q[t], 1.0);
            let known = if self.has_direction[t] { error } else { [0.0; 3] };
            let missing = self.turn(q, t).map_or([0.0; 3], |(_, missing)| missing);
            weigh(known, &variances.orientation_rad2)
                + weigh(missing, &variances.angular_velocity_rad2_s2)
        };
        (0..q.len()).map(weighted_error).sum()
    }
}

/// Variances of the groups of [`Turning::step`].
fn groups(variances: &FusionVariances) -> [f64; 4] {
    let (q, omega) = (&variances.orientation_rad2, &variances.angular_velocity_rad2_s2);
    [q.horizontal, q.vertical, omega.horizontal, omega.vertical]
}

/// Returns `exp(share δ[t]) q[t]`; where δ is 0, q to the bit.
fn moved(q: &[Quaternion], delta: &[f64], share: f64) -> Vec<Quaternion> {
    let turn = |(q, d): (&Quaternion, &[f64])| {
        if d.iter().all(|x| *x == 0.0) {
            return *q;
        }
        normalize(mul(from_rotation_vector([share * d[0], share * d[1], share * d[2]]), *q))
    };
    q.iter().zip(delta.chunks_exact(3)).map(turn).collect()
}

/// The inverse of the left Jacobian of rotations,
/// `J(φ) = I - [φ]×/2 + (1 - (θ/2) cot(θ/2)) [φ]×² / θ²`, θ = |φ| below 2π.
///
/// Source: Solà, Deray and Atchuthan, A micro Lie theory for state estimation in robotics,
/// arXiv:1812.01537, equation 146.
fn inverse_jacobian(phi: [f64; 3]) -> [[f64; 3]; 3] {
    let theta = size(phi);
    let factor = if theta < SMALL_ANGLE {
        1.0 / 12.0 + theta * theta / 720.0
    } else {
        let half = theta / 2.0;
        (1.0 - half * half.cos() / half.sin()) / (theta * theta)
    };
    let [x, y, z] = phi;
    let cross = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]];
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            // [φ]×² = φ φᵀ - θ² I.
            let diagonal = f64::from(u8::from(i == j));
            let square = phi[i] * phi[j] - theta * theta * diagonal;
            diagonal - cross[i][j] / 2.0 + factor * square
        })
    })
}

#[cfg(test)]
mod tests;
