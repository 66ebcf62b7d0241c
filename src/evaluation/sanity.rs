//! Sanity checks: the reference's five, and strict ones.
//!
//! The reference's (section 10) let 1 m/s of noise on the velocity pass: measured on a capture, its five
//! pass with an error of 0.80 m/s. They keep their names, thresholds and messages; beside them stand checks
//! that real capture passes and such noise does not.

mod quantities;

use ndarray::ArrayView2;

use crate::motion::postprocess::PostProcessConfig;
use crate::motion::{BODY, ChannelLimits, Layout};

use quantities::CheckQuantities;
pub use quantities::derivative_error;

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

/// Checks a motion of [`BODY`], `[T, 25]`; see [`checks_in`].
pub fn checks(frames: ArrayView2<f32>, limits: ChannelLimits) -> Vec<Check> {
    checks_in(BODY, frames, limits)
}

/// Checks a motion, `[T, columns]`; first the reference's five, then the strict ones, without those of columns that
/// the layout lacks.
///
/// Differences are forward ones, as everywhere. A value that is not finite fails every check that it
/// enters, and one of its own.
pub fn checks_in(layout: Layout, frames: ArrayView2<f32>, limits: ChannelLimits) -> Vec<Check> {
    let m = CheckQuantities::of(layout, frames, limits);
    let within = |x: f64, [low, high]: [f64; 2]| x >= low && x <= high;
    let check = |name, set, value: f64, threshold, passed, message: String| Check {
        name,
        set,
        value,
        threshold,
        passed: passed && value.is_finite(),
        message,
    };
    let reference = {
        use reference::*;
        let set = CheckSet::Reference;
        [
            Some(check(
                "quaternion",
                set,
                m.norm,
                1.0,
                within(m.norm, QUATERNION_NORM),
                format!("Mean quaternion norm: {:.4}", m.norm),
            )),
            m.phase.map(|[low, high]| {
                let value = if low < PHASE[0] { low } else { high };
                let is_within = low >= PHASE[0] && high <= PHASE[1];
                let message = format!("Phase range: [{low:.4}, {high:.4}]");
                check("phase", set, value, 1.0, is_within, message)
            }),
            m.jerk.map(|jerk| {
                let message = format!("Mean jerk: {jerk:.2} (threshold: {MAX_JERK:.1})");
                check("jerk", set, jerk, MAX_JERK, jerk < MAX_JERK, message)
            }),
            m.velocity_error.map(|error| {
                let (most, message) =
                    (MAX_VELOCITY_ERROR, format!("Velocity coherence error: {error:.4}"));
                check("velocity_coherence", set, error, most, error < most, message)
            }),
            m.acceleration_error.map(|error| {
                let (most, message) =
                    (MAX_ACCELERATION_ERROR, format!("Acceleration coherence error: {error:.4}"));
                check("accel_coherence", set, error, most, error < most, message)
            }),
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
            Some(count("finite", "values that are not finite", m.n_not_finite)),
            Some(count("ranges", "values outside their channel's limits", m.n_outside)),
            m.n_falls.map(|n| count("phase_monotonic", "falls of the phase within a bar", n)),
            m.velocity_error.map(|error| {
                below("velocity", "velocity against position", "m/s", error, MAX_VELOCITY_ERROR)
            }),
            m.acceleration_error.map(|error| {
                let (what, most) = ("acceleration against velocity", MAX_ACCELERATION_ERROR);
                below("acceleration", what, "m/s²", error, most)
            }),
            m.turn_error.map(|error| {
                let (what, most) = ("angular velocity against orientation", MAX_TURN_ERROR);
                below("angular_velocity", what, "rad/s", error, most)
            }),
            Some(check(
                "quaternion_continuity",
                CheckSet::Strict,
                m.least_dot,
                MIN_QUATERNION_DOT,
                m.least_dot >= MIN_QUATERNION_DOT,
                format!(
                    "least q · q' of two frames: {:.4}, at least {MIN_QUATERNION_DOT}",
                    m.least_dot
                ),
            )),
            m.jerk.map(|jerk| {
                let [least, most] = JERK;
                let message =
                    format!("mean jerk: {jerk:.1} m/s³, that of captures is {least} to {most}");
                check("jerk_of_capture", CheckSet::Strict, jerk, most, within(jerk, JERK), message)
            }),
        ]
    };
    reference.into_iter().chain(strict).flatten().collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::kinematics::{Poses, frames_of};
    use crate::motion::layout::tests::ROOT;
    use crate::motion::quaternion::from_axis_angle;
    use crate::units::FPS;
    use ndarray::{Array2, Axis};

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
    fn the_root_alone_has_the_checks_of_its_columns() {
        let columns: Vec<usize> = (0..6).chain(9..16).collect();
        let mut body = walk(61);
        body.column_mut(4).mapv_inplace(|v| v + 0.3);
        body[[7, 14]] = 21.0;
        let root = body.select(Axis(1), &columns);
        let found = checks_in(ROOT, root.view(), ChannelLimits::Wide);
        let names: Vec<_> = found.iter().map(|check| check.name).collect();
        let wanted = [
            "quaternion",
            "velocity_coherence",
            "finite",
            "ranges",
            "velocity",
            "angular_velocity",
            "quaternion_continuity",
        ];
        assert_eq!(names, wanted);
        let of_body = checks(body.view(), ChannelLimits::Wide);
        for check in found {
            assert!(of_body.contains(&check), "{check:?}");
        }
    }

    #[test]
    fn a_single_frame_is_measured() {
        assert_eq!(failed(&walk(1)), ["jerk_of_capture"]);
    }
}
