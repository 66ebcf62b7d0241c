//! Onset envelopes in four registers.

use super::bands::{N_BANDS, Spectra, centres_hz};

/// Registers: kick and bass, low middle, high middle, hats.
pub const N_REGISTERS: usize = 4;
/// Where a register ends, in Hz.
const ENDS_HZ: [f64; N_REGISTERS - 1] = [150.0, 500.0, 2000.0];
/// Frames before, from which a rise is measured.
const LAG: usize = 2;
/// Frames on either side over which the local mean is taken: 0.4 s.
const HALF_MEAN: usize = 40;
/// Root mean square below which no register has onsets; that of music is 0.05 to 0.5.
const MIN_RMS: f64 = 0.005;
/// A register counts as at least this share of the strongest, so that one that is nearly silent stays so.
const MIN_SHARE: f64 = 0.05;

/// Onset envelopes; T frames.
pub struct Onsets {
    /// [T], in root mean squares of the register (or a twentieth of the strongest).
    pub registers: [Vec<f64>; N_REGISTERS],
    /// Whether a register has more than that twentieth.
    pub is_heard: [bool; N_REGISTERS],
    /// [T]: the sum over the registers, in its own standard deviations.
    pub sum: Vec<f64>,
}

/// Returns the rise of band b to frame t over the highest of the bands around it two frames before; before the
/// first frame there is silence (Böck and Widmer 2013, "Maximum filter vibrato suppression for onset detection").
pub fn rise(spectra: &Spectra, t: usize, b: usize) -> f32 {
    let now = spectra.bands[t * N_BANDS + b];
    let Some(before) = t.checked_sub(LAG) else { return now };
    let row = &spectra.bands[before * N_BANDS..(before + 1) * N_BANDS];
    let around = &row[b.saturating_sub(1)..(b + 2).min(N_BANDS)];
    (now - around.iter().copied().fold(0.0, f32::max)).max(0.0)
}

impl Onsets {
    /// Returns the envelopes of compressed spectra; none where there are no onsets.
    pub fn of(spectra: &Spectra) -> Option<Self> {
        let register_of = centres_hz().map(|hz| ENDS_HZ.iter().filter(|&&end| hz >= end).count());
        let envelope = |register: usize| {
            let bands: Vec<usize> = (0..N_BANDS).filter(|&b| register_of[b] == register).collect();
            let mean = |t: usize| {
                bands.iter().map(|&b| f64::from(rise(spectra, t, b))).sum::<f64>()
                    / bands.len() as f64
            };
            smoothed(&above_mean((0..spectra.n_frames()).map(mean).collect()))
        };
        let mut registers: [Vec<f64>; N_REGISTERS] = std::array::from_fn(envelope);
        let n = spectra.n_frames() as f64;
        let rms = registers.each_ref().map(|e| (e.iter().map(|x| x * x).sum::<f64>() / n).sqrt());
        let strongest = rms.iter().copied().fold(0.0, f64::max);
        if strongest < MIN_RMS {
            return None;
        }
        for (e, rms) in registers.iter_mut().zip(rms) {
            let unit = rms.max(MIN_SHARE * strongest);
            e.iter_mut().for_each(|x| *x /= unit);
        }
        let mut sum: Vec<f64> =
            (0..spectra.n_frames()).map(|t| registers.iter().map(|e| e[t]).sum()).collect();
        let mean = sum.iter().sum::<f64>() / n;
        let deviation = (sum.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
        sum.iter_mut().for_each(|x| *x /= deviation.max(f64::MIN_POSITIVE));
        let is_heard = rms.map(|rms| rms > MIN_SHARE * strongest);
        Some(Self { registers, is_heard, sum })
    }
}

/// Returns what exceeds the local mean, with zeros outside.
fn above_mean(e: Vec<f64>) -> Vec<f64> {
    let mut sums = vec![0.0];
    sums.extend(e.iter().scan(0.0, |sum, x| {
        *sum += x;
        Some(*sum)
    }));
    let width = (2 * HALF_MEAN + 1) as f64;
    let mean = |t: usize| {
        (sums[(t + HALF_MEAN + 1).min(e.len())] - sums[t.saturating_sub(HALF_MEAN)]) / width
    };
    e.iter().enumerate().map(|(t, x)| (x - mean(t)).max(0.0)).collect()
}

/// Returns ¼ e[t−1] + ½ e\[t\] + ¼ e[t+1].
fn smoothed(e: &[f64]) -> Vec<f64> {
    let at = |t: Option<usize>| t.and_then(|t| e.get(t)).copied().unwrap_or(0.0);
    (0..e.len()).map(|t| 0.25 * (at(t.checked_sub(1)) + at(Some(t + 1))) + 0.5 * e[t]).collect()
}
