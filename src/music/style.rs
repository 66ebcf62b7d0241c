//! What a style is: tempi, grooves, basses, chords and riffs, as tables.
//!
//! A bar is written in sixteenths, four to a beat. In grooves `.` is a rest, `o` a soft hit, `x` one, `X` an
//! accent. In tonal patterns `-` holds the note before.

use super::score::Voice;
use super::styles;

/// One bar of drums: a pattern for every voice that plays.
pub type Groove = &'static [(Voice, &'static str)];

/// The subdivision that a style swings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SwingGrid {
    Eighths,
    Sixteenths,
}

/// A style of music.
#[derive(Clone, Copy, Debug)]
pub struct Style {
    pub name: &'static str,
    pub beats_per_bar: u32,
    /// Lowest and highest tempo, in beats per minute.
    pub tempo_bpm: (f64, f64),
    pub swung: SwingGrid,
    /// Least and most share of a pair of notes that the first one takes; 0.5 is even.
    pub swing: (f64, f64),
    /// Whether people play it, whose tempo drifts and whose hits are not on the grid to the millisecond.
    pub is_live: bool,
    pub grooves: &'static [Groove],
    /// `1` root, `3` third, `5` fifth, `8` octave, `a` a step before the next root.
    pub basses: &'static [&'static str],
    /// `x` the chord, `0` to `3` one of its tones.
    pub comping: &'static [&'static str],
    /// Chord symbols in C or A minor, a bar each.
    pub loops: &'static [&'static str],
    /// Rhythms of melodies: `x` a note, `X` one that is a tone of the chord.
    pub riffs: &'static [&'static str],
}

impl Style {
    /// Every style.
    pub fn all() -> impl ExactSizeIterator<Item = &'static Style> {
        styles::FOUR.iter().chain(styles::THREE).collect::<Vec<_>>().into_iter()
    }

    /// Steps of a bar, sixteenths.
    pub fn steps_per_bar(&self) -> usize {
        self.beats_per_bar as usize * STEPS_PER_BEAT
    }

    /// Returns where a place on the grid is played, in beats: the second of a pair comes late.
    ///
    /// With s the share of the first, a pair of length L is warped to s·L and (1−s)·L.
    pub fn swing_beats(&self, beats: f64, share: f64) -> f64 {
        let pair = match self.swung {
            SwingGrid::Eighths => 1.0,
            SwingGrid::Sixteenths => 0.5,
        };
        let begin = (beats / pair).floor() * pair;
        let at = (beats - begin) / pair;
        let warped =
            if at < 0.5 { 2.0 * at * share } else { share + (2.0 * at - 1.0) * (1.0 - share) };
        begin + warped * pair
    }
}

/// Sixteenths in a beat.
pub const STEPS_PER_BEAT: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::music::harmony::chord_loop;

    #[test]
    fn tables_are_whole() {
        let n = Style::all().count();
        assert!(n >= 16, "{n} styles");
        for style in Style::all() {
            let steps = style.steps_per_bar();
            let is_bar = |pattern: &str, letters: &str| {
                assert_eq!(pattern.len(), steps, "{}: {pattern}", style.name);
                assert!(pattern.chars().all(|c| letters.contains(c)), "{}: {pattern}", style.name);
            };
            for (_, pattern) in style.grooves.iter().flat_map(|groove| groove.iter()) {
                is_bar(pattern, ".oxX");
            }
            style.basses.iter().for_each(|pattern| is_bar(pattern, ".-1358a"));
            style.comping.iter().for_each(|pattern| is_bar(pattern, ".-x0123"));
            style.riffs.iter().for_each(|pattern| is_bar(pattern, ".-xX"));
            for text in style.loops {
                let bars = chord_loop(text);
                let n_symbols = text.split([' ', ',']).count();
                assert_eq!(bars.iter().map(Vec::len).sum::<usize>(), n_symbols, "{text}");
            }
            assert!(!style.grooves.is_empty() && !style.loops.is_empty(), "{}", style.name);
            let (slowest, fastest) = style.tempo_bpm;
            assert!(70.0 <= slowest && slowest < fastest && fastest <= 180.0, "{}", style.name);
        }
        for beats_per_bar in [3, 4] {
            assert!(Style::all().any(|style| style.beats_per_bar == beats_per_bar));
        }
    }

    #[test]
    fn swing_moves_the_second_of_a_pair() {
        let style = |swung| Style { swung, ..styles::FOUR[0] };
        let found = [0.0, 0.25, 0.5, 0.75, 1.0]
            .map(|beats| style(SwingGrid::Eighths).swing_beats(beats, 0.75));
        assert_eq!(found, [0.0, 0.375, 0.75, 0.875, 1.0]);
        let found = [0.0, 0.25, 0.5, 0.75]
            .map(|beats| style(SwingGrid::Sixteenths).swing_beats(beats, 0.625));
        assert_eq!(found, [0.0, 0.3125, 0.5, 0.8125]);
    }
}
