//! The 163 features of a recording, raw and normalised.

use std::borrow::Cow;

use ndarray::{Array2, ArrayView2, Axis, s};

use super::beat::{Rhythm, track_beats};
use super::chroma::{ChromaPass, N_CHROMA};
use super::mel::{N_MELS, clip_below_top};
use super::mfcc::{Dct, N_MFCC};
use super::onset::onset_strength;
use super::spectral::{Spectral, SpectralPass};
use super::tuning::{Tuning, TuningPass};

/// Values of one frame.
pub const FEATURE_DIM: usize = N_MELS + N_CHROMA + N_MFCC + 3;

/// A group of features, in the order in which they stand in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// The name, also the key in a feature file.
    pub name: &'static str,
    /// Values per frame.
    pub len: usize,
    /// What one value is.
    pub meaning: &'static str,
}

/// The blocks of a frame.
pub const BLOCKS: [Block; 6] = [
    Block {
        name: "mel",
        len: N_MELS,
        meaning: "Power in one of 128 mel bands from 20 to 8000 Hz, in dB, scaled to 0 … 1 over the file",
    },
    Block {
        name: "chroma",
        len: N_CHROMA,
        meaning: "Strength of one of the 12 pitch classes, C first, relative to the frame's strongest",
    },
    Block {
        name: "mfcc",
        len: N_MFCC,
        meaning: "One of 20 mel-frequency cepstral coefficients, in standard deviations from the file's mean",
    },
    Block { name: "rms", len: 1, meaning: "Root mean square relative to the file's highest" },
    Block {
        name: "spectral_centroid",
        len: 1,
        meaning: "Centre of the spectrum, scaled to 0 … 1 over the file",
    },
    Block {
        name: "onset_strength",
        len: 1,
        meaning: "Rise in loudness over all mel bands relative to the file's highest",
    },
];

/// Returns the name and the block of every value of a frame: `mel_000` … `onset_strength`.
pub fn feature_names() -> impl Iterator<Item = (Cow<'static, str>, Block)> {
    BLOCKS.into_iter().flat_map(|block| {
        let digits = (block.len.max(1) - 1).to_string().len();
        (0..block.len).map(move |i| match block.len {
            1 => (Cow::Borrowed(block.name), block),
            _ => (Cow::Owned(format!("{}_{i:0digits$}", block.name)), block),
        })
    })
}

/// librosa's scripts add this where they divide by a range, maximum or deviation.
const EPSILON: f64 = 1e-8;
/// Standard deviation of an MFCC below which it counts as constant. librosa's own values there are
/// the rounding of an f32 mean over a deviation of the same size; a deliberate difference.
const MIN_MFCC_DEVIATION: f64 = 1e-3;

/// Why a signal has no features.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FeatureError {
    /// No samples.
    #[error("has no samples; features need at least one")]
    Empty,
}

/// The first pass over a signal: all but the chroma, and the tuning on which that depends.
pub struct FirstPass {
    spectral: SpectralPass,
    tuning: Result<Tuning, TuningPass>,
    n_samples: u64,
}

impl FirstPass {
    /// Starts a signal; `tuning` fixes what would be estimated.
    pub fn new(tuning: Option<Tuning>) -> Self {
        let tuning = tuning.ok_or_else(TuningPass::new);
        Self { spectral: SpectralPass::new(), tuning, n_samples: 0 }
    }

    /// Takes the next mono samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        self.n_samples += samples.len() as u64;
        self.spectral.push(samples);
        if let Err(pass) = &mut self.tuning {
            pass.push(samples);
        }
    }

    /// Ends the signal.
    ///
    /// # Errors
    /// [`FeatureError::Empty`].
    pub fn finish(self) -> Result<SecondPass, FeatureError> {
        if self.n_samples == 0 {
            return Err(FeatureError::Empty);
        }
        let tuning = self.tuning.unwrap_or_else(TuningPass::finish);
        Ok(SecondPass {
            chroma: ChromaPass::new(tuning),
            raw: RawFeatures::from_spectral(self.spectral.finish(), tuning, self.n_samples),
        })
    }
}

/// The second pass over the same signal: chroma.
pub struct SecondPass {
    chroma: ChromaPass,
    raw: RawFeatures,
}

