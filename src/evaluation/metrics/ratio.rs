//! Numbers over those of held-out real motion: 1 is right.

use std::collections::BTreeMap;

use super::Number;
use crate::evaluation::interval::{Estimate, mean_estimate};

/// Returns speeds and jerk over those of real motion.
pub fn motion_ratios(own: &[Number], truth: &[Number]) -> Vec<Number> {
    let mut numbers: Vec<Number> = ["x", "y", "z"]
        .into_iter()
        .filter_map(|axis| ratio("speed_ratio", ["axis_speed", axis], axis, own, truth))
        .collect();
    numbers.extend(ratio("jerk_ratio", ["position_jerk", ""], "", own, truth));
    numbers
}

/// Returns the amplitude that is locked to the bar over that of real motion: the coefficients on the known coupling,
/// mean over mean.
pub fn coupling_ratio(own: &[Number], truth: &[Number]) -> Option<Number> {
    let find =
        |numbers: &[Number]| numbers.iter().find(|number| number.metric == "coupling").cloned();
    let (own, truth) = (find(own)?, find(truth)?);
    let (a, b) = (own.estimate.value?, truth.estimate.value.filter(|x| *x > 0.0)?);
    // A coefficient may be below 0, where a ratio of logarithms would mean nothing.
    let scaled = |x: Option<f64>| x.map(|x| x / b);
    let estimate = Estimate {
        value: Some(a / b),
        ci_low: scaled(own.estimate.ci_low),
        ci_high: scaled(own.estimate.ci_high),
        n: own.estimate.n,
    };
    let protocol = format!("mean coefficient over that of held-out real motion, {b:.3}");
    Some(Number::new("coupling_ratio", own.variant, "", estimate, protocol))
}

/// Returns `exp ⟨ln(x_s / y_s)⟩` over the songs s that both have, with Student's interval of the logarithm; the
/// ratio of both values, without an interval, where they have no song in common.
fn ratio(
    metric: &'static str,
    [of_metric, of_variant]: [&str; 2],
    variant: &str,
    own: &[Number],
    truth: &[Number],
) -> Option<Number> {
    let find = |numbers: &[Number]| -> Option<(f64, BTreeMap<usize, f64>)> {
        let is_it = |n: &&Number| n.metric == of_metric && n.variant == of_variant;
        let found = numbers.iter().find(is_it)?;
        Some((found.estimate.value?, found.by_song.clone()))
    };
    let ((a, own), (b, truth)) = (find(own)?, find(truth)?);
    let logs: Vec<f64> = own
        .iter()
        .filter_map(|(song, x)| Some((x / truth.get(song)?).ln()))
        .filter(|x| x.is_finite())
        .collect();
    let (estimate, protocol) = match mean_estimate(&logs) {
        // Some song stands still, or there is none in common.
        Estimate { value: Some(mean), ci_low, ci_high, n } if n == own.len() => {
            let exp = |x: Option<f64>| x.map(f64::exp);
            let found =
                Estimate { value: Some(mean.exp()), ci_low: exp(ci_low), ci_high: exp(ci_high), n };
            (found, "over that of held-out real motion for the same songs, mean of logarithms")
        }
        _ => (Estimate::plain(Some(a / b), own.len()), "mean over mean of held-out real motion"),
    };
    Some(Number::new(metric, variant, "", estimate, protocol))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(metric: &'static str, variant: &str, songs: &[(usize, f64)]) -> Number {
        let values: Vec<f64> = songs.iter().map(|song| song.1).collect();
        Number::new(metric, variant, "", mean_estimate(&values), "")
            .with_songs(songs.iter().copied().collect())
    }

    #[test]
    fn ratios_are_of_the_same_songs() {
        let own = [number("position_jerk", "", &[(1, 4.0), (2, 9.0)])];
        let truth = [number("position_jerk", "", &[(1, 2.0), (2, 18.0), (5, 1.0)])];
        let found = motion_ratios(&own, &truth);
        // Twice and half as much: 1 on a scale of logarithms.
        assert_eq!((found.len(), found[0].metric), (1, "jerk_ratio"));
        assert!((found[0].estimate.value.unwrap() - 1.0).abs() < 1e-12, "{found:?}");
        // Songs of another number: 6.5 over 7.
        let others = [number("position_jerk", "", &[(7, 2.0), (8, 18.0), (9, 1.0)])];
        let found = motion_ratios(&own, &others);
        assert!((found[0].estimate.value.unwrap() - 6.5 / 7.0).abs() < 1e-12, "{found:?}");
        // A body that stands still in one song has no logarithm there, and is not left out.
        let still = [number("position_jerk", "", &[(1, 0.0), (2, 18.0)])];
        let found = motion_ratios(&still, &truth);
        assert!((found[0].estimate.value.unwrap() - 9.0 / 7.0).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn a_coupling_the_wrong_way_has_a_ratio_below_zero() {
        let own = [number("coupling", "constructed", &[(1, -0.2), (2, -0.4)])];
        let truth = [number("coupling", "constructed", &[(1, 1.0), (2, 1.4)])];
        let found = coupling_ratio(&own, &truth).expect("both");
        assert!((found.estimate.value.unwrap() + 0.25).abs() < 1e-12, "{found:?}");
        assert_eq!(coupling_ratio(&own, &own), None);
    }
}
