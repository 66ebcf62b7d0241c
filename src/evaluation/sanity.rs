//! Sanity checks: the reference's five, and strict ones.
//!
//! The reference's (section 10) let 1 m/s of noise on the velocity pass: measured on a capture, its five
//! pass with an error of 0.80 m/s. They keep their names, thresholds and messages; beside them stand checks
//! that real capture passes and such noise does not.

use ndarray::ArrayView2;

use crate::motion::phase::WRAP_BARS;
use crate::motion::postprocess::PostProcessConfig;
use crate::motion::quaternion::{Quaternion, angular_velocity, dot, normalize};
use crate::motion::{Channel, ChannelLimits};
use crate::units::FPS;

/// Which set a check is of; the two are never mixed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CheckSet {
    Reference,
    Strict,
}

/// The answer of a check.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    pub name: &'static str,
    pub set: CheckSet,
    pub value: f64,
    pub threshold: f64,
    pub passed: bool,
    pub message: String,
}

/// Thresholds of the reference (10.1).
mod reference {
    pub const QUATERNION_NORM: [f64; 2] = [0.95, 1.05];
    pub const PHASE: [f64; 2] = [0.0, 1.0];
    pub const MAX_JERK: f64 = 50_000.0;
    pub const MAX_VELOCITY_ERROR: f64 = 5.0;
    pub const MAX_ACCELERATION_ERROR: f64 = 100.0;
}

/// Thresholds that captured motion keeps: 64 trajectories, 46 minutes of them dance.
mod strict {
    /// m/s
    pub const MAX_VELOCITY_ERROR: f64 = 0.05;
    /// m/s²
    pub const MAX_ACCELERATION_ERROR: f64 = 1.0;
    /// rad/s
    pub const MAX_TURN_ERROR: f64 = 0.05;
    /// Mean jerk of captures, m/s³.
    pub const JERK: [f64; 2] = [5.0, 404.0];
    /// |q · q'| of neighbouring frames.
    pub const MIN_QUATERNION_DOT: f64 = 0.95;
}

