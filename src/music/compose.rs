//! Songs from a seed: style, tempo, key and form, and what every bar plays.

use super::drums::{Amount, Drumming, Fill, rise};
use super::harmony::{Chord, chord_loop};
use super::parts::{Bar, Feel, Riff, bass, comping, pad};
use super::score::{Note, Score, Section, SectionKind, Voice};
use super::style::{STEPS_PER_BEAT, Style};
use super::tempo::{Drift, TempoMap, drifting};
use crate::chance::Chance;

/// Streams of choices of a song, so that a change to one part leaves the others alone.
const PLAN: u64 = 0;
const TEMPO: u64 = 1;
const DRUMS: u64 = 2;
const TONES: u64 = 3;
const MELODY: u64 = 4;
/// The order of styles, a stream of a round and not of a song.
const ORDER: u64 = 5;
const N_STREAMS: u64 = 8;

/// Shortest and longest length that a song aims at, in seconds.
const LENGTH_S: (f64, f64) = (44.0, 76.0);
/// Silence before the first beat, in seconds.
const LEAD_S: (f64, f64) = (0.05, 0.6);
/// Most that a drummer is off the grid, in seconds.
const LOOSE_S: f64 = 0.003;
/// How much a drummer's tempo wanders.
const WANDER: (f64, f64) = (0.004, 0.03);
/// How much slower or faster a song ends than it began, half of it.
const RAMP: (f64, f64) = (0.02, 0.06);
/// How much slower a song is at its end.
const SLOWING: (f64, f64) = (0.1, 0.3);

/// Longest song that is composed, in seconds: the length that it aims at, rounded to four bars, and slowing.
pub const MAX_SONG_S: f64 = 110.0;

/// Returns the style of a song and the tempo that it is in, in beats per minute, without composing it.
pub fn heading(seed: u64, index: u64) -> (&'static str, f64) {
    let style = style_of(seed, index);
    (style.name, tempo(style, &mut stream(seed, index, TEMPO)).0)
}

fn stream(seed: u64, index: u64, part: u64) -> Chance {
    Chance::new(seed, index.wrapping_mul(N_STREAMS).wrapping_add(part))
}

/// Composes song number `index` of a seed.
///
/// Songs take turns: each of [`Style::all`] comes once in as many songs as there are styles.
pub fn compose(seed: u64, index: u64) -> Score {
    let stream = |part: u64| stream(seed, index, part);
    let style = style_of(seed, index);
    let mut tempo_chance = stream(TEMPO);
    let (bpm, drift) = tempo(style, &mut tempo_chance);
    let song = SongPlan::draw(style, bpm, &mut stream(PLAN));
    let n_bars = song.sections.iter().map(|planned| planned.section.n_bars).sum();
    let n_beats = song.pickup_beats + n_bars * style.beats_per_bar as usize;
    let tempi_bpm = drifting(bpm, n_beats, drift, &mut tempo_chance);
    let mut notes = song.drums(&mut stream(DRUMS));
    notes.append(&mut song.tones(&mut stream(TONES)));
    notes.append(&mut song.melody(&mut stream(MELODY)));
    notes.sort_by(|a, b| a.onset_beats.total_cmp(&b.onset_beats).then(a.voice.cmp(&b.voice)));
    Score {
        style: style.name,
        beats_per_bar: style.beats_per_bar,
        pickup_beats: song.pickup_beats as u32,
        n_bars,
        tempo: TempoMap::new(between(LEAD_S, &mut tempo_chance), &tempi_bpm),
        sections: song.sections.iter().map(|planned| planned.section).collect(),
        notes,
    }
}

/// Returns the style of a song: every round of songs has every style, in an order of its own.
fn style_of(seed: u64, index: u64) -> &'static Style {
    let mut styles: Vec<&'static Style> = Style::all().collect();
    let n = styles.len();
    let round = index / n as u64;
    stream(seed, round, ORDER).shuffle(&mut styles);
    styles[index as usize % n]
}

fn between((low, high): (f64, f64), chance: &mut Chance) -> f64 {
    low + (high - low) * chance.uniform()
}

fn one_of<T: Copy>(values: &[T], chance: &mut Chance) -> Option<T> {
    values.get(chance.below(values.len())).copied()
}

/// Draws the tempo of a song, in beats per minute, and how it moves.
fn tempo(style: &Style, chance: &mut Chance) -> (f64, Drift) {
    let exact = between(style.tempo_bpm, chance);
    // Machines are mostly set to whole numbers.
    let bpm = if style.is_live || chance.below(4) == 0 { exact } else { exact.round() };
    let sign = if chance.below(2) == 0 { 1.0 } else { -1.0 };
    let drift = match (style.is_live, chance.below(10)) {
        (true, 0..=4) => Drift::Wander { share: between(WANDER, chance) },
        (_, 5) => Drift::Ramp { share: sign * between(RAMP, chance) },
        (true, 6) => Drift::Slowing { share: between(SLOWING, chance) },
        _ => Drift::Steady,
    };
    (bpm, drift)
}

