//! Where voices meet: levels, ducking, equalisation, room, saturation, noise.

use super::filter::{Noise, OnePole, decay, gain};
use super::{RATE_HZ, onset_sample};
use crate::chance::Chance;
use crate::music::score::{Score, SectionKind, Voice};

/// Voices that are mixed together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bus {
    Drums,
    Bass,
    Harmony,
    Melody,
}

impl Bus {
    pub const ALL: [Self; 4] = [Self::Drums, Self::Bass, Self::Harmony, Self::Melody];

    pub fn voices(self) -> &'static [Voice] {
        match self {
            Self::Drums => &Voice::ALL[..10],
            Self::Bass => &[Voice::Bass],
            Self::Harmony => &[Voice::Chords, Voice::Pad],
            Self::Melody => &[Voice::Melody],
        }
    }
}

/// Lengths of the room's combs and all-pass filters, in samples at 44.1 kHz.
///
/// Source: Schroeder, "Natural Sounding Artificial Reverberation", 1962; the lengths of Freeverb.
const COMBS: [usize; 4] = [1557, 1617, 1491, 1422];
const ALL_PASSES: [usize; 2] = [225, 556];
/// Corner below which nothing is heard, in Hz.
const RUMBLE_HZ: f64 = 22.0;
/// Corners of the shelves, in Hz.
const SHELVES_HZ: (f64, f64) = (220.0, 3200.0);

/// The settings of a bus.
#[derive(Clone, Copy, Debug)]
struct Channel {
    gain: f32,
    send: f32,
    ducking: f32,
}

/// The desk with a song on it.
pub struct Desk {
    bus: Vec<f32>,
    mix: Vec<f32>,
    room: Vec<f32>,
    channels: [Channel; 4],
    /// Samples at which the kick ducks others.
    kicks: Vec<usize>,
    duck_s: f64,
    /// Samples over which a song fades out, if it does.
    fade: Option<(usize, usize)>,
}

fn between(low: f64, high: f64, chance: &mut Chance) -> f64 {
    low + (high - low) * chance.uniform()
}

impl Desk {
    pub fn draw(n_samples: usize, score: &Score, chance: &mut Chance) -> Self {
        let depth = if chance.below(5) < 2 { between(0.3, 0.85, chance) } else { 0.0 };
        let channels = Bus::ALL.map(|bus| Channel {
            gain: gain(between(-3.5, 3.5, chance)),
            send: between(0.0, 0.3, chance) as f32 * if bus == Bus::Bass { 0.1 } else { 1.0 },
            ducking: if bus == Bus::Drums { 0.0 } else { depth as f32 },
        });
        let kicks = score.notes.iter().filter(|note| note.voice == Voice::Kick);
        let outro = score.sections.iter().find(|section| section.kind == SectionKind::Outro);
        let fade = outro.filter(|_| chance.below(6) == 0).map(|section| {
            let beat =
                score.pickup_beats as usize + section.first_bar * score.beats_per_bar as usize;
            let begin = (score.tempo.time_s(beat as f64) * RATE_HZ) as usize;
            (begin, ((score.end_s() * RATE_HZ) as usize).max(begin + 1))
        });
        Self {
            bus: vec![0.0; n_samples],
            mix: vec![0.0; n_samples],
            room: vec![0.0; n_samples],
            channels,
            kicks: kicks.map(|note| onset_sample(score, note)).collect(),
            duck_s: between(0.06, 0.2, chance),
            fade,
        }
    }

    /// A desk on which all is mixed already.
    #[cfg(feature = "soundfont")]
    pub fn of_mix(mix: Vec<f32>) -> Self {
        let (bus, room, kicks) = (Vec::new(), Vec::new(), Vec::new());
        let channels = [Channel { gain: 1.0, send: 0.0, ducking: 0.0 }; 4];
        Self { bus, mix, room, channels, kicks, duck_s: 0.1, fade: None }
    }

    /// Returns the bus from a sample on.
    pub fn from(&mut self, sample: usize) -> &mut [f32] {
        let begin = sample.min(self.bus.len());
        &mut self.bus[begin..]
    }

