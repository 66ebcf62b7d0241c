//! `model.json`: what a model's folder says of itself.

mod shared;

use std::fmt;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::LearnedFrom;
use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::diffusion::DiffusionConfig;
use crate::model::{DecoderConfig, Family, MotionDecoder, UNet1D, UNetConfig};
use crate::motion::rates::MotionRange;
use crate::motion::style_name::NamedStyles;
use crate::motion::{MOTION_DIM, Normalizer};
use crate::onnx::Storage;
use shared::MAX_NAME_BYTES;
pub(in crate::generation) use shared::shared_fields;
pub use shared::{
    CardError, FamilyCard, FileEntry, MAX_CARD_BYTES, MODEL_FORMAT, SamplingDefaults, SharedFields,
    check_n_parameters, check_sizes, family_of, is_name, most_bytes, own_channels, own_features,
};

/// The names of a model's files.
pub mod file_names {
    pub const CARD: &str = "model.json";
    pub const UNET: &str = "unet.onnx";
    /// Weights of a UNet that is too large for one file.
    pub const UNET_WEIGHTS: &str = "unet.weights.bin";
    pub const DECODER: &str = "decoder.onnx";
    pub const DECODER_WEIGHTS: &str = "decoder.weights.bin";
    /// Of a model of the family `group`.
    pub const DENOISER: &str = "denoiser.onnx";
    pub const SCORE: &str = "score.onnx";
    /// Of a model of the family `tokens`, which has a denoiser too.
    pub const ENCODER: &str = "encoder.onnx";
    pub const SIGNAL: &str = "signal.onnx";
    pub const PLANNER: &str = "planner.onnx";
    /// Of a planner that plans token by token: what it hears, and a step of it.
    pub const PLANNER_MUSIC: &str = "planner_music.onnx";
    pub const PLANNER_STEP: &str = "planner_step.onnx";
}

/// The files that a model can have beside its card; a card can name no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ModelFileName {
    Unet,
    UnetWeights,
    Decoder,
    DecoderWeights,
    Denoiser,
    Score,
    Encoder,
    Signal,
    Planner,
    PlannerMusic,
    PlannerStep,
}

impl ModelFileName {
    /// Every name, in the order in which cards list them.
    pub const ALL: [Self; 11] = [
        Self::Unet,
        Self::UnetWeights,
        Self::Decoder,
        Self::DecoderWeights,
        Self::Denoiser,
        Self::Score,
        Self::Encoder,
        Self::Signal,
        Self::Planner,
        Self::PlannerMusic,
        Self::PlannerStep,
    ];

    /// Returns the name of the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unet => file_names::UNET,
            Self::UnetWeights => file_names::UNET_WEIGHTS,
            Self::Decoder => file_names::DECODER,
            Self::DecoderWeights => file_names::DECODER_WEIGHTS,
            Self::Denoiser => file_names::DENOISER,
            Self::Score => file_names::SCORE,
            Self::Encoder => file_names::ENCODER,
            Self::Signal => file_names::SIGNAL,
            Self::Planner => file_names::PLANNER,
            Self::PlannerMusic => file_names::PLANNER_MUSIC,
            Self::PlannerStep => file_names::PLANNER_STEP,
        }
    }

    /// Returns the file of that name; none where no model has such a file.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|file| file.name() == name)
    }
}

impl fmt::Display for ModelFileName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl Serialize for ModelFileName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for ModelFileName {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::of_name(&text).ok_or_else(|| {
            let start: String = text.chars().take(MAX_NAME_BYTES).collect();
            let known = Self::ALL.map(Self::name).join(", ");
            serde::de::Error::custom(format!("a model has no file {start:?}, only {known}"))
        })
    }
}

/// A model: where it comes from, how it is used, and its files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelCard {
    pub format: u32,
    /// Cards of release 0.1 name none.
    #[serde(default, skip_serializing_if = "Family::is_unet")]
    pub family: Family,
    pub name: String,
    /// The program that wrote it.
    pub program: String,
    pub provenance: Provenance,
    pub precision: Storage,
    pub unet: UNetConfig,
    pub decoder: DecoderConfig,
    pub diffusion: DiffusionConfig,
    /// ᾱ of each step of the diffusion, for programs other than this one that sample from the model.
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
    /// Mean style of the phrases of each name; of a model that takes none, and of earlier releases, empty.
    #[serde(default, skip_serializing_if = "NamedStyles::is_empty")]
    pub styles: NamedStyles,
    /// How it is best sampled; cards of release 0.1 do not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampling: Option<SamplingDefaults>,
    pub licence: String,
    pub files: Vec<FileEntry>,
}

/// The run, training steps and data that a model was made from.
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

impl FamilyCard for ModelCard {
    const FAMILY: Family = Family::Unet;
    const MIN_WINDOW_FRAMES: usize = 2;
    // As release 0.1 sampled its models.
    const USUAL_GUIDANCE: f64 = 4.0;

    fn shared(&self) -> SharedFields<'_> {
        shared_fields!(self)
    }

    fn check_networks(&self) -> Result<(), String> {
        let Self { unet, decoder, diffusion, .. } = self;
        unet.check().map_err(|e| e.to_string())?;
        decoder.check().map_err(|e| e.to_string())?;
        diffusion.check().map_err(|e| e.to_string())?;
        check_sizes(&[
            ("in_channels", unet.in_channels, MOTION_DIM),
            ("out_channels", unet.out_channels, MOTION_DIM),
            ("audio_cond_dim", unet.audio_cond_dim, FEATURE_DIM),
            ("input_dim of the decoder", decoder.input_dim, MOTION_DIM),
            ("n_steps of the network", unet.n_steps, diffusion.n_steps),
        ])?;
        check_n_parameters("the UNet has", UNet1D::new(unet).1.n_elements())?;
        check_n_parameters("the decoder has", MotionDecoder::new(decoder).1.n_elements())
    }

    fn most_bytes(&self, name: ModelFileName) -> Option<u64> {
        let Self { unet, decoder, .. } = self;
        match name {
            ModelFileName::Unet | ModelFileName::UnetWeights => {
                let n_table = unet.n_steps * unet.time_embed_dim;
                Some(most_bytes(UNet1D::new(unet).1.n_elements() + n_table))
            }
            ModelFileName::Decoder | ModelFileName::DecoderWeights => {
                Some(most_bytes(MotionDecoder::new(decoder).1.n_elements()))
            }
            ModelFileName::Denoiser
            | ModelFileName::Score
            | ModelFileName::Encoder
            | ModelFileName::Signal
            | ModelFileName::Planner
            | ModelFileName::PlannerMusic
            | ModelFileName::PlannerStep => None,
        }
    }
}

#[cfg(test)]
mod tests;
