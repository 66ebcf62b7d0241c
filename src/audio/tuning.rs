//! How far a recording's pitch lies from A440, in bins of 1/36 octave.
//!
//! librosa's `estimate_tuning` with 36 bins per octave, to the letter: on real music the histogram
//! is nearly flat, so that one vote can move the chroma of the whole file.

use std::fmt;
use std::ops::Range;

use super::framing::Framer;
use super::stft::PairDft;
use super::{N_FFT, SAMPLE_RATE_HZ};
use crate::instructions::vectorized;

/// Bins of the constant-Q transform per octave.
pub const BINS_PER_OCTAVE: usize = 36;
/// Candidates: −0.50, −0.49 … 0.49.
const N_CANDIDATES: usize = 100;
/// Frames of the estimate are closer than those of the features.
const HOP: usize = 512;
/// Spectral bins with 150 Hz ≤ f < 4000 Hz.
const PITCH_BINS: Range<usize> = 7..186;
/// A peak counts if it reaches this share of its frame's highest magnitude.
const THRESHOLD: f32 = 0.1;
/// Lowest A of the piano, to which residuals refer.
const A0_HZ: f32 = 27.5;

/// Deviation from A440 in fractions of 1/36 octave, from −0.5 to below 0.5.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct Tuning(f64);

impl Tuning {
    /// A440.
    pub const STANDARD: Tuning = Tuning(0.0);

    /// Takes a deviation in bins.
    ///
    /// # Errors
    /// [`TuningRangeError`] outside −0.5 … 0.5, where it would be another bin's.
    pub fn new(bins: f64) -> Result<Self, TuningRangeError> {
        if (-0.5..0.5).contains(&bins) { Ok(Self(bins)) } else { Err(TuningRangeError(bins)) }
    }

    /// Returns the left edge of a histogram bin, as `numpy.linspace(-0.5, 0.5, 101)[i]`.
    fn of_candidate(i: usize) -> Self {
        Self(i as f64 * (1.0 / N_CANDIDATES as f64) - 0.5)
    }

    /// Returns the deviation in bins of 1/36 octave.
    pub fn bins(self) -> f64 {
        self.0
    }
}

impl fmt::Display for Tuning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// A tuning outside its range.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "tuning {0} is outside -0.5 <= tuning < 0.5 (in bins of 1/36 octave); give the nearest bin's"
)]
pub struct TuningRangeError(f64);

impl std::str::FromStr for Tuning {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let bins = text.parse::<f64>().map_err(|_| format!("tuning {text:?} is not a number"))?;
        Self::new(bins).map_err(|e| e.to_string())
    }
}

/// Collects spectral peaks from a stream at 44.1 kHz.
pub struct TuningPass {
    framer: Framer,
    dft: PairDft,
    powers: [[f64; N_FFT / 2 + 1]; 2],
    peaks: Peaks,
}

/// Peaks of a file: the candidate that each votes for, and its magnitude.
#[derive(Default)]
struct Peaks {
    candidates: Vec<u8>,
    magnitudes: Vec<f32>,
}

impl TuningPass {
    pub fn new() -> Self {
        Self {
            framer: Framer::new(N_FFT, HOP),
            dft: PairDft::hann(N_FFT),
            powers: [[0.0; N_FFT / 2 + 1]; 2],
            peaks: Peaks::default(),
        }
    }

    /// Takes the next samples.
    pub fn push(&mut self, samples: &[f32]) {
        let Self { framer, dft, powers, peaks } = self;
        framer.push_pairs(samples, |first, second| peaks.add_pair(first, second, dft, powers));
    }

    /// Ends the signal and returns the most frequent tuning, [`Tuning::STANDARD`] without peaks.
    ///
    /// Peaks below the median magnitude have no vote; ties go to the lowest tuning.
    pub fn finish(mut self) -> Tuning {
        let Self { framer, dft, powers, peaks } = &mut self;
        framer.finish_pairs(|first, second| peaks.add_pair(first, second, dft, powers));
        self.peaks.tuning()
    }
}

impl Default for TuningPass {
    fn default() -> Self {
        Self::new()
    }
}

impl Peaks {
    fn add_pair(
        &mut self,
        first: &[f32],
        second: Option<&[f32]>,
        dft: &mut PairDft,
        powers: &mut [[f64; N_FFT / 2 + 1]; 2],
    ) {
        let [first_power, second_power] = powers;
        dft.transform(first, second);
        dft.powers(first_power, second_power);
        self.add(first_power);
        if second.is_some() {
            self.add(second_power);
        }
    }

