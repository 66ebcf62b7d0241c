//! Whether motions did what was asked of them.

use std::collections::BTreeMap;

use super::{Number, by_song};
use crate::evaluation::control::{POSITION_THRESHOLDS_MM, ROTATION_THRESHOLDS_DEG, control_errors};
use crate::evaluation::interval::{
    Estimate, clustered_mean_estimate, clustered_share_estimate, share_estimate,
};
use crate::evaluation::keyframe::{KeyframeMisses, TIMING_REACH_FRAMES};
use crate::units::frames_to_s;

/// Sums up the largest misses of motions that had constraints: of positions, mm, and of orientations, °.
///
/// `songs` names the song of each.
pub fn control_numbers(misses: [&[f64]; 2], songs: [&[usize]; 2]) -> Vec<Number> {
    let kinds = [
        ("control_position", "mm", POSITION_THRESHOLDS_MM[1]),
        ("control_orientation", "°", ROTATION_THRESHOLDS_DEG[1]),
    ];
    let mut numbers = Vec::new();
    for (i, (metric, unit, threshold)) in kinds.into_iter().enumerate() {
        if misses[i].is_empty() {
            continue;
        }
        let mean = clustered_mean_estimate(misses[i], songs[i]).non_negative();
        let protocol = "largest miss of a motion, mean over motions";
        numbers.push(Number::new(metric, "largest", unit, mean, protocol));
        let samples: Vec<[f64; 1]> = misses[i].iter().map(|miss| [*miss]).collect();
        if let Some(errors) = control_errors(&samples, threshold) {
            let n_missed = (errors.trajectory * errors.n_samples as f64).round() as usize;
            numbers.push(Number::new(
                metric,
                format!("share above {threshold} {unit}"),
                "",
                share_estimate(n_missed, errors.n_samples),
                "share of motions with a miss above the threshold (Traj. err.)",
            ));
        }
    }
    numbers
}

/// The misses of one kind of all motions that have such keyframes, and the song of each motion.
struct Misses<'a> {
    of_motions: Vec<&'a [f64]>,
    songs: Vec<usize>,
}

