//! Whether a motion is as fast as motion of the training set: two strict checks that need its percentiles.

use ndarray::ArrayView2;
use serde::{Deserialize, Serialize};

use crate::motion::Channel;
use crate::motion::quantile::percentile;

use super::body::{norm, vectors};
use super::sanity::{Check, CheckSet};

/// Percentile of the frames of the training set that a motion must keep within.
pub const RANGE_PERCENT: f64 = 99.9;

/// How fast the motion of a training set is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingRange {
    /// 99.9th percentile of `|v|` over frames.
    pub speed_m_s: f64,
    /// 99.9th percentile of `|ω|` over frames.
    pub turn_rate_rad_s: f64,
}

impl TrainingRange {
    /// Takes the percentiles over all frames of motions, `[T, 25]` each; none without frames or where a
    /// value is not finite.
    pub fn fit<'a>(motions: impl IntoIterator<Item = ArrayView2<'a, f32>>) -> Option<Self> {
        let (mut speeds, mut turn_rates) = (Vec::new(), Vec::new());
        for frames in motions {
            speeds.extend(sizes(frames, Channel::Velocity));
            turn_rates.extend(sizes(frames, Channel::AngularVelocity));
        }
        if speeds.iter().chain(&turn_rates).any(|x| !x.is_finite()) {
            return None;
        }
        Some(Self {
            speed_m_s: percentile(&mut speeds, RANGE_PERCENT)?,
            turn_rate_rad_s: percentile(&mut turn_rates, RANGE_PERCENT)?,
        })
    }

    /// Checks the highest speed and turn rate of a motion, `[T, 25]`, as its channels say them.
    ///
    /// Motion without frames or with a value that is not finite fails.
    pub fn checks(&self, frames: ArrayView2<f32>) -> [Check; 2] {
        [
            check("speed", Channel::Velocity, frames, self.speed_m_s),
            check("turn_rate", Channel::AngularVelocity, frames, self.turn_rate_rad_s),
        ]
    }
}

fn check(name: &'static str, channel: Channel, frames: ArrayView2<f32>, threshold: f64) -> Check {
    // `f64::max` would pass over NaN.
    let higher = |a: f64, b: f64| if b > a || b.is_nan() { b } else { a };
    let value = sizes(frames, channel).into_iter().reduce(higher).unwrap_or(f64::NAN);
    let unit = channel.unit();
    Check {
        name,
        set: CheckSet::Strict,
        value,
        threshold,
        passed: value.is_finite() && value <= threshold,
        message: format!(
            "highest {}: {value:.4} {unit}, at most {threshold:.4} {unit} as in training",
            name.replace('_', " ")
        ),
    }
}

fn sizes(frames: ArrayView2<f32>, channel: Channel) -> Vec<f64> {
    vectors(frames, channel).into_iter().map(norm).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use ndarray::Array2;

    /// Speeds 0 to n - 1 m/s along y, turning a tenth as many rad/s about z.
    fn speeding(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, MOTION_DIM));
        for t in 0..n {
            frames[[t, 4]] = t as f32;
            frames[[t, 15]] = 0.1 * t as f32;
        }
        frames
    }

    #[test]
    fn the_range_is_a_percentile_over_the_frames_of_all_motions() {
        let range = TrainingRange::fit([speeding(1001).view()]).expect("frames");
        assert!((range.speed_m_s - 999.0).abs() < 1e-9, "{range:?}");
        assert!((range.turn_rate_rad_s - 99.9).abs() < 1e-4, "{range:?}");
        let (a, b) = (speeding(3), speeding(2));
        let range = TrainingRange::fit([a.view(), b.view()]).expect("frames");
        // Sorted 0, 0, 1, 1, 2: 99.6 % of the way from 1 to 2.
        assert!((range.speed_m_s - 1.996).abs() < 1e-9, "{range:?}");
        assert_eq!(TrainingRange::fit([]), None);
    }

    #[test]
    fn the_highest_value_decides() {
        let range = TrainingRange { speed_m_s: 5.0, turn_rate_rad_s: 0.45 };
        let [speed, turn] = range.checks(speeding(6).view());
        assert!(speed.passed && !turn.passed, "{speed:?} {turn:?}");
        assert_eq!(speed.message, "highest speed: 5.0000 m/s, at most 5.0000 m/s as in training");
        assert_eq!(
            turn.message,
            "highest turn rate: 0.5000 rad/s, at most 0.4500 rad/s as in training"
        );
        assert_eq!((speed.name, speed.set), ("speed", CheckSet::Strict));
    }

    #[test]
    fn what_is_not_finite_fails() {
        let range = TrainingRange { speed_m_s: 1e9, turn_rate_rad_s: 1e9 };
        for x in [f32::NAN, f32::INFINITY] {
            let mut frames = speeding(7);
            frames[[3, 5]] = x;
            let [speed, turn] = range.checks(frames.view());
            assert!(!speed.passed && turn.passed, "{speed:?} {turn:?}");
            assert_eq!(TrainingRange::fit([frames.view()]), None);
        }
        assert!(range.checks(speeding(0).view()).iter().all(|check| !check.passed));
    }
}
