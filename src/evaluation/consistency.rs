//! Whether the channels of a motion belong to one body, and how smoothly it moves.
//!
//! In the place of foot contact, which a single rigid body does not have.

use ndarray::ArrayView2;

use crate::motion::kinematics::forward_differences;
use crate::motion::quantile::percentile;
use crate::motion::quaternion::{Quaternion, dot, from_axis_angle, mul};
use crate::motion::{Channel, ChannelLimits};
use crate::units::FPS;

use super::body::{poses, vectors};
use super::control::rotation_error_rad;
use crate::motion::vector::{Vector, minus, norm};

/// Fewest frames with a third difference.
const MIN_FRAMES: usize = 4;

/// What drives a body has limits on these.
const DRIVEN: [Channel; 3] = [Channel::Velocity, Channel::Acceleration, Channel::AngularVelocity];

/// How far the channels of a motion are from belonging to one body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Consistency {
    /// Mean `|v[t] - Δp/Δt|` over frames and axes, m/s: the number of the check `velocity_coherence`.
    pub velocity_error_m_s: f64,
    /// Mean `|a[t] - Δv/Δt|` over frames and axes, m/s²: the number of the check `accel_coherence`.
    pub acceleration_error_m_s2: f64,
    /// Mean angle between q\[t+1\] and q\[t\] turned by ω\[t\] for a frame, as a rate, rad/s.
    pub turn_error_rad_s: f64,
    /// Mean `| |q| - 1 |`.
    pub norm_error: f64,
    /// Mean `|Δa/Δt|`, m/s³: the number of the check `jerk`.
    pub jerk_mean_m_s3: f64,
    /// 95th percentile of the same.
    pub jerk_p95_m_s3: f64,
    /// See [`log_dimensionless_jerk`].
    pub log_dimensionless_jerk: Option<f64>,
    /// Share of the frames in which velocity, acceleration or angular velocity is over its limits.
    pub share_over_limits: f64,
}

/// Measures a motion, `[T, 25]`; none for fewer than four frames, or where a channel of the body (all but
/// phase and style) is not finite or a quaternion zero.
///
/// # Panics
/// When there are other than 25 channels.
pub fn consistency(frames: ArrayView2<f32>, limits: ChannelLimits) -> Option<Consistency> {
    let poses = poses(frames)?;
    let [velocity, acceleration, turn] = DRIVEN.map(|channel| vectors(frames, channel));
    let is_finite = |x: &[Vector]| x.iter().flatten().all(|x| x.is_finite());
    let all_finite = is_finite(&velocity) && is_finite(&acceleration) && is_finite(&turn);
    if poses.len() < MIN_FRAMES || !all_finite {
        return None;
    }
    let turn_errors = poses.orientation.windows(2).zip(&turn).map(|(q, &turn)| {
        let angle = norm(turn) / FPS;
        let axis = if angle > 0.0 { turn.map(|x| x / (FPS * angle)) } else { [0.0; 3] };
        rotation_error_rad(mul(from_axis_angle(axis, angle), q[0]), q[1]) * FPS
    });
    let norm_errors = frames.rows().into_iter().map(|row| {
        let first = Channel::Quaternion.range().start;
        let q: Quaternion = std::array::from_fn(|i| f64::from(row[first + i]));
        (dot(q, q).sqrt() - 1.0).abs()
    });
    let mut jerk: Vec<f64> = forward_differences(&acceleration).into_iter().map(norm).collect();
    let is_over = |row: ndarray::ArrayView1<'_, f32>| {
        DRIVEN.into_iter().any(|channel| {
            let (low, high) = limits.bounds(channel);
            channel.range().any(|i| row[i] < low || row[i] > high)
        })
    };
    let n_over = frames.rows().into_iter().filter(|row| is_over(*row)).count();
    Some(Consistency {
        velocity_error_m_s: mean_error(&poses.position_m, &velocity),
        acceleration_error_m_s2: mean_error(&velocity, &acceleration),
        turn_error_rad_s: mean(turn_errors),
        norm_error: mean(norm_errors),
        jerk_mean_m_s3: mean(jerk.iter().copied()),
        jerk_p95_m_s3: percentile(&mut jerk, 95.0)?,
        log_dimensionless_jerk: log_dimensionless_jerk(&poses.position_m),
        share_over_limits: n_over as f64 / frames.nrows() as f64,
    })
}

/// Returns the mean of `|d[t] - (x[t+1] - x[t]) FPS|` over frames and axes.
fn mean_error(x: &[Vector], derivative: &[Vector]) -> f64 {
    let errors = forward_differences(x).into_iter().zip(derivative).flat_map(|(derived, &d)| {
        let error = minus(d, derived);
        error.map(f64::abs)
    });
    mean(errors)
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (n, sum) = values.fold((0_usize, 0.0), |(n, sum), x| (n + 1, sum + x));
    sum / n as f64
}

