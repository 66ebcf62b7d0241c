//! The timbre of a tonal voice, drawn for every song.

use super::wave::Wave;
use crate::chance::Chance;
use crate::music::score::Voice;

/// Where a tone's vibration comes from.
#[derive(Clone, Debug)]
pub enum Timbre {
    /// One wave, or two that are off each other by some cents.
    Wave { wave: std::borrow::Cow<'static, Wave>, detune_cents: f64 },
    /// A sine whose phase another sine moves, less and less.
    ///
    /// Source: Chowning, "The Synthesis of Complex Audio Spectra by Means of Frequency Modulation", 1973.
    Fm { ratio: f64, index: f64, decay_s: f64 },
    /// A plucked string.
    ///
    /// Source: Karplus and Strong, "Digital Synthesis of Plucked-String and Drum Timbres", 1983.
    Pluck { brightness: f64, decay_s: f64 },
}

/// How a voice sounds.
#[derive(Clone, Debug)]
pub struct Patch {
    pub timbre: Timbre,
    pub attack_s: f64,
    /// To 1/e of the way to the level that is held.
    pub decay_s: f64,
    /// Level that is held, of the peak.
    pub sustain: f64,
    /// To 1/e.
    pub release_s: f64,
    /// Corner of the low-pass filter, in Hz.
    pub cutoff_hz: f64,
    /// How many octaves above its corner the filter begins.
    pub sweep_octaves: f64,
    pub sweep_s: f64,
    pub gain: f32,
}

fn between(low: f64, high: f64, chance: &mut Chance) -> f64 {
    low + (high - low) * chance.uniform()
}

/// Returns a number that is as likely between 1 and 2 as between 2 and 4.
fn log_between(low: f64, high: f64, chance: &mut Chance) -> f64 {
    low * libm::exp2(chance.uniform() * libm::log2(high / low))
}

impl Timbre {
    /// Random partials: falling as k^−p, each more or less.
    fn organ(chance: &mut Chance) -> Self {
        let fall = between(0.8, 2.4, chance);
        let n = 6 + chance.below(26);
        let partial = |k: usize| libm::pow(k as f64, -fall) * chance.uniform();
        let mut amplitudes: Vec<f64> = (1..=n).map(partial).collect();
        amplitudes[0] = 1.0;
        let wave = std::borrow::Cow::Owned(Wave::of_partials(&amplitudes));
        Self::Wave { wave, detune_cents: 0.0 }
    }

    fn of(wave: &'static Wave, detune_cents: f64) -> Self {
        Self::Wave { wave: std::borrow::Cow::Borrowed(wave), detune_cents }
    }
}

impl Patch {
    /// Draws the sound of a voice.
    pub fn draw(voice: Voice, chance: &mut Chance) -> Self {
        match voice {
            Voice::Bass => Self::bass(chance),
            Voice::Pad => Self::pad(chance),
            Voice::Melody => Self::melody(chance),
            _ => Self::chords(chance),
        }
    }

    fn bass(c: &mut Chance) -> Self {
        let timbre = match c.below(6) {
            0 => Timbre::of(Wave::saw(), between(0.0, 12.0, c)),
            1 => Timbre::of(Wave::square(), 0.0),
            2 => Timbre::of(Wave::triangle(), 0.0),
            3 => Timbre::Fm { ratio: 1.0, index: between(0.5, 3.0, c), decay_s: 0.2 },
            4 => Timbre::Pluck { brightness: between(0.1, 0.6, c), decay_s: between(0.5, 2.0, c) },
            _ => Timbre::organ(c),
        };
        Self {
            timbre,
            attack_s: between(0.001, 0.008, c),
            decay_s: log_between(0.08, 0.8, c),
            sustain: between(0.2, 0.9, c),
            release_s: log_between(0.02, 0.1, c),
            cutoff_hz: log_between(180.0, 1800.0, c),
            sweep_octaves: between(0.0, 3.0, c),
            sweep_s: log_between(0.05, 0.4, c),
            gain: between(0.30, 0.55, c) as f32,
        }
    }

    fn chords(c: &mut Chance) -> Self {
        let timbre = match c.below(7) {
            0 | 1 => Timbre::organ(c),
            2 => Timbre::of(Wave::saw(), between(4.0, 20.0, c)),
            3 => Timbre::of(Wave::square(), between(0.0, 10.0, c)),
            4 => Timbre::Fm {
                ratio: [1.0, 2.0, 3.0, 7.0][c.below(4)],
                index: between(0.4, 2.5, c),
                decay_s: log_between(0.1, 1.0, c),
            },
            _ => Timbre::Pluck { brightness: between(0.2, 0.95, c), decay_s: between(0.6, 3.0, c) },
        };
        Self {
            timbre,
            attack_s: log_between(0.001, 0.012, c),
            decay_s: log_between(0.1, 1.5, c),
            sustain: between(0.2, 0.9, c),
            release_s: log_between(0.03, 0.3, c),
            cutoff_hz: log_between(700.0, 7000.0, c),
            sweep_octaves: between(0.0, 2.0, c),
            sweep_s: log_between(0.08, 0.6, c),
            gain: between(0.09, 0.19, c) as f32,
        }
    }

    fn pad(c: &mut Chance) -> Self {
        let timbre = match c.below(3) {
            0 => Timbre::organ(c),
            1 => Timbre::of(Wave::triangle(), between(4.0, 16.0, c)),
            _ => Timbre::of(Wave::saw(), between(8.0, 24.0, c)),
        };
        Self {
            timbre,
            attack_s: log_between(0.06, 0.35, c),
            decay_s: 1.0,
            sustain: 0.8,
            release_s: log_between(0.2, 0.8, c),
            cutoff_hz: log_between(500.0, 4000.0, c),
            sweep_octaves: between(0.0, 1.0, c),
            sweep_s: 0.8,
            gain: between(0.04, 0.10, c) as f32,
        }
    }

    fn melody(c: &mut Chance) -> Self {
        let timbre = match c.below(8) {
            0 | 1 => Timbre::organ(c),
            2 => Timbre::of(Wave::saw(), between(0.0, 18.0, c)),
            3 => Timbre::of(Wave::square(), between(0.0, 8.0, c)),
            4 => Timbre::of(Wave::triangle(), between(0.0, 8.0, c)),
            5 => Timbre::Fm {
                ratio: [1.0, 2.0, 3.5, 5.0][c.below(4)],
                index: between(0.5, 4.0, c),
                decay_s: log_between(0.1, 1.2, c),
            },
            _ => Timbre::Pluck { brightness: between(0.3, 0.98, c), decay_s: between(0.5, 2.5, c) },
        };
        Self {
            timbre,
            attack_s: log_between(0.002, 0.03, c),
            decay_s: log_between(0.1, 1.0, c),
            sustain: between(0.3, 0.95, c),
            release_s: log_between(0.03, 0.25, c),
            cutoff_hz: log_between(1200.0, 9000.0, c),
            sweep_octaves: between(0.0, 2.0, c),
            sweep_s: log_between(0.05, 0.5, c),
            gain: between(0.15, 0.32, c) as f32,
        }
    }
}
