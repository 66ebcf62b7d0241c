//! Within which bounds the windows of the training split lie, and whether another window does.

use ndarray::ArrayView2;
use serde::{Deserialize, Serialize};

use crate::motion::Poses;
use crate::motion::kinematics::forward_differences;
use crate::motion::quantile::percentile;
use crate::motion::quaternion::rotate;

use super::body::{poses, turn_rates};
use super::sanity::{Check, CheckSet};
use crate::motion::vector::norm;

/// Percentage of the training windows that lie below an upper bound, and above a lower one.
pub const RANGE_PERCENT: f64 = 99.5;

/// Quantities of a window, all from positions and orientations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Posture {
    /// Highest speed, m/s.
    pub speed_m_s: f64,
    /// Highest turn rate, rad/s.
    pub turn_rate_rad_s: f64,
    /// Mean angle between the body's up axis and the vertical, rad.
    pub tilt_rad: f64,
    /// Lowest and highest height, m.
    pub height_m: [f64; 2],
    /// Mean turn rate, rad/s.
    pub turning_rad_s: f64,
    /// Mean `|Δ³p / Δt³|`, m/s³.
    pub jerk_m_s3: f64,
    /// Root mean square of the velocity along x, y and z, m/s.
    pub axis_speed_m_s: [f64; 3],
}

impl Posture {
    /// Looks at a window; none for fewer than four frames.
    pub fn new(poses: &Poses) -> Option<Self> {
        let velocity = forward_differences(&poses.position_m);
        let jerk = forward_differences(&forward_differences(&velocity));
        if jerk.is_empty() {
            return None;
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let highest = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
        let speeds: Vec<f64> = velocity.iter().map(|v| norm(*v)).collect();
        let turns: Vec<f64> = turn_rates(&poses.orientation).into_iter().map(norm).collect();
        let tilts: Vec<f64> = poses
            .orientation
            .iter()
            .map(|&q| rotate(q, [0.0, 1.0, 0.0])[1].clamp(-1.0, 1.0).acos())
            .collect();
        let heights = || poses.position_m.iter().map(|p| p[1]);
        let axis = |i: usize| {
            (velocity.iter().map(|v| v[i] * v[i]).sum::<f64>() / velocity.len() as f64).sqrt()
        };
        Some(Self {
            speed_m_s: highest(&speeds),
            turn_rate_rad_s: highest(&turns),
            tilt_rad: mean(&tilts),
            height_m: [
                heights().fold(f64::INFINITY, f64::min),
                heights().fold(f64::NEG_INFINITY, f64::max),
            ],
            turning_rad_s: mean(&turns),
            jerk_m_s3: mean(&jerk.into_iter().map(norm).collect::<Vec<_>>()),
            axis_speed_m_s: [axis(0), axis(1), axis(2)],
        })
    }
}

/// Bounds of the training split's windows: the 0.5th and 99.5th percentile of each number of [`Posture`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WindowRange {
    pub n_windows: usize,
    /// Highest speed of a window, m/s.
    pub speed_m_s: f64,
    /// Highest turn rate of a window, rad/s.
    pub turn_rate_rad_s: f64,
    /// Mean tilt, rad.
    pub tilt_rad: f64,
    /// Lowest height and highest height, m.
    pub height_m: [f64; 2],
    /// Mean turn rate, rad/s.
    pub turning_rad_s: f64,
    /// Mean jerk, m/s³, from and to.
    pub jerk_m_s3: [f64; 2],
}

/// Names of the checks, in order.
pub const RANGE_CHECKS: [&str; 6] =
    ["speed", "turn_rate", "upright", "height", "turning", "jerk_range"];

impl WindowRange {
    /// Takes the percentiles over windows; none without windows or where a number is not finite.
    pub fn fit(windows: &[Posture]) -> Option<Self> {
        let bound = |percent: f64, value: fn(&Posture) -> f64| -> Option<f64> {
            let mut values: Vec<f64> = windows.iter().map(value).collect();
            if values.iter().any(|x| !x.is_finite()) {
                return None;
            }
            percentile(&mut values, percent)
        };
        let (low, high) = (100.0 - RANGE_PERCENT, RANGE_PERCENT);
        Some(Self {
            n_windows: windows.len(),
            speed_m_s: bound(high, |w| w.speed_m_s)?,
            turn_rate_rad_s: bound(high, |w| w.turn_rate_rad_s)?,
            tilt_rad: bound(high, |w| w.tilt_rad)?,
            height_m: [bound(low, |w| w.height_m[0])?, bound(high, |w| w.height_m[1])?],
            turning_rad_s: bound(high, |w| w.turning_rad_s)?,
            jerk_m_s3: [bound(low, |w| w.jerk_m_s3)?, bound(high, |w| w.jerk_m_s3)?],
        })
    }

