//! Error variances of decoded channels, by which fusion weighs them.

use ndarray::{Array2, ArrayView2};
use serde::{Deserialize, Serialize};

use super::fusion::{Held, Measured};
use super::turning::Turning;
use crate::motion::channels::Channel;
use crate::motion::quaternion::{Quaternion, angular_velocity, dot, normalize};

/// Most rounds of [`FusionVariances::of_decoded`]; a few dozen are many.
const MAX_ROUNDS: usize = 60;
/// Rounds end when no variance changes by more than this share.
const TOLERANCE: f64 = 1e-3;
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

    /// Returns the first variance that is not finite and above 0, with its group.
    pub fn unsound(&self) -> Option<(&'static str, f64)> {
        let each = self
            .groups()
            .into_iter()
            .flat_map(|(name, of)| [of.horizontal, of.vertical].map(|variance| (name, variance)));
        each.into_iter().find(|(_, variance)| !(variance.is_finite() && *variance > 0.0))
    }

    fn from_groups(x: [f64; N_GROUPS]) -> Self {
        let of = |i: usize| AxisVariances { horizontal: x[2 * i], vertical: x[2 * i + 1] };
        Self {
            position_m2: of(0),
            velocity_m2_s2: of(1),
            acceleration_m2_s4: of(2),
            orientation_rad2: of(3),
            angular_velocity_rad2_s2: of(4),
        }
    }

    /// Measures the errors of decoded motions against the truth that they were decoded of, `[T, 25]` each:
    /// `σ² = Σ ε² / n`, the maximum likelihood of errors with mean 0.
    ///
    /// Frames with a value that is not finite in either are left out, as are the last values that fusion
    /// leaves out. Only meant for motion with a truth frame by frame, such as what a decoder makes of the
    /// latents of real motion: sampled motion rightly differs from any one truth, and what it differs by is no
    /// error. None where a group has no frames, or no error at all.
    ///
    /// # Panics
    /// When a pair has two lengths.
    pub fn measure<'a>(
        pairs: impl IntoIterator<Item = (ArrayView2<'a, f32>, ArrayView2<'a, f32>)>,
    ) -> Option<Self> {
        let mut means = [Mean::default(); N_GROUPS];
        for (decoded, truth) in pairs {
            assert_eq!(decoded.dim(), truth.dim(), "decoded motion against its truth");
            let (decoded, truth) = (Measured::of(decoded), Measured::of(truth));
            let n = decoded.position.len();
            let vectors = [
                (&decoded.position, &truth.position, n),
                (&decoded.velocity, &truth.velocity, n.saturating_sub(1)),
                (&decoded.acceleration, &truth.acceleration, n.saturating_sub(2)),
            ];
            for (i, (found, wanted, n)) in vectors.into_iter().enumerate() {
                for (a, b) in found.iter().zip(wanted).take(n) {
                    add_errors(&mut means, i, std::array::from_fn(|axis| a[axis] - b[axis]));
                }
            }
            let is_turn = |q: &Quaternion| dot(*q, *q) > 0.0;
            let orientations = decoded.orientation.iter().zip(&truth.orientation);
            for (a, b) in orientations.filter(|(a, b)| is_turn(a) && is_turn(b)) {
                add_errors(&mut means, 3, angular_velocity(normalize(*b), normalize(*a), 1.0));
            }
            let turns = decoded.angular_velocity.iter().zip(&truth.angular_velocity);
            for (a, b) in turns.take(n.saturating_sub(1)) {
                add_errors(&mut means, 4, std::array::from_fn(|axis| a[axis] - b[axis]));
            }
        }
        Self::sound(means.map(|mean| mean.value()))
    }

    /// Estimates the errors of decoded motions, `[T, 25]`, from how far their channels contradict each other,
    /// without any truth: restricted maximum likelihood.
    ///
    /// Every path is as likely as any other beforehand, so that nothing counts but what no path explains: a
    /// motion that is not the dancer's but agrees with itself has no error. From a start, each round fuses and
    /// sets `σ² = Σ r² / (n - Σ c A⁻¹ cᵀ / σ²)`, r the residuals of a group, n less how much of them the path
    /// takes up; where it ends, the likelihood is stationary. Source: Patterson and Thompson, Recovery of
    /// inter-block information when block sizes are unequal, Biometrika 58(3), 1971; the rounds are those of
    /// MacKay, Bayesian interpolation, Neural Computation 4(3), 1992. O(T) a round.
    ///
    /// It takes errors to be independent from frame to frame, as fusion does. Those of a network that hardly
    /// learnt a channel are not: what it then says is how little the channel is worth to fusion, not how large
    /// its errors are.
    ///
    /// Values that are not finite are left out. None where a group has no frames (motions of fewer than
    /// three), or nothing contradicts.
    pub fn of_decoded<'a>(motions: impl IntoIterator<Item = ArrayView2<'a, f32>>) -> Option<Self> {
        let motions: Vec<Measured> = motions.into_iter().map(Measured::of).collect();
        let turnings: Vec<Turning> =
            motions.iter().map(|motion| Turning::new(motion, &Held::default())).collect();
        let mut q: Vec<_> = turnings.iter().map(|turning| turning.q_hat.clone()).collect();
        let mut variances = Self::default();
        for _ in 0..MAX_ROUNDS {
            let mut means = [Mean::default(); N_GROUPS];
            for (i, (motion, turning)) in motions.iter().zip(&turnings).enumerate() {
                for axis in 0..3 {
                    let (solution, equations) =
                        motion.position_solution(axis, &variances, &Held::default());
                    for (e, taken) in equations.iter().zip(solution.variances_of(&equations)) {
                        let group = 2 * e.group + usize::from(axis == 1);
                        let sigma2 = variances.groups()[e.group].1.of_axis(axis);
                        means[group].add(e.residual(&solution.x), 1.0 - taken / sigma2);
                    }
                }
                turning.settle(&mut q[i], &variances);
                let (solution, equations) = turning.step(&q[i], &variances);
                for (e, taken) in equations.iter().zip(solution.variances_of(&equations)) {
                    let of = variances.groups()[3 + e.group / 2].1;
                    let sigma2 = if e.group % 2 == 1 { of.vertical } else { of.horizontal };
                    means[6 + e.group].add(e.residual(&solution.x), 1.0 - taken / sigma2);
                }
            }
            let next = Self::sound(means.map(|mean| mean.value()))?;
            let change = |(a, b): (&(_, AxisVariances), &(_, AxisVariances))| {
                let (a, b) = (a.1, b.1);
                let of = |a: f64, b: f64| (a / b).ln().abs();
                of(a.horizontal, b.horizontal).max(of(a.vertical, b.vertical))
            };
            let largest =
                next.groups().iter().zip(&variances.groups()).map(change).fold(0.0, f64::max);
            variances = next;
            if largest < TOLERANCE {
                break;
            }
        }
        Some(variances)
    }

    fn sound(variances: [f64; N_GROUPS]) -> Option<Self> {
        Some(Self::from_groups(variances)).filter(|found| found.unsound().is_none())
    }
}

/// A mean of squares.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: f64,
    n: f64,
}

impl Mean {
    fn add(&mut self, x: f64, n: f64) {
        self.sum += x * x;
        self.n += n;
    }

    /// NaN where nothing was added.
    fn value(self) -> f64 {
        self.sum / self.n
    }
}

/// Adds an error of the i-th group of channels, unless it is not finite.
fn add_errors(means: &mut [Mean; N_GROUPS], i: usize, error: [f64; 3]) {
    if error.iter().all(|x| x.is_finite()) {
        for (axis, x) in error.into_iter().enumerate() {
            means[2 * i + usize::from(axis == 1)].add(x, 1.0);
        }
    }
}

impl Measured {
    /// Takes frames, `[T, 25]`, as measurements.
    pub fn of(frames: ArrayView2<f32>) -> Self {
        let frames: Array2<f32> = frames.to_owned();
        Self {
            position: super::vectors(&frames, Channel::Position),
            velocity: super::vectors(&frames, Channel::Velocity),
            acceleration: super::vectors(&frames, Channel::Acceleration),
            orientation: super::quaternions(&frames),
            angular_velocity: super::vectors(&frames, Channel::AngularVelocity),
        }
    }
}

#[cfg(test)]
mod tests;
