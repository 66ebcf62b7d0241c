//! A piece of music as notes on a grid of beats.

use super::tempo::TempoMap;

/// The instrument of a note.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Voice {
    Kick,
    Snare,
    Clap,
    Rim,
    ClosedHat,
    OpenHat,
    Ride,
    Crash,
    Tom,
    Shaker,
    Bass,
    Chords,
    Pad,
    Melody,
}

impl Voice {
    /// Every voice.
    pub const ALL: [Self; 14] = [
        Self::Kick,
        Self::Snare,
        Self::Clap,
        Self::Rim,
        Self::ClosedHat,
        Self::OpenHat,
        Self::Ride,
        Self::Crash,
        Self::Tom,
        Self::Shaker,
        Self::Bass,
        Self::Chords,
        Self::Pad,
        Self::Melody,
    ];

    /// Returns whether it is a drum or cymbal, whose notes have no length.
    pub fn is_drum(self) -> bool {
        !matches!(self, Self::Bass | Self::Chords | Self::Pad | Self::Melody)
    }
}

/// One note.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Note {
    pub voice: Voice,
    /// From the first beat of the score, in beats.
    pub onset_beats: f64,
    /// In beats; drums ignore it.
    pub duration_beats: f64,
    /// MIDI note number, 69 is A at 440 Hz; of drums only toms have one.
    pub pitch: u8,
    /// Loudness, in (0, 1].
    pub velocity: f32,
    /// How much later than written it is played, in seconds; negative for earlier.
    pub late_s: f64,
}

/// The kind of a section of whole bars in a song.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SectionKind {
    Intro,
    Verse,
    Chorus,
    /// Few voices, often without drums.
    Break,
    Outro,
}

/// A stretch of whole bars.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Section {
    pub kind: SectionKind,
    /// Index of its first bar, from 0.
    pub first_bar: usize,
    pub n_bars: usize,
}

/// One beat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beat {
    /// From the begin of the sound, s.
    pub time_s: f64,
    /// Number in the bar, from 1; 1 is the downbeat.
    pub number: u32,
}

/// A piece of music.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// Name of the style: `house`, `waltz` …
    pub style: &'static str,
    pub beats_per_bar: u32,
    /// Beats before the first downbeat, fewer than a bar has.
    pub pickup_beats: u32,
    pub n_bars: usize,
    /// Time of every beat.
    pub tempo: TempoMap,
    /// In order, without gaps.
    pub sections: Vec<Section>,
    /// Sorted by onset.
    pub notes: Vec<Note>,
}

impl Score {
    /// Returns the number of beats, pickup included.
    pub fn n_beats(&self) -> usize {
        self.pickup_beats as usize + self.n_bars * self.beats_per_bar as usize
    }

    /// Returns every beat with its number in the bar.
    pub fn beats(&self) -> Vec<Beat> {
        let (bar, pickup) = (self.beats_per_bar as usize, self.pickup_beats as usize);
        let number = |beat: usize| (beat + bar - pickup % bar) % bar + 1;
        let beat =
            |i: usize| Beat { time_s: self.tempo.time_s(i as f64), number: number(i) as u32 };
        (0..self.n_beats()).map(beat).collect()
    }

    /// Returns the time at which a note is played, in seconds, at least 0.
    pub fn onset_s(&self, note: &Note) -> f64 {
        (self.tempo.time_s(note.onset_beats) + note.late_s).max(0.0)
    }

    /// Returns when the last bar ends, in seconds; tones may ring on.
    pub fn end_s(&self) -> f64 {
        self.tempo.time_s(self.n_beats() as f64)
    }

    /// Returns the mean tempo, in beats per minute.
    pub fn tempo_bpm(&self) -> f64 {
        60.0 * self.n_beats() as f64 / (self.end_s() - self.tempo.time_s(0.0))
    }
}
