//! How windows compare with real motion, and whether they are sound.

use std::collections::BTreeMap;

use ndarray::{Array2, ArrayView2, Axis, concatenate};

use super::{MotionWindow, Number, SEED, mean_over, staged};
use crate::evaluation::consistency::Consistency;
use crate::evaluation::distribution::channel_distances;
use crate::evaluation::diversity::{
    DIVERSITY_PAIRS, MULTIMODALITY_PAIRS, distance, diversity, mean_distance, multimodality,
};
use crate::evaluation::frechet::{Gaussian, frechet_distance};
use crate::evaluation::interval::{
    Estimate, clustered_mean_estimate, clustered_share_estimate, jackknife_estimate,
};
use crate::evaluation::kinetic::CHUNK_FRAMES;
use crate::evaluation::measured::WindowMeasures;
use crate::evaluation::reference_statistics::{FeatureSet, ReferenceStatistics};
use crate::evaluation::sanity::CheckSet;
use crate::evaluation::window_range::Posture;
use crate::motion::CHANNEL_NAMES;

/// Windows, evenly among all, whose pairs are compared: every one with every other.
const MAX_COMPARED: usize = 400;
/// Replications of numbers that draw pairs, as for HumanML3D.
const N_DIVERSITY: u64 = 20;
const N_MULTIMODALITY: u64 = 5;
/// Windows of a song, evenly among all, whose features are compared with those of other songs.
const MAX_COMPARED_PER_SONG: usize = 24;
/// Songs, evenly among all, that are compared with each other.
const MAX_COMPARED_SONGS: usize = 48;

/// Reference values that windows are compared with.
#[derive(Clone, Copy, Debug)]
pub struct MotionContext<'a> {
    pub reference: Option<&'a ReferenceStatistics>,
    /// Windows that a Fréchet distance is made of, evenly among all: the same number for all subjects.
    pub n_frechet: usize,
}

/// Measures how windows compare with the training split, and how different they are.
pub fn motion_numbers(danced: &[MotionWindow], context: &MotionContext) -> Vec<Number> {
    let mut numbers = posture_numbers(danced);
    for set in FeatureSet::ALL {
        numbers.push(frechet_number(danced, set, context));
    }
    numbers.push(shift_number(danced));
    numbers.extend(variety_numbers(danced));
    numbers
}

/// Measures the shares of whole motions that are finite, and that have no seams: of each motion its song and both.
pub fn whole_numbers(motions: &[(usize, bool, bool)]) -> Vec<Number> {
    let songs: Vec<usize> = motions.iter().map(|(song, ..)| *song).collect();
    let share = |variant: &str, protocol: &str, is_true: Vec<bool>| {
        let share = clustered_share_estimate(&is_true, &songs);
        Number::new("pass_rate", variant.to_owned(), "", share, protocol)
    };
    if motions.is_empty() {
        return Vec::new();
    }
    vec![
        share(
            "finite",
            "share of motions all of whose values are finite, with orientations of length 1",
            motions.iter().map(|(_, is_finite, _)| *is_finite).collect(),
        ),
        share(
            "seamless",
            "share of motions whose derivatives agree over the borders of windows and to the last frame",
            motions.iter().map(|(.., is_seamless)| *is_seamless).collect(),
        ),
    ]
}

