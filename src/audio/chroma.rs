//! Chroma: how strongly each of the twelve pitch classes sounds, from the constant-Q transform.

use std::sync::Arc;

use super::cqt::{DFT_BINS, OctaveKernels, Spectrum, kernels, magnitudes, octaves};
use super::decimate::Halver;
use super::framing::Framer;
use super::sliding_dft::SlidingDft;
use super::stft::PairDft;
use super::tuning::{BINS_PER_OCTAVE, Tuning};

/// Pitch classes, C first.
pub const N_CHROMA: usize = 12;

/// Returns the pitch class of a constant-Q bin: the three around a semitone belong to it.
fn pitch_class(bin: usize) -> usize {
    (bin % BINS_PER_OCTAVE + 1) / 3 % N_CHROMA
}

/// Sums a stream's constant-Q magnitudes into pitch classes.
pub struct ChromaPass {
    kernels: Arc<Vec<OctaveKernels>>,
    highest: (Framer, PairDft),
    halver: Halver,
    halved: Vec<f32>,
    second: (Framer, PairDft),
    low: Vec<SlidingDft>,
    /// Sums of the frames so far, [T, 12] row by row.
    sums: Vec<[f64; N_CHROMA]>,
    /// Frames that each octave has added.
    n_done: Vec<usize>,
}

impl ChromaPass {
    pub fn new(tuning: Tuning) -> Self {
        let octaves = octaves();
        let frames = |i: usize| {
            let octave = octaves[i];
            (Framer::new(octave.n_fft, octave.hop), PairDft::new(octave.n_fft))
        };
        Self {
            kernels: kernels(tuning),
            highest: frames(0),
            halver: Halver::new(),
            halved: Vec::new(),
            second: frames(1),
            low: octaves[2..].iter().filter_map(|octave| SlidingDft::new(*octave)).collect(),
            sums: Vec::new(),
            n_done: vec![0; octaves.len()],
        }
    }

    /// Takes the next samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        let mut adder =
            Adder { kernels: &self.kernels, sums: &mut self.sums, n_done: &mut self.n_done };
        let (framer, dft) = &mut self.highest;
        framer.push_pairs(samples, |a, b| adder.add_pair(0, a, b, dft));
        self.halved.clear();
        self.halver.push(samples, &mut self.halved);
        let (framer, dft) = &mut self.second;
        framer.push_pairs(&self.halved, |a, b| adder.add_pair(1, a, b, dft));
        for (octave, sliding) in (2..).zip(&mut self.low) {
            sliding.push(&self.halved, |spectrum| adder.add(octave, spectrum));
        }
    }

    /// Ends the signal and returns the chroma, [T, 12] row by row: c / max c for every frame.
    ///
    /// Silent frames stay 0.
    pub fn finish(mut self) -> Vec<f32> {
        let mut adder =
            Adder { kernels: &self.kernels, sums: &mut self.sums, n_done: &mut self.n_done };
        let (framer, dft) = &mut self.highest;
        framer.finish_pairs(|a, b| adder.add_pair(0, a, b, dft));
        self.halved.clear();
        self.halver.finish(&mut self.halved);
        let (framer, dft) = &mut self.second;
        framer.push_pairs(&self.halved, |a, b| adder.add_pair(1, a, b, dft));
        framer.finish_pairs(|a, b| adder.add_pair(1, a, b, dft));
        for (octave, sliding) in (2..).zip(&mut self.low) {
            sliding.push(&self.halved, |spectrum| adder.add(octave, spectrum));
            sliding.finish(|spectrum| adder.add(octave, spectrum));
        }
        // Every octave has as many frames as the highest, or one more where n is odd.
        self.sums.truncate(self.n_done[0]);
        self.sums.iter().flat_map(|sums| normalized(*sums)).collect()
    }
}

struct Adder<'a> {
    kernels: &'a [OctaveKernels],
    sums: &'a mut Vec<[f64; N_CHROMA]>,
    n_done: &'a mut [usize],
}

impl Adder<'_> {
    /// Transforms and adds the next frame of an octave, or two.
    fn add_pair(
        &mut self,
        octave: usize,
        first: &[f32],
        second: Option<&[f32]>,
        dft: &mut PairDft,
    ) {
        dft.transform(first, second);
        for i in 0..=usize::from(second.is_some()) {
            let mut spectrum = Spectrum::default();
            dft.bins(i, *DFT_BINS.start(), &mut spectrum.re, &mut spectrum.im);
            self.add(octave, &spectrum);
        }
    }

    /// Adds the next frame of an octave.
    fn add(&mut self, octave: usize, spectrum: &Spectrum) {
        let frame = self.n_done[octave];
        self.n_done[octave] += 1;
        if frame == self.sums.len() {
            self.sums.push([0.0; N_CHROMA]);
        }
        let mut strengths = [0.0; BINS_PER_OCTAVE];
        magnitudes(&self.kernels[octave], spectrum, &mut strengths);
        for (bin, strength) in strengths.into_iter().enumerate() {
            self.sums[frame][pitch_class(bin)] += strength;
        }
    }
}

fn normalized(sums: [f64; N_CHROMA]) -> [f32; N_CHROMA] {
    let max = sums.iter().copied().fold(0.0, f64::max);
    // librosa leaves frames below the smallest normal f32 as they are.
    let scale = if max < f64::from(f32::MIN_POSITIVE) { 1.0 } else { 1.0 / max };
    sums.map(|c| (c * scale) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn three_bins_make_a_pitch_class() {
        let classes: Vec<_> = (0..7).chain([34, 35, 36]).map(pitch_class).collect();
        assert_eq!(classes, [0, 0, 1, 1, 1, 2, 2, 11, 0, 0]);
    }

    #[test]
    fn every_octave_of_a_note_is_heard_as_that_note() {
        // A1 … A7, a tone in each octave of the transform.
        for octave in 0..7 {
            let hz = 55.0 * f64::from(1 << octave);
            let y: Vec<f32> = (0..66_150)
                .map(|i| (0.5 * (TAU * hz * f64::from(i) / 44_100.0).sin()) as f32)
                .collect();
            let mut pass = ChromaPass::new(Tuning::STANDARD);
            pass.push(&y);
            let chroma = pass.finish();
            assert_eq!(chroma.len(), 46 * N_CHROMA);
            let middle = &chroma[23 * N_CHROMA..24 * N_CHROMA];
            assert_eq!(middle[9], 1.0, "{hz} Hz: {middle:?}");
            assert!(middle[3] < 0.01, "{hz} Hz: {middle:?}");
        }
    }
}
