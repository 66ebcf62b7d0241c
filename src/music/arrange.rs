//! Tunes with accompaniment: count-in, chords, bass, and drums by meter.

use super::abc::{Key, Meter, TICKS_PER_WHOLE, Tune};
use super::drums::velocity;
use super::harmony::{Chord, at_or_above};
use super::score::{Note, Score, Section, SectionKind, Voice};
use super::tempo::{Drift, TempoMap, drifting};
use crate::chance::Chance;

/// Streams of choices, apart from those of composed songs by their seeds.
const PLAN: u64 = 1 << 40;
const PLAY: u64 = PLAN + 1;
const DRIFT: u64 = PLAN + 2;

/// A tune is played again until it has taken so long, in seconds, but not more than so often.
const SHORTEST_S: f64 = 30.0;
const MAX_TIMES: usize = 3;
/// Tempi that are played, in beats per minute.
const TEMPI_BPM: (f64, f64) = (66.0, 184.0);
/// Most that a player is off the grid, in seconds.
const LOOSE_S: f64 = 0.004;
/// Lowest pitches of bass and chords.
const BASS_LOWEST: u8 = 31;
const CHORDS_LOWEST: u8 = 50;
/// Bars that count in.
const COUNT_IN_BARS: usize = 1;

/// Drums of a beat in four parts, and in three, for the first beat of a bar and for others.
type BeatDrums = (Voice, &'static str, &'static str);
const IN_FOUR: [&[BeatDrums]; 4] = [
    &[],
    &[
        (Voice::Kick, "X...", "...."),
        (Voice::Snare, "....", "x..."),
        (Voice::ClosedHat, "x.o.", "x.o."),
    ],
    &[(Voice::Kick, "X...", "x..."), (Voice::Shaker, "x.ox", "x.ox"), (Voice::Rim, "....", "..x.")],
    &[
        (Voice::Kick, "X...", "...."),
        (Voice::ClosedHat, "....", "x..."),
        (Voice::Ride, "x...", "x.o."),
    ],
];
const IN_THREE: [&[BeatDrums]; 4] = [
    &[],
    &[(Voice::Kick, "X..", "..."), (Voice::Snare, "...", "x.o"), (Voice::ClosedHat, "x.o", "x.o")],
    &[(Voice::Kick, "X..", "x.."), (Voice::Shaker, "xox", "xox")],
    &[(Voice::Tom, "X.o", "x.o"), (Voice::Rim, "...", "..x")],
];