/// The layers that play in a section.
#[derive(Clone, Copy, Debug)]
struct Layers {
    drums: Amount,
    bass: bool,
    chords: bool,
    pad: bool,
    melody: bool,
}

/// A section as it is going to be played.
#[derive(Clone, Debug)]
struct SectionPlan {
    section: Section,
    layers: Layers,
    loudness: f64,
    /// Whether its last bars rise to the next section.
    rises: bool,
}

/// The decisions on a song before its first note.
#[derive(Clone, Debug)]
struct SongPlan {
    style: &'static Style,
    key: u8,
    swing: f64,
    loose_s: f64,
    pickup_beats: usize,
    /// Bars from fill to fill.
    fill_every: usize,
    /// Chords of verses and of choruses, a bar each.
    loops: [Vec<Vec<Chord>>; 2],
    sections: Vec<SectionPlan>,
}

impl SongPlan {
    fn draw(style: &'static Style, bpm: f64, chance: &mut Chance) -> Self {
        let key = chance.below(12) as u8;
        let transposed = |bars: Vec<Vec<Chord>>| -> Vec<Vec<Chord>> {
            let bar = |bar: Vec<Chord>| bar.into_iter().map(|c| c.transposed(key)).collect();
            bars.into_iter().map(bar).collect()
        };
        let verse = transposed(chord_loop(one_of(style.loops, chance).unwrap_or("C")));
        let chorus = if chance.below(2) == 0 {
            verse.clone()
        } else {
            transposed(chord_loop(one_of(style.loops, chance).unwrap_or("C")))
        };
        let bar = style.beats_per_bar as usize;
        let bar_s = 60.0 / bpm * bar as f64;
        let n_fours = (between(LENGTH_S, chance) / bar_s / 4.0).round().max(4.0) as usize;
        Self {
            style,
            key,
            swing: between(style.swing, chance),
            loose_s: if style.is_live { LOOSE_S } else { 0.0 },
            pickup_beats: if chance.below(4) == 0 { 1 + chance.below(bar - 1) } else { 0 },
            fill_every: if chance.below(3) == 0 { 8 } else { 4 },
            loops: [verse, chorus],
            sections: sections(n_fours, chance),
        }
    }

    fn feel(&self) -> Feel<'static> {
        Feel { style: self.style, swing: self.swing, loose_s: self.loose_s }
    }

    /// Returns the bars of a section, each with its number in the section.
    fn bars(&self, planned: &SectionPlan) -> impl Iterator<Item = (usize, Bar)> + use<> {
        let bar_beats = self.style.beats_per_bar as usize;
        let begin = self.pickup_beats + planned.section.first_bar * bar_beats;
        let loudness = planned.loudness;
        (0..planned.section.n_bars)
            .map(move |i| (i, Bar { begin_beats: (begin + i * bar_beats) as f64, loudness }))
    }

    /// Returns the chords of a bar of a section.
    fn chords(&self, section: Section, bar: usize) -> &[Chord] {
        let chords = &self.loops[usize::from(section.kind == SectionKind::Chorus)];
        &chords[bar % chords.len()]
    }

    fn drums(&self, chance: &mut Chance) -> Vec<Note> {
        let (feel, n_steps) = (self.feel(), self.style.steps_per_bar());
        let mut notes = Vec::new();
        let groove = |chance: &mut Chance| {
            Drumming::of(one_of(self.style.grooves, chance).unwrap_or_default(), chance)
        };
        let grooves = [groove(chance), groove(chance)];
        if self.pickup_beats > 0 {
            let first = (self.style.beats_per_bar as usize - self.pickup_beats) as f64;
            let bar = Bar {
                begin_beats: self.pickup_beats as f64 - self.style.beats_per_bar as f64,
                loudness: 0.9,
            };
            let voice = one_of(&[Voice::Snare, Voice::Tom, Voice::ClosedHat], chance);
            let voice = voice.unwrap_or(Voice::Snare);
            for step in (first as usize * STEPS_PER_BEAT..n_steps).step_by(2) {
                if step % STEPS_PER_BEAT == 0 || chance.below(2) == 0 {
                    notes.push(feel.hit(voice, bar, step, 0.8, chance));
                }
            }
        }
        for planned in &self.sections {
            let (section, amount) = (planned.section, planned.layers.drums);
            let groove = &grooves[usize::from(section.kind == SectionKind::Chorus)];
            for (i, bar) in self.bars(planned) {
                let is_last = i + 1 == section.n_bars;
                let left = section.n_bars - i;
                if planned.rises && left <= 2 {
                    let at = if left == 2 { 0.0 } else { 0.5 };
                    rise(&feel, bar, at, chance, &mut notes);
                    continue;
                }
                let is_fill = amount == Amount::Full
                    && ((i + 1).is_multiple_of(self.fill_every) || is_last)
                    && chance.below(4) > 0;
                if is_fill {
                    let (fill, n_beats) = Fill::draw(self.style.beats_per_bar as usize, chance);
                    let until = n_steps - n_beats * STEPS_PER_BEAT;
                    groove.play(&feel, bar, amount, until, chance, &mut notes);
                    fill.play(&feel, bar, n_beats, chance, &mut notes);
                } else {
                    groove.play(&feel, bar, amount, n_steps, chance, &mut notes);
                }
                let is_new = i == 0 && amount == Amount::Full && chance.below(3) > 0;
                if is_new {
                    notes.push(feel.hit(Voice::Crash, bar, 0, 0.8, chance));
                }
            }
        }
        notes
    }

    fn tones(&self, chance: &mut Chance) -> Vec<Note> {
        let feel = self.feel();
        let mut notes = Vec::new();
        let draw = |chance: &mut Chance| {
            let bass = one_of(self.style.basses, chance).unwrap_or_default();
            (bass, one_of(self.style.comping, chance).unwrap_or_default())
        };
        let patterns = [draw(chance), draw(chance)];
        for planned in &self.sections {
            let (section, layers) = (planned.section, planned.layers);
            let (low, middle) = patterns[usize::from(section.kind == SectionKind::Chorus)];
            for (i, bar) in self.bars(planned) {
                let chords = self.chords(section, i);
                let next = self.chords(section, i + 1).first().copied();
                if layers.bass {
                    bass(&feel, bar, low, (chords, next), chance, &mut notes);
                }
                if layers.chords {
                    comping(&feel, bar, middle, chords, chance, &mut notes);
                }
                if layers.pad {
                    pad(&feel, bar, chords, chance, &mut notes);
                }
            }
        }
        notes
    }

    fn melody(&self, chance: &mut Chance) -> Vec<Note> {
        let feel = self.feel();
        let mut notes = Vec::new();
        let riffs = [(); 2].map(|()| Riff::draw(self.style, self.key, chance));
        for planned in self.sections.iter().filter(|planned| planned.layers.melody) {
            let section = planned.section;
            let Some(riff) = &riffs[usize::from(section.kind == SectionKind::Chorus)] else {
                continue;
            };
            for (i, bar) in self.bars(planned) {
                riff.play(&feel, bar, i, self.chords(section, i), chance, &mut notes);
            }
        }
        notes
    }
}

