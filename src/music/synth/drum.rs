//! Drums and cymbals: each sound is made once for a song, and every hit adds it.

use std::collections::BTreeMap;

use super::RATE_HZ;
use super::filter::{Noise, OnePole, decay, gain, pitch_hz};
use super::wave::{phase_step, sine};
use crate::chance::Chance;
use crate::music::score::{Note, Score, Voice};

/// Longest sound of a drum, in seconds.
const LONGEST_S: f64 = 1.6;
/// Level at which a sound ends.
const SILENT: f32 = 3e-4;
/// Ratios of the six square waves of a cymbal; no two have a simple one.
const CYMBAL_RATIOS: [f64; 6] = [2.0, 3.0, 4.16, 5.43, 6.79, 8.21];

/// The drums of a song.
pub struct DrumKit {
    /// By voice and, of toms, pitch.
    sounds: BTreeMap<(Voice, u8), Vec<f32>>,
}

fn between(low: f64, high: f64, chance: &mut Chance) -> f64 {
    low + (high - low) * chance.uniform()
}

fn key(note: &Note) -> (Voice, u8) {
    (note.voice, if note.voice == Voice::Tom { note.pitch } else { 0 })
}

impl DrumKit {
    /// Draws the sounds that a score asks for.
    pub fn draw(score: &Score, chance: &mut Chance) -> Self {
        let recipes: Vec<(Voice, Recipe)> = Voice::ALL
            .into_iter()
            .filter(|voice| voice.is_drum())
            .map(|voice| (voice, Recipe::draw(voice, chance)))
            .collect();
        let mut sounds = BTreeMap::new();
        for note in score.notes.iter().filter(|note| note.voice.is_drum()) {
            let (voice, pitch) = key(note);
            let recipe = recipes.iter().find(|(of, _)| *of == voice);
            if let Some((_, recipe)) = recipe {
                sounds.entry((voice, pitch)).or_insert_with(|| recipe.sound(pitch));
            }
        }
        Self { sounds }
    }

    /// Adds a hit to `out`, which begins at its onset.
    pub fn play(&self, note: &Note, out: &mut [f32]) {
        let Some(sound) = self.sounds.get(&key(note)) else { return };
        for (y, x) in out.iter_mut().zip(sound) {
            *y += note.velocity * x;
        }
    }
}

/// The parameters of a drum's sound.
#[derive(Clone, Copy, Debug)]
struct Recipe {
    /// Pitch of the skin, in Hz, and how many times that it begins with.
    hz: f64,
    sweep: f64,
    sweep_s: f64,
    tone: f32,
    tone_s: f64,
    noise: f32,
    noise_s: f64,
    /// Band of the noise, in Hz.
    low_hz: f64,
    high_hz: f64,
    /// Share of square waves in the noise.
    metal: f32,
    /// Bursts before the last one, as hands clap.
    n_bursts: usize,
    attack_s: f64,
    gain: f32,
    seed: u32,
}