impl SecondPass {
    /// Takes the next mono samples at 44.1 kHz.
    pub fn push(&mut self, samples: &[f32]) {
        self.chroma.push(samples);
    }

    /// Ends the signal.
    pub fn finish(self) -> RawFeatures {
        let mut raw = self.raw;
        raw.chroma = rows(self.chroma.finish(), N_CHROMA);
        raw
    }
}

/// Features before they are normalised over the file; T frames.
#[derive(Clone, Debug, PartialEq)]
pub struct RawFeatures {
    /// Samples at 44.1 kHz; T = 1 + ⌊n/1470⌋.
    pub n_samples: u64,
    pub tuning: Tuning,
    pub rhythm: Rhythm,
    /// [T, 128], dB below the file's loudest band, 0 … −80.
    pub mel_db: Array2<f32>,
    /// [T, 12], each frame divided by its maximum.
    pub chroma: Array2<f32>,
    /// [T, 20].
    pub mfcc: Array2<f32>,
    /// \[T\].
    pub rms: Vec<f32>,
    /// \[T\], Hz.
    pub centroid_hz: Vec<f64>,
    /// \[T\], dB.
    pub onset_strength: Vec<f32>,
}

/// The features of a recording; T frames at 30 fps, frame t centred at t/30 s.
#[derive(Clone, Debug, PartialEq)]
pub struct Features {
    /// [T, 163], the blocks of [`BLOCKS`] side by side.
    pub frames: Array2<f32>,
    /// Samples at 44.1 kHz.
    pub n_samples: u64,
    pub tuning: Tuning,
    pub rhythm: Rhythm,
}

impl Features {
    /// Returns the columns of one block, [T, len].
    pub fn block(&self, name: &str) -> Option<ArrayView2<'_, f32>> {
        let mut first = 0;
        for block in BLOCKS {
            if block.name == name {
                return Some(self.frames.slice(s![.., first..first + block.len]));
            }
            first += block.len;
        }
        None
    }
}

/// Extracts the features of a whole signal at 44.1 kHz.
///
/// # Errors
/// [`FeatureError::Empty`].
pub fn extract(samples: &[f32], tuning: Option<Tuning>) -> Result<RawFeatures, FeatureError> {
    let mut first = FirstPass::new(tuning);
    first.push(samples);
    let mut second = first.finish()?;
    second.push(samples);
    Ok(second.finish())
}

impl RawFeatures {
    fn from_spectral(spectral: Spectral, tuning: Tuning, n_samples: u64) -> Self {
        let Spectral { mut mel_db, mut full_db, rms, centroid_hz } = spectral;
        let top = clip_below_top(&mut mel_db);
        for db in &mut mel_db {
            *db -= top;
        }
        clip_below_top(&mut full_db);
        let onset = onset_strength(&full_db);
        let dct = Dct::new();
        let mfcc = full_db.chunks_exact(N_MELS).flat_map(|db| dct.of(db)).collect();
        Self {
            n_samples,
            tuning,
            rhythm: track_beats(&onset.median),
            mel_db: rows(mel_db, N_MELS),
            chroma: Array2::zeros((0, N_CHROMA)),
            mfcc: rows(mfcc, N_MFCC),
            rms,
            centroid_hz,
            onset_strength: onset.mean,
        }
    }

