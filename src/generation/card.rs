//! `model.json`: what a model's folder says of itself.

use serde::{Deserialize, Serialize};

use super::LearnedFrom;
use crate::audio::{FEATURE_DIM, FeatureScale, feature_names};
use crate::diffusion::DiffusionConfig;
use crate::model::{DecoderConfig, UNetConfig};
use crate::motion::postprocess::FusionVariances;
use crate::motion::rates::MotionRange;
use crate::motion::{CHANNEL_NAMES, Normalizer};
use crate::onnx::Storage;
use crate::units::FPS;

/// Layout of the card; raised when a field changes its meaning.
pub const MODEL_FORMAT: u32 = 1;

/// The names of a model's files.
pub mod file_names {
    pub const CARD: &str = "model.json";
    pub const UNET: &str = "unet.onnx";
    /// Weights of a UNet that is too large for one file.
    pub const UNET_WEIGHTS: &str = "unet.weights.bin";
    pub const DECODER: &str = "decoder.onnx";
    pub const DECODER_WEIGHTS: &str = "decoder.weights.bin";
}

/// A model: where it comes from, how it is used, and its files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelCard {
    pub format: u32,
    pub name: String,
    /// The program that wrote it.
    pub program: String,
    pub provenance: Provenance,
    pub precision: Storage,
    pub unet: UNetConfig,
    pub decoder: DecoderConfig,
    pub diffusion: DiffusionConfig,
    /// ᾱ of each step of the diffusion, for whoever samples without this program.
    pub alphas_cumprod: Vec<f64>,
    pub n_parameters: Networks<usize>,
    /// SHA-256 of each network's weights as f32, in the order in which its layers are made.
    pub weights_sha256: Networks<String>,
    /// Frames that it was trained on; longer motion is sampled in windows of as many.
    pub window_frames: usize,
    /// Frames a second.
    pub fps: f64,
    /// Names of the channels of motion, in order.
    pub channels: Vec<String>,
    /// Names of the features of the music, in order.
    pub features: Vec<String>,
    /// Centre and scale of each channel of motion.
    pub normalizer: Normalizer,
    /// Centre and scale of each feature; `unet.onnx` applies them itself.
    pub feature_scale: FeatureScale,
    /// How fast the motion is that it was trained on; generated motion is held to it.
    #[serde(default)]
    pub motion_range: Option<MotionRange>,
    /// How it is best sampled; cards of release 0.1 do not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampling: Option<SamplingDefaults>,
    pub licence: String,
    pub files: Vec<FileEntry>,
}

/// How a model is best sampled, as measured on the songs of its validation split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SamplingDefaults {
    /// With which the motion that is locked to the bar is as large as that of real motion.
    pub guidance: f64,
    /// Of the errors that the decoder leaves, by which post-processing weighs its channels.
    pub fusion_variances: FusionVariances,
}

/// Guidance of models whose card tells none, as release 0.1 sampled them.
const GUIDANCE_WITHOUT_CARD: f64 = 4.0;

/// What a model was made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    pub run: String,
    /// `diffusion` (UNet and decoder trained apart) or `finetune` (end to end).
    pub stage: String,
    pub unet_step: u64,
    pub decoder_step: u64,
    pub validation_loss: Option<f64>,
    /// Digest of the phrases.
    pub data: String,
    /// Which music that was; cards of release 0.1 do not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learned_from: Option<LearnedFrom>,
}

/// Something of each network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Networks<T> {
    pub unet: T,
    pub decoder: T,
}

/// A file of a model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileEntry {
    pub name: String,
    pub n_bytes: u64,
    pub sha256: String,
}

/// Why a model cannot be used by this program.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CardError {
    #[error("{place}: is no description of a model ({reason}); export the model again")]
    Unreadable { place: String, reason: String },
    #[error(
        "{place}: has format {found}, this program reads format {MODEL_FORMAT}; use the version of \
         motiongen that wrote it, or export the model again"
    )]
    Format { place: String, found: u32 },
    #[error(
        "{place}: is a model of other {what}: {detail}; train and export a model with this version of \
         motiongen"
    )]
    Layout { place: String, what: &'static str, detail: String },
    #[error("{place}: {problem}")]
    Config { place: String, problem: String },
    #[error("{place}: has no file {name}; export the model again")]
    NoFile { place: String, name: &'static str },
    #[error(
        "{place}: SHA-256 is {found}, model.json says {expected}; the file was changed or damaged; copy it \
         again or export the model again"
    )]
    Digest { place: String, found: String, expected: String },
}