/// Measures the share of windows that pass all checks of a set, and means of what the checks look at.
///
/// `stage` is added to the variants, where it is not empty.
pub fn soundness_numbers(danced: &[MotionWindow], stage: &str) -> Vec<Number> {
    let passed = |set: CheckSet| {
        let (is_true, songs): (Vec<bool>, Vec<usize>) =
            danced.iter().map(|item| (item.motion.passes(set), item.song)).unzip();
        clustered_share_estimate(&is_true, &songs)
    };
    let variant = |name: &str| staged(name, stage);
    let checks = "share of windows that pass every check of the set";
    let mut numbers = Vec::new();
    for (name, set) in [("reference", CheckSet::Reference), ("strict", CheckSet::Strict)] {
        let share = passed(set);
        let (_, by_song) =
            mean_over(danced, |item| Some(f64::from(u8::from(item.motion.passes(set)))));
        numbers
            .push(Number::new("pass_rate", variant(name), "", share, checks).with_songs(by_song));
    }
    type ConsistencyPart = fn(&Consistency) -> Option<f64>;
    let parts: [(&'static str, &'static str, ConsistencyPart); 8] = [
        ("velocity_error", "m/s", |c| Some(c.velocity_error_m_s)),
        ("acceleration_error", "m/s²", |c| Some(c.acceleration_error_m_s2)),
        ("turn_error", "rad/s", |c| Some(c.turn_error_rad_s)),
        ("norm_error", "", |c| Some(c.norm_error)),
        ("jerk_mean", "m/s³", |c| Some(c.jerk_mean_m_s3)),
        ("jerk_p95", "m/s³", |c| Some(c.jerk_p95_m_s3)),
        ("log_dimensionless_jerk", "", |c| c.log_dimensionless_jerk),
        ("share_over_limits", "", |c| Some(c.share_over_limits)),
    ];
    for (metric, unit, part) in parts {
        let (mean, by_song) =
            mean_over(danced, |item| item.motion.consistency.as_ref().and_then(part));
        let mean = if metric == "log_dimensionless_jerk" { mean } else { mean.non_negative() };
        let number = Number::new(metric, variant(""), unit, mean, "mean over windows");
        numbers.push(number.with_songs(by_song));
    }
    let windows = "share of windows within the training split's bounds";
    for (metric, check) in [
        ("share_upright", "upright"),
        ("share_height", "height"),
        ("share_turning", "turning"),
        ("share_jerk", "jerk_range"),
    ] {
        let (is_true, songs): (Vec<bool>, Vec<usize>) =
            danced.iter().filter_map(|item| Some((item.motion.passed(check)?, item.song))).unzip();
        let share = clustered_share_estimate(&is_true, &songs);
        let share = if is_true.is_empty() { Estimate::plain(None, 0) } else { share };
        numbers.push(Number::new(metric, variant(""), "", share, windows));
    }
    numbers
}

/// Speeds and jerk, as positions say them.
fn posture_numbers(danced: &[MotionWindow]) -> Vec<Number> {
    type PosturePart = fn(&Posture) -> f64;
    let parts: [(&'static str, &str, &'static str, PosturePart); 6] = [
        ("axis_speed", "x", "m/s", |p| p.axis_speed_m_s[0]),
        ("axis_speed", "y", "m/s", |p| p.axis_speed_m_s[1]),
        ("axis_speed", "z", "m/s", |p| p.axis_speed_m_s[2]),
        ("position_jerk", "", "m/s³", |p| p.jerk_m_s3),
        ("tilt", "", "°", |p| p.tilt_rad.to_degrees()),
        ("turn_rate", "", "rad/s", |p| p.turning_rad_s),
    ];
    let (speed, by_song) = mean_over(danced, |item| item.motion.mean_speed_m_s);
    let mut numbers = vec![
        Number::new("mean_speed", "", "m/s", speed.non_negative(), "of positions")
            .with_songs(by_song),
    ];
    for (metric, variant, unit, part) in parts {
        let (mean, by_song) = mean_over(danced, |item| item.motion.posture.as_ref().map(part));
        let protocol = "of positions and orientations, mean over windows";
        let number = Number::new(metric, variant, unit, mean.non_negative(), protocol);
        numbers.push(number.with_songs(by_song));
    }
    numbers
}

/// Groups of songs, at most 40, that the jackknife leaves out one at a time.
const MAX_GROUPS: usize = 40;

/// Rows of features by group of songs: each song is one, where there are few.
fn rows_by_song(
    danced: &[MotionWindow],
    rows: impl Fn(&WindowMeasures) -> Option<Array2<f64>>,
) -> Vec<Vec<Array2<f64>>> {
    let mut songs: BTreeMap<usize, Vec<Array2<f64>>> = BTreeMap::new();
    for item in danced {
        if let Some(rows) = rows(item.motion) {
            songs.entry(item.song).or_default().push(rows);
        }
    }
    let mut groups: Vec<Vec<Array2<f64>>> = vec![Vec::new(); songs.len().min(MAX_GROUPS)];
    for (i, rows) in songs.into_values().enumerate() {
        groups[i % MAX_GROUPS].extend(rows);
    }
    groups
}

fn stacked<'a>(rows: impl IntoIterator<Item = &'a Array2<f64>>) -> Option<Array2<f64>> {
    let views: Vec<ArrayView2<f64>> = rows.into_iter().map(|rows| rows.view()).collect();
    concatenate(Axis(0), &views).ok()
}

/// Returns `n` of `len` places, evenly.
fn evenly(len: usize, n: usize) -> impl Iterator<Item = usize> {
    let n = n.min(len);
    (0..n).map(move |i| i * len / n)
}