/// Draws the sections of a song of `n_fours` times four bars.
fn sections(n_fours: usize, chance: &mut Chance) -> Vec<SectionPlan> {
    use SectionKind::{Break, Chorus, Intro, Outro, Verse};
    let mut kinds = vec![(Intro, 1)];
    let mut left = n_fours.saturating_sub(2).max(1);
    let turns: &[SectionKind] = one_of(
        &[
            &[Verse, Chorus, Break, Chorus][..],
            &[Verse, Chorus, Verse, Chorus, Break, Chorus],
            &[Chorus, Verse, Break, Chorus],
            &[Verse, Break, Chorus, Verse],
        ],
        chance,
    )
    .unwrap_or(&[Verse]);
    for &kind in turns.iter().cycle() {
        if left == 0 {
            break;
        }
        let wanted = if kind == Break { 1 } else { 1 + chance.below(2) };
        let n = wanted.min(left);
        kinds.push((kind, n));
        left -= n;
    }
    kinds.push((Outro, 1));
    let mut first_bar = 0;
    let planned = |(i, &(kind, n)): (usize, &(SectionKind, usize))| {
        let section = Section { kind, first_bar, n_bars: 4 * n };
        first_bar += section.n_bars;
        let leads_to_chorus = kinds.get(i + 1).is_some_and(|(kind, _)| *kind == Chorus);
        let (layers, loudness) = layers(kind, chance);
        let rises = kind == Break && leads_to_chorus && chance.below(2) == 0;
        SectionPlan { section, layers, loudness, rises }
    };
    kinds.iter().enumerate().map(planned).collect()
}

/// Draws what plays in a section, and how loud.
fn layers(kind: SectionKind, chance: &mut Chance) -> (Layers, f64) {
    let mut likely = |percent: usize| chance.below(100) < percent;
    let layers = match kind {
        SectionKind::Intro | SectionKind::Outro => {
            let drums = if likely(70) { Amount::Full } else { Amount::NoKick };
            let is_tonal = likely(50);
            Layers {
                drums: if is_tonal && likely(30) { Amount::Silent } else { drums },
                bass: likely(40),
                chords: is_tonal,
                pad: likely(20),
                melody: likely(15),
            }
        }
        SectionKind::Verse => Layers {
            drums: Amount::Full,
            bass: likely(90),
            chords: likely(85),
            pad: likely(20),
            melody: likely(65),
        },
        SectionKind::Chorus => Layers {
            drums: Amount::Full,
            bass: true,
            chords: likely(92),
            pad: likely(50),
            melody: likely(80),
        },
        SectionKind::Break => Layers {
            drums: if likely(40) {
                Amount::Silent
            } else if likely(50) {
                Amount::Kick
            } else {
                Amount::NoKick
            },
            bass: likely(30),
            chords: likely(80),
            pad: likely(60),
            melody: likely(50),
        },
    };
    let loudness = match kind {
        SectionKind::Chorus => 1.0,
        SectionKind::Verse => 0.85,
        SectionKind::Intro | SectionKind::Outro => 0.8,
        SectionKind::Break => 0.65,
    };
    (layers, loudness)
}