/// Returns `-ln(D³ / v² · Σ |j|² Δt)`, D the duration, v the highest speed and j the jerk of a path of
/// positions: higher is smoother, whatever the size and the speed of the motion.
///
/// Velocity and jerk are first and third differences. None for fewer than four frames, for a body that
/// stands still or never changes its velocity, and where a position is not finite. Source: Balasubramanian,
/// Melendez-Calderon and Burdet, "A Robust and Sensitive Metric for Quantifying Movement Smoothness", 2012.
pub fn log_dimensionless_jerk(position_m: &[Vector]) -> Option<f64> {
    if position_m.len() < MIN_FRAMES {
        return None;
    }
    let velocity = forward_differences(position_m);
    let jerk = forward_differences(&forward_differences(&velocity));
    let duration_s = (position_m.len() - 1) as f64 / FPS;
    let peak_m_s = velocity.into_iter().map(norm).fold(0.0, f64::max);
    let squares: f64 = jerk.into_iter().map(|j| norm(j).powi(2)).sum();
    let found = -(duration_s.powi(3) / peak_m_s.powi(2) * squares / FPS).ln();
    found.is_finite().then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Poses;
    use crate::motion::kinematics::frames_of;
    use ndarray::Array2;

    /// Sways by 0.1 m at `hz`, turning at 2 rad/s about the vertical.
    fn sway(n: usize, hz: f64) -> Array2<f32> {
        let pose = |t: usize| {
            let s = t as f64 / FPS;
            let x = 0.1 * (std::f64::consts::TAU * hz * s).sin();
            ([x, 1.0, 0.0], from_axis_angle([0.0, 1.0, 0.0], 2.0 * s))
        };
        let (position_m, orientation) = (0..n + 2).map(pose).unzip();
        frames_of(&Poses { position_m, orientation }, n)
    }

    #[test]
    fn derived_channels_are_consistent() {
        let found = consistency(sway(121, 0.5).view(), ChannelLimits::Wide).expect("finite");
        // Single precision of 0.1 m differenced once and twice.
        assert!(found.velocity_error_m_s < 1e-6 && found.acceleration_error_m_s2 < 1e-5);
        assert!(found.turn_error_rad_s < 1e-4 && found.norm_error < 1e-7, "{found:?}");
        assert_eq!(found.share_over_limits, 0.0);
        // 0.1 (2π 0.5)³ |cos|, whose mean over a period is 2/π of its largest.
        let largest = 0.1 * std::f64::consts::PI.powi(3);
        let expected = largest * std::f64::consts::FRAC_2_PI;
        assert!((found.jerk_mean_m_s3 / expected - 1.0).abs() < 0.02, "{found:?}");
        assert!(found.jerk_p95_m_s3 < largest && found.jerk_p95_m_s3 > 0.98 * largest);
    }

    #[test]
    fn every_error_shows_in_its_number() {
        let mut frames = sway(121, 0.5);
        frames.column_mut(4).mapv_inplace(|v| v + 0.3);
        frames.column_mut(14).fill(2.5);
        frames.row_mut(7)[6] = 130.0;
        for i in 9..13 {
            frames.column_mut(i).mapv_inplace(|q| q * 1.02);
        }
        let found = consistency(frames.view(), ChannelLimits::Wide).expect("finite");
        assert!((found.velocity_error_m_s - 0.1).abs() < 1e-6, "one axis of three");
        assert!((found.turn_error_rad_s - 0.5).abs() < 1e-4, "{found:?}");
        assert!((found.norm_error - 0.02).abs() < 1e-6, "{found:?}");
        assert!((found.share_over_limits - 1.0 / 121.0).abs() < 1e-12);
        let strict = consistency(sway(121, 0.5).view(), ChannelLimits::Reference);
        assert_eq!(strict.expect("finite").share_over_limits, 0.0);
    }

    #[test]
    fn smoothness_depends_on_shape_alone() {
        let path = |n: usize, size: f64| -> Vec<Vector> {
            // Minimum jerk from rest to rest: 10 u³ - 15 u⁴ + 6 u⁵.
            let u = |t: usize| t as f64 / (n - 1) as f64;
            let x = |u: f64| size * (10.0 * u.powi(3) - 15.0 * u.powi(4) + 6.0 * u.powi(5));
            (0..n).map(|t| [x(u(t)), 0.0, 0.0]).collect()
        };
        // ∫ j² = 720 per unit of size and time, the highest speed is 15/8: -ln(720 / (15/8)²).
        let expected = -(720.0 / (15.0_f64 / 8.0).powi(2)).ln();
        for (n, size) in [(301, 1.0), (601, 0.2)] {
            let found = log_dimensionless_jerk(&path(n, size)).expect("moves");
            // Three samples of n, at the ends, have no third difference: 10 / n of the sum.
            assert!((found - expected).abs() < 10.5 / n as f64, "{found}, {expected}");
        }
    }

    #[test]
    fn what_is_short_still_or_not_finite_is_absent() {
        assert_eq!(consistency(sway(3, 0.5).view(), ChannelLimits::Wide), None);
        assert_eq!(log_dimensionless_jerk(&[[1.0, 2.0, 3.0]; 9]), None);
        assert_eq!(log_dimensionless_jerk(&[[1.0, 2.0, 3.0]; 3]), None);
        assert_eq!(log_dimensionless_jerk(&[[f64::NAN, 0.0, 0.0]; 9]), None);
        for i in [0, 4, 8, 11, 13] {
            let mut frames = sway(31, 0.5);
            frames[[17, i]] = f32::NAN;
            assert_eq!(consistency(frames.view(), ChannelLimits::Wide), None, "{i}");
        }
    }
}
