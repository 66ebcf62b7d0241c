//! Our own voices: a score becomes samples.
//!
//! Every song has an ensemble of its own: timbres, envelopes, levels, equalisation, room, saturation and noise are
//! drawn from a seed. Notes begin on the sample that is nearest to their onset.

mod desk;
mod drum;
mod filter;
mod patch;
mod tone;
mod wave;

use super::score::{Note, Score, Voice};
use crate::audio::SAMPLE_RATE_HZ;
use crate::chance::Chance;
use desk::{Bus, Desk};
use drum::DrumKit;
use patch::Patch;

/// Longest music that is rendered, in seconds.
pub const MAX_DURATION_S: f64 = 600.0;
/// How long tones ring after the last bar, in seconds.
const TAIL_S: f64 = 1.2;

/// Streams of choices of an ensemble.
const STREAM: u64 = 0x5_0000_0000;

/// The sampling rate, as a factor.
const RATE_HZ: f64 = SAMPLE_RATE_HZ as f64;

/// Why a score has no sound.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RenderError {
    #[error(
        "takes {duration_s:.0} s, and music of up to {MAX_DURATION_S:.0} s is rendered; give it a faster tempo or \
         fewer repeats"
    )]
    TooLong { duration_s: f64 },
}

/// Returns how many samples a score takes, with what rings on.
///
/// # Errors
/// [`RenderError::TooLong`].
pub fn n_samples(score: &Score) -> Result<usize, RenderError> {
    let duration_s = score.end_s() + TAIL_S;
    if duration_s.is_finite() && duration_s <= MAX_DURATION_S {
        return Ok((duration_s * RATE_HZ).ceil() as usize);
    }
    Err(RenderError::TooLong { duration_s })
}

/// Returns the sample on which a note begins.
pub fn onset_sample(score: &Score, note: &Note) -> usize {
    (score.onset_s(note) * RATE_HZ).round() as usize
}

/// Returns the sample on which a note is let go.
pub fn release_sample(score: &Score, note: &Note) -> usize {
    let end_s = score.tempo.time_s(note.onset_beats + note.duration_beats) + note.late_s;
    (end_s.max(0.0) * RATE_HZ) as usize
}

/// Gives a whole mix the equalisation, saturation and noise of a song of its own.
#[cfg(feature = "soundfont")]
pub fn master(mix: Vec<f32>, chance: &mut Chance) -> Vec<f32> {
    Desk::of_mix(mix).master(chance)
}

/// Plays a score: mono samples at 44.1 kHz, within ±1. The seed chooses the ensemble.
///
/// # Errors
/// [`RenderError::TooLong`].
pub fn render(score: &Score, seed: u64) -> Result<Vec<f32>, RenderError> {
    let n_samples = n_samples(score)?;
    let stream = |part: u64| Chance::new(seed, STREAM + part);
    let mut desk = Desk::draw(n_samples, score, &mut stream(0));
    let kit = DrumKit::draw(score, &mut stream(1));
    for bus in Bus::ALL {
        let voices = bus.voices();
        let mut notes = score.notes.iter().filter(|note| voices.contains(&note.voice)).peekable();
        if notes.peek().is_none() {
            continue;
        }
        match bus {
            Bus::Drums => {
                for note in notes {
                    kit.play(note, desk.from(onset_sample(score, note)));
                }
            }
            Bus::Bass | Bus::Harmony | Bus::Melody => {
                let patches: Vec<(Voice, Patch)> = voices
                    .iter()
                    .map(|&voice| (voice, Patch::draw(voice, &mut stream(2 + voice as u64))))
                    .collect();
                for note in notes {
                    let onset = onset_sample(score, note);
                    let held = release_sample(score, note).saturating_sub(onset);
                    let patch = patches.iter().find(|(voice, _)| *voice == note.voice);
                    if let Some((_, patch)) = patch {
                        tone::play(patch, note, held, desk.from(onset));
                    }
                }
            }
        }
        desk.mix(bus);
    }
    Ok(desk.master(&mut stream(40)))
}
