//! Band-limited waves from tables, one per octave.

use std::sync::OnceLock;

use super::RATE_HZ;

/// Samples of a period.
const LEN: usize = 2048;
/// Bits of a phase that are below a sample of the table.
const FRACTION_BITS: u32 = 32 - 11;
/// Highest frequency of a partial, in Hz.
const HIGHEST_HZ: f64 = 18_000.0;
/// Partials of the lowest table.
const MAX_PARTIALS: usize = 512;

/// A period of a wave, with fewer and fewer partials from table to table.
#[derive(Clone, Debug)]
pub struct Wave {
    /// The first has `n_partials`, each other half of the one before; [LEN + 1], the last sample as the first.
    tables: Vec<Vec<f32>>,
    n_partials: usize,
}

/// A period of a sine.
fn sine_table() -> &'static [f32] {
    static TABLE: OnceLock<Vec<f32>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let sample = |i: usize| libm::sin(std::f64::consts::TAU * i as f64 / LEN as f64) as f32;
        (0..=LEN).map(sample).collect()
    })
}

/// Returns the sine of a phase; a whole turn is 2³².
pub fn sine(phase: u32) -> f32 {
    interpolate(sine_table(), phase)
}

fn interpolate(table: &[f32], phase: u32) -> f32 {
    let i = (phase >> FRACTION_BITS) as usize;
    let at = (phase & ((1 << FRACTION_BITS) - 1)) as f32 * (1.0 / (1u32 << FRACTION_BITS) as f32);
    match table.get(i..i + 2) {
        Some([from, to]) => from + at * (to - from),
        _ => 0.0,
    }
}

/// Returns the phase that a wave of `hz` moves on in a sample.
pub fn phase_step(hz: f64) -> u32 {
    (hz / RATE_HZ * 4_294_967_296.0) as u32
}

impl Wave {
    /// Sums partials, the first the fundamental, and scales the wave to a peak of 1.
    pub fn of_partials(amplitudes: &[f64]) -> Self {
        let amplitudes = &amplitudes[..amplitudes.len().min(MAX_PARTIALS)];
        let sine = sine_table();
        let sum = |n: usize| -> Vec<f32> {
            let mut table = vec![0.0_f32; LEN];
            for (k, amplitude) in amplitudes.iter().enumerate().take(n) {
                let amplitude = *amplitude as f32;
                if amplitude != 0.0 {
                    for (i, y) in table.iter_mut().enumerate() {
                        *y += amplitude * sine[i * (k + 1) % LEN];
                    }
                }
            }
            table
        };
        let mut tables = Vec::new();
        let mut n = amplitudes.len();
        while n > 0 {
            tables.push(sum(n));
            n /= 2;
        }
        let peak = tables.first().map_or(0.0, |t| t.iter().fold(0.0_f32, |p, y| p.max(y.abs())));
        for table in &mut tables {
            table.iter_mut().for_each(|y| *y /= peak.max(1e-6));
            table.push(table[0]);
        }
        Self { tables, n_partials: amplitudes.len() }
    }

    /// All partials as 1/k.
    pub fn saw() -> &'static Self {
        static WAVE: OnceLock<Wave> = OnceLock::new();
        WAVE.get_or_init(|| Self::of_partials(&partials(|k| 1.0 / k)))
    }

    /// Odd partials as 1/k.
    pub fn square() -> &'static Self {
        static WAVE: OnceLock<Wave> = OnceLock::new();
        WAVE.get_or_init(|| Self::of_partials(&partials(|k| (k % 2.0) / k)))
    }

    /// Odd partials as 1/k², every second one negative.
    pub fn triangle() -> &'static Self {
        static WAVE: OnceLock<Wave> = OnceLock::new();
        WAVE.get_or_init(|| Self::of_partials(&partials(|k| (k % 2.0) * (2.0 - k % 4.0) / (k * k))))
    }

    /// Returns the table that has no partial above hearing at a frequency.
    pub fn at(&self, hz: f64) -> Table<'_> {
        let mut n = self.n_partials;
        let mut level = 0;
        while n as f64 * hz > HIGHEST_HZ && level + 1 < self.tables.len() {
            (n, level) = (n / 2, level + 1);
        }
        Table(self.tables.get(level).map_or(&[], Vec::as_slice))
    }
}

fn partials(amplitude: impl Fn(f64) -> f64) -> Vec<f64> {
    (1..=MAX_PARTIALS).map(|k| amplitude(k as f64)).collect()
}

/// A period at one octave.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a>(&'a [f32]);

impl Table<'_> {
    /// Returns the wave at a phase; a whole turn is 2³².
    pub fn at(self, phase: u32) -> f32 {
        interpolate(self.0, phase)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_is_the_sum_of_its_partials_and_no_partial_folds_back() {
        let wave = Wave::of_partials(&[1.0, 0.0, 0.5]);
        let at = |turn: f64| f64::from(wave.at(100.0).at((turn * 4_294_967_296.0) as u32));
        let exact = |turn: f64| {
            let angle = std::f64::consts::TAU * turn;
            angle.sin() + 0.5 * (3.0 * angle).sin()
        };
        let peak = (0..LEN).map(|i| exact(i as f64 / LEN as f64).abs()).fold(0.0, f64::max);
        for turn in [0.0, 0.1, 0.37, 0.5, 0.93] {
            // Linear interpolation of the third partial: (2π·3/2048)²/8 = 1e-5.
            assert!((at(turn) - exact(turn) / peak).abs() < 3e-5, "{turn}");
        }
        // Of a saw at 5 kHz, three partials are below 18 kHz; tables are halves of 512.
        let table = Wave::saw().at(5000.0);
        let sum = |k: usize| -> f64 {
            let term = |i: usize| {
                f64::from(table.0[i]) * (std::f64::consts::TAU * (k * i) as f64 / LEN as f64).sin()
            };
            (0..LEN).map(term).sum::<f64>().abs() / LEN as f64
        };
        assert!(sum(1) > 0.1 && sum(2) > 0.05 && sum(4) < 1e-6, "{} {}", sum(1), sum(4));
    }
}