/// Checks a motion, `[T, 25]`; first the reference's five, then the strict ones.
///
/// Differences are forward ones, as everywhere. A value that is not finite fails every check that it
/// enters, and one of its own.
pub fn checks(frames: ArrayView2<f32>, limits: ChannelLimits) -> Vec<Check> {
    let m = CheckQuantities::of(frames, limits);
    let within = |x: f64, [low, high]: [f64; 2]| x >= low && x <= high;
    let check = |name, set, value: f64, threshold, passed, message: String| Check {
        name,
        set,
        value,
        threshold,
        passed: passed && value.is_finite(),
        message,
    };
    let [low, high] = m.phase;
    let reference = {
        use reference::*;
        let set = CheckSet::Reference;
        [
            check(
                "quaternion",
                set,
                m.norm,
                1.0,
                within(m.norm, QUATERNION_NORM),
                format!("Mean quaternion norm: {:.4}", m.norm),
            ),
            check(
                "phase",
                set,
                if low < PHASE[0] { low } else { high },
                1.0,
                low >= PHASE[0] && high <= PHASE[1],
                format!("Phase range: [{low:.4}, {high:.4}]"),
            ),
            check(
                "jerk",
                set,
                m.jerk,
                MAX_JERK,
                m.jerk < MAX_JERK,
                format!("Mean jerk: {:.2} (threshold: {MAX_JERK:.1})", m.jerk),
            ),
            check(
                "velocity_coherence",
                set,
                m.velocity_error,
                MAX_VELOCITY_ERROR,
                m.velocity_error < MAX_VELOCITY_ERROR,
                format!("Velocity coherence error: {:.4}", m.velocity_error),
            ),
            check(
                "accel_coherence",
                set,
                m.acceleration_error,
                MAX_ACCELERATION_ERROR,
                m.acceleration_error < MAX_ACCELERATION_ERROR,
                format!("Acceleration coherence error: {:.4}", m.acceleration_error),
            ),
        ]
    };
    let strict = {
        use strict::*;
        let below = |name, what: &str, unit: &str, value: f64, limit: f64| {
            let message = format!("{what}: {value:.4} {unit}, below {limit} {unit}");
            check(name, CheckSet::Strict, value, limit, value < limit, message)
        };
        let count = |name, what: &str, value: usize| {
            let message = format!("{what}: {value}");
            check(name, CheckSet::Strict, value as f64, 0.0, value == 0, message)
        };
        [
            count("finite", "values that are not finite", m.n_not_finite),
            count("ranges", "values outside their channel's limits", m.n_outside),
            count("phase_monotonic", "falls of the phase within a bar", m.n_falls),
            below(
                "velocity",
                "velocity against position",
                "m/s",
                m.velocity_error,
                MAX_VELOCITY_ERROR,
            ),
            below(
                "acceleration",
                "acceleration against velocity",
                "m/s²",
                m.acceleration_error,
                MAX_ACCELERATION_ERROR,
            ),
            below(
                "angular_velocity",
                "angular velocity against orientation",
                "rad/s",
                m.turn_error,
                MAX_TURN_ERROR,
            ),
            check(
                "quaternion_continuity",
                CheckSet::Strict,
                m.least_dot,
                MIN_QUATERNION_DOT,
                m.least_dot >= MIN_QUATERNION_DOT,
                format!(
                    "least q · q' of two frames: {:.4}, at least {MIN_QUATERNION_DOT}",
                    m.least_dot
                ),
            ),
            check(
                "jerk_of_capture",
                CheckSet::Strict,
                m.jerk,
                JERK[1],
                within(m.jerk, JERK),
                format!(
                    "mean jerk: {:.1} m/s³, that of captures is {} to {}",
                    m.jerk, JERK[0], JERK[1]
                ),
            ),
        ]
    };
    reference.into_iter().chain(strict).collect()
}

/// Returns whether a check holds of every motion whose velocities are derived from its poses.
pub fn holds_by_derivation(check: &str) -> bool {
    matches!(
        check,
        "velocity" | "acceleration" | "angular_velocity" | "velocity_coherence" | "accel_coherence"
    )
}

/// Returns whether post-processing makes a check pass whatever was decoded, so that passing is no merit.
///
/// `has_phase` tells whether the phase of the music was known, to which `relock_phase` sets that of the motion.
pub fn holds_by_construction(check: &str, config: &PostProcessConfig, has_phase: bool) -> bool {
    let is_derived = config.coherence.derives();
    let is_relocked = config.relock_phase && has_phase;
    match check {
        check if holds_by_derivation(check) => is_derived,
        "quaternion" => config.normalize_quaternions,
        "quaternion_continuity" => config.normalize_quaternions && config.range.is_some(),
        "phase" => is_relocked || config.clamp_phase,
        "phase_monotonic" => is_relocked || config.enforce_phase_monotonic,
        "speed" | "turn_rate" => config.range.is_some(),
        _ => false,
    }
}

/// Returns the mean `|d[t] - 30 (x[t+1] - x[t])|` over frames and axes, of a channel x and the one that says
/// it is its derivative; 0 where there are no two frames.
pub fn derivative_error(frames: ArrayView2<f32>, of: Channel, derivative: Channel) -> f64 {
    let at = |t: usize, i: usize| f64::from(frames[[t, i]]);
    let (x, d) = (of.range().start, derivative.range().start);
    let pairs = frames.nrows().saturating_sub(1);
    let off = |t: usize| -> f64 {
        (0..3).map(|i| (at(t, d + i) - FPS * (at(t + 1, x + i) - at(t, x + i))).abs()).sum()
    };
    (0..pairs).map(off).sum::<f64>() / (3 * pairs.max(1)) as f64
}

