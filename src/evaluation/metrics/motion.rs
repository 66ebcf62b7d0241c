//! How motions compare with real motion, and whether they are sound.

use std::collections::BTreeMap;

use ndarray::{Array2, ArrayView2, Axis, concatenate};

use super::super::consistency::Consistency;
use super::super::control::{POSITION_THRESHOLDS_MM, ROTATION_THRESHOLDS_DEG, control_errors};
use super::super::distribution::channel_distances;
use super::super::diversity::{
    DIVERSITY_PAIRS, MULTIMODALITY_PAIRS, diversity, mean_distance, multimodality,
};
use super::super::frechet::{Gaussian, frechet_distance};
use super::super::interval::{
    Estimate, bootstrap_estimate, clustered_mean_estimate, mean_estimate, share_estimate,
};
use super::super::kinetic::CHUNK_FRAMES;
use super::super::measured::Measured;
use super::super::reference_statistics::{FeatureSet, ReferenceStatistics};
use super::super::sanity::CheckSet;
use super::{Danced, Number, SEED, mean_over};
use crate::motion::CHANNEL_NAMES;

/// Resamples of an interval of a number of a whole set.
const N_RESAMPLES: usize = 100;
/// Features, evenly among all, whose pairs are compared: every one with every other.
const MAX_COMPARED: usize = 400;
/// Replications of numbers that draw pairs, as for HumanML3D.
const N_DIVERSITY: u64 = 20;
const N_MULTIMODALITY: u64 = 5;

/// Measures how sound motions are and, with reference statistics, how they compare with the ground truth.
pub fn of_motion(danced: &[Danced], reference: Option<&ReferenceStatistics>) -> Vec<Number> {
    let mut numbers = soundness(danced);
    for set in FeatureSet::ALL {
        numbers.push(frechet(danced, set, reference));
    }
    numbers.extend(variety(danced));
    numbers
}

/// Pass rates, and means of what the checks look at.
fn soundness(danced: &[Danced]) -> Vec<Number> {
    let passed = |set: CheckSet| {
        let n = danced.iter().filter(|item| item.motion.passes(set)).count();
        share_estimate(n, danced.len())
    };
    type Of = fn(&Consistency) -> Option<f64>;
    let parts: [(&'static str, &'static str, Of); 8] = [
        ("velocity_error", "m/s", |c| Some(c.velocity_error_m_s)),
        ("acceleration_error", "m/s²", |c| Some(c.acceleration_error_m_s2)),
        ("turn_error", "rad/s", |c| Some(c.turn_error_rad_s)),
        ("norm_error", "", |c| Some(c.norm_error)),
        ("jerk_mean", "m/s³", |c| Some(c.jerk_mean_m_s3)),
        ("jerk_p95", "m/s³", |c| Some(c.jerk_p95_m_s3)),
        ("log_dimensionless_jerk", "", |c| c.log_dimensionless_jerk),
        ("share_over_limits", "", |c| Some(c.share_over_limits)),
    ];
    let checks = "share of motions that pass every check of the set";
    let mut numbers = vec![
        Number::new("pass_rate", "reference", "", passed(CheckSet::Reference), checks),
        Number::new("pass_rate", "strict", "", passed(CheckSet::Strict), checks),
        Number::new(
            "mean_speed",
            "",
            "m/s",
            mean_over(danced, |item| item.motion.mean_speed_m_s),
            "of positions",
        ),
    ];
    for (metric, unit, of) in parts {
        let mean = mean_over(danced, |item| item.motion.consistency.as_ref().and_then(of));
        numbers.push(Number::new(metric, "", unit, mean, "mean over motions"));
    }
    numbers
}

/// Rows of features by song.
fn by_song(
    danced: &[Danced],
    of: impl Fn(&Measured) -> Option<Array2<f64>>,
) -> Vec<Vec<Array2<f64>>> {
    let mut songs: BTreeMap<usize, Vec<Array2<f64>>> = BTreeMap::new();
    for item in danced {
        if let Some(rows) = of(item.motion) {
            songs.entry(item.song).or_default().push(rows);
        }
    }
    songs.into_values().collect()
}

fn stacked<'a>(rows: impl IntoIterator<Item = &'a Array2<f64>>) -> Option<Array2<f64>> {
    let views: Vec<ArrayView2<f64>> = rows.into_iter().map(|rows| rows.view()).collect();
    concatenate(Axis(0), &views).ok()
}

/// The Fréchet distance from the ground truth; its interval resamples songs.
fn frechet(danced: &[Danced], set: FeatureSet, reference: Option<&ReferenceStatistics>) -> Number {
    let (metric, variant) = match set {
        FeatureSet::Geometric => ("fid_g", ""),
        kinetic => ("fid_k", kinetic.name()),
    };
    let songs = by_song(danced, |motion| motion.features(set).map(|rows| rows.to_owned()));
    let n_chunks: usize = songs.iter().flatten().map(Array2::nrows).sum();
    let distance = |picked: &[usize]| {
        let rows = stacked(picked.iter().flat_map(|&song| &songs[song]))?;
        let found = Gaussian::fit(rows.view())?;
        frechet_distance(&found, &reference?.statistics(set).gaussian)
    };
    let estimate = bootstrap_estimate(songs.len(), N_RESAMPLES, SEED, distance);
    let of = reference.map_or("no ground truth".to_owned(), |reference| {
        format!("{} of ground truth", reference.n_chunks)
    });
    let protocol = format!("chunks of {CHUNK_FRAMES} frames against {of}, songs resampled");
    Number::new(metric, variant, "", Estimate { n: n_chunks, ..estimate }, protocol)
}