/// The Fréchet distance from the training split, without the bias of few songs.
fn frechet_number(danced: &[MotionWindow], set: FeatureSet, context: &MotionContext) -> Number {
    let (metric, variant) = match set {
        FeatureSet::Geometric => ("fid_g", ""),
        kinetic => ("fid_k", kinetic.name()),
    };
    let chosen: Vec<MotionWindow> =
        evenly(danced.len(), context.n_frechet).map(|i| danced[i].clone()).collect();
    let songs = rows_by_song(&chosen, |motion| motion.features(set).map(|rows| rows.to_owned()));
    let n_chunks: usize = songs.iter().flatten().map(Array2::nrows).sum();
    let distance = |left_out: Option<usize>| {
        let kept = songs.iter().enumerate().filter(|(song, _)| Some(*song) != left_out);
        let rows = stacked(kept.flat_map(|(_, rows)| rows))?;
        let found = Gaussian::fit(rows.view())?;
        frechet_distance(&found, &context.reference?.statistics(set).gaussian)
    };
    let estimate = jackknife_estimate(songs.len(), n_chunks, distance).non_negative();
    let truth = context.reference.map_or("no real motion".to_owned(), |reference| {
        format!("{} of the training split", reference.n_chunks)
    });
    let protocol = format!(
        "{n_chunks} chunks of {CHUNK_FRAMES} frames against {truth}, bias of few songs taken out (jackknife)"
    );
    Number::new(metric, variant, "", estimate, protocol)
}

/// `√⟨μ_j²⟩` over the mean features of windows, in deviations of the training split.
fn shift_number(danced: &[MotionWindow]) -> Number {
    let songs = rows_by_song(danced, joined);
    let shift = |left_out: Option<usize>| {
        let kept = songs.iter().enumerate().filter(|(song, _)| Some(*song) != left_out);
        let mean = stacked(kept.flat_map(|(_, rows)| rows))?.mean_axis(Axis(0))?;
        Some((mean.iter().map(|x| x * x).sum::<f64>() / mean.len() as f64).sqrt())
    };
    let n = songs.iter().map(Vec::len).sum();
    let estimate = jackknife_estimate(songs.len(), n, shift).non_negative();
    let protocol =
        "root mean square over 24 features of how far their mean is from the training split's";
    Number::new("feature_shift", "", "deviations", estimate, protocol)
}

/// Kinetic features of the axes and geometric ones side by side, `[n, 24]`.
fn joined(motion: &WindowMeasures) -> Option<Array2<f64>> {
    let (a, b) = (motion.features(FeatureSet::Axes)?, motion.features(FeatureSet::Geometric)?);
    concatenate(Axis(1), &[a, b]).ok()
}

/// How different windows are: all of them, those of different songs, and those of one place of one phrase.
fn variety_numbers(danced: &[MotionWindow]) -> Vec<Number> {
    let groups = rows_by_song(danced, joined);
    let n_windows = groups.iter().map(Vec::len).sum();
    let most = MAX_COMPARED.div_ceil(groups.len().max(1));
    let kept = |left_out: Option<usize>| {
        let kept = groups.iter().enumerate().filter(|(group, _)| Some(*group) != left_out);
        let rows = kept.flat_map(|(_, rows)| evenly(rows.len(), most).map(|i| &rows[i]));
        stacked(rows)
    };
    let spread = |left_out| mean_distance(kept(left_out)?.view());
    let pairs = |left_out| {
        let rows = kept(left_out)?;
        let seeds = SEED..SEED + N_DIVERSITY;
        let found: Option<Vec<f64>> =
            seeds.map(|seed| diversity(rows.view(), DIVERSITY_PAIRS, seed)).collect();
        Some(found?.iter().sum::<f64>() / N_DIVERSITY as f64)
    };
    let whole = |metric, protocol: String, estimate: Estimate| {
        Number::new(metric, "axes", "", estimate.non_negative(), protocol)
    };
    let mut numbers = vec![
        whole(
            "mean_distance",
            format!("every pair of up to {MAX_COMPARED} windows, one song left out at a time"),
            jackknife_estimate(groups.len(), n_windows, spread),
        ),
        whole(
            "diversity",
            format!(
                "{DIVERSITY_PAIRS} pairs of windows, {N_DIVERSITY} replications, one song left out at a time"
            ),
            jackknife_estimate(groups.len(), n_windows, pairs),
        ),
    ];
    numbers.extend(song_distances(danced));
    numbers.push(multimodality_number(danced));
    numbers
}