/// Gives a tune its accompaniment. The seed decides tempo (where the tune has none), drums and manner.
pub fn arrange(tune: &Tune, seed: u64) -> Score {
    let chance = &mut Chance::new(seed, PLAN);
    let beat_ticks = tune.meter.beat_ticks();
    let per_bar = tune.meter.n_beats() as usize;
    let bpm = tempo_bpm(tune, chance);
    let tune_s = (tune.n_bars * per_bar) as f64 * 60.0 / bpm;
    let n_times = ((SHORTEST_S / tune_s.max(1.0)).ceil() as usize).clamp(1, MAX_TIMES);
    // Bars of two beats are counted in pairs where every part has an even number of them.
    let is_paired = per_bar == 2
        && tune.n_bars.is_multiple_of(2)
        && tune.parts.iter().all(|bar| bar.is_multiple_of(2));
    let count_in = COUNT_IN_BARS * if is_paired { 2 } else { 1 };
    let n_bars = count_in + n_times * tune.n_bars;
    let chords = chords(tune);
    let player = Player {
        per_bar,
        beat_ticks,
        is_compound: tune.meter.is_compound(),
        drums: {
            let grooves = if tune.meter.is_compound() { IN_THREE } else { IN_FOUR };
            grooves[chance.below(grooves.len())]
        },
        is_offbeat: chance.below(2) == 0,
    };
    let mut notes = Vec::new();
    let chance = &mut Chance::new(seed, PLAY);
    for beat in 0..count_in * per_bar {
        notes.push(note(Voice::Rim, beat as f64, 0.25, 60, 0.7, chance));
    }
    for time in 0..n_times {
        let first_bar = count_in + time * tune.n_bars;
        let begin = (first_bar * per_bar) as f64;
        for played in &tune.notes {
            let onset = begin + played.onset as f64 / f64::from(beat_ticks);
            let length = f64::from(played.duration) / f64::from(beat_ticks);
            let is_on_beat = played.onset.rem_euclid(i64::from(beat_ticks)) == 0;
            let loud = if is_on_beat { 0.9 } else { 0.75 };
            if onset >= 0.0 {
                notes.push(note(Voice::Melody, onset, 0.95 * length, played.pitch, loud, chance));
            }
        }
        for bar in 0..tune.n_bars {
            let begin = ((first_bar + bar) * per_bar) as f64;
            player.bar(&chords[2 * bar..2 * bar + 2], begin, chance, &mut notes);
        }
    }
    notes.sort_by(|a, b| a.onset_beats.total_cmp(&b.onset_beats).then(a.voice.cmp(&b.voice)));
    let chance = &mut Chance::new(seed, DRIFT);
    let drift = if chance.below(2) == 0 {
        Drift::Wander { share: 0.005 + 0.015 * chance.uniform() }
    } else {
        Drift::Steady
    };
    let tempi_bpm = drifting(bpm, n_bars * per_bar, drift, chance);
    let pair = if is_paired { 2 } else { 1 };
    let section = |kind, first_bar, n_bars| Section { kind, first_bar, n_bars };
    Score {
        style: "tune",
        beats_per_bar: (per_bar * pair) as u32,
        pickup_beats: 0,
        n_bars: n_bars / pair,
        tempo: TempoMap::new(0.1 + 0.3 * chance.uniform(), &tempi_bpm),
        sections: vec![
            section(SectionKind::Intro, 0, count_in / pair),
            section(SectionKind::Verse, count_in / pair, (n_bars - count_in) / pair),
        ],
        notes,
    }
}

/// Returns the tempo of a tune, in beats per minute: what it says, else what such tunes have, by a tenth more or less.
fn tempo_bpm(tune: &Tune, chance: &mut Chance) -> f64 {
    let Meter { numerator, denominator } = tune.meter;
    let usual = match (numerator, denominator) {
        (3, 4) if tune.rhythm.contains("waltz") => 150.0,
        (3, 8) => 150.0,
        (3, _) => 120.0,
        (2, 2) => 104.0,
        (4, _) if tune.rhythm.contains("reel") => 176.0,
        _ => 114.0,
    };
    let drawn = usual * (0.9 + 0.2 * chance.uniform());
    let said = tune.tempo.map(|tempo| {
        tempo.per_minute * f64::from(tempo.ticks) / f64::from(tune.meter.beat_ticks())
    });
    said.unwrap_or(drawn).clamp(TEMPI_BPM.0, TEMPI_BPM.1)
}

fn note(
    voice: Voice,
    onset_beats: f64,
    duration_beats: f64,
    pitch: u8,
    velocity: f64,
    chance: &mut Chance,
) -> Note {
    Note {
        voice,
        onset_beats,
        duration_beats,
        pitch,
        velocity: (velocity * (0.9 + 0.2 * chance.uniform())).clamp(0.05, 1.0) as f32,
        late_s: (2.0 * chance.uniform() - 1.0) * LOOSE_S,
    }
}

/// The accompaniment of a melody.
struct Player {
    per_bar: usize,
    beat_ticks: u32,
    is_compound: bool,
    drums: &'static [BeatDrums],
    /// Whether chords come after the beat, or on all but the first.
    is_offbeat: bool,
}