    /// Adds the peaks of one frame, interpolated by a parabola through three bins.
    fn add(&mut self, power: &[f64]) {
        let highest = highest(power).sqrt() as f32;
        let threshold = THRESHOLD * highest;
        let mut s = [0f32; PITCH_BINS.end + 1];
        let bins = PITCH_BINS.start - 1..PITCH_BINS.end + 1;
        roots(&power[bins.clone()], &mut s[bins]);
        // Magnitudes at or below the threshold count as 0 when maxima are sought.
        let z = |k: usize| if s[k] > threshold { s[k] } else { 0.0 };
        for k in PITCH_BINS {
            if !(z(k) > z(k - 1) && z(k) >= z(k + 1)) {
                continue;
            }
            let slope = (s[k + 1] - s[k - 1]) / 2.0;
            // librosa's stencil goes over to f64 here.
            let a = f64::from(s[k + 1] + s[k - 1]) - 2.0 * f64::from(s[k]);
            let b = f64::from(s[k + 1] - s[k - 1]) / 2.0;
            let shift = if b.abs() >= a.abs() { 0.0 } else { (-b / a) as f32 };
            let rate_hz = f64::from(SAMPLE_RATE_HZ);
            let pitch_hz = ((k as f64 + f64::from(shift)) * rate_hz / N_FFT as f64) as f32;
            self.candidates.push(candidate(pitch_hz));
            self.magnitudes.push(s[k] + 0.5 * slope * shift);
        }
    }

    fn tuning(mut self) -> Tuning {
        if self.magnitudes.is_empty() {
            return Tuning::STANDARD;
        }
        // The votes keep their order, so the median works on a copy.
        let mut sorted = self.magnitudes.clone();
        let threshold = median(&mut sorted);
        let mut votes = [0u64; N_CANDIDATES];
        for (candidate, magnitude) in self.candidates.drain(..).zip(self.magnitudes) {
            if magnitude >= threshold {
                votes[usize::from(candidate)] += 1;
            }
        }
        // The first of equals: `max_by_key` alone would return the last.
        let best = (0..N_CANDIDATES).rev().max_by_key(|&i| votes[i]).unwrap_or(0);
        Tuning::of_candidate(best)
    }
}

vectorized! {
    /// Returns the largest of some values that are neither negative nor NaN.
    fn highest(values: &[f64]) -> f64 {
        // They are ordered as the integers that their bits are, and maxima of integers vectorise.
        let bits = values.iter().fold(0, |highest, x| x.to_bits().cast_signed().max(highest));
        f64::from_bits(bits.cast_unsigned())
    }

    /// Writes √p, rounded to single precision.
    fn roots(powers: &[f64], roots: &mut [f32]) {
        for (root, p) in roots.iter_mut().zip(powers) {
            *root = p.sqrt() as f32;
        }
    }
}

/// Returns the histogram bin of a pitch: r = 36·log₂(f/27.5) mod 1, from −½ to ½, in f32.
fn candidate(pitch_hz: f32) -> u8 {
    // Rounded from f64: within one unit of the last place of any f32 logarithm.
    let octaves = f64::from(pitch_hz / A0_HZ).log2() as f32;
    // Pitches above A0: what lies behind the point, exactly.
    let bins = BINS_PER_OCTAVE as f32 * octaves;
    let mut r = bins - bins as i32 as f32;
    if r >= 0.5 {
        r -= 1.0;
    }
    let r = f64::from(r);
    // Bins are closed on the left. The product may round across an edge, so the edges decide.
    let guess = ((r + 0.5) * N_CANDIDATES as f64) as usize;
    let below = guess.min(N_CANDIDATES - 1);
    let bin = if r < Tuning::of_candidate(below).0 {
        below.saturating_sub(1)
    } else if below + 1 < N_CANDIDATES && r >= Tuning::of_candidate(below + 1).0 {
        below + 1
    } else {
        below
    };
    bin as u8
}

/// Returns the median: the mean of the two middle values when there are two.
fn median(values: &mut [f32]) -> f32 {
    let half = values.len() / 2;
    let is_even = values.len().is_multiple_of(2);
    let (below, &mut upper, _) = values.select_nth_unstable_by(half, f32::total_cmp);
    if !is_even {
        return upper;
    }
    let lower = below.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    (lower + upper) / 2.0
}

#[cfg(test)]
mod tests;