/// Distance of windows of different songs, anywhere in them and at the same place.
fn song_distances(danced: &[MotionWindow]) -> [Number; 2] {
    let mut songs: BTreeMap<usize, Vec<(usize, Array2<f64>)>> = BTreeMap::new();
    for item in danced {
        if let Some(rows) = joined(item.motion).filter(|rows| rows.nrows() > 0) {
            songs.entry(item.song).or_default().push((item.first_frame, rows));
        }
    }
    let songs: Vec<Vec<(usize, Array2<f64>)>> = songs.into_values().collect();
    let songs: Vec<Vec<&(usize, Array2<f64>)>> = evenly(songs.len(), MAX_COMPARED_SONGS)
        .map(|i| evenly(songs[i].len(), MAX_COMPARED_PER_SONG).map(|j| &songs[i][j]).collect())
        .collect();
    let n_windows = songs.iter().map(Vec::len).sum();
    // Sum and number of the pairs of two songs.
    let pairs_of = |i: usize, j: usize, is_same_place: bool| -> (f64, f64) {
        let (mut sum, mut n) = (0.0, 0.0);
        for (first, rows) in &songs[i] {
            for (other_first, other) in &songs[j] {
                if !is_same_place || first == other_first {
                    sum += distance(rows.row(0), other.row(0));
                    n += 1.0;
                }
            }
        }
        (sum, n)
    };
    [("anywhere", false), ("same_place", true)].map(|(variant, is_same_place)| {
        let pairs: Vec<Vec<(f64, f64)>> = (0..songs.len())
            .map(|i| (0..i).map(|j| pairs_of(i, j, is_same_place)).collect())
            .collect();
        let mean = |left_out: Option<usize>| {
            let (mut sum, mut n) = (0.0, 0.0);
            for (i, row) in pairs.iter().enumerate() {
                for (j, (of_pair, n_pairs)) in row.iter().enumerate() {
                    if ![Some(i), Some(j)].contains(&left_out) {
                        sum += of_pair;
                        n += n_pairs;
                    }
                }
            }
            (n > 0.0).then(|| sum / n)
        };
        let estimate = jackknife_estimate(songs.len(), n_windows, mean).non_negative();
        Number::new("song_distance", variant, "", estimate, "windows of different songs")
    })
}

/// How different motions are for one place of one phrase.
fn multimodality_number(danced: &[MotionWindow]) -> Number {
    // By phrase and first frame: the song, and a row for each motion.
    type WindowPlace = (usize, usize);
    let mut places: BTreeMap<WindowPlace, (usize, Vec<Array2<f64>>)> = BTreeMap::new();
    for item in danced {
        if let Some(rows) = joined(item.motion).filter(|rows| rows.nrows() > 0) {
            let place = places.entry((item.phrase, item.first_frame)).or_default();
            place.0 = item.song;
            place.1.push(rows);
        }
    }
    let several = places.values().filter(|(_, rows)| rows.len() > 1);
    let multimodality_of_place = |(song, rows): &(usize, Vec<Array2<f64>>)| {
        let rows = stacked(rows)?;
        let seeds = SEED..SEED + N_MULTIMODALITY;
        let found: Option<Vec<f64>> =
            seeds.map(|seed| multimodality(&[rows.view()], MULTIMODALITY_PAIRS, seed)).collect();
        Some((found?.iter().sum::<f64>() / N_MULTIMODALITY as f64, *song))
    };
    let (values, songs): (Vec<f64>, Vec<usize>) =
        several.filter_map(multimodality_of_place).unzip();
    let protocol = format!(
        "motions at one place of one phrase, {MULTIMODALITY_PAIRS} pairs, {N_MULTIMODALITY} replications"
    );
    let estimate = clustered_mean_estimate(&values, &songs).non_negative();
    Number::new("multimodality", "axes", "", estimate, protocol)
}

/// Compares the values of each channel, of frames `[n, 25]`, with those of the training split.
pub fn channel_numbers(motion: ArrayView2<f32>, truth: ArrayView2<f32>) -> Vec<Number> {
    let protocol =
        format!("{} frames against {} of the training split", motion.nrows(), truth.nrows());
    CHANNEL_NAMES
        .iter()
        .zip(channel_distances(motion, truth))
        .map(|(name, distance)| {
            let estimate = Estimate::plain(distance, motion.nrows());
            Number::new("channel_distance", *name, "deviations", estimate, &*protocol)
        })
        .collect()
}
