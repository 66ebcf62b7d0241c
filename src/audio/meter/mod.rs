//! Tempo, beats and bars by hypotheses over the whole song.
//!
//! `bands` hears the song at 100 frames per second; `onsets` makes envelopes of it; `tempo` scores every beat
//! period by how alike the song is to itself one, two, four … beats later; `pulse` follows the beats of the best
//! one; `bar` finds how many make a bar, and which is the first. The beats that belong to the 163 features are
//! librosa's and come from [`super::beat`].

mod bands;
mod bar;
mod onsets;
mod places;
mod pulse;
mod tempo;
#[cfg(test)]
mod tests;

use bands::BandPass;
use onsets::Onsets;
use places::Places;

/// Samples between frames.
const HOP: usize = 441;
/// Frames per second: 44,100 / 441.
const RATE_HZ: f64 = 100.0;
/// Fewest beats that are a pulse.
const MIN_BEATS: usize = 4;

/// The beats of a song, and what they are in its bars.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Meter {
    /// Ascending, s; none where there is no pulse.
    pub beat_times_s: Vec<f64>,
    /// How like itself the song is one, two and four beats later: a correlation, about 0 to 1.
    pub salience: f64,
    /// None where no beat stands out as the first.
    pub bar: Option<Bar>,
}

/// How beats make bars.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bar {
    /// 3 or 4.
    pub beats_per_bar: usize,
    /// Index of the first downbeat, below `beats_per_bar`.
    pub first_downbeat: usize,
    /// By how much the evidence for this beat exceeds that for the next best, in standard deviations.
    pub margin: f64,
}

impl Meter {
    /// Returns 60 over the median interval, beats/min; none without beats.
    pub fn tempo_bpm(&self) -> Option<f64> {
        let mut intervals: Vec<f64> =
            self.beat_times_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        intervals.sort_by(f64::total_cmp);
        intervals.get(intervals.len() / 2).map(|interval_s| 60.0 / interval_s)
    }

    /// Returns every beat's time, s, and its number in the bar, 1 on the downbeat.
    pub fn numbered(&self) -> impl Iterator<Item = (f64, Option<i64>)> + '_ {
        let number = |i: usize| {
            let bar = self.bar?;
            let n = bar.beats_per_bar;
            Some(((i + n - bar.first_downbeat) % n + 1) as i64)
        };
        self.beat_times_s.iter().enumerate().map(move |(i, &time_s)| (time_s, number(i)))
    }
}

/// Hears a song block by block.
pub struct MeterPass {
    bands: BandPass,
}

impl MeterPass {
    pub fn new() -> Self {
        Self { bands: BandPass::new() }
    }

    /// Takes the next mono samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        self.bands.push(samples);
    }

    /// Ends the song.
    pub fn finish(self) -> Meter {
        let Some(spectra) = self.bands.finish().compressed() else { return Meter::default() };
        let Some(onsets) = Onsets::of(&spectra) else { return Meter::default() };
        let Some(found) = tempo::find(&onsets) else { return Meter::default() };
        let beats = pulse::follow(&onsets, found.period_frames);
        if beats.len() < MIN_BEATS {
            return Meter::default();
        }
        let beats = pulse::on_the_beat(beats, |halves| Places::at(halves, &spectra, &onsets));
        let bar = bar::find(&Places::at(&beats, &spectra, &onsets), &beats, &spectra);
        Meter {
            beat_times_s: beats.iter().map(|frame| frame / RATE_HZ).collect(),
            salience: found.salience,
            bar,
        }
    }
}

impl Default for MeterPass {
    fn default() -> Self {
        Self::new()
    }
}