impl Recipe {
    fn draw(voice: Voice, c: &mut Chance) -> Self {
        let level = gain(between(-4.0, 4.0, c));
        let plain = Self {
            hz: 200.0,
            sweep: 1.0,
            sweep_s: 0.02,
            tone: 0.0,
            tone_s: 0.1,
            noise: 0.0,
            noise_s: 0.1,
            low_hz: 20.0,
            high_hz: 16_000.0,
            metal: 0.0,
            n_bursts: 0,
            attack_s: 0.0003,
            gain: level,
            seed: c.below(1 << 30) as u32,
        };
        match voice {
            Voice::Kick => Self {
                hz: between(42.0, 64.0, c),
                sweep: between(2.5, 7.0, c),
                sweep_s: between(0.012, 0.045, c),
                tone: 0.9,
                tone_s: between(0.07, 0.28, c),
                noise: between(0.02, 0.3, c) as f32,
                noise_s: between(0.002, 0.012, c),
                high_hz: between(2000.0, 9000.0, c),
                ..plain
            },
            Voice::Snare => Self {
                hz: between(150.0, 250.0, c),
                sweep: between(1.1, 1.8, c),
                tone: between(0.1, 0.4, c) as f32,
                tone_s: between(0.03, 0.12, c),
                noise: between(0.35, 0.6, c) as f32,
                noise_s: between(0.04, 0.18, c),
                low_hz: between(300.0, 1800.0, c),
                high_hz: between(6000.0, 16_000.0, c),
                ..plain
            },
            Voice::Clap => Self {
                noise: between(0.5, 0.8, c) as f32,
                noise_s: between(0.05, 0.16, c),
                low_hz: between(700.0, 1200.0, c),
                high_hz: between(2500.0, 6000.0, c),
                n_bursts: 2 + c.below(2),
                ..plain
            },
            Voice::Rim => Self {
                hz: between(380.0, 1700.0, c),
                tone: 0.4,
                tone_s: between(0.008, 0.03, c),
                noise: 0.2,
                noise_s: 0.006,
                low_hz: 800.0,
                ..plain
            },
            Voice::Tom => Self {
                sweep: between(1.2, 2.0, c),
                sweep_s: 0.05,
                tone: 0.6,
                tone_s: between(0.08, 0.25, c),
                noise: between(0.02, 0.15, c) as f32,
                noise_s: 0.02,
                high_hz: 5000.0,
                ..plain
            },
            Voice::Shaker => Self {
                noise: between(0.12, 0.25, c) as f32,
                noise_s: between(0.02, 0.05, c),
                low_hz: between(3000.0, 6000.0, c),
                attack_s: 0.003,
                ..plain
            },
            _ => {
                let (noise, noise_s) = match voice {
                    Voice::OpenHat => (0.25, between(0.09, 0.3, c)),
                    Voice::Ride => (0.18, between(0.2, 0.6, c)),
                    Voice::Crash => (0.4, between(0.4, 0.9, c)),
                    _ => (0.25, between(0.012, 0.05, c)),
                };
                Self {
                    hz: between(320.0, 620.0, c),
                    noise,
                    noise_s,
                    low_hz: between(5000.0, 8500.0, c),
                    metal: between(0.0, 0.8, c) as f32,
                    ..plain
                }
            }
        }
    }

    fn sound(&self, pitch: u8) -> Vec<f32> {
        let hz = if pitch > 0 { pitch_hz(f64::from(pitch)) } else { self.hz };
        let (tone_fade, noise_fade) = (decay(self.tone_s), decay(self.noise_s));
        let sweep_fade = f64::from(decay(self.sweep_s));
        let (mut tone, mut burst) = (self.tone, self.noise);
        let mut sweep = self.sweep - 1.0;
        let (mut low, mut high) = ([OnePole::new(self.low_hz); 2], OnePole::new(self.high_hz));
        let mut noise = Noise::new(self.seed);
        let squares = CYMBAL_RATIOS.map(|ratio| phase_step(self.hz * ratio));
        let mut phases = [0_u32; 6];
        let mut phase = 0_u32;
        let attack = (self.attack_s * RATE_HZ).max(1.0);
        let burst_len = (0.011 * RATE_HZ) as usize;
        let n = (LONGEST_S * RATE_HZ) as usize;
        let mut sound = Vec::new();
        for i in 0..n {
            let rise = (((i + 1) as f64 / attack) as f32).min(1.0);
            let skin = tone * sine(phase);
            phase = phase.wrapping_add(phase_step(hz * (1.0 + sweep)));
            sweep *= sweep_fade;
            let mut metal = 0.0;
            if self.metal > 0.0 {
                for (phase, step) in phases.iter_mut().zip(squares) {
                    metal += if *phase < 1 << 31 { 1.0 / 3.0 } else { -1.0 / 3.0 };
                    *phase = phase.wrapping_add(step);
                }
            }
            let rough = (1.0 - self.metal) * noise.next() + self.metal * metal;
            let [first, second] = &mut low;
            let band = high.low(second.high(first.high(rough)));
            sound.push(self.gain * rise * (skin + burst * band));
            tone *= tone_fade;
            burst *= noise_fade;
            if i > 0 && i % burst_len == 0 && i / burst_len <= self.n_bursts {
                burst = self.noise;
            }
            if tone.max(burst) < SILENT {
                break;
            }
        }
        sound
    }
}