/// The quantities of a motion that the checks compare with thresholds.
struct CheckQuantities {
    norm: f64,
    phase: [f64; 2],
    jerk: f64,
    velocity_error: f64,
    acceleration_error: f64,
    turn_error: f64,
    least_dot: f64,
    n_not_finite: usize,
    n_outside: usize,
    n_falls: usize,
}

impl CheckQuantities {
    fn of(frames: ArrayView2<f32>, limits: ChannelLimits) -> Self {
        let n = frames.nrows();
        let vector = |channel: Channel, t: usize| -> [f64; 3] {
            let first = channel.range().start;
            std::array::from_fn(|i| f64::from(frames[[t, first + i]]))
        };
        let quaternion = |t: usize| -> Quaternion {
            let first = Channel::Quaternion.range().start;
            std::array::from_fn(|i| f64::from(frames[[t, first + i]]))
        };
        let phase = |t: usize| f64::from(frames[[t, Channel::Phase.range().start]]);
        let pairs = n.saturating_sub(1);
        // Where there is nothing to measure there is no error.
        let mean = |sum: f64, n: usize| if n == 0 { 0.0 } else { sum / n as f64 };
        let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let jerk = |t: usize| {
            let (a, b) = (vector(Channel::Acceleration, t), vector(Channel::Acceleration, t + 1));
            FPS * length(std::array::from_fn(|i| b[i] - a[i]))
        };
        let turn = |t: usize| {
            let derived =
                angular_velocity(normalize(quaternion(t)), normalize(quaternion(t + 1)), FPS);
            let own = vector(Channel::AngularVelocity, t);
            (0..3).map(|i| (own[i] - derived[i]).abs()).sum::<f64>()
        };
        // `f64::min` would pass over NaN.
        let least = |a: f64, b: f64| if b < a || b.is_nan() { b } else { a };
        let most = |a: f64, b: f64| if b > a || b.is_nan() { b } else { a };
        let outside = Channel::ALL.into_iter().map(|channel| {
            let (low, high) = limits.bounds(channel);
            let columns = frames.slice(ndarray::s![.., channel.range()]);
            columns.iter().filter(|x| !(low..=high).contains(*x)).count()
        });
        Self {
            norm: mean((0..n).map(|t| dot(quaternion(t), quaternion(t)).sqrt()).sum(), n),
            phase: [
                (0..n).map(phase).fold(f64::INFINITY, least),
                (0..n).map(phase).fold(f64::NEG_INFINITY, most),
            ],
            jerk: mean((0..pairs).map(jerk).sum(), pairs),
            velocity_error: derivative_error(frames, Channel::Position, Channel::Velocity),
            acceleration_error: derivative_error(frames, Channel::Velocity, Channel::Acceleration),
            turn_error: mean((0..pairs).map(turn).sum(), 3 * pairs),
            least_dot: (0..pairs)
                .map(|t| dot(normalize(quaternion(t)), normalize(quaternion(t + 1))))
                .fold(1.0, least),
            n_not_finite: frames.iter().filter(|x| !x.is_finite()).count(),
            n_outside: outside.sum(),
            n_falls: (0..pairs)
                .filter(|&t| {
                    let change = phase(t + 1) - phase(t);
                    (-WRAP_BARS..-1e-6).contains(&change)
                })
                .count(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::kinematics::{Poses, frames_of};
    use crate::motion::quaternion::from_axis_angle;
    use ndarray::Array2;

    /// A walk along a circle of 1 m that bobs twice a second.
    fn walk(n: usize) -> Array2<f32> {
        let pose = |t: usize| {
            let s = t as f64 / FPS;
            let turn = from_axis_angle([0.0, 1.0, 0.0], s);
            ([s.sin(), 0.9 + 0.03 * (12.0 * s).sin(), s.cos()], turn)
        };
        let (position_m, orientation) = (0..n + 2).map(pose).unzip();
        let mut frames = frames_of(&Poses { position_m, orientation }, n);
        for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
            row[16] = (t as f32 / 60.0).fract();
        }
        frames
    }

    fn failed(frames: &Array2<f32>) -> Vec<&'static str> {
        let checks = checks(frames.view(), ChannelLimits::Wide);
        assert_eq!(checks.len(), 13);
        checks.into_iter().filter(|check| !check.passed).map(|check| check.name).collect()
    }

    #[test]
    fn sound_motion_passes_and_its_messages_are_the_references() {
        let frames = walk(121);
        assert_eq!(failed(&frames), [""; 0]);
        let all = checks(frames.view(), ChannelLimits::Wide);
        assert_eq!(all[0].message, "Mean quaternion norm: 1.0000");
        assert_eq!(all[1].message, "Phase range: [0.0000, 0.9833]");
        assert!(all[2].message.ends_with("(threshold: 50000.0)"), "{}", all[2].message);
        assert_eq!(all[3].message, "Velocity coherence error: 0.0000");
        // Jerk of 0.03 sin 12 s is 0.03 · 12³ |cos| = 51.84 · 2/π on average, and 1 of the circle beside it.
        assert!((all[2].value - 33.0).abs() < 2.0, "{}", all[2].value);
    }

    #[test]
    fn noise_that_the_reference_lets_pass_fails_the_strict_checks() {
        let mut frames = walk(121);
        for t in 0..121 {
            frames[[t, 3]] += if t % 2 == 0 { 0.8 } else { -0.8 };
        }
        assert_eq!(failed(&frames), ["velocity", "acceleration"]);
        let value = checks(frames.view(), ChannelLimits::Wide)[3].value;
        // One of three axes is off by 0.8 m/s.
        assert!((value - 0.8 / 3.0).abs() < 1e-3, "{value}");
    }

    #[test]
    fn every_defect_is_found_by_its_check() {
        let with = |change: &dyn Fn(&mut Array2<f32>)| {
            let mut frames = walk(121);
            change(&mut frames);
            failed(&frames)
        };
        assert_eq!(with(&|f| f[[40, 20]] = f32::NAN), ["finite", "ranges"]);
        assert_eq!(
            with(&|f| f[[40, 0]] = f32::INFINITY),
            ["velocity_coherence", "finite", "ranges", "velocity"]
        );
        assert_eq!(with(&|f| f[[40, 16]] = 0.3), ["phase_monotonic"]);
        assert_eq!(with(&|f| f[[59, 16]] = 1.2), ["phase", "ranges"]);
        assert_eq!(
            with(&|f| (9..13).for_each(|i| f[[40, i]] *= -1.0)),
            ["quaternion_continuity"],
            "q and -q turn alike"
        );
        assert_eq!(with(&|f| f.column_mut(14).fill(0.0)), ["angular_velocity"]);
        assert_eq!(with(&|f| f[[40, 14]] = 25.0), ["ranges", "angular_velocity"]);
        assert!(with(&|f| f.slice_mut(ndarray::s![.., 9..13]).fill(0.0)).contains(&"quaternion"));
    }

    #[test]
    fn what_post_processing_makes_true_is_known() {
        let config = PostProcessConfig::default();
        let holds = |check: &str| holds_by_construction(check, &config, true);
        let found = ["velocity", "quaternion", "phase_monotonic", "speed", "jerk_of_capture"];
        assert_eq!(found.map(holds), [true, true, true, false, false]);
        assert!(!holds_by_construction("phase_monotonic", &config, false));
        let nothing = PostProcessConfig::nothing();
        let all = checks(walk(31).view(), ChannelLimits::Wide);
        assert!(all.iter().all(|check| !holds_by_construction(check.name, &nothing, true)));
    }

    #[test]
    fn a_single_frame_is_measured() {
        assert_eq!(failed(&walk(1)), ["jerk_of_capture"]);
    }
}
