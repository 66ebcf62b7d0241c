//! The numbers of windows of groups, with their intervals over songs.

use std::collections::BTreeMap;

use ndarray::{Array2, ArrayView3, Axis, concatenate};

use super::realism::kinetic_features;
use super::{GroupMeasures, dancers, measure};
use crate::evaluation::frechet::{Gaussian, MIN_PER_DIMENSION, frechet_distance};
use crate::evaluation::interval::{Estimate, jackknife_estimate};
use crate::evaluation::kinetic::CHUNK_FRAMES;
use crate::evaluation::metrics::{Number, mean_by_song};
use crate::evaluation::score::locking_above_chance;
use crate::motion::Channel;

/// Fewest windows from which a group motion correlation is told.
pub const MIN_CORRELATION_WINDOWS: usize = 8;

/// A window of a group and what was measured of it.
#[derive(Clone, Debug)]
pub struct GroupWindow {
    /// Number of the song; windows of one song are no independent ones.
    pub song: usize,
    measures: GroupMeasures,
    /// R² of each dancer's vertical velocity with the bar, above that at wrong tempi.
    locking: Vec<f64>,
    /// The same with the bars of another song; empty where there is none.
    other_locking: Vec<f64>,
    /// Kinetic features of the group, \[chunks, 12\].
    features: Option<Array2<f64>>,
}

/// The bars of a window's music.
#[derive(Clone, Copy, Debug)]
pub struct WindowBars<'a> {
    pub song: usize,
    /// Length of a bar, frames.
    pub bar_frames: f64,
    /// Phase of the bar in every frame, in [0, 1).
    pub phase: &'a [f64],
}

impl GroupWindow {
    /// Measures a window of a group, \[N, T, 25\] in metres, whose bodies have a radius of `radius_m`, and holds it
    /// against its own bars and those of another song.
    pub fn new(
        group: ArrayView3<f32>,
        radius_m: f64,
        own: WindowBars,
        other: Option<WindowBars>,
    ) -> Self {
        let locking = |bars: WindowBars| -> Vec<f64> {
            let of_dancers = group.outer_iter().map(|dancer| {
                let vertical = dancer.column(Channel::Velocity.range().start + 1);
                let vertical: Vec<f64> = vertical.iter().map(|&v| f64::from(v)).collect();
                let n = vertical.len().min(bars.phase.len());
                locking_above_chance(&vertical[..n], &bars.phase[..n])
            });
            of_dancers.collect()
        };
        Self {
            song: own.song,
            measures: measure(group, own.bar_frames, radius_m),
            locking: locking(own),
            other_locking: other.map(locking).unwrap_or_default(),
            features: dancers(group).map(|poses| kinetic_features(&poses)),
        }
    }
}

/// A number of every window: its name, its unit, and where it is.
type Measure = (&'static str, &'static str, fn(&GroupMeasures) -> Option<f64>);

/// The numbers of windows of groups.
const MEASURES: [Measure; 10] = [
    ("unison_index", "", |m| m.unison),
    ("gmc_correlation", "", |m| m.gmc_correlation),
    ("gmc_published", "", |m| m.gmc_published),
    ("tif", "", |m| m.tif),
    ("tif_published", "", |m| m.touching_pairs_per_frame),
    ("least_separation", "m", |m| m.least_separation_m),
    ("formation_coverage", "m²", |m| m.coverage_m2),
    ("formation_spread", "m", |m| m.spread_m),
    ("dancer_diversity", "", |m| m.dancer_diversity),
    ("dancer_velocity_difference", "m/s", |m| m.dancer_velocity_difference_m_s),
];

/// Returns the normal distribution of the kinetic features of groups; none for too few to fit one.
pub fn feature_distribution(windows: &[GroupWindow]) -> Option<Gaussian> {
    distribution(windows.iter())
}

fn distribution<'a>(windows: impl Iterator<Item = &'a GroupWindow>) -> Option<Gaussian> {
    let rows: Vec<_> =
        windows.filter_map(|window| Some(window.features.as_ref()?.view())).collect();
    Gaussian::fit(concatenate(Axis(0), &rows).ok()?.view())
}