    /// Normalises every block over the whole file.
    ///
    /// mel and centroid: (x − min)/(max − min + ε); mfcc: (x − mean)/(std + ε) per coefficient;
    /// rms and onset: x/(max + ε); ε = 10⁻⁸. Chroma is left as it is.
    pub fn normalize(self) -> Features {
        let mut frames = Array2::zeros((self.rms.len(), FEATURE_DIM));
        let (mut mel, rest) = frames.view_mut().split_at(Axis(1), N_MELS);
        let (mut chroma, rest) = rest.split_at(Axis(1), N_CHROMA);
        let (mut mfcc, mut curves) = rest.split_at(Axis(1), N_MFCC);

        let (min, max) = range(self.mel_db.iter().map(|&db| f64::from(db)));
        let scaled = |x: f64, min: f64, max: f64| ((x - min) / (max - min + EPSILON)) as f32;
        mel.zip_mut_with(&self.mel_db, |to, &db| *to = scaled(f64::from(db), min, max));
        chroma.assign(&self.chroma);
        for (mut to, from) in mfcc.columns_mut().into_iter().zip(self.mfcc.columns()) {
            let n = from.len() as f64;
            let mean = from.iter().map(|&c| f64::from(c)).sum::<f64>() / n;
            let square = |c: &f32| (f64::from(*c) - mean).powi(2);
            let deviation = (from.iter().map(square).sum::<f64>() / n).sqrt();
            if deviation >= MIN_MFCC_DEVIATION {
                let standard = |c: f32| ((f64::from(c) - mean) / (deviation + EPSILON)) as f32;
                to.zip_mut_with(&from, |to, &c| *to = standard(c));
            }
        }
        let share = |x: f32, max: f64| (f64::from(x) / (max + EPSILON)) as f32;
        let (_, loudest) = range(self.rms.iter().map(|&x| f64::from(x)));
        let (_, strongest) = range(self.onset_strength.iter().map(|&x| f64::from(x)));
        let (low, high) = range(self.centroid_hz.iter().copied());
        for (t, mut curve) in curves.rows_mut().into_iter().enumerate() {
            curve[0] = share(self.rms[t], loudest);
            curve[1] = scaled(self.centroid_hz[t], low, high);
            curve[2] = share(self.onset_strength[t], strongest);
        }
        let Self { n_samples, tuning, rhythm, .. } = self;
        Features { frames, n_samples, tuning, rhythm }
    }
}

fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), x| (min.min(x), max.max(x)))
}

fn rows(values: Vec<f32>, len: usize) -> Array2<f32> {
    let n_rows = values.len() / len;
    Array2::from_shape_vec((n_rows, len), values)
        .expect("invariant: every frame adds one row of values")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_has_163_named_values() {
        let names: Vec<_> = feature_names().map(|(name, _)| name.into_owned()).collect();
        assert_eq!(names.len(), FEATURE_DIM);
        assert_eq!(FEATURE_DIM, 163);
        let at = [0, 127, 128, 139, 140, 159, 160, 161, 162].map(|i| names[i].as_str());
        let expected = [
            "mel_000",
            "mel_127",
            "chroma_00",
            "chroma_11",
            "mfcc_00",
            "mfcc_19",
            "rms",
            "spectral_centroid",
            "onset_strength",
        ];
        assert_eq!(at, expected);
    }

    #[test]
    fn lengths_follow_the_definition() {
        for (n, t) in [(1, 1), (1469, 1), (1470, 2), (44_100, 31)] {
            let raw = extract(&vec![0.1; n], None).expect("samples");
            assert_eq!((raw.mel_db.dim(), raw.chroma.dim()), ((t, 128), (t, 12)), "{n}");
            assert_eq!(raw.normalize().frames.dim(), (t, 163), "{n}");
        }
        assert_eq!(extract(&[], None), Err(FeatureError::Empty));
    }

    #[test]
    fn silence_is_zero_everywhere() {
        let features = extract(&[0.0; 9000], None).expect("samples").normalize();
        assert!(features.frames.iter().all(|&x| x == 0.0));
        assert_eq!((features.tuning, features.rhythm), (Tuning::STANDARD, Rhythm::default()));
    }

    #[test]
    fn one_frame_is_normalised_by_itself() {
        let features = extract(&[0.5], None).expect("samples").normalize();
        let at = |i: usize| features.frames[[0, i]];
        // ε is a thousandth of the highest RMS here: 0.5/√2048 = 0.011.
        assert!((at(160) - 1.0).abs() < 1e-5);
        assert_eq!((at(161), at(162)), (0.0, 0.0));
        assert!(features.block("mfcc").is_some_and(|mfcc| mfcc.iter().all(|&x| x == 0.0)));
        let mel = features.block("mel").expect("a block");
        assert_eq!(mel.iter().copied().fold(f32::NAN, f32::min), 0.0);
    }

    #[test]
    fn blocks_of_the_stream_do_not_matter() {
        let y: Vec<f32> = (0..30_011).map(|i| ((i * i) as f32 * 1e-4).sin() * 0.3).collect();
        let whole = extract(&y, None).expect("samples");
        let mut first = FirstPass::new(None);
        y.chunks(1237).for_each(|samples| first.push(samples));
        let mut second = first.finish().expect("samples");
        y.chunks(4099).for_each(|samples| second.push(samples));
        assert_eq!(second.finish(), whole);
    }
}
