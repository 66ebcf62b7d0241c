//! Bass, chords and melody of a bar, and how players place notes.

use super::harmony::{Chord, at_or_above, scale};
use super::score::{Note, Voice};
use super::style::{STEPS_PER_BEAT, Style};
use crate::chance::Chance;

/// Lowest pitches of bass, chords and melody.
const BASS_LOWEST: u8 = 28;
const CHORDS_LOWEST: u8 = 53;
const MELODY: (u8, u8) = (60, 86);
/// Pitch classes of melodies above the key.
const DIATONIC: &[u8] = &[0, 2, 4, 5, 7, 9, 11];
const PENTATONIC: &[u8] = &[0, 2, 4, 7, 9];
/// How much of its steps a tone sounds that is not held.
const DETACHED: f64 = 0.85;
/// Players of tones are looser than drummers by this.
const TONE_LOOSENESS: f64 = 2.0;

/// Where notes of a style are played.
#[derive(Clone, Copy, Debug)]
pub struct Feel<'a> {
    pub style: &'a Style,
    /// Share of a pair that its first note takes.
    pub swing: f64,
    /// Most that a drummer is off the grid, in seconds.
    pub loose_s: f64,
}

/// A bar under way.
#[derive(Clone, Copy, Debug)]
pub struct Bar {
    /// Beat at which it begins.
    pub begin_beats: f64,
    /// How loud the section is, in (0, 1].
    pub loudness: f64,
}

impl Feel<'_> {
    /// Returns the steps of a bar.
    pub fn n_steps(&self) -> usize {
        self.style.steps_per_bar()
    }

    fn place(&self, bar: Bar, step: usize) -> f64 {
        let beats = step as f64 / STEPS_PER_BEAT as f64;
        bar.begin_beats + self.style.swing_beats(beats, self.swing)
    }

    fn velocity(bar: Bar, velocity: f64, chance: &mut Chance) -> f32 {
        let varied = velocity * bar.loudness * (0.92 + 0.16 * chance.uniform());
        varied.clamp(0.02, 1.0) as f32
    }

    /// Returns a hit of a drum at a step of a bar.
    pub fn hit(
        &self,
        voice: Voice,
        bar: Bar,
        step: usize,
        velocity: f64,
        chance: &mut Chance,
    ) -> Note {
        Note {
            voice,
            onset_beats: self.place(bar, step),
            duration_beats: 0.25,
            pitch: 43,
            velocity: Self::velocity(bar, velocity, chance),
            late_s: (2.0 * chance.uniform() - 1.0) * self.loose_s,
        }
    }

    /// Returns a tone over some steps of a bar.
    fn tone(
        &self,
        voice: Voice,
        bar: Bar,
        over: ToneSteps,
        pitch: u8,
        chance: &mut Chance,
    ) -> Note {
        let onset_beats = self.place(bar, over.step);
        let whole = self.place(bar, over.step + over.n_steps) - onset_beats;
        Note {
            voice,
            onset_beats,
            duration_beats: if over.n_steps > 1 { whole } else { whole * DETACHED },
            pitch,
            velocity: Self::velocity(bar, over.velocity, chance),
            late_s: (2.0 * chance.uniform() - 1.0) * self.loose_s * TONE_LOOSENESS,
        }
    }
}

/// The steps of a tone.
#[derive(Clone, Copy, Debug, PartialEq)]
struct ToneSteps {
    step: usize,
    n_steps: usize,
    velocity: f64,
}

/// Returns the tones of a pattern with their letters: `-` goes on with the one before.
fn tones(pattern: &str) -> Vec<(ToneSteps, u8)> {
    let mut found: Vec<(ToneSteps, u8)> = Vec::new();
    let mut is_held = false;
    for (step, letter) in pattern.bytes().enumerate() {
        match (letter, found.last_mut()) {
            (b'-', Some((over, _))) if is_held => over.n_steps += 1,
            (b'-' | b'.', _) => is_held = false,
            _ => {
                let velocity = if step % STEPS_PER_BEAT == 0 { 0.9 } else { 0.75 };
                found.push((ToneSteps { step, n_steps: 1, velocity }, letter));
                is_held = true;
            }
        }
    }
    found
}

/// Returns the chord at a step of a bar that has one or more.
pub fn chord_at(chords: &[Chord], step: usize, n_steps: usize) -> Option<Chord> {
    chords.get(step * chords.len() / n_steps.max(1)).copied()
}

/// Plays a bar of bass.
pub fn bass(
    feel: &Feel,
    bar: Bar,
    pattern: &str,
    (chords, next): (&[Chord], Option<Chord>),
    chance: &mut Chance,
    notes: &mut Vec<Note>,
) {
    for (over, letter) in tones(pattern) {
        let Some(chord) = chord_at(chords, over.step, feel.n_steps()) else { continue };
        let root = at_or_above(chord.bass, BASS_LOWEST);
        let above = |i: usize| chord.root + chord.intervals.get(i).copied().unwrap_or(7);
        let pitch = match letter {
            b'3' => at_or_above(above(1) % 12, root),
            b'5' => at_or_above((chord.root + 7) % 12, root),
            b'8' => root + 12,
            b'a' => next.map_or(root, |next| at_or_above(next.bass, BASS_LOWEST) - 1),
            _ => root,
        };
        notes.push(feel.tone(Voice::Bass, bar, over, pitch, chance));
    }
}