/// Returns the numbers of windows of groups; `reference` is the distribution of the training groups' features.
///
/// Where there are too few windows for a number it is absent, and its protocol says how many there must be.
pub fn group_numbers(windows: &[GroupWindow], reference: Option<&Gaussian>) -> Vec<Number> {
    let mut numbers: Vec<Number> = MEASURES
        .iter()
        .map(|(metric, unit, of)| {
            let number = mean_number(metric, "", unit, windows, |window| of(&window.measures));
            match metric.starts_with("gmc") && windows.len() < MIN_CORRELATION_WINDOWS {
                true => too_few(number, windows.len(), MIN_CORRELATION_WINDOWS, "windows"),
                false => number,
            }
        })
        .collect();
    let mean = |values: &[f64]| {
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let metric = "group_locking";
    numbers.push(mean_number(metric, "", "", windows, |window| mean(&window.locking)));
    numbers.push(mean_number(metric, "least_dancer", "", windows, |window| {
        window.locking.iter().copied().reduce(f64::min)
    }));
    let other = |window: &GroupWindow| mean(&window.other_locking);
    numbers.push(mean_number(metric, "other_song", "", windows, other));
    let least = windows.iter().filter_map(|window| window.measures.least_separation_m);
    let least = Estimate::plain(least.reduce(f64::min), windows.len());
    numbers.push(Number::new("least_separation", "least", "m", least, "the least of all windows"));
    numbers.push(realism_number(windows, reference));
    numbers
}

/// The mean over windows that have a number, with songs as clusters.
fn mean_number(
    metric: &'static str,
    variant: &str,
    unit: &'static str,
    windows: &[GroupWindow],
    of: impl Fn(&GroupWindow) -> Option<f64>,
) -> Number {
    let known = windows
        .iter()
        .filter_map(|window| Some((of(window).filter(|x| x.is_finite())?, window.song)));
    let (estimate, by_song) = mean_by_song(known);
    Number::new(metric, variant, unit, estimate, "mean over windows, interval over songs")
        .with_songs(by_song)
}

/// Takes the value of a number that rests on too little, and says how much it takes.
fn too_few(number: Number, n: usize, least: usize, what: &str) -> Number {
    Number {
        estimate: Estimate::plain(None, n),
        by_song: BTreeMap::new(),
        protocol: format!("too few: {n} {what}, and {least} are the least"),
        ..number
    }
}

/// The Fréchet distance of groups' kinetic features from those of the training groups, without the bias of few songs.
fn realism_number(windows: &[GroupWindow], reference: Option<&Gaussian>) -> Number {
    let rows = |window: &GroupWindow| window.features.as_ref().map_or(0, Array2::nrows);
    let n_chunks: usize = windows.iter().map(rows).sum();
    let songs: BTreeMap<usize, usize> = windows
        .iter()
        .map(|w| w.song)
        .collect::<std::collections::BTreeSet<_>>()
        .into_iter()
        .zip(0..)
        .collect();
    let distance = |left_out: Option<usize>| {
        let kept = windows.iter().filter(|window| Some(songs[&window.song]) != left_out);
        frechet_distance(&distribution(kept)?, reference?)
    };
    let estimate = jackknife_estimate(songs.len(), n_chunks, distance).non_negative();
    let protocol =
        format!("{n_chunks} chunks of {CHUNK_FRAMES} frames against those of the training groups");
    let number = Number::new("gmr", "", "", estimate, protocol);
    let width = windows.iter().find_map(|w| Some(w.features.as_ref()?.ncols())).unwrap_or(0);
    let least = MIN_PER_DIMENSION * width;
    match reference {
        None => Number { protocol: "no training groups to compare with".to_owned(), ..number },
        Some(_) if n_chunks < least => too_few(number, n_chunks, least, "chunks of 2.5 s"),
        Some(_) => number,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::metrics::Number;
    use crate::motion::MOTION_DIM;
    use ndarray::Array3;
    use std::f64::consts::TAU;

    const BAR_FRAMES: f64 = 60.0;

    fn phase(bar_frames: f64) -> Vec<f64> {
        (0..240).map(|t| (f64::from(t) / bar_frames).fract()).collect()
    }

    /// Three dancers 1.5 m apart who rise and fall with the bar, the last of them at `last_tempo` times its tempo.
    fn group(last_tempo: f64, shift: f64) -> Array3<f32> {
        let mut frames = Array3::zeros((3, 240, MOTION_DIM));
        for (k, mut dancer) in frames.outer_iter_mut().enumerate() {
            let tempo = if k == 2 { last_tempo } else { 1.0 };
            for (t, mut row) in dancer.outer_iter_mut().enumerate() {
                let w = TAU * tempo / BAR_FRAMES;
                let at = w * t as f64 + shift + 0.1 * k as f64;
                row[0] = 1.5 * k as f32;
                row[1] = 1.0 + 0.1 * at.sin() as f32;
                row[4] = (0.1 * w * 30.0 * at.cos()) as f32;
                row[9] = 1.0;
            }
        }
        frames
    }

    fn windows(n: usize, last_tempo: f64) -> Vec<GroupWindow> {
        let own = phase(BAR_FRAMES);
        let other = phase(47.0);
        let bars = |song, phase| WindowBars { song, bar_frames: BAR_FRAMES, phase };
        let window = |i: usize| {
            let group = group(last_tempo, 0.3 * i as f64);
            GroupWindow::new(group.view(), 0.35, bars(i % 3, &own), Some(bars(9, &other)))
        };
        (0..n).map(window).collect()
    }

    fn find<'a>(numbers: &'a [Number], metric: &str, variant: &str) -> &'a Number {
        let is_it = |n: &&Number| n.metric == metric && n.variant == variant;
        numbers.iter().find(is_it).expect(metric)
    }

    #[test]
    fn one_dancer_off_the_beat_is_seen_by_the_least_and_another_song_by_all() {
        let value = |numbers: &[Number], variant| {
            find(numbers, "group_locking", variant).estimate.value.expect("a value")
        };
        let together = group_numbers(&windows(6, 1.0), None);
        let apart = group_numbers(&windows(6, 0.77), None);
        let [whole, least] = ["", "least_dancer"].map(|variant| value(&together, variant));
        assert!(whole > 0.5 && least > 0.5, "{whole} {least}");
        let [whole, least] = ["", "least_dancer"].map(|variant| value(&apart, variant));
        assert!(whole > 0.3 && least < 0.25, "{whole} {least}");
        assert!(value(&together, "other_song") < 0.25, "{}", value(&together, "other_song"));
        assert_eq!(find(&together, "group_locking", "").by_song.len(), 3);
        let apart_m = find(&together, "least_separation", "least").estimate.value;
        assert_eq!(apart_m, Some(1.5));
    }

    #[test]
    fn too_few_windows_are_told_in_the_place_of_a_number() {
        let few = windows(7, 1.0);
        let reference = feature_distribution(&few);
        for (metric, protocol) in [
            ("gmc_correlation", "too few: 7 windows, and 8 are the least"),
            ("gmc_published", "too few: 7 windows, and 8 are the least"),
            ("gmr", "too few: 21 chunks of 2.5 s, and 120 are the least"),
        ] {
            let numbers = group_numbers(&few, reference.as_ref());
            let number = find(&numbers, metric, "");
            assert_eq!(number.estimate.value, None, "{metric}");
            assert_eq!(number.protocol, protocol);
        }
        let enough = group_numbers(&windows(8, 1.0), None);
        let told = find(&enough, "gmc_correlation", "").estimate;
        assert!(told.value.is_some_and(|r| r > 0.5), "{told:?}");
        assert_eq!(find(&enough, "gmr", "").protocol, "no training groups to compare with");
    }
}