    /// Adds the bus to the mix and empties it.
    pub fn mix(&mut self, bus: Bus) {
        let Channel { gain, send, ducking } = self.channels[bus as usize];
        let fade = decay(self.duck_s);
        let mut kicks = self.kicks.iter().copied().peekable();
        let mut duck = 0.0_f32;
        for (i, ((y, mix), room)) in
            self.bus.iter_mut().zip(&mut self.mix).zip(&mut self.room).enumerate()
        {
            if ducking > 0.0 {
                while kicks.next_if(|kick| *kick <= i).is_some() {
                    duck = ducking;
                }
                duck *= fade;
            }
            let x = *y * gain * (1.0 - duck);
            *mix += x;
            *room += send * x;
            *y = 0.0;
        }
    }

    /// Returns what is heard: room, tilt, saturation, noise, and a peak below 1.
    pub fn master(self, chance: &mut Chance) -> Vec<f32> {
        let Self { mix: mut out, room, fade, bus, .. } = self;
        drop(bus);
        reverberate(&room, between(0.6, 0.86, chance), between(2000.0, 7000.0, chance), &mut out);
        drop(room);
        let (low_gain, high_gain) =
            (gain(between(-4.0, 4.0, chance)) - 1.0, gain(between(-6.0, 5.0, chance)) - 1.0);
        let (mut low, mut high) = (OnePole::new(SHELVES_HZ.0), OnePole::new(SHELVES_HZ.1));
        let mut rumble = OnePole::new(RUMBLE_HZ);
        let band_hz = if chance.below(10) < 3 { between(4000.0, 11_000.0, chance) } else { 2e4 };
        let mut band = [OnePole::new(band_hz); 2];
        let drive = gain(between(-6.0, 12.0, chance));
        let hiss = if chance.below(2) == 0 { gain(between(-75.0, -44.0, chance)) } else { 0.0 };
        let mut noise = Noise::new(chance.below(1 << 30) as u32);
        let mut peak = 1e-6_f32;
        for (i, y) in out.iter_mut().enumerate() {
            let x = rumble.high(*y);
            let x = x + low_gain * low.low(x) + high_gain * high.high(x);
            let x = saturated(drive * x) + hiss * noise.next();
            let [first, second] = &mut band;
            let x = if band_hz < 2e4 { second.low(first.low(x)) } else { x };
            *y = match fade {
                Some((begin, end)) if i >= begin => {
                    x * (1.0 - (i - begin) as f32 / (end - begin) as f32).max(0.0)
                }
                _ => x,
            };
            peak = peak.max(y.abs());
        }
        let level = between(0.35, 0.97, chance) as f32 / peak;
        out.iter_mut().for_each(|y| *y *= level);
        out
    }
}

/// x (27 + x²)/(27 + 9x²) within ±3: close to tanh.
fn saturated(x: f32) -> f32 {
    let x = x.clamp(-3.0, 3.0);
    x * (27.0 + x * x) / (27.0 + 9.0 * x * x)
}

/// Adds the answer of a room to `out`.
fn reverberate(x: &[f32], feedback: f64, damping_hz: f64, out: &mut [f32]) {
    let feedback = feedback as f32;
    let mut combs = COMBS.map(|n| (vec![0.0_f32; n], 0, OnePole::new(damping_hz)));
    let mut all_passes = ALL_PASSES.map(|n| (vec![0.0_f32; n], 0));
    for (x, out) in x.iter().zip(out) {
        let mut sum = 0.0;
        for (line, at, damping) in &mut combs {
            let y = line[*at];
            line[*at] = x + feedback * damping.low(y);
            *at = if *at + 1 == line.len() { 0 } else { *at + 1 };
            sum += y;
        }
        let mut y = 0.3 * sum;
        for (line, at) in &mut all_passes {
            let delayed = line[*at];
            line[*at] = y + 0.5 * delayed;
            *at = if *at + 1 == line.len() { 0 } else { *at + 1 };
            y = delayed - 0.5 * y;
        }
        *out += y;
    }
}
