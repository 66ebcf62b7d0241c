//! A score played by the instruments of a soundfont (SF2).

use std::sync::Arc;

use rustysynth::{SoundFont, Synthesizer, SynthesizerSettings};

use super::score::{Note, Score, Voice};
use super::synth::{RenderError, master, n_samples, onset_sample, release_sample};
use crate::audio::SAMPLE_RATE_HZ;
use crate::chance::Chance;

/// Stream of choices.
const STREAM: u64 = 0x6_0000_0000;
/// Samples between two looks at events of the synthesiser: notes begin up to 0.7 ms late.
const BLOCK: usize = 32;
/// The channel of drums, from 0, as General MIDI has it.
const DRUMS: i32 = 9;
const PROGRAM_CHANGE: i32 = 0xC0;
/// Peak below which a soundfont plays nothing.
const SILENT: f32 = 1e-4;

/// General MIDI programs, from 0, that play a voice.
const BASSES: &[i32] = &[32, 33, 34, 35, 36, 38, 39];
const CHORDS: &[i32] = &[0, 1, 2, 4, 5, 7, 16, 17, 18, 21, 24, 25, 26, 27, 28, 46, 61, 62];
const PADS: &[i32] = &[48, 49, 50, 51, 52, 88, 89, 90, 91, 94];
const LEADS: &[i32] = &[
    0, 4, 11, 12, 13, 21, 22, 25, 26, 40, 41, 56, 59, 64, 65, 66, 68, 71, 72, 73, 74, 75, 79, 80,
    81, 105, 110,
];

/// The instruments of a soundfont.
#[derive(Clone)]
pub struct Instruments(Arc<SoundFont>);

/// Why a soundfont was refused.
#[derive(Debug, thiserror::Error)]
pub enum SoundFontError {
    #[error("{0}; SF2 files are read, and not SF3, whose samples are compressed")]
    Format(rustysynth::SoundFontError),
    #[error("the synthesiser does not start ({0})")]
    Synthesizer(rustysynth::SynthesizerError),
    #[error("has no instrument that is heard; choose a General MIDI soundfont")]
    Silent,
    #[error(transparent)]
    Render(#[from] RenderError),
}

impl Instruments {
    /// Reads an SF2 file.
    ///
    /// # Errors
    /// [`SoundFontError::Format`].
    pub fn read(mut bytes: &[u8]) -> Result<Self, SoundFontError> {
        let font = SoundFont::new(&mut bytes).map_err(SoundFontError::Format)?;
        Ok(Self(Arc::new(font)))
    }

    /// Plays a score: mono samples at 44.1 kHz, within ±1. The seed chooses programs and levels.
    ///
    /// # Errors
    /// [`SoundFontError`].
    pub fn render(&self, score: &Score, seed: u64) -> Result<Vec<f32>, SoundFontError> {
        let n = n_samples(score)?;
        let mut settings = SynthesizerSettings::new(SAMPLE_RATE_HZ as i32);
        settings.block_size = BLOCK;
        let mut synthesizer =
            Synthesizer::new(&self.0, &settings).map_err(SoundFontError::Synthesizer)?;
        let mut chance = Chance::new(seed, STREAM);
        for (channel, programs) in [BASSES, CHORDS, PADS, LEADS].into_iter().enumerate() {
            let program = programs[chance.below(programs.len())];
            synthesizer.process_midi_message(channel as i32, PROGRAM_CHANGE, program, 0);
        }
        let levels: Vec<f64> = (0..5).map(|_| 0.7 + 0.6 * chance.uniform()).collect();
        let mut samples = vec![0.0_f32; n];
        let (mut left, mut right) = (vec![0.0_f32; n], vec![0.0_f32; n]);
        let mut at = 0;
        for event in events(score) {
            let to = event.sample.clamp(at, n);
            synthesizer.render(&mut left[at..to], &mut right[at..to]);
            at = to;
            let channel = event.channel;
            if event.velocity > 0.0 {
                let level = levels.get(channel as usize).copied().unwrap_or(levels[4]);
                let velocity = (event.velocity * 110.0 * level).clamp(1.0, 127.0) as i32;
                synthesizer.note_on(channel, event.key, velocity);
            } else {
                synthesizer.note_off(channel, event.key);
            }
        }
        synthesizer.render(&mut left[at..], &mut right[at..]);
        for ((y, left), right) in samples.iter_mut().zip(&left).zip(&right) {
            *y = 0.5 * (left + right);
        }
        let peak = samples.iter().fold(0.0_f32, |peak, y| peak.max(y.abs()));
        if peak < SILENT || !peak.is_finite() {
            return Err(SoundFontError::Silent);
        }
        // As loud as our own voices are before they are mastered.
        samples.iter_mut().for_each(|y| *y /= peak);
        Ok(master(samples, &mut chance))
    }
}

/// A key goes down or, with velocity 0, up.
struct Event {
    sample: usize,
    channel: i32,
    key: i32,
    velocity: f64,
}

/// Returns what happens, in order; keys go up before others go down.
fn events(score: &Score) -> Vec<Event> {
    let mut events = Vec::with_capacity(2 * score.notes.len());
    for note in &score.notes {
        let (channel, key) = place(note);
        let onset = onset_sample(score, note);
        let end = release_sample(score, note).max(onset + BLOCK);
        events.push(Event { sample: onset, channel, key, velocity: f64::from(note.velocity) });
        events.push(Event { sample: end, channel, key, velocity: 0.0 });
    }
    events.sort_by(|a, b| {
        let order = |event: &Event| (event.sample, event.velocity > 0.0, event.channel, event.key);
        order(a).cmp(&order(b))
    });
    events
}

/// Returns channel and key of a note, drums as General MIDI has them.
fn place(note: &Note) -> (i32, i32) {
    let pitch = i32::from(note.pitch);
    match note.voice {
        Voice::Bass => (0, pitch),
        Voice::Chords => (1, pitch),
        Voice::Pad => (2, pitch),
        Voice::Melody => (3, pitch),
        Voice::Kick => (DRUMS, 36),
        Voice::Snare => (DRUMS, 38),
        Voice::Clap => (DRUMS, 39),
        Voice::Rim => (DRUMS, 37),
        Voice::ClosedHat => (DRUMS, 42),
        Voice::OpenHat => (DRUMS, 46),
        Voice::Ride => (DRUMS, 51),
        Voice::Crash => (DRUMS, 49),
        Voice::Shaker => (DRUMS, 70),
        // Low, middle and high toms.
        Voice::Tom if pitch < 42 => (DRUMS, 45),
        Voice::Tom if pitch < 47 => (DRUMS, 47),
        Voice::Tom => (DRUMS, 50),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_soundfont_is_refused() {
        for bytes in [&b""[..], b"RIFF", b"RIFF\x10\0\0\0sfbkLIST\x04\0\0\0INFO", &[0xff; 400]] {
            let refused = Instruments::read(bytes).err().expect("no soundfont").to_string();
            assert!(refused.contains("SF2"), "{refused}");
        }
    }

    #[test]
    fn keys_go_down_and_up() {
        let score = crate::music::compose(1, 0);
        let events = events(&score);
        assert!(events.is_sorted_by_key(|event| event.sample));
        let down = events.iter().filter(|event| event.velocity > 0.0).count();
        assert_eq!((down, events.len()), (score.notes.len(), 2 * score.notes.len()));
    }
}
