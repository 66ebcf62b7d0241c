//! A tone: vibration, filter, envelope.

use super::RATE_HZ;
use super::filter::{Noise, OnePole, decay, pitch_hz};
use super::patch::{Patch, Timbre};
use super::wave::{Table, phase_step, sine};
use crate::music::score::Note;

/// Level at which a released tone ends.
const SILENT: f32 = 2e-4;
/// Samples between two looks at the filter's corner.
const FILTER_STRIDE: usize = 32;
/// A turn of phase over 2π, for sines whose phase is moved.
const TURN: f32 = (4_294_967_296.0 / std::f64::consts::TAU) as f32;

/// Adds a tone to `out`, which begins at its onset; it is held for `held` samples and then let go.
pub fn play(patch: &Patch, note: &Note, held: usize, out: &mut [f32]) {
    let hz = pitch_hz(f64::from(note.pitch));
    match &patch.timbre {
        Timbre::Wave { wave, detune_cents } => {
            let table = wave.at(hz);
            if *detune_cents == 0.0 {
                let mut one = Oscillator { table, phase: 0, step: phase_step(hz) };
                shape(patch, note, held, out, || one.next());
            } else {
                let cents = libm::exp2(detune_cents / 2400.0);
                let mut low = Oscillator { table, phase: 0, step: phase_step(hz / cents) };
                let mut high = Oscillator { table, phase: 1 << 30, step: phase_step(hz * cents) };
                shape(patch, note, held, out, || 0.5 * (low.next() + high.next()));
            }
        }
        Timbre::Fm { ratio, index, decay_s } => {
            let (carrier_step, modulator_step) = (phase_step(hz), phase_step(hz * ratio));
            let (mut carrier, mut modulator) = (0_u32, 0_u32);
            // Bright when it is struck hard; no sidebands far above hearing.
            let brightest = (8000.0 / (hz * ratio)).min(*index) * f64::from(note.velocity);
            let (mut index, fade) = (brightest as f32, decay(*decay_s));
            shape(patch, note, held, out, || {
                let moved = (index * sine(modulator) * TURN) as i64 as u32;
                let y = sine(carrier.wrapping_add(moved));
                carrier = carrier.wrapping_add(carrier_step);
                modulator = modulator.wrapping_add(modulator_step);
                index *= fade;
                y
            });
        }
        Timbre::Pluck { brightness, decay_s } => {
            let mut string = PluckedString::new(hz, *brightness, *decay_s, note.pitch);
            shape(patch, note, held, out, || string.next());
        }
    }
}

struct Oscillator<'a> {
    table: Table<'a>,
    phase: u32,
    step: u32,
}

impl Oscillator<'_> {
    fn next(&mut self) -> f32 {
        let y = self.table.at(self.phase);
        self.phase = self.phase.wrapping_add(self.step);
        y
    }
}

/// Filters a vibration, gives it its envelope, and adds it.
fn shape(
    patch: &Patch,
    note: &Note,
    held: usize,
    out: &mut [f32],
    mut vibration: impl FnMut() -> f32,
) {
    let attack = (patch.attack_s * RATE_HZ).max(1.0) as usize;
    let (fall, release) = (decay(patch.decay_s), decay(patch.release_s));
    let sustain = patch.sustain as f32;
    // Softer notes are darker.
    let cutoff_hz = patch.cutoff_hz * (0.5 + 0.5 * f64::from(note.velocity));
    let sweep_fade = libm::exp(-(FILTER_STRIDE as f64) / (patch.sweep_s * RATE_HZ));
    let mut octaves = patch.sweep_octaves;
    let mut filter = [OnePole::new(cutoff_hz); 2];
    let gain = patch.gain * note.velocity;
    let mut level = 0.0_f32;
    for (i, y) in out.iter_mut().enumerate() {
        if i % FILTER_STRIDE == 0 && octaves > 0.01 {
            let hz = cutoff_hz * libm::exp2(octaves);
            filter.iter_mut().for_each(|pole| pole.set(hz));
            octaves *= sweep_fade;
        }
        if i >= held {
            level *= release;
            if level < SILENT {
                break;
            }
        } else if i < attack {
            level = (i + 1) as f32 / attack as f32;
        } else {
            level = sustain + (level - sustain) * fall;
        }
        let [first, second] = &mut filter;
        *y += gain * level * second.low(first.low(vibration()));
    }
}

/// A delay line as long as a period, whose sum of neighbours is fed back.
struct PluckedString {
    line: Vec<f32>,
    at: usize,
    last: f32,
    /// Share of the neighbour.
    smooth: f32,
    loss: f32,
    /// Delay beyond whole samples, as the coefficient of an all-pass filter.
    allpass: f32,
    memory: (f32, f32),
}

impl PluckedString {
    fn new(hz: f64, brightness: f64, decay_s: f64, seed: u8) -> Self {
        let smooth = 0.5 * (1.0 - brightness);
        let period = RATE_HZ / hz - smooth;
        let whole = (period - 0.1).floor().max(2.0);
        let rest = (period - whole).clamp(0.05, 1.5);
        let mut noise = Noise::new(u32::from(seed) + 1);
        let mut soft = OnePole::new(1500.0 + 9000.0 * brightness);
        let line: Vec<f32> = (0..whole as usize).map(|_| soft.low(noise.next())).collect();
        let mean = line.iter().sum::<f32>() / line.len() as f32;
        let peak = line.iter().fold(1e-3_f32, |p, y| p.max((y - mean).abs()));
        Self {
            line: line.iter().map(|y| (y - mean) / peak).collect(),
            at: 0,
            last: 0.0,
            smooth: smooth as f32,
            loss: libm::exp(-1.0 / (decay_s * hz)) as f32,
            allpass: ((1.0 - rest) / (1.0 + rest)) as f32,
            memory: (0.0, 0.0),
        }
    }

    fn next(&mut self) -> f32 {
        let x = self.line[self.at];
        let smoothed = (1.0 - self.smooth) * x + self.smooth * self.last;
        self.last = x;
        let delayed = self.allpass * (smoothed - self.memory.1) + self.memory.0;
        self.memory = (smoothed, delayed);
        self.line[self.at] = self.loss * delayed;
        self.at = if self.at + 1 == self.line.len() { 0 } else { self.at + 1 };
        x
    }
}
