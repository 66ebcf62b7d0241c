//! The numbers of a set of windows: how far they follow the music, and how they compare with real motion.

mod control;
mod motion;
mod music;
mod ratio;
mod reconstruction;

pub use control::{control_numbers, keyframe_numbers};
pub use motion::{
    MotionContext, channel_numbers, motion_numbers, soundness_numbers, whole_numbers,
};
pub use music::{
    MusicContext, N_WRONG_TEMPI, PhaseOrigin, music_numbers, phase_numbers, shifted_numbers,
    song_harmonics,
};
pub use ratio::{coupling_ratio, motion_ratios};
pub use reconstruction::{CodeUse, ReconstructedPhrase, reconstruction_numbers};

use std::collections::BTreeMap;

use super::interval::{Estimate, clustered_mean_estimate};
use super::measured::WindowMeasures;

/// Seed of all resampling and pairing, so that two evaluations of the same motions agree.
const SEED: u64 = 2026;

/// The music of a phrase, from its first frame on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhraseMusic {
    /// Beats, s.
    pub beats_s: Vec<f64>,
    /// Bars that had passed at each frame of the song, or of the phrase where nothing else is known.
    pub bars: Vec<f64>,
    pub beats_per_bar: u32,
    /// Activity of the song at each frame, in (0, 1); none where it is not known.
    pub activity: Option<Vec<f64>>,
    /// Whether the bars were read from the motion itself, so that its phase has nothing to be held against.
    pub is_of_motion: bool,
}

/// The music of a window.
#[derive(Clone, Debug)]
pub struct MusicWindow<'a> {
    /// Beats from the window's first frame on, s; those before it are negative.
    pub beats_s: Vec<f64>,
    pub bars: &'a [f64],
    pub beats_per_bar: u32,
    pub activity: Option<&'a [f64]>,
    pub is_of_motion: bool,
}

impl PhraseMusic {
    /// Returns the music of `n_frames` frames from `first` on; none where it ends before.
    pub fn window(&self, first: usize, n_frames: usize) -> Option<MusicWindow<'_>> {
        let frames = first..first + n_frames;
        let start_s = crate::units::frames_to_s(first);
        Some(MusicWindow {
            beats_s: self.beats_s.iter().map(|t| t - start_s).collect(),
            bars: self.bars.get(frames.clone())?,
            beats_per_bar: self.beats_per_bar,
            activity: self.activity.as_ref().and_then(|activity| activity.get(frames)),
            is_of_motion: self.is_of_motion,
        })
    }
}

/// A window of motion, and what it was danced to.
#[derive(Clone, Debug)]
pub struct MotionWindow<'a> {
    /// Number of the song; windows of one song are no independent ones.
    pub song: usize,
    /// Number of the phrase, of which there may be several motions.
    pub phrase: usize,
    /// Where in the phrase the window begins.
    pub first_frame: usize,
    pub motion: &'a WindowMeasures,
    /// None for music without beats.
    pub music: Option<MusicWindow<'a>>,
}

/// A number of a set of windows.
#[derive(Clone, Debug, PartialEq)]
pub struct Number {
    pub metric: &'static str,
    /// Which of several ways to measure it; empty where there is one.
    pub variant: String,
    pub unit: &'static str,
    pub estimate: Estimate,
    /// The same of each song, where it is a mean over windows or songs.
    pub by_song: BTreeMap<usize, f64>,
    /// How it was measured, in a few words.
    pub protocol: String,
}

impl Number {
    pub(in crate::evaluation) fn new(
        metric: &'static str,
        variant: impl Into<String>,
        unit: &'static str,
        estimate: Estimate,
        protocol: impl Into<String>,
    ) -> Self {
        let (variant, protocol) = (variant.into(), protocol.into());
        Self { metric, variant, unit, estimate, by_song: BTreeMap::new(), protocol }
    }

    pub(in crate::evaluation) fn with_songs(self, by_song: BTreeMap<usize, f64>) -> Self {
        Self { by_song, ..self }
    }
}

/// Mean over windows that have a value, with songs as clusters, and the mean of each song.
fn mean_over(
    danced: &[MotionWindow],
    value: impl Fn(&MotionWindow) -> Option<f64>,
) -> (Estimate, BTreeMap<usize, f64>) {
    mean_by_song(danced.iter().filter_map(|item| Some((value(item)?, item.song))))
}

/// Mean over values with the number of their songs, with songs as clusters, and the mean of each song.
pub(in crate::evaluation) fn mean_by_song(
    known: impl Iterator<Item = (f64, usize)>,
) -> (Estimate, BTreeMap<usize, f64>) {
    let (values, songs): (Vec<f64>, Vec<usize>) = known.unzip();
    (clustered_mean_estimate(&values, &songs), by_song(&values, &songs))
}

/// Mean of the values of each song.
fn by_song(values: &[f64], songs: &[usize]) -> BTreeMap<usize, f64> {
    let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
    for (value, song) in values.iter().zip(songs) {
        let (sum, n) = sums.entry(*song).or_default();
        *sum += value;
        *n += 1.0;
    }
    sums.into_iter().map(|(song, (sum, n))| (song, sum / n)).collect()
}

/// Returns a variant with the stage of the making of motion that it is of: `strict_raw`, `raw`; plain without one.
fn staged(variant: &str, stage: &str) -> String {
    let parts = [variant, stage].into_iter().filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join("_")
}