impl ModelCard {
    /// Reads a card; `place` is what messages call it.
    ///
    /// # Errors
    /// One sentence for a text that is no card, another format, another layout of channels or features.
    pub fn read(bytes: &[u8], place: &str) -> Result<Self, CardError> {
        #[derive(Deserialize)]
        struct Head {
            format: u32,
        }
        let place = || place.to_owned();
        let unreadable =
            |e: serde_json::Error| CardError::Unreadable { place: place(), reason: e.to_string() };
        let Head { format } = serde_json::from_slice(bytes).map_err(unreadable)?;
        if format != MODEL_FORMAT {
            return Err(CardError::Format { place: place(), found: format });
        }
        let card: Self = serde_json::from_slice(bytes).map_err(unreadable)?;
        let layout = |what, detail| Err(CardError::Layout { place: place(), what, detail });
        if let Some(detail) = difference(&card.channels, &own_channels()) {
            return layout("channels", detail);
        }
        if let Some(detail) = difference(&card.features, &own_features()) {
            return layout("features", detail);
        }
        if card.fps != FPS {
            return layout("frames", format!("{} a second instead of {FPS}", card.fps));
        }
        let n_scaled = card.feature_scale.centre.len().min(card.feature_scale.scale.len());
        if n_scaled != FEATURE_DIM {
            return layout("features", format!("{n_scaled} are scaled instead of {FEATURE_DIM}"));
        }
        let config = |problem: String| CardError::Config { place: place(), problem };
        card.unet.check().map_err(|e| config(e.to_string()))?;
        card.diffusion.check().map_err(|e| config(e.to_string()))?;
        if let Some(sampling) = &card.sampling {
            if !(sampling.guidance.is_finite() && sampling.guidance >= 0.0) {
                return Err(config(format!(
                    "guidance is {}; it must be 0 or more; export the model again",
                    sampling.guidance
                )));
            }
            if let Some((name, variance)) = sampling.fusion_variances.unsound() {
                return Err(config(format!(
                    "{name} of fusion_variances is {variance}; it must be above 0; export the model again"
                )));
            }
        }
        if card.window_frames < 2 {
            return Err(config("window_frames is below 2; export the model again".to_owned()));
        }
        Ok(card)
    }

    /// Returns the guidance that the model is sampled with unless the user says otherwise.
    pub fn guidance(&self) -> f64 {
        self.sampling.as_ref().map_or(GUIDANCE_WITHOUT_CARD, |sampling| sampling.guidance)
    }

    /// Returns the variances of the decoder's errors; none where they were not measured.
    pub fn fusion_variances(&self) -> Option<FusionVariances> {
        self.sampling.as_ref().map(|sampling| sampling.fusion_variances)
    }

    /// Returns a file's entry.
    ///
    /// # Errors
    /// [`CardError::NoFile`] when the card lists none.
    pub fn file(&self, name: &'static str, place: &str) -> Result<&FileEntry, CardError> {
        let found = self.files.iter().find(|file| file.name == name);
        found.ok_or_else(|| CardError::NoFile { place: place.to_owned(), name })
    }
}

/// Returns the names of the channels, as cards have them.
pub fn own_channels() -> Vec<String> {
    CHANNEL_NAMES.iter().map(|&name| name.to_owned()).collect()
}

/// Returns the names of the features, as cards have them.
pub fn own_features() -> Vec<String> {
    feature_names().map(|(name, _)| name.into_owned()).collect()
}

/// Says where two lists of names part.
fn difference(found: &[String], own: &[String]) -> Option<String> {
    let first = (0..found.len().max(own.len())).find(|&i| found.get(i) != own.get(i))?;
    let name = |names: &[String]| names.get(first).cloned().unwrap_or_else(|| "none".to_owned());
    Some(format!(
        "{} of them instead of {}, and number {first} is {} instead of {}",
        found.len(),
        own.len(),
        name(found),
        name(own)
    ))
}
