//! Sample-rate conversion as libsoxr does it at quality HQ, which librosa uses.
//!
//! The edge of the pass band decides: the 80 dB floor and the min-max of the mel features let the
//! top bands move the whole file. Constants are fitted to libsoxr 0.1.3's impulse responses
//! (`tests/golden/audio_resample/fit.py`; max. error 3·10⁻⁷ of full scale).

mod dot;
mod filter;
mod phases;

use std::sync::Arc;

use super::SAMPLE_RATE_HZ;
use phases::{PhaseCache, Phases};

static PHASES: PhaseCache = PhaseCache::new();

/// Converts a stream to 44.1 kHz; ⌈n · 44,100 / rate⌉ samples.
///
/// Where the filter sees only zeros the result is exactly 0 (a deliberate difference: libsoxr
/// leaves noise of 10⁻⁹ there, whose spectral centroid is arbitrary).
#[derive(Debug)]
pub struct Resampler {
    /// `None` when the rate is 44.1 kHz already.
    phases: Option<Arc<Phases>>,
    buffer: Vec<f32>,
    /// Input position of the next output: whole samples from the start of `buffer`'s window …
    whole: usize,
    /// … and phase.
    phase: usize,
    n_in: u64,
    n_out: u64,
}

impl Resampler {
    /// Starts a conversion from `rate_hz`, which is not 0.
    pub fn new(rate_hz: u32) -> Self {
        let phases = (rate_hz != SAMPLE_RATE_HZ).then(|| PHASES.phases(rate_hz, Phases::new));
        let n_before = phases.as_ref().map_or(0, |p| p.n_before);
        Self { phases, buffer: vec![0.0; n_before], whole: 0, phase: 0, n_in: 0, n_out: 0 }
    }

    /// Takes the next samples and appends what is ready at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32], out: &mut Vec<f32>) {
        let Some(phases) = self.phases.clone() else {
            out.extend_from_slice(samples);
            return;
        };
        self.n_in += samples.len() as u64;
        self.buffer.extend_from_slice(samples);
        self.convert(&phases, u64::MAX, out);
    }

    /// Ends the signal and appends the rest.
    pub fn finish(&mut self, out: &mut Vec<f32>) {
        let Some(phases) = self.phases.clone() else { return };
        let total = (u128::from(self.n_in) * phases.up as u128).div_ceil(phases.down as u128);
        self.buffer.resize(self.buffer.len() + phases.n_taps + phases.down / phases.up + 1, 0.0);
        self.convert(&phases, u64::try_from(total).unwrap_or(u64::MAX), out);
    }

    fn convert(&mut self, phases: &Phases, n_total: u64, out: &mut Vec<f32>) {
        while self.n_out < n_total {
            let Some(window) = self.buffer.get(self.whole..self.whole + phases.n_taps) else {
                break;
            };
            out.push(phases.filtered(window, self.phase));
            self.n_out += 1;
            self.phase += phases.down;
            self.whole += self.phase / phases.up;
            self.phase %= phases.up;
        }
        let used = self.whole.min(self.buffer.len());
        self.buffer.drain(..used);
        self.whole -= used;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    fn resample(y: &[f32], rate_hz: u32, block: usize) -> Vec<f32> {
        let mut resampler = Resampler::new(rate_hz);
        let mut out = Vec::new();
        for samples in y.chunks(block) {
            resampler.push(samples, &mut out);
        }
        resampler.finish(&mut out);
        out
    }

    #[test]
    fn lengths_are_rounded_up() {
        for (rate_hz, n, expected) in [
            (44_100, 1234, 1234),
            (22_050, 7, 14),
            (48_000, 160, 147),
            (48_000, 161, 148),
            (8_000, 1, 6),
            (192_000, 1, 1),
            (88_200, 3, 2),
            (44_101, 44_101, 44_100),
        ] {
            assert_eq!(resample(&vec![0.1; n], rate_hz, 5).len(), expected, "{rate_hz} {n}");
        }
        assert_eq!(resample(&[], 48_000, 1), Vec::<f32>::new());
    }

    #[test]
    fn odd_rates_are_converted_as_libsoxr_converts_them() {
        // soxr 1.1.0 (libsoxr 0.1.3), quality HQ, of the same f32 samples: every 333rd from 700 on.
        // The chirp passes every frequency up to the Nyquist frequency.
        for (rate_hz, slowness, n, expected) in [
            (
                22_254,
                1.0,
                4000,
                [-0.5454515, 0.6177592, -0.0792595, -0.5466780, 0.5685009, -0.2633378, -0.3639714],
            ),
            (
                47_999,
                1.0,
                4000,
                [-0.1086550, -0.3900688, -0.0506574, -0.4444513, -0.2346830, 0.2213636, 0.5535879],
            ),
            (
                96_001,
                0.5,
                8000,
                [-0.1118099, -0.3806992, -0.0547404, -0.4001840, -0.2358009, 0.0385302, 0.2933827],
            ),
        ] {
            let sample = |i: usize| {
                let t = slowness * i as f64;
                (0.4 * (0.05 * t).sin() + 0.3 * (0.0007 * t * t).sin()) as f32
            };
            let y: Vec<f32> = (0..n).map(sample).collect();
            let out = resample(&y, rate_hz, 1000);
            for (i, (&found, e)) in out[700..2700].iter().step_by(333).zip(expected).enumerate() {
                // The fit is good to 3e-7 of an impulse, blending to 9e-8.
                assert!((f64::from(found) - e).abs() < 1e-6, "{rate_hz} Hz, {i}: {found} {e}");
            }
        }
    }

    #[test]
    fn tones_in_the_pass_band_keep_level_and_phase() {
        for rate_hz in [8_000, 11_025, 22_050, 32_000, 48_000, 96_000, 192_000] {
            let hz = 0.3 * f64::from(rate_hz.min(SAMPLE_RATE_HZ));
            let tone = |i: usize, rate_hz: u32| (TAU * hz * i as f64 / f64::from(rate_hz)).sin();
            let y: Vec<f32> = (0..rate_hz as usize / 10).map(|i| tone(i, rate_hz) as f32).collect();
            let out = resample(&y, rate_hz, 999);
            // Away from the ends, where the signal's sudden start is heard by the filter.
            let middle = out.len() / 3..out.len() * 2 / 3;
            for (i, &found) in out.iter().enumerate().take(middle.end).skip(middle.start) {
                let expected = tone(i, SAMPLE_RATE_HZ);
                // Stop band at −126 dB (5·10⁻⁷), f32 sums, and the fit.
                assert!((f64::from(found) - expected).abs() < 4e-6, "{rate_hz}: sample {i}");
            }
        }
    }

    #[test]
    fn what_the_target_cannot_hold_is_removed() {
        for rate_hz in [48_000u32, 96_000, 88_200] {
            let hz = 22_500.0;
            let y: Vec<f32> = (0..rate_hz as usize / 10)
                .map(|i| (TAU * hz * i as f64 / f64::from(rate_hz)).sin() as f32)
                .collect();
            let out = resample(&y, rate_hz, 4096);
            let peak = out[1000..3400].iter().fold(0f32, |peak, y| peak.max(y.abs()));
            assert!(peak < 3e-6, "{rate_hz}: {peak}");
        }
    }

    #[test]
    fn silence_stays_exactly_silent() {
        let mut y = vec![0.0; 48_000];
        y[20_000..20_100].fill(0.7);
        let out = resample(&y, 48_000, 1000);
        assert!(out[..18_000].iter().chain(&out[19_000..]).all(|&y| y == 0.0));
    }
}
