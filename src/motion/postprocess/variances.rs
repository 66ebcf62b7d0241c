//! Error variances of decoded channels, by which fusion weighs them.

use ndarray::{Array2, ArrayView2};
use serde::{Deserialize, Serialize};

use super::fusion::FusionMeasurements;
use crate::motion::layout::{BodyColumns, Columns};

/// Horizontal and vertical variances of five channel groups.
const N_GROUPS: usize = 10;

/// Variances along the floor and up.
///
/// x and z have one between them: where a dancer faces is free, and fused motion must not depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisVariances {
    /// Of x and z each; of rotations about them.
    pub horizontal: f64,
    /// Of y; of rotations about it.
    pub vertical: f64,
}

impl AxisVariances {
    /// The same on every axis.
    pub const fn even(variance: f64) -> Self {
        Self { horizontal: variance, vertical: variance }
    }

    /// Multiplies both.
    pub fn times(self, factor: f64) -> Self {
        Self { horizontal: self.horizontal * factor, vertical: self.vertical * factor }
    }

    /// The variance along axis 0 to 2, x, y, z.
    pub fn of_axis(&self, axis: usize) -> f64 {
        if axis == 1 { self.vertical } else { self.horizontal }
    }
}

/// Variances of the errors that a decoder leaves in each group of channels; only their ratios matter to
/// [`super::Coherence::Fuse`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FusionVariances {
    pub position_m2: AxisVariances,
    pub velocity_m2_s2: AxisVariances,
    pub acceleration_m2_s4: AxisVariances,
    pub orientation_rad2: AxisVariances,
    pub angular_velocity_rad2_s2: AxisVariances,
}

impl Default for FusionVariances {
    /// Two centimetres, 0.2 m/s, 2 m/s², 0.02 rad, 0.2 rad/s, for models that were not measured.
    ///
    /// σ_p²/σ_v² = 0.01 s² and σ_p²/σ_a² = 0.0001 s⁴ gave constructed dance its own jerk and speed; the best
    /// differ from data to data.
    fn default() -> Self {
        Self {
            position_m2: AxisVariances::even(4e-4),
            velocity_m2_s2: AxisVariances::even(0.04),
            acceleration_m2_s4: AxisVariances::even(4.0),
            orientation_rad2: AxisVariances::even(4e-4),
            angular_velocity_rad2_s2: AxisVariances::even(0.04),
        }
    }
}

impl FusionVariances {
    /// Returns each group with its name.
    fn groups(&self) -> [(&'static str, AxisVariances); 5] {
        [
            ("position_m2", self.position_m2),
            ("velocity_m2_s2", self.velocity_m2_s2),
            ("acceleration_m2_s4", self.acceleration_m2_s4),
            ("orientation_rad2", self.orientation_rad2),
            ("angular_velocity_rad2_s2", self.angular_velocity_rad2_s2),
        ]
    }

    /// Changes every variance.
    pub fn map(self, mut change: impl FnMut(f64) -> f64) -> Self {
        let groups = self.groups().map(|(_, of)| [of.horizontal, of.vertical]);
        let mut changed = [0.0; N_GROUPS];
        for (new, old) in changed.iter_mut().zip(groups.as_flattened()) {
            *new = change(*old);
        }
        Self::from_groups(changed)
    }

    /// Returns the first variance that is not finite and above 0, with its group.
    pub fn unsound(&self) -> Option<(&'static str, f64)> {
        let each = self
            .groups()
            .into_iter()
            .flat_map(|(name, of)| [of.horizontal, of.vertical].map(|variance| (name, variance)));
        each.into_iter().find(|(_, variance)| !(variance.is_finite() && *variance > 0.0))
    }

    fn from_groups(x: [f64; N_GROUPS]) -> Self {
        let group = |i: usize| AxisVariances { horizontal: x[2 * i], vertical: x[2 * i + 1] };
        Self {
            position_m2: group(0),
            velocity_m2_s2: group(1),
            acceleration_m2_s4: group(2),
            orientation_rad2: group(3),
            angular_velocity_rad2_s2: group(4),
        }
    }
}

impl FusionMeasurements {
    /// Takes frames, `[T, columns]`, as measurements; those that a layout lacks are not numbers, which fusion leaves
    /// out.
    pub fn of(body: &BodyColumns, frames: ArrayView2<f32>) -> Self {
        let frames: Array2<f32> = frames.to_owned();
        let vectors = |columns: Option<Columns>| match columns {
            Some(columns) => super::vectors(&frames, columns),
            None => vec![[f64::NAN; 3]; frames.nrows()],
        };
        Self {
            position: vectors(Some(body.position)),
            velocity: vectors(body.velocity),
            acceleration: vectors(body.acceleration),
            orientation: super::quaternions(&frames, body.orientation),
            angular_velocity: vectors(body.angular_velocity),
        }
    }
}

#[cfg(test)]
mod tests;
