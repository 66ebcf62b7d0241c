//! Features that follow from one frame at a time: RMS, spectral centroid, mel bands.

use std::sync::LazyLock;

use super::framing::Framer;
use super::mel::{MelBank, N_MELS, powers_to_db};
use super::stft::PairDft;
use super::{HOP, N_FFT, SAMPLE_RATE_HZ};
use crate::instructions::vectorized;

/// Range of the mel bands that are features, in Hz.
pub const MEL_RANGE_HZ: (f64, f64) = (20.0, 8000.0);
/// Range of the mel bands from which MFCC, onsets and beats come: everything.
const FULL_RANGE_HZ: (f64, f64) = (0.0, 22_050.0);

static MEL_BANK: LazyLock<MelBank> = LazyLock::new(|| MelBank::new(MEL_RANGE_HZ.0, MEL_RANGE_HZ.1));
static FULL_BANK: LazyLock<MelBank> =
    LazyLock::new(|| MelBank::new(FULL_RANGE_HZ.0, FULL_RANGE_HZ.1));

/// Values that sums take side by side: as many f64 as the widest register holds.
const LANES: usize = 8;

vectorized! {
    /// Root mean square of a frame: √(Σ y² / N).
    pub fn rms(frame: &[f32]) -> f32 {
        let (lots, rest) = frame.as_chunks::<LANES>();
        let mut lanes = [0.0; LANES];
        for lot in lots {
            for l in 0..LANES {
                lanes[l] += f64::from(lot[l]) * f64::from(lot[l]);
            }
        }
        let rest: f64 = rest.iter().map(|&y| f64::from(y) * f64::from(y)).sum();
        ((lanes.iter().sum::<f64>() + rest) / frame.len() as f64).sqrt() as f32
    }

    /// Replaces powers by the squares of their roots S rounded to single precision, which librosa's powers are;
    /// adds up k S\[k\] and S\[k\] side by side.
    fn round_roots(power: &mut [f64], weighted: &mut [f64; LANES], sums: &mut [f64; LANES]) {
        let round = |power: &mut f64| {
            let root = power.sqrt() as f32;
            *power = f64::from(root * root);
            f64::from(root)
        };
        let (lots, rest) = power.as_chunks_mut::<LANES>();
        let mut bins: [f64; LANES] = std::array::from_fn(|l| l as f64);
        // Lanes that lie in memory are added to as vectors.
        let (mut weighted_lanes, mut lanes) = (*weighted, *sums);
        for lot in lots {
            let roots = lot.each_mut().map(round);
            for l in 0..LANES {
                weighted_lanes[l] += bins[l] * roots[l];
            }
            for l in 0..LANES {
                lanes[l] += roots[l];
            }
            for bin in &mut bins {
                *bin += LANES as f64;
            }
        }
        for (l, power) in rest.iter_mut().enumerate() {
            let root = round(power);
            weighted_lanes[l] += bins[l] * root;
            lanes[l] += root;
        }
        *weighted = weighted_lanes;
        *sums = lanes;
    }
}

/// Rounds roots as [`round_roots`] and returns Σ_k k S\[k\] and Σ_k S\[k\].
fn moments(power: &mut [f64]) -> [f64; 2] {
    let (mut weighted, mut sums) = ([0.0; LANES], [0.0; LANES]);
    round_roots(power, &mut weighted, &mut sums);
    [weighted.iter().sum(), sums.iter().sum()]
}

/// Spectral centroid in Hz: Σ_k f_k S\[k\] / Σ_k S\[k\], given Σ_k k S\[k\] and Σ_k S\[k\]; 0 for silence.
fn centroid_hz([weighted, sum]: [f64; 2]) -> f64 {
    // librosa's `normalize` leaves columns below the smallest normal f32 as they are: nearly 0.
    if sum < f64::from(f32::MIN_POSITIVE) {
        return 0.0;
    }
    weighted / sum * f64::from(SAMPLE_RATE_HZ) / N_FFT as f64
}

/// Collects what a stream's spectra tell, frame by frame.
pub struct SpectralPass {
    framer: Framer,
    room: Room,
    pub found: Spectral,
}

/// Room for the spectra of two frames.
struct Room {
    dft: PairDft,
    powers: [[f64; N_BINS]; 2],
    mel: [[f32; N_MELS]; 2],
}

/// Bins of a frame's spectrum.
const N_BINS: usize = N_FFT / 2 + 1;

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
        let (powers, mel) = ([[0.0; N_BINS]; 2], [[0.0; N_MELS]; 2]);
        Self {
            framer: Framer::new(N_FFT, HOP),
            room: Room { dft: PairDft::hann(N_FFT), powers, mel },
            found: Spectral::default(),
        }
    }

    /// Takes the next samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        let Self { framer, room, found } = self;
        framer.push_pairs(samples, |first, second| found.add_pair(first, second, room));
    }

    /// Ends the signal.
    pub fn finish(mut self) -> Spectral {
        let Self { framer, room, found } = &mut self;
        framer.finish_pairs(|first, second| found.add_pair(first, second, room));
        self.found
    }
}

impl Default for SpectralPass {
    fn default() -> Self {
        Self::new()
    }
}

impl Spectral {
    fn add_pair(&mut self, first: &[f32], second: Option<&[f32]>, room: &mut Room) {
        let Room { dft, powers, mel } = room;
        let [first_power, second_power] = powers;
        dft.transform(first, second);
        dft.powers(first_power, second_power);
        for (frame, power) in [Some(first), second].into_iter().zip(powers.iter_mut()) {
            let Some(frame) = frame else { continue };
            self.rms.push(rms(frame));
            self.centroid_hz.push(centroid_hz(moments(power)));
        }
        let n_frames = 1 + usize::from(second.is_some());
        for (bank, found) in [(&*MEL_BANK, &mut self.mel_db), (&*FULL_BANK, &mut self.full_db)] {
            bank.apply(powers, mel);
            let db = &mut mel.as_flattened_mut()[..n_frames * N_MELS];
            powers_to_db(db);
            found.extend_from_slice(db);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_has_its_own_rms() {
        assert_eq!(rms(&[-0.25; 9]), 0.25);
        assert_eq!(rms(&[3.0, 4.0, 0.0, 0.0]), 2.5);
        assert_eq!(rms(&[1.5; 24]), 1.5);
    }

    #[test]
    fn the_centroid_is_the_mean_frequency() {
        let centroid = |magnitudes: &[f64]| {
            let mut powers: Vec<f64> = magnitudes.iter().map(|s| s * s).collect();
            let found = centroid_hz(moments(&mut powers));
            // Small integers are rounded to themselves.
            assert!(powers.iter().zip(magnitudes).all(|(p, s)| *p == s * s));
            found
        };
        let bin_hz = 44_100.0 / 2048.0;
        assert_eq!(centroid(&[0.0, 0.0, 3.0, 0.0, 1.0]), 2.5 * bin_hz);
        assert_eq!(centroid(&[0.0; 5]), 0.0);
        // Σk/n = (n − 1)/2 of a flat spectrum, whatever part of it is summed side by side.
        assert_eq!(centroid(&[1.0; 17]), 8.0 * bin_hz);
    }

    #[test]
    fn powers_are_squares_of_rounded_roots() {
        let mut powers = [2.0; 11];
        moments(&mut powers);
        let root = 2f32.sqrt();
        assert_eq!(powers, [f64::from(root * root); 11]);
    }
}