    /// Checks a window, in the order of [`RANGE_CHECKS`]; one that is not finite (none) fails all.
    pub fn checks(&self, posture: Option<&Posture>) -> [Check; 6] {
        let n = self.n_windows;
        let below = |name, what: &str, unit: &str, value: Option<f64>, limit: f64, scale: f64| {
            let value = value.unwrap_or(f64::NAN) * scale;
            let threshold = limit * scale;
            Check {
                name,
                set: CheckSet::Strict,
                value,
                threshold,
                passed: value <= threshold,
                message: format!(
                    "{what}: {value:.3} {unit}, at most {threshold:.3} {unit} in {RANGE_PERCENT} % of {n} \
                     training windows"
                ),
            }
        };
        let within = |name,
                      what: &str,
                      unit: &str,
                      value: Option<[f64; 2]>,
                      [low, high]: [f64; 2]| {
            let [lowest, highest] = value.unwrap_or([f64::NAN; 2]);
            // The end that is farther out, or nearer to its bound.
            let (value, threshold) = match low - lowest > highest - high {
                true => (lowest, low),
                false => (highest, high),
            };
            Check {
                name,
                set: CheckSet::Strict,
                value,
                threshold,
                passed: lowest >= low && highest <= high,
                message: format!(
                    "{what}: {value:.3} {unit}, {low:.3} to {high:.3} {unit} in {RANGE_PERCENT} % of {n} \
                     training windows"
                ),
            }
        };
        let degrees = 1.0_f64.to_degrees();
        [
            below(
                "speed",
                "highest speed",
                "m/s",
                posture.map(|w| w.speed_m_s),
                self.speed_m_s,
                1.0,
            ),
            below(
                "turn_rate",
                "highest turn rate",
                "rad/s",
                posture.map(|w| w.turn_rate_rad_s),
                self.turn_rate_rad_s,
                1.0,
            ),
            below("upright", "mean tilt", "°", posture.map(|w| w.tilt_rad), self.tilt_rad, degrees),
            within("height", "height", "m", posture.map(|w| w.height_m), self.height_m),
            below(
                "turning",
                "mean turn rate",
                "rad/s",
                posture.map(|w| w.turning_rad_s),
                self.turning_rad_s,
                1.0,
            ),
            within(
                "jerk_range",
                "mean jerk",
                "m/s³",
                posture.map(|w| [w.jerk_m_s3; 2]),
                self.jerk_m_s3,
            ),
        ]
    }

    /// Whether every bound is a number and in order.
    pub fn is_sound(&self) -> bool {
        let above_zero = [self.speed_m_s, self.turn_rate_rad_s, self.tilt_rad, self.turning_rad_s];
        let pairs = [self.height_m, self.jerk_m_s3];
        above_zero.iter().all(|x| x.is_finite() && *x >= 0.0)
            && pairs.iter().all(|[low, high]| low.is_finite() && high.is_finite() && low <= high)
    }
}

/// Looks at a window, `[T, 25]`; none where it is not finite or has fewer than four frames.
pub fn posture(frames: ArrayView2<f32>) -> Option<Posture> {
    Posture::new(&poses(frames)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::kinematics::frames_of;
    use crate::motion::quaternion::from_axis_angle;
    use crate::units::FPS;
    use ndarray::Array2;

    /// A window that bobs 0.1 m at `hz` about 1 m, leans by `lean_rad` and turns by 1 rad/s.
    fn bobbing(hz: f64, lean_rad: f64) -> Array2<f32> {
        let pose = |t: usize| {
            let s = t as f64 / FPS;
            let turn = from_axis_angle([0.0, 1.0, 0.0], s);
            let lean = from_axis_angle([1.0, 0.0, 0.0], lean_rad);
            let y = 1.0 + 0.1 * (std::f64::consts::TAU * hz * s).sin();
            ([0.0, y, 0.0], crate::motion::quaternion::mul(turn, lean))
        };
        let (position_m, orientation) = (0..93).map(pose).unzip();
        frames_of(&Poses { position_m, orientation }, 91)
    }

    fn range() -> WindowRange {
        let windows: Vec<Posture> = (0..41)
            .map(|i| posture(bobbing(1.0 + 0.01 * f64::from(i), 0.2).view()).expect("finite"))
            .collect();
        WindowRange::fit(&windows).expect("finite")
    }

    fn failed(frames: &Array2<f32>) -> Vec<&'static str> {
        let checks = range().checks(posture(frames.view()).as_ref());
        checks.into_iter().filter(|check| !check.passed).map(|check| check.name).collect()
    }

    #[test]
    fn numbers_of_a_window_are_those_of_its_motion() {
        let found = posture(bobbing(1.0, 0.2).view()).expect("finite");
        assert!((found.tilt_rad - 0.2).abs() < 1e-4 && (found.turning_rad_s - 1.0).abs() < 1e-4);
        // 2π 0.1 m/s at most, and that over √2 on average; differences over a frame lose half a percent.
        assert!((found.speed_m_s - 0.628).abs() < 0.005, "{found:?}");
        assert!((found.axis_speed_m_s[1] - 0.444).abs() < 0.005, "{found:?}");
        assert!((found.height_m[0] - 0.9).abs() < 1e-3 && (found.height_m[1] - 1.1).abs() < 1e-3);
        // (2π)³ 0.1 · 2/π; third differences lose 1.6 %.
        assert!((found.jerk_m_s3 / 15.79 - 1.0).abs() < 0.03, "{found:?}");
    }

    #[test]
    fn each_defect_fails_its_check() {
        assert_eq!(failed(&bobbing(1.2, 0.2)), [""; 0]);
        assert_eq!(failed(&bobbing(1.2, 1.5)), ["upright"]);
        let mut high = bobbing(1.2, 0.2);
        high.column_mut(1).mapv_inplace(|y| y + 0.3);
        assert_eq!(failed(&high), ["height"]);
        assert_eq!(failed(&bobbing(2.0, 0.2)), ["speed", "jerk_range"]);
        let mut jittery = bobbing(1.2, 0.2);
        for t in 0..91 {
            jittery[[t, 0]] = if t % 2 == 0 { 0.001 } else { -0.001 };
        }
        assert_eq!(failed(&jittery), ["jerk_range"]);
        let mut nan = bobbing(1.2, 0.2);
        nan[[7, 0]] = f32::NAN;
        assert_eq!(failed(&nan), RANGE_CHECKS);
        let message = &range().checks(posture(high.view()).as_ref())[3].message;
        assert_eq!(message, "height: 1.400 m, 0.900 to 1.100 m in 99.5 % of 41 training windows");
    }
}