/// Plays a bar of chords.
pub fn comping(
    feel: &Feel,
    bar: Bar,
    pattern: &str,
    chords: &[Chord],
    chance: &mut Chance,
    notes: &mut Vec<Note>,
) {
    for (over, letter) in tones(pattern) {
        let Some(chord) = chord_at(chords, over.step, feel.n_steps()) else { continue };
        let voiced = chord.voiced(CHORDS_LOWEST);
        let one = letter.checked_sub(b'0').map(usize::from).filter(|i| *i < 10);
        let over =
            ToneSteps { velocity: over.velocity * if one.is_some() { 0.9 } else { 0.7 }, ..over };
        for (i, &pitch) in voiced.iter().enumerate() {
            if one.is_none_or(|tone| tone % voiced.len() == i) {
                notes.push(feel.tone(Voice::Chords, bar, over, pitch, chance));
            }
        }
    }
}

/// Plays the chords of a bar, held.
pub fn pad(feel: &Feel, bar: Bar, chords: &[Chord], chance: &mut Chance, notes: &mut Vec<Note>) {
    for (i, chord) in chords.iter().enumerate() {
        let step = i * feel.n_steps() / chords.len();
        let end = (i + 1) * feel.n_steps() / chords.len();
        let over = ToneSteps { step, n_steps: end - step, velocity: 0.5 };
        for pitch in chord.voiced(CHORDS_LOWEST + 5) {
            notes.push(feel.tone(Voice::Pad, bar, over, pitch, chance));
        }
    }
}

/// A melody of some bars that is played again over other chords.
#[derive(Clone, Debug)]
pub struct Riff {
    /// Of every bar: the tones, whether each belongs to the chord, and its place in the scale.
    bars: Vec<Vec<(ToneSteps, bool, usize)>>,
    scale: Vec<u8>,
}

impl Riff {
    /// Bars of a riff, one after the other: the same again, or something else.
    const FORMS: [&[usize]; 5] =
        [&[0, 0, 0, 1], &[0, 1, 0, 2], &[0, 0, 1, 1], &[0, 1, 0, 1], &[0, 1, 2, 1]];

    /// Draws a riff in a key.
    pub fn draw(style: &Style, key: u8, chance: &mut Chance) -> Option<Self> {
        let classes = if chance.below(3) == 0 { DIATONIC } else { PENTATONIC };
        let scale = scale(key, classes, MELODY.0, MELODY.1);
        let mut at = scale.len() / 4 + chance.below(scale.len() / 3);
        let mut motif = || {
            let pattern = style.riffs.get(chance.below(style.riffs.len()))?;
            let mut placed = Vec::new();
            for (over, letter) in tones(pattern) {
                // Steps of the scale mostly, leaps sometimes, back from the edges.
                let leap = if chance.below(5) == 0 { 4 } else { 2 };
                let to = (at + chance.below(2 * leap + 1)).saturating_sub(leap);
                at = to.clamp(1, scale.len().saturating_sub(2));
                placed.push((over, letter == b'X', at));
            }
            Some(placed)
        };
        let motifs = [motif()?, motif()?, motif()?];
        let form = Self::FORMS[chance.below(Self::FORMS.len())];
        let bars = form.iter().map(|i| motifs[*i].clone()).collect();
        Some(Self { bars, scale })
    }

    /// Plays a bar.
    pub fn play(
        &self,
        feel: &Feel,
        bar: Bar,
        index: usize,
        chords: &[Chord],
        chance: &mut Chance,
        notes: &mut Vec<Note>,
    ) {
        let Some(placed) = self.bars.get(index % self.bars.len().max(1)) else { return };
        for &(over, is_of_chord, place) in placed {
            let Some(&written) = self.scale.get(place) else { continue };
            let chord = chord_at(chords, over.step, feel.n_steps());
            let pitch = match chord.filter(|_| is_of_chord) {
                // The nearest tone of the chord; no tone is more than six semitones away.
                Some(chord) => (0..7)
                    .flat_map(|i| [written - i, written + i])
                    .find(|pitch| chord.has(*pitch))
                    .unwrap_or(written),
                None => written,
            };
            notes.push(feel.tone(Voice::Melody, bar, over, pitch, chance));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_hold_and_rest() {
        let found: Vec<_> =
            tones("-1--.-5.").iter().map(|(o, l)| (o.step, o.n_steps, *l)).collect();
        assert_eq!(found, [(1, 3, b'1'), (6, 1, b'5')]);
    }

    #[test]
    fn a_bar_of_bass_and_chords() {
        let style = Style::all().next().expect("a style");
        let feel = Feel { style, swing: 0.5, loose_s: 0.0 };
        let bar = Bar { begin_beats: 8.0, loudness: 1.0 };
        let chords: Vec<Chord> = ["Am", "F"].iter().filter_map(|s| Chord::parse(s)).collect();
        let (mut notes, mut chance) = (Vec::new(), Chance::new(0, 0));
        bass(&feel, bar, "1---5-8-1-3-..a-", (&chords, Chord::parse("G")), &mut chance, &mut notes);
        let found: Vec<_> =
            notes.iter().map(|n| (n.onset_beats, n.duration_beats, n.pitch)).collect();
        let expected = [
            (8.0, 1.0, 33),
            (9.0, 0.5, 40),
            (9.5, 0.5, 45),
            (10.0, 0.5, 29),
            (10.5, 0.5, 33),
            (11.5, 0.5, 30),
        ];
        assert_eq!(found, expected);
        notes.clear();
        comping(&feel, bar, "x-......1.......", &chords, &mut chance, &mut notes);
        let found: Vec<_> = notes.iter().map(|n| (n.onset_beats, n.pitch)).collect();
        assert_eq!(found, [(8.0, 57), (8.0, 60), (8.0, 64), (10.0, 57)]);
    }
}