impl Player {
    /// Plays a bar over the chords of its halves.
    fn bar(&self, chords: &[Chord], begin: f64, chance: &mut Chance, notes: &mut Vec<Note>) {
        let parts = if self.is_compound { 3.0 } else { 4.0 };
        // In quick beats, such as quavers, sixteenths would be a blur.
        let is_quick = self.beat_ticks < TICKS_PER_WHOLE / 4;
        for beat in 0..self.per_bar {
            let at = begin + beat as f64;
            for (voice, first, other) in self.drums {
                let pattern = if beat == 0 { first } else { other };
                for (i, letter) in pattern.bytes().enumerate() {
                    let loud = 0.8 * velocity(letter);
                    if loud > 0.0 && (i == 0 || !is_quick) {
                        let onset = at + i as f64 / parts;
                        notes.push(note(*voice, onset, 0.2, 45, loud, chance));
                    }
                }
            }
            let Some(chord) = chords.get(beat * chords.len() / self.per_bar) else { continue };
            let is_new_half = beat == 0 || (self.per_bar == 4 && beat == 2);
            if is_new_half {
                let root = at_or_above(chord.bass, BASS_LOWEST);
                let fifth = at_or_above((chord.root + 7) % 12, BASS_LOWEST);
                let pitch = if beat == 0 { root } else { fifth };
                notes.push(note(Voice::Bass, at, 0.9, pitch, 0.85, chance));
            }
            let offbeat = if self.is_compound { 2.0 / 3.0 } else { 0.5 };
            let strum = match (self.is_offbeat && self.per_bar != 3, beat) {
                (true, _) => Some(at + offbeat),
                (false, 0) => None,
                (false, _) => Some(at),
            };
            if let Some(onset) = strum {
                for pitch in chord.voiced(CHORDS_LOWEST) {
                    notes.push(note(Voice::Chords, onset, 0.4, pitch, 0.6, chance));
                }
            }
        }
    }
}

/// Returns the chord of every half bar: those that the tune has, or else the triads of the key that fit best.
fn chords(tune: &Tune) -> Vec<Chord> {
    let half = i64::from(tune.meter.ticks()) / 2;
    let mut given = tune.chords.iter().peekable();
    let mut held: Option<Chord> = None;
    let candidates = triads(tune.key);
    let mut found: Vec<Chord> = Vec::with_capacity(2 * tune.n_bars);
    for bar in 0..tune.n_bars as i64 {
        let (begin, end) = (2 * bar * half, (2 * bar + 2) * half);
        let guessed = if tune.chords.is_empty() {
            let is_last = bar + 1 == tune.n_bars as i64;
            guess(tune, &candidates, begin, end, is_last)
        } else {
            candidates[0]
        };
        for i in 0..2 {
            while let Some((_, chord)) = given.next_if(|(at, _)| *at < begin + (i + 1) * half) {
                held = Some(*chord);
            }
            found.push(held.unwrap_or(guessed));
        }
    }
    found
}

/// Returns triads of a key, the usual ones first: I IV V vi ii, or i VII iv VI III v.
fn triads(key: Key) -> Vec<Chord> {
    let major: &'static [u8] = &[0, 4, 7];
    let minor: &'static [u8] = &[0, 3, 7];
    let degrees: &[(u8, &'static [u8])] = if key.is_minor {
        &[(0, minor), (10, major), (5, minor), (8, major), (3, major), (7, minor)]
    } else {
        &[(0, major), (7, major), (5, major), (9, minor), (2, minor), (10, major)]
    };
    let chord = |(above, intervals): &(u8, &'static [u8])| {
        let root = (key.tonic + above) % 12;
        Chord { root, intervals, bass: root }
    };
    degrees.iter().map(chord).collect()
}

/// Returns the triad that has most of a bar's notes, by their lengths; the tonic at the end.
fn guess(tune: &Tune, candidates: &[Chord], begin: i64, end: i64, is_last: bool) -> Chord {
    if is_last {
        return candidates[0];
    }
    let in_bar = tune.notes.iter().filter(|note| (begin..end).contains(&note.onset));
    let sounds: Vec<_> = in_bar.collect();
    let fit = |(i, chord): (usize, &Chord)| {
        let weight: i64 = sounds
            .iter()
            .filter(|note| chord.has(note.pitch))
            .map(|note| {
                // The first note of a bar tells most.
                i64::from(note.duration) * if note.onset == begin { 2 } else { 1 }
            })
            .sum();
        // The usual triads come first, and win where notes do not decide.
        weight * 20 - weight * i as i64
    };
    let best = candidates
        .iter()
        .enumerate()
        .max_by_key(|candidate| (fit(*candidate), -(candidate.0 as i64)));
    best.map_or(candidates[0], |(_, chord)| *chord)
}
