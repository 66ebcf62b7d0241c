//! Features that follow from one frame at a time: RMS, spectral centroid, mel bands.

use std::sync::LazyLock;

use super::framing::Framer;
use super::mel::{MelBank, N_MELS, power_to_db};
use super::stft::{Dft, hann_power};
use super::{HOP, N_FFT, SAMPLE_RATE_HZ};

/// Range of the mel bands that are features, in Hz.
pub const MEL_RANGE_HZ: (f64, f64) = (20.0, 8000.0);
/// Range of the mel bands from which MFCC, onsets and beats come: everything.
const FULL_RANGE_HZ: (f64, f64) = (0.0, 22_050.0);

static MEL_BANK: LazyLock<MelBank> = LazyLock::new(|| MelBank::new(MEL_RANGE_HZ.0, MEL_RANGE_HZ.1));
static FULL_BANK: LazyLock<MelBank> =
    LazyLock::new(|| MelBank::new(FULL_RANGE_HZ.0, FULL_RANGE_HZ.1));

/// Root mean square of a frame: √(Σ y² / N).
pub fn rms(frame: &[f32]) -> f32 {
    let energy: f64 = frame.iter().map(|&y| f64::from(y) * f64::from(y)).sum();
    (energy / frame.len() as f64).sqrt() as f32
}

/// Spectral centroid in Hz: Σ_k f_k S\[k\] / Σ_k S\[k\]; 0 for silence.
pub fn centroid_hz(magnitude: &[f64]) -> f64 {
    let (mut weighted, mut sum) = (0.0, 0.0);
    for (k, s) in magnitude.iter().enumerate() {
        weighted += k as f64 * s;
        sum += s;
    }
    // librosa's `normalize` leaves columns below the smallest normal f32 as they are: nearly 0.
    if sum < f64::from(f32::MIN_POSITIVE) {
        return 0.0;
    }
    weighted / sum * f64::from(SAMPLE_RATE_HZ) / N_FFT as f64
}

/// Collects what a stream's spectra tell, frame by frame.
pub struct SpectralPass {
    framer: Framer,
    dft: Dft,
    power: Vec<f64>,
    magnitude: Vec<f64>,
    pub found: Spectral,
}

/// What [`SpectralPass`] collected; T frames.
#[derive(Clone, Debug, Default)]
pub struct Spectral {
    /// Mel power in dB over 1, 20–8000 Hz, [T, 128] row by row, unclipped.
    pub mel_db: Vec<f32>,
    /// The same over 0–22,050 Hz.
    pub full_db: Vec<f32>,
    pub rms: Vec<f32>,
    pub centroid_hz: Vec<f64>,
}

impl SpectralPass {
    pub fn new() -> Self {
        Self {
            framer: Framer::new(N_FFT, HOP),
            dft: Dft::new(N_FFT),
            power: vec![0.0; N_FFT / 2 + 1],
            magnitude: vec![0.0; N_FFT / 2 + 1],
            found: Spectral::default(),
        }
    }

    /// Takes the next samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        let Self { framer, dft, power, magnitude, found } = self;
        framer.push(samples, |frame| found.add(frame, dft, power, magnitude));
    }

    /// Ends the signal.
    pub fn finish(mut self) -> Spectral {
        let Self { framer, dft, power, magnitude, found } = &mut self;
        framer.finish(|frame| found.add(frame, dft, power, magnitude));
        self.found
    }
}

impl Default for SpectralPass {
    fn default() -> Self {
        Self::new()
    }
}

impl Spectral {
    fn add(&mut self, frame: &[f32], dft: &mut Dft, power: &mut [f64], magnitude: &mut [f64]) {
        hann_power(dft.of(frame), power);
        for (s, p) in magnitude.iter_mut().zip(power.iter_mut()) {
            // librosa squares the magnitude that it has rounded to f32.
            let rounded = p.sqrt() as f32;
            *s = f64::from(rounded);
            *p = f64::from(rounded * rounded);
        }
        self.rms.push(rms(frame));
        self.centroid_hz.push(centroid_hz(magnitude));
        let db = |bank: &MelBank| -> [f32; N_MELS] { bank.apply(power).map(power_to_db) };
        self.mel_db.extend(db(&MEL_BANK));
        self.full_db.extend(db(&FULL_BANK));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_has_its_own_rms() {
        assert_eq!(rms(&[-0.25; 9]), 0.25);
        assert_eq!(rms(&[3.0, 4.0, 0.0, 0.0]), 2.5);
    }

    #[test]
    fn the_centroid_is_the_mean_frequency() {
        let bin_hz = 44_100.0 / 2048.0;
        assert_eq!(centroid_hz(&[0.0, 0.0, 3.0, 0.0, 1.0]), 2.5 * bin_hz);
        assert_eq!(centroid_hz(&[0.0; 5]), 0.0);
    }
}
