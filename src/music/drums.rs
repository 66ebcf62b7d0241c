//! Drums: grooves that vary from song to song, fills, and rolls.

use super::parts::{Bar, Feel};
use super::score::{Note, Voice};
use super::style::{Groove, STEPS_PER_BEAT};
use crate::chance::Chance;

/// How likely a song's own groove has a soft hit more, or a hit less, at a step of a voice.
const VARIATION: f64 = 0.05;
/// Pitches of a drummer's toms, high to low.
const TOMS: [u8; 4] = [50, 47, 43, 40];
/// How much of a beat's fill is heard at the begin and at the end of a roll.
const ROLL: (f64, f64) = (0.35, 1.0);

/// How much of the drums plays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Amount {
    Silent,
    /// The lowest drum alone.
    Kick,
    /// All but the lowest drum.
    NoKick,
    Full,
}

/// A groove as a song has it: velocities by voice and step, 0 for a rest.
#[derive(Clone, Debug)]
pub struct Drumming(Vec<(Voice, Vec<f64>)>);

impl Drumming {
    /// Makes a song's own variant; the first beat of the bar stays.
    pub fn of(groove: Groove, chance: &mut Chance) -> Self {
        let vary = |(voice, pattern): &(Voice, &str)| {
            let mut hits: Vec<f64> = pattern.bytes().map(velocity).collect();
            for (step, hit) in hits.iter_mut().enumerate().skip(1) {
                let is_on_beat = step % STEPS_PER_BEAT == 0;
                if chance.uniform() < VARIATION && !is_on_beat {
                    *hit = if *hit == 0.0 { velocity(b'o') } else { 0.0 };
                }
            }
            (*voice, hits)
        };
        Self(groove.iter().map(vary).collect())
    }

    /// Plays a bar up to a step, at which a fill takes over.
    pub fn play(
        &self,
        feel: &Feel,
        bar: Bar,
        amount: Amount,
        until: usize,
        chance: &mut Chance,
        notes: &mut Vec<Note>,
    ) {
        for (voice, hits) in &self.0 {
            let is_heard = match amount {
                Amount::Silent => false,
                Amount::Kick => *voice == Voice::Kick,
                Amount::NoKick => *voice != Voice::Kick,
                Amount::Full => true,
            };
            let heard = hits.iter().enumerate().take(until);
            for (step, &velocity) in heard.filter(|(_, hit)| is_heard && **hit > 0.0) {
                notes.push(feel.hit(*voice, bar, step, velocity, chance));
            }
        }
    }
}

pub(super) fn velocity(letter: u8) -> f64 {
    match letter {
        b'X' => 1.0,
        b'x' => 0.75,
        b'o' => 0.4,
        _ => 0.0,
    }
}

/// The fill of a drummer at the end of four or eight bars.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fill {
    /// Snare in sixteenths, louder and louder.
    Roll,
    /// Down the toms.
    Toms,
    /// Kick and snare in turn, in eighths.
    Flurry,
    /// Three against four.
    Threes,
    /// Nothing: the next bar comes out of silence.
    Stop,
}

impl Fill {
    const ALL: [Self; 5] = [Self::Roll, Self::Toms, Self::Flurry, Self::Threes, Self::Stop];

    /// Draws a fill and its length in beats, at most two thirds of the bar where it is a stop.
    pub fn draw(beats_per_bar: usize, chance: &mut Chance) -> (Self, usize) {
        let fill = Self::ALL[chance.below(Self::ALL.len())];
        let longest = if fill == Self::Stop { 2 } else { beats_per_bar };
        (fill, 1 + chance.below(longest))
    }

    /// Plays the last `n_beats` of a bar.
    pub fn play(
        self,
        feel: &Feel,
        bar: Bar,
        n_beats: usize,
        chance: &mut Chance,
        notes: &mut Vec<Note>,
    ) {
        let n = n_beats * STEPS_PER_BEAT;
        let first = feel.n_steps().saturating_sub(n);
        for i in 0..n {
            let at = i as f64 / n as f64;
            let swell = ROLL.0 + (ROLL.1 - ROLL.0) * at;
            let hit = match self {
                Self::Roll => Some((Voice::Snare, swell)),
                Self::Toms => (i % 2 == 0 || chance.uniform() < 0.5).then_some((Voice::Tom, 0.85)),
                Self::Flurry if i % 2 == 0 => {
                    Some((if i % 4 == 0 { Voice::Kick } else { Voice::Snare }, 0.85))
                }
                Self::Threes if i % 3 == 0 => Some((Voice::Snare, 0.9)),
                Self::Flurry | Self::Threes | Self::Stop => None,
            };
            let Some((voice, velocity)) = hit else { continue };
            let mut note = feel.hit(voice, bar, first + i, velocity, chance);
            if voice == Voice::Tom {
                note.pitch = TOMS[i * TOMS.len() / n];
            }
            notes.push(note);
        }
    }
}

/// Plays a bar of a rise to what follows: eighths in its first bar, sixteenths in its last, louder and louder.
pub fn rise(feel: &Feel, bar: Bar, at: f64, chance: &mut Chance, notes: &mut Vec<Note>) {
    let stride = if at < 0.5 { 2 } else { 1 };
    for step in (0..feel.n_steps()).step_by(stride) {
        let at = at + 0.5 * step as f64 / feel.n_steps() as f64;
        notes.push(feel.hit(Voice::Snare, bar, step, 0.2 + 0.7 * at.min(1.0), chance));
    }
}
