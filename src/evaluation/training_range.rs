//! Whether a motion is as fast as motion of the training set: two strict checks that need its percentiles.

use ndarray::ArrayView2;

use crate::motion::Channel;
use crate::motion::rates::{MotionRange, sizes};

use super::sanity::{Check, CheckSet};

/// Checks the highest speed and turn rate of a motion, `[T, 25]`, as its channels say them, against those of
/// the training set.
///
/// Motion without frames or with a value that is not finite fails.
pub fn range_checks(range: &MotionRange, frames: ArrayView2<f32>) -> [Check; 2] {
    [
        check("speed", Channel::Velocity, frames, range.speed_m_s),
        check("turn_rate", Channel::AngularVelocity, frames, range.turn_rate_rad_s),
    ]
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
    fn the_highest_value_decides() {
        let range = MotionRange { speed_m_s: 5.0, turn_rate_rad_s: 0.45 };
        let [speed, turn] = range_checks(&range, speeding(6).view());
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
        let range = MotionRange { speed_m_s: 1e9, turn_rate_rad_s: 1e9 };
        for x in [f32::NAN, f32::INFINITY] {
            let mut frames = speeding(7);
            frames[[3, 5]] = x;
            let [speed, turn] = range_checks(&range, frames.view());
            assert!(!speed.passed && turn.passed, "{speed:?} {turn:?}");
            assert_eq!(MotionRange::fit([frames.view()]), None);
        }
        assert!(range_checks(&range, speeding(0).view()).iter().all(|check| !check.passed));
    }
}
