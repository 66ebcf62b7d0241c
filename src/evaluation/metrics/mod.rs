//! The numbers of a set of motions: how far they follow the music, and how they compare with real motion.

mod motion;
mod music;

pub use motion::{of_channels, of_control, of_motion};
pub use music::of_music;

use super::interval::{Estimate, clustered_mean_estimate};
use super::measured::Measured;

/// Seed of all resampling and pairing, so that two evaluations of the same motions agree.
const SEED: u64 = 2026;

/// The music of a motion, from the motion's first frame on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Music {
    /// Beats, s.
    pub beats_s: Vec<f64>,
    /// Bars that had passed at each frame of the song, or of the motion where nothing else is known.
    pub bars: Vec<f64>,
    pub beats_per_bar: u32,
}

/// A motion, and what it was danced to.
#[derive(Clone, Copy, Debug)]
pub struct Danced<'a> {
    /// Number of the song; motions for one song are no independent ones.
    pub song: usize,
    /// Number of the phrase, of which there may be several motions.
    pub phrase: usize,
    pub motion: &'a Measured,
    /// None for music without beats.
    pub music: Option<&'a Music>,
}

/// A number of a set of motions.
#[derive(Clone, Debug, PartialEq)]
pub struct Number {
    pub metric: &'static str,
    /// Which of several ways to measure it; empty where there is one.
    pub variant: String,
    pub unit: &'static str,
    pub estimate: Estimate,
    /// How it was measured, in a few words.
    pub protocol: String,
}

impl Number {
    fn new(
        metric: &'static str,
        variant: impl Into<String>,
        unit: &'static str,
        estimate: Estimate,
        protocol: impl Into<String>,
    ) -> Self {
        Self { metric, variant: variant.into(), unit, estimate, protocol: protocol.into() }
    }
}

/// Mean over motions that have a value, with songs as clusters.
fn mean_over(danced: &[Danced], of: impl Fn(&Danced) -> Option<f64>) -> Estimate {
    let (values, songs): (Vec<f64>, Vec<usize>) =
        danced.iter().filter_map(|item| Some((of(item)?, item.song))).unzip();
    clustered_mean_estimate(&values, &songs)
}
