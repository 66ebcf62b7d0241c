//! Is it like real motion?

use super::{Evidence, Rule, Test, estimate, real};
use crate::evaluation::interval::Estimate;

/// Speeds along each axis over those of real motion.
const SPEED_RATIO: [f64; 2] = [0.67, 1.5];
/// Jerk over that of real motion; at 1.2 times its speed motion has 1.73 times its jerk.
const JERK_RATIO: [f64; 2] = [0.6, 1.6];
/// How much farther from the training split than held-out real motion a Fréchet distance may be: in eight features,
/// as much as half a deviation of each.
const FRECHET_MARGIN: f64 = 2.0;
/// The same of the mean features, in deviations.
const SHIFT_MARGIN: f64 = 0.5;
/// Least share of windows within the training split's bounds.
const MIN_SHARE: f64 = 0.9;

/// Distances, speeds and postures against those of held-out real motion.
pub(super) fn tests(evidence: &Evidence) -> Vec<Test> {
    let Evidence { own, truth, .. } = evidence;
    let mut tests = Vec::new();
    for (name, axis) in [("speed_x", "x"), ("speed_y", "y"), ("speed_z", "z")] {
        tests.push(Test::of_value(
            name,
            format!("speed along {axis} over that of real motion"),
            estimate(own, "speed_ratio", axis),
            "",
            Rule::Within(SPEED_RATIO[0], SPEED_RATIO[1]),
            real(truth, "axis_speed", axis) + " m/s",
        ));
    }
    tests.push(Test::of_value(
        "jerk",
        "jerk over that of real motion",
        estimate(own, "jerk_ratio", ""),
        "",
        Rule::Within(JERK_RATIO[0], JERK_RATIO[1]),
        real(truth, "position_jerk", "") + " m/s³",
    ));
    for (name, what, metric, variant, margin) in [
        ("fid_k", "Fréchet distance of kinetic features", "fid_k", "axes", FRECHET_MARGIN),
        ("fid_g", "Fréchet distance of geometric features", "fid_g", "", FRECHET_MARGIN),
        ("feature_shift", "shift of the mean features", "feature_shift", "", SHIFT_MARGIN),
    ] {
        let held_out = estimate(truth, metric, variant);
        let value = estimate(own, metric, variant);
        // A covariance needs ten windows for every feature: with fewer, of either, the shift of the means must do.
        let is_measured = value.value.is_some() && held_out.value.is_some();
        if !is_measured && metric != "feature_shift" {
            continue;
        }
        let value = if is_measured { value } else { Estimate::default() };
        tests.push(Test::of_value(
            name,
            what,
            value,
            "",
            Rule::AtMost(held_out.value.unwrap_or(0.0) + margin),
            real(truth, metric, variant),
        ));
    }
    for (name, what, metric) in [
        ("upright", "share of windows that are upright", "share_upright"),
        ("height", "share of windows at the height of a body", "share_height"),
        ("turning", "share of windows that turn no more", "share_turning"),
    ] {
        tests.push(Test::of_value(
            name,
            format!("{what}, as training motion"),
            estimate(own, metric, ""),
            "",
            Rule::AtLeast(MIN_SHARE),
            real(truth, metric, ""),
        ));
    }
    tests
}
