//! What the sanity checks compare with their thresholds.

use ndarray::{ArrayView2, s};

use crate::motion::phase::WRAP_BARS;
use crate::motion::quaternion::{Quaternion, angular_velocity, dot, normalize};
use crate::motion::{ChannelLimits, ColumnRole, Columns, Layout};
use crate::units::FPS;

/// Returns the mean `|d[t] - 30 (x[t+1] - x[t])|` over frames and axes, of columns x and those that say
/// they are their derivative; 0 where there are no two frames.
pub fn derivative_error(frames: ArrayView2<f32>, of: Columns, derivative: Columns) -> f64 {
    let at = |t: usize, i: usize| f64::from(frames[[t, i]]);
    let (x, d) = (of.first, derivative.first);
    let pairs = frames.nrows().saturating_sub(1);
    let off = |t: usize| -> f64 {
        (0..3).map(|i| (at(t, d + i) - FPS * (at(t + 1, x + i) - at(t, x + i))).abs()).sum()
    };
    (0..pairs).map(off).sum::<f64>() / (3 * pairs.max(1)) as f64
}

/// The quantities of a motion that the checks compare with thresholds; none of columns that its layout lacks.
pub(super) struct CheckQuantities {
    pub norm: f64,
    pub phase: Option<[f64; 2]>,
    pub jerk: Option<f64>,
    pub velocity_error: Option<f64>,
    pub acceleration_error: Option<f64>,
    pub turn_error: Option<f64>,
    pub least_dot: f64,
    pub n_not_finite: usize,
    pub n_outside: usize,
    pub n_falls: Option<usize>,
}

impl CheckQuantities {
    /// Measures frames, `[T, columns]`.
    pub fn of(layout: Layout, frames: ArrayView2<f32>, limits: ChannelLimits) -> Self {
        let n = frames.nrows();
        let body = layout.body();
        let vector = |columns: Columns, t: usize| -> [f64; 3] {
            std::array::from_fn(|i| f64::from(frames[[t, columns.first + i]]))
        };
        let quaternion = |t: usize| -> Quaternion {
            std::array::from_fn(|i| f64::from(frames[[t, body.orientation.first + i]]))
        };
        let pairs = n.saturating_sub(1);
        // Where there is nothing to measure there is no error.
        let mean = |sum: f64, n: usize| if n == 0 { 0.0 } else { sum / n as f64 };
        let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let jerk = |acceleration: Columns, t: usize| {
            let (a, b) = (vector(acceleration, t), vector(acceleration, t + 1));
            FPS * length(std::array::from_fn(|i| b[i] - a[i]))
        };
        let turn = |angular: Columns, t: usize| {
            let derived =
                angular_velocity(normalize(quaternion(t)), normalize(quaternion(t + 1)), FPS);
            let own = vector(angular, t);
            (0..3).map(|i| (own[i] - derived[i]).abs()).sum::<f64>()
        };
        // `f64::min` would pass over NaN.
        let least = |a: f64, b: f64| if b < a || b.is_nan() { b } else { a };
        let most = |a: f64, b: f64| if b > a || b.is_nan() { b } else { a };
        let phase: Option<Vec<f64>> = layout
            .with_role(ColumnRole::Phase)
            .next()
            .map(|columns| frames.column(columns.first).iter().map(|&x| f64::from(x)).collect());
        let n_falls = |phase: &Vec<f64>| {
            let changes = phase.windows(2).map(|pair| pair[1] - pair[0]);
            changes.filter(|change| (-WRAP_BARS..-1e-6).contains(change)).count()
        };
        let outside = layout.groups().map(|columns| {
            let (low, high) = limits.of(columns.group);
            let values = frames.slice(s![.., columns.range()]);
            values.iter().filter(|x| !(low..=high).contains(*x)).count()
        });
        let error = |of: Option<Columns>, derivative: Option<Columns>| {
            Some(derivative_error(frames, of?, derivative?))
        };
        Self {
            norm: mean((0..n).map(|t| dot(quaternion(t), quaternion(t)).sqrt()).sum(), n),
            phase: phase.as_ref().map(|phase| {
                [
                    phase.iter().copied().fold(f64::INFINITY, least),
                    phase.iter().copied().fold(f64::NEG_INFINITY, most),
                ]
            }),
            jerk: body
                .acceleration
                .map(|columns| mean((0..pairs).map(|t| jerk(columns, t)).sum(), pairs)),
            velocity_error: error(Some(body.position), body.velocity),
            acceleration_error: error(body.velocity, body.acceleration),
            turn_error: body
                .angular_velocity
                .map(|columns| mean((0..pairs).map(|t| turn(columns, t)).sum(), 3 * pairs)),
            least_dot: (0..pairs)
                .map(|t| dot(normalize(quaternion(t)), normalize(quaternion(t + 1))))
                .fold(1.0, least),
            n_not_finite: frames.iter().filter(|x| !x.is_finite()).count(),
            n_outside: outside.sum(),
            n_falls: phase.as_ref().map(n_falls),
        }
    }
}