/// How different motions are from each other, and those for one phrase.
fn variety(danced: &[Danced]) -> Vec<Number> {
    let mut numbers = Vec::new();
    for set in [FeatureSet::Axes, FeatureSet::Markers, FeatureSet::Geometric] {
        let songs = by_song(danced, |motion| motion.features(set).map(|rows| rows.to_owned()));
        let rows = stacked(songs.iter().flatten()).unwrap_or_default();
        let protocol = format!("every pair of up to {MAX_COMPARED} chunks");
        let estimate = spread(rows.view());
        numbers.push(Number::new("mean_distance", set.name(), "", estimate, protocol));
    }
    for kinetic in [FeatureSet::Axes, FeatureSet::Markers] {
        let joined = |motion: &Measured| {
            let (a, b) = (motion.features(kinetic)?, motion.features(FeatureSet::Geometric)?);
            concatenate(Axis(1), &[a, b]).ok()
        };
        let rows = stacked(by_song(danced, joined).iter().flatten()).unwrap_or_default();
        let seeds = SEED..SEED + N_DIVERSITY;
        let values: Option<Vec<f64>> =
            seeds.map(|seed| diversity(rows.view(), DIVERSITY_PAIRS, seed)).collect();
        let estimate = Estimate { n: rows.nrows(), ..mean_estimate(&values.unwrap_or_default()) };
        let protocol = format!("{DIVERSITY_PAIRS} pairs of chunks, {N_DIVERSITY} replications");
        numbers.push(Number::new("diversity", kinetic.name(), "", estimate, protocol));

        let mut phrases: BTreeMap<usize, Vec<Array2<f64>>> = BTreeMap::new();
        for item in danced {
            // One chunk of each motion: later ones dance to other music.
            if let Some(rows) = joined(item.motion).filter(|rows| rows.nrows() > 0) {
                let first = rows.slice(ndarray::s![..1, ..]).to_owned();
                phrases.entry(item.phrase).or_default().push(first);
            }
        }
        let conditions: Vec<Array2<f64>> =
            phrases.values().filter(|rows| rows.len() > 1).filter_map(stacked).collect();
        let views: Vec<ArrayView2<f64>> = conditions.iter().map(|rows| rows.view()).collect();
        let seeds = SEED..SEED + N_MULTIMODALITY;
        let values: Option<Vec<f64>> =
            seeds.map(|seed| multimodality(&views, MULTIMODALITY_PAIRS, seed)).collect();
        let estimate = Estimate { n: views.len(), ..mean_estimate(&values.unwrap_or_default()) };
        let protocol = format!(
            "first chunks of the motions for a phrase, {MULTIMODALITY_PAIRS} pairs, {N_MULTIMODALITY} \
             replications"
        );
        numbers.push(Number::new("multimodality", kinetic.name(), "", estimate, protocol));
    }
    numbers
}

/// The mean distance of all pairs of rows, evenly picked where there are many.
fn spread(rows: ArrayView2<f64>) -> Estimate {
    let stride = rows.nrows().div_ceil(MAX_COMPARED).max(1);
    let picked: Vec<usize> = (0..rows.nrows()).step_by(stride).collect();
    let rows = rows.select(Axis(0), &picked);
    bootstrap_estimate(rows.nrows(), N_RESAMPLES, SEED, |of| {
        mean_distance(rows.select(Axis(0), of).view())
    })
}

/// Compares the values of each channel, of frames `[n, 25]`, with those of the ground truth.
pub fn of_channels(motion: ArrayView2<f32>, truth: ArrayView2<f32>) -> Vec<Number> {
    let protocol = format!("{} frames against {} of ground truth", motion.nrows(), truth.nrows());
    CHANNEL_NAMES
        .iter()
        .zip(channel_distances(motion, truth))
        .map(|(name, distance)| {
            let estimate = Estimate::plain(distance, motion.nrows());
            Number::new("channel_distance", *name, "deviations", estimate, &*protocol)
        })
        .collect()
}

/// Sums up the largest misses of motions that had constraints: of positions, mm, and of orientations, °.
///
/// `songs` names the song of each.
pub fn of_control(misses: [&[f64]; 2], songs: [&[usize]; 2]) -> Vec<Number> {
    let kinds = [
        ("control_position", "mm", POSITION_THRESHOLDS_MM[1]),
        ("control_orientation", "°", ROTATION_THRESHOLDS_DEG[1]),
    ];
    let mut numbers = Vec::new();
    for (i, (metric, unit, threshold)) in kinds.into_iter().enumerate() {
        if misses[i].is_empty() {
            continue;
        }
        let mean = clustered_mean_estimate(misses[i], songs[i]);
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
