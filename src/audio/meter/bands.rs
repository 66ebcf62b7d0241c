//! What a song sounds like at 100 frames per second: magnitudes in 36 mel bands, and of the 12 notes.

use super::HOP;
use crate::audio::bank::Bank;
use crate::audio::framing::Framer;
use crate::audio::mel::{hz_to_mel, mel_to_hz};
use crate::audio::stft::PairDft;
use crate::audio::{N_FFT, SAMPLE_RATE_HZ};
use crate::instructions::vectorized;

/// Bins of a frame's spectrum.
const N_BINS: usize = N_FFT / 2 + 1;

/// Bands of the spectrum.
pub const N_BANDS: usize = 36;
/// Notes of the octave.
pub const N_NOTES: usize = 12;
/// Range of the bands, in Hz.
const BANDS_HZ: (f64, f64) = (30.0, 11_000.0);
/// Range of the notes, in Hz: a bin is a semitone wide at 360 Hz, and two at 180 Hz.
const NOTES_HZ: (f64, f64) = (180.0, 2500.0);
/// Magnitudes are heard relative to a loud frame, and log(1 + 1000 x) of them counts.
const COMPRESSION: f32 = 1000.0;
/// The share of frames that are not louder than a loud one.
const LOUD_QUANTILE: f64 = 0.95;

/// Returns the centre frequencies of the bands, in Hz.
pub fn centres_hz() -> [f64; N_BANDS] {
    let e = edges_hz();
    std::array::from_fn(|i| e[i + 1])
}

fn edges_hz() -> Vec<f64> {
    let (low, high) = (hz_to_mel(BANDS_HZ.0), hz_to_mel(BANDS_HZ.1));
    let step = (high - low) / (N_BANDS + 1) as f64;
    (0..N_BANDS + 2).map(|j| mel_to_hz(low + step * j as f64)).collect()
}

fn bin_hz(k: usize) -> f64 {
    k as f64 * f64::from(SAMPLE_RATE_HZ) / N_FFT as f64
}

/// The spectra of a song; T frames, frame t centred at t/100 s.
pub struct Spectra {
    /// [T, 36] row by row.
    pub bands: Vec<f32>,
    /// [T, 12] row by row, C first.
    pub notes: Vec<f32>,
}

impl Spectra {
    pub fn n_frames(&self) -> usize {
        self.bands.len() / N_BANDS
    }

    /// Returns the bands as ln(1 + 1000 x / r), r being the strongest band of a loud frame; none for silence.
    pub fn compressed(mut self) -> Option<Self> {
        let strongest = |row: &[f32]| row.iter().copied().fold(0f32, f32::max);
        let mut levels: Vec<f32> = self.bands.chunks_exact(N_BANDS).map(strongest).collect();
        let at = (LOUD_QUANTILE * levels.len() as f64) as usize;
        if at >= levels.len() {
            return None;
        }
        let loud = *levels.select_nth_unstable_by(at, f32::total_cmp).1;
        if loud <= 0.0 {
            return None;
        }
        for x in &mut self.bands {
            *x = (*x / loud * COMPRESSION).ln_1p();
        }
        Some(self)
    }
}

/// Collects the spectra of a stream.
pub struct BandPass {
    framer: Framer,
    dft: PairDft,
    powers: [[f64; N_BINS]; 2],
    hearing: Hearing,
    found: Spectra,
}

/// What is heard of a spectrum.
struct Hearing {
    /// One row per band, whose weights sum to 1.
    bank: Bank,
    /// Bins up to the highest that is heard.
    n_bins: usize,
    /// First bin of the notes; of every bin the note below and the share of the note above.
    notes: (usize, Vec<(usize, f64)>),
}

impl BandPass {
    pub fn new() -> Self {
        Self {
            framer: Framer::new(N_FFT, HOP),
            dft: PairDft::hann(N_FFT),
            powers: [[0.0; N_BINS]; 2],
            hearing: Hearing::new(),
            found: Spectra { bands: Vec::new(), notes: Vec::new() },
        }
    }

    /// Takes the next samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        self.with(|framer, visit| framer.push_pairs(samples, visit));
    }

    /// Ends the signal.
    pub fn finish(mut self) -> Spectra {
        self.with(|framer, visit| framer.finish_pairs(visit));
        self.found
    }

    fn with(&mut self, pairs: impl FnOnce(&mut Framer, &mut dyn FnMut(&[f32], Option<&[f32]>))) {
        let Self { framer, dft, powers: [first_power, second_power], hearing, found } = self;
        pairs(framer, &mut |first, second| {
            dft.transform(first, second);
            dft.powers(first_power, second_power);
            let n_frames = 1 + usize::from(second.is_some());
            hearing.add([first_power, second_power], n_frames, found);
        });
    }
}

impl Hearing {
    fn new() -> Self {
        let e = edges_hz();
        let band = |i: usize| {
            let weight = |k: usize| {
                let hz = bin_hz(k);
                ((hz - e[i]) / (e[i + 1] - e[i])).min((e[i + 2] - hz) / (e[i + 2] - e[i + 1]))
            };
            let bins: Vec<usize> = (0..=N_FFT / 2).filter(|&k| weight(k) > 0.0).collect();
            let sum: f64 = bins.iter().map(|&k| weight(k)).sum();
            let weights = bins.iter().map(|&k| weight(k) / sum).collect();
            (bins.first().copied().unwrap_or(0), weights)
        };
        let is_note = |&k: &usize| (NOTES_HZ.0..=NOTES_HZ.1).contains(&bin_hz(k));
        let first = (0..N_FFT / 2).find(is_note).unwrap_or(0);
        let note = |k: usize| {
            // MIDI's numbers: 69 is A of 440 Hz, 60 a C.
            let pitch = 69.0 + 12.0 * (bin_hz(k) / 440.0).log2();
            (pitch.floor() as usize % N_NOTES, pitch.fract())
        };
        let notes = (first..N_FFT / 2).take_while(is_note).map(note).collect();
        let bands: Vec<(usize, Vec<f64>)> = (0..N_BANDS).map(band).collect();
        let n_bins = bands.iter().map(|(first, w)| first + w.len()).max().unwrap_or(0);
        Self { bank: Bank::new(N_BINS, bands), n_bins, notes: (first, notes) }
    }

    /// Adds what is heard of a frame or two, given |X\[k\]|², of which the roots are taken in place.
    fn add(&self, powers: [&mut [f64; N_BINS]; 2], n_frames: usize, found: &mut Spectra) {
        let [first, second] = powers.map(|power| {
            take_roots(&mut power[..self.n_bins]);
            &power[..]
        });
        let mut bands = [[0.0; N_BANDS]; 2];
        let [first_bands, second_bands] = &mut bands;
        self.bank.apply([first, second], [first_bands, second_bands]);
        found.bands.extend_from_slice(bands[..n_frames].as_flattened());
        for magnitude in [first, second].into_iter().take(n_frames) {
            let mut strengths = [0.0; N_NOTES];
            for (m, &(note, share)) in magnitude[self.notes.0..].iter().zip(&self.notes.1) {
                strengths[note] += m * (1.0 - share);
                strengths[(note + 1) % N_NOTES] += m * share;
            }
            found.notes.extend(strengths.map(|x| x as f32));
        }
    }
}

vectorized! {
    fn take_roots(values: &mut [f64]) {
        for x in values {
            *x = x.sqrt();
        }
    }
}
