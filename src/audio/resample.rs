//! Sample-rate conversion as libsoxr does it at quality HQ, which librosa uses.
//!
//! The edge of the pass band decides: the 80 dB floor and the min-max of the mel features let the
//! top bands move the whole file. Constants are fitted to libsoxr 0.1.3's impulse responses
//! (`tests/golden/audio_resample/fit.py`; max. error 3·10⁻⁷ of full scale).

use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use super::SAMPLE_RATE_HZ;
use super::decimate::{kaiser, sinc};

/// Cut-off relative to the lower rate's Nyquist frequency, midway between pass and stop band.
const CUT_OFF: f64 = 0.956_871_8;

/// A low-pass filter in time, in units of the lower rate's samples.
///
/// h(z) = c₀k(z) + Σⱼ cⱼ/2 · (k(z − j/2) + k(z + j/2)),
/// k(z) = F_c · sinc(F_c z) · I₀(β√(1 − (z/L)²)) / I₀(β)
#[derive(Debug, PartialEq)]
struct Filter {
    /// L: half the length of the window.
    half_length: f64,
    /// β of the window.
    beta: f64,
    /// c: the droop that libsoxr's last, shorter stage adds below the cut-off (10⁻³ there).
    droop: &'static [f64],
}

/// Rates in a ratio of small whole numbers: one stage of 2·97·m + 1 taps, no droop.
fn exact(largest_term: u32) -> Filter {
    let half_length = 97.0 + 0.5 / f64::from(largest_term);
    Filter { half_length, beta: 13.040_03, droop: &[1.0] }
}
const UP: Filter = Filter {
    half_length: 102.25,
    beta: 13.7112,
    droop: &[
        0.924_191_619,
        0.131_195_135,
        -0.084_007_933,
        0.038_117_398,
        -0.010_869_255,
        0.001_089_315,
        0.000_444_155,
        -0.000_182_88,
        0.000_022_634,
    ],
};
const DOWN: Filter = Filter {
    half_length: 102.211,
    beta: 13.7112,
    droop: &[
        0.963_511_202,
        0.061_499_433,
        -0.035_859_245,
        0.012_811_347,
        -0.001_203_796,
        -0.001_392_36,
        0.000_824_067,
        -0.000_216_649,
        0.000_025_904,
    ],
};
const FAR_UP: Filter = Filter {
    half_length: 107.248,
    beta: 14.3828,
    droop: &[
        0.849_698_686,
        0.268_055_395,
        -0.189_786_446,
        0.106_260_877,
        -0.046_813_29,
        0.016_144_197,
        -0.004_299_712,
        0.000_828_689,
        -0.000_088_476,
    ],
};
const FAR_DOWN: Filter = Filter {
    half_length: 106.805,
    beta: 14.3828,
    droop: &[
        1.025_930_121,
        -0.053_331_816,
        0.053_250_934,
        -0.044_982_632,
        0.029_572_914,
        -0.014_444_064,
        0.005_000_969,
        -0.001_124_291,
        0.000_127_873,
    ],
};

/// Largest term of a ratio that libsoxr converts in one stage.
const MAX_EXACT_TERM: u32 = 5;
/// Ratio of the rates from which libsoxr adds a stage, and with it attenuation.
const FAR: f64 = 4.0;

impl Filter {
    fn of(rate_hz: u32, up: u32, down: u32) -> Self {
        let is_far = |ratio: f64| ratio > FAR;
        let ratio = f64::from(SAMPLE_RATE_HZ) / f64::from(rate_hz);
        if up.max(down) <= MAX_EXACT_TERM {
            exact(up.max(down))
        } else if ratio > 1.0 {
            if is_far(ratio) { FAR_UP } else { UP }
        } else if is_far(1.0 / ratio) {
            FAR_DOWN
        } else {
            DOWN
        }
    }

    fn at(&self, z: f64) -> f64 {
        let k = |z: f64| CUT_OFF * sinc(CUT_OFF * z) * kaiser(z / self.half_length, self.beta);
        let pairs = self.droop.iter().enumerate().skip(1);
        let echoes = pairs.map(|(j, c)| {
            let shift = j as f64 / 2.0;
            c / 2.0 * (k(z - shift) + k(z + shift))
        });
        self.droop[0] * k(z) + echoes.sum::<f64>()
    }

    /// Returns the distance at which the filter has ended.
    fn reach(&self) -> f64 {
        self.half_length + (self.droop.len() - 1) as f64 / 2.0
    }
}

/// The taps of every phase of a conversion by `up`/`down`.
#[derive(Debug)]
struct Phases {
    up: usize,
    down: usize,
    /// Taps of one phase, a multiple of [`LANES`].
    n_taps: usize,
    /// Samples before an output's position that its first tap covers.
    n_before: usize,
    taps: Vec<f32>,
}

/// Partial sums of a dot product: as many as a vector register holds, so that it vectorises.
const LANES: usize = 8;

impl Phases {
    fn new(rate_hz: u32) -> Self {
        let divisor = gcd(rate_hz, SAMPLE_RATE_HZ);
        let (up, down) = (SAMPLE_RATE_HZ / divisor, rate_hz / divisor);
        let filter = Filter::of(rate_hz, up, down);
        // The lower rate's samples per input sample; also the gain that keeps the level.
        let scale = (f64::from(SAMPLE_RATE_HZ) / f64::from(rate_hz)).min(1.0);
        let n_before = (filter.reach() / scale).floor() as usize;
        let n_taps = (2 * n_before + 2).next_multiple_of(LANES);
        let tap = |phase: u32, i: usize| {
            // Output at input position p + phase/up, tap on input sample p − n_before + i.
            let distance = f64::from(phase) / f64::from(up) + n_before as f64 - i as f64;
            (scale * filter.at(distance * scale)) as f32
        };
        let taps = (0..up).flat_map(|phase| (0..n_taps).map(move |i| tap(phase, i))).collect();
        Self { up: up as usize, down: down as usize, n_taps, n_before, taps }
    }

    /// Returns the phases of a rate, made once per process.
    fn of(rate_hz: u32) -> Arc<Self> {
        static MADE: LazyLock<Mutex<HashMap<u32, Arc<Phases>>>> = LazyLock::new(Mutex::default);
        let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
        Arc::clone(made.entry(rate_hz).or_insert_with(|| Arc::new(Phases::new(rate_hz))))
    }
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

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
        let phases = (rate_hz != SAMPLE_RATE_HZ).then(|| Phases::of(rate_hz));
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
            let first_tap = self.phase * phases.n_taps;
            out.push(dot(window, &phases.taps[first_tap..first_tap + phases.n_taps]));
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

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for i in 0..LANES {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum()
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