impl<'a> Misses<'a> {
    fn new(
        motions: &[(usize, &'a KeyframeMisses)],
        kind: impl Fn(&'a KeyframeMisses) -> &'a [f64],
    ) -> Self {
        let (songs, of_motions) = motions
            .iter()
            .map(|(song, misses)| (*song, kind(misses)))
            .filter(|(_, misses)| !misses.is_empty())
            .unzip();
        Self { of_motions, songs }
    }

    /// The misses of all motions, one behind the other, and the song of each.
    fn pooled(&self) -> (Vec<f64>, Vec<usize>) {
        let motions = self.of_motions.iter().zip(&self.songs);
        motions.flat_map(|(misses, song)| misses.iter().map(|miss| (*miss, *song))).unzip()
    }

    /// A number of each motion.
    fn by_sample(&self, number: impl Fn(&[f64]) -> f64) -> Vec<f64> {
        self.of_motions.iter().map(|misses| number(misses)).collect()
    }

    /// Mean over all keyframes, and mean of each motion's mean.
    fn means(&self) -> [(Estimate, BTreeMap<usize, f64>); 2] {
        let (pooled, songs) = self.pooled();
        let means = self.by_sample(mean);
        [(&pooled, &songs), (&means, &self.songs)].map(|(values, songs)| {
            (clustered_mean_estimate(values, songs).non_negative(), by_song(values, songs))
        })
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Suffix of variants that are a number of each motion first and then their mean, as MaskControl has it; without it
/// keyframes of all motions count alike.
const BY_SAMPLE: &str = "_by_sample";

/// Measures motions at their keyframes as the field does: trajectory, location and average error (OmniControl, GMD),
/// pooled and by sample, and how far keyframes are met in time. Of each motion its song and its misses; motions
/// without keyframes do not count, and there are no numbers where there are no others.
pub fn keyframe_numbers(motions: &[(usize, &KeyframeMisses)]) -> Vec<Number> {
    let mut numbers = Vec::new();
    let position = Misses::new(motions, |misses| &misses.position_mm);
    numbers.extend(error_numbers(&position, ("position", "mm", "mm"), POSITION_THRESHOLDS_MM));
    let orientation = Misses::new(motions, |misses| &misses.orientation_deg);
    numbers.extend(error_numbers(
        &orientation,
        ("orientation", "deg", "°"),
        ROTATION_THRESHOLDS_DEG,
    ));
    let timing = Misses::new(motions, |misses| &misses.timing_s);
    if !timing.of_motions.is_empty() {
        let protocol = format!(
            "how long from each keyframe's time the body is nearest to its place, looked for within {} s",
            frames_to_s(TIMING_REACH_FRAMES)
        );
        numbers.extend(mean_numbers(&timing, "control_timing_error", "position", "s", &protocol));
    }
    numbers
}

/// Trajectory, location and average error of positions or orientations; `name` is what variants call them, their
/// thresholds' unit, and the unit of tables.
fn error_numbers(
    misses: &Misses,
    (kind, suffix, unit): (&str, &str, &'static str),
    thresholds: [f64; 2],
) -> Vec<Number> {
    let (pooled, pooled_songs) = misses.pooled();
    let mut numbers = Vec::new();
    for threshold in thresholds {
        let Some(errors) = control_errors(&misses.of_motions, threshold) else { continue };
        let is_above = |miss: &f64| !miss.is_finite() || *miss > threshold;
        let share = |is_true: &[bool], songs: &[usize]| {
            let values: Vec<f64> = is_true.iter().map(|&x| f64::from(u8::from(x))).collect();
            (clustered_share_estimate(is_true, songs), by_song(&values, songs))
        };
        let failed: Vec<bool> =
            misses.of_motions.iter().map(|misses| misses.iter().any(is_above)).collect();
        let above: Vec<bool> = pooled.iter().map(is_above).collect();
        let shares = misses.by_sample(|misses| {
            misses.iter().filter(|&miss| is_above(miss)).count() as f64 / misses.len() as f64
        });
        let of_samples = clustered_mean_estimate(&shares, &misses.songs).within(0.0, 1.0);
        let variant = format!("{kind}_{threshold}{suffix}");
        let (n_samples, n_keyframes) = (errors.n_samples, errors.n_keyframes);
        let found = [
            (
                "control_trajectory_error",
                variant.clone(),
                errors.trajectory,
                share(&failed, &misses.songs),
                format!("share of {n_samples} motions with a keyframe off by more (Traj. err.)"),
            ),
            (
                "control_location_error",
                variant.clone(),
                errors.location,
                share(&above, &pooled_songs),
                format!("share of the {n_keyframes} keyframes that are off by more (Loc. err.)"),
            ),
            (
                "control_location_error",
                variant + BY_SAMPLE,
                errors.location_by_sample,
                (of_samples, by_song(&shares, &misses.songs)),
                format!("the same share of each of {n_samples} motions, mean over motions"),
            ),
        ];
        numbers.extend(found.map(|(metric, variant, value, (interval, songs), protocol)| {
            let estimate = Estimate { value: Some(value), ..interval };
            Number::new(metric, variant, "", estimate, protocol).with_songs(songs)
        }));
    }
    if !misses.of_motions.is_empty() {
        let protocol = "mean miss over keyframes (Avg. err.)";
        numbers.extend(mean_numbers(misses, "control_average_error", kind, unit, protocol));
    }
    numbers
}

/// Mean over keyframes and over motions.
fn mean_numbers(
    misses: &Misses,
    metric: &'static str,
    kind: &str,
    unit: &'static str,
    protocol: &str,
) -> [Number; 2] {
    let [pooled, by_sample] = misses.means();
    let variants = [
        (kind.to_owned(), pooled, protocol.to_owned()),
        (format!("{kind}{BY_SAMPLE}"), by_sample, format!("{protocol}, of each motion first")),
    ];
    variants.map(|(variant, (estimate, songs), protocol)| {
        Number::new(metric, variant, unit, estimate, protocol).with_songs(songs)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn misses(position_mm: &[f64], orientation_deg: &[f64]) -> KeyframeMisses {
        KeyframeMisses {
            position_mm: position_mm.to_vec(),
            orientation_deg: orientation_deg.to_vec(),
            timing_s: position_mm.iter().map(|_| 0.1).collect(),
        }
    }

    fn value(numbers: &[Number], metric: &str, variant: &str) -> Option<f64> {
        let mut found =
            numbers.iter().filter(|number| number.metric == metric && number.variant == variant);
        let value = found.next().unwrap_or_else(|| panic!("{metric} {variant}")).estimate.value;
        assert!(found.next().is_none(), "{metric} {variant} twice");
        value
    }

    #[test]
    fn errors_are_pooled_and_by_sample() {
        let all = [
            misses(&[100.0, 300.0, 700.0, 100.0], &[]),
            misses(&[50.0], &[20.0, 40.0]),
            misses(&[], &[5.0]),
            misses(&[200.0, 200.0], &[]),
        ];
        let motions: Vec<_> = [4, 4, 5, 9].into_iter().zip(&all).collect();
        let numbers = keyframe_numbers(&motions);
        let is = |metric, variant, wanted: f64| {
            let found = value(&numbers, metric, variant).expect("a value");
            assert!((found - wanted).abs() < 1e-12, "{metric} {variant}: {found}, wanted {wanted}");
        };
        is("control_trajectory_error", "position_200mm", 1.0 / 3.0);
        is("control_location_error", "position_200mm", 2.0 / 7.0);
        is("control_location_error", "position_200mm_by_sample", 0.5 / 3.0);
        is("control_location_error", "position_500mm", 1.0 / 7.0);
        is("control_average_error", "position", 1650.0 / 7.0);
        is("control_average_error", "position_by_sample", 550.0 / 3.0);
        is("control_trajectory_error", "orientation_10deg", 0.5);
        is("control_location_error", "orientation_30deg", 1.0 / 3.0);
        is("control_average_error", "orientation", 65.0 / 3.0);
        is("control_timing_error", "position", 0.1);
        let pooled = numbers.iter().find(|number| number.variant == "position_200mm");
        assert_eq!(pooled.expect("a number").by_song, BTreeMap::from([(4, 0.5), (9, 0.0)]));
    }

    #[test]
    fn what_is_not_finite_is_a_miss_and_no_mean() {
        let all = [misses(&[f64::NAN, 1.0], &[]), misses(&[1.0], &[])];
        let numbers = keyframe_numbers(&[(0, &all[0]), (1, &all[1])]);
        assert_eq!(value(&numbers, "control_trajectory_error", "position_500mm"), Some(0.5));
        assert_eq!(value(&numbers, "control_average_error", "position"), None);
        assert!(keyframe_numbers(&[]).is_empty());
        assert!(keyframe_numbers(&[(0, &misses(&[], &[]))]).is_empty());
    }
}
