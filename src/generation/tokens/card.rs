//! `model.json` of a model of the family `tokens`.

use serde::{Deserialize, Serialize};

use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::diffusion::{DiffusionConfig, Prediction};
use crate::generation::card::{
    FamilyCard, FileEntry, ModelFileName, SamplingDefaults, SharedFields, check_n_parameters,
    check_sizes, most_bytes, shared_fields,
};
use crate::generation::learned::LearnedFrom;
use crate::model::{CONSTRAINT_DIM, Family, Planner, PlannerConfig, Tokenizer, TokensConfig};
use crate::motion::rates::MotionRange;
use crate::motion::style::STYLE_DIM;
use crate::motion::style_name::NamedStyles;
use crate::motion::{MOTION_DIM, Normalizer};
use crate::onnx::Storage;

/// A model of tokens: where it comes from, how it is used, and its files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensCard {
    pub format: u32,
    pub family: Family,
    pub name: String,
    /// The program that wrote it.
    pub program: String,
    pub provenance: TokensProvenance,
    pub precision: Storage,
    pub tokens: TokensConfig,
    pub planner: PlannerConfig,
    pub diffusion: DiffusionConfig,
    /// ᾱ of each step of the diffusion, for programs other than this one that sample from the model.
    pub alphas_cumprod: Vec<f64>,
    pub n_parameters: TokensNetworks<usize>,
    /// SHA-256 of the weights as f32, in the order in which layers are made.
    pub weights_sha256: TokensNetworks<String>,
    /// Frames that it was trained on; longer motion is planned in windows of as many.
    pub window_frames: usize,
    /// Frames a second.
    pub fps: f64,
    /// Names of the channels of motion, in order.
    pub channels: Vec<String>,
    /// Names of the features of the music, in order.
    pub features: Vec<String>,
    /// Centre and scale of each channel of motion.
    pub normalizer: Normalizer,
    /// Centre and scale of each feature; `planner.onnx` applies them itself.
    pub feature_scale: FeatureScale,
    /// How fast the motion is that it was trained on; generated motion is held to it.
    pub motion_range: Option<MotionRange>,
    /// Mean style of the phrases of each name; of a model that takes none, and of earlier releases, empty.
    #[serde(default, skip_serializing_if = "NamedStyles::is_empty")]
    pub styles: NamedStyles,
    /// How it is best sampled; none where it was not measured. The guidance is that of the planner.
    pub sampling: Option<SamplingDefaults>,
    pub licence: String,
    pub files: Vec<FileEntry>,
}

/// Something of the tokenizer and of the planner.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokensNetworks<T> {
    pub tokenizer: T,
    pub planner: T,
}

/// The runs, training steps and data that a model of tokens was made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensProvenance {
    /// Run of the planner.
    pub run: String,
    /// Run of the tokenizer.
    pub tokenizer: String,
    /// Step of the planner.
    pub step: u64,
    /// That of the planner: nats a token.
    pub validation_loss: Option<f64>,
    /// Digest of the phrases of the planner.
    pub data: String,
    /// Which music that was, and that of the tokenizer.
    pub learned_from: Option<LearnedFrom>,
}

impl FamilyCard for TokensCard {
    const FAMILY: Family = Family::Tokens;
    const MIN_WINDOW_FRAMES: usize = 2;
    const USUAL_GUIDANCE: f64 = 1.0;

    fn shared(&self) -> SharedFields<'_> {
        shared_fields!(self)
    }

    fn check_networks(&self) -> Result<(), String> {
        let Self { tokens, planner, diffusion, .. } = self;
        tokens.check().map_err(|e| e.to_string())?;
        planner.check().map_err(|e| e.to_string())?;
        planner.check_fits(tokens).map_err(|e| e.to_string())?;
        diffusion.check().map_err(|e| e.to_string())?;
        check_sizes(&[
            ("motion_dim", tokens.motion_dim, MOTION_DIM),
            ("audio_cond_dim", planner.audio_cond_dim, FEATURE_DIM),
            ("n_steps of the network", tokens.n_steps, diffusion.n_steps),
        ])?;
        if planner.style_dim > 0 {
            check_sizes(&[("style_dim", planner.style_dim, STYLE_DIM)])?;
        }
        if planner.constraint_dim > 0 {
            check_sizes(&[("constraint_dim", planner.constraint_dim, CONSTRAINT_DIM)])?;
        }
        if diffusion.prediction != Prediction::Sample {
            return Err("the denoiser of a model of tokens predicts clean motion, and the diffusion says otherwise; \
                        export the model again"
                .to_owned());
        }
        let rho = tokens.frames_per_token;
        if !self.window_frames.is_multiple_of(rho) {
            return Err(format!(
                "window_frames is {}; it must be a multiple of the {rho} that a token stands for; export the model \
                 again",
                self.window_frames
            ));
        }
        check_n_parameters("the tokenizer has", Tokenizer::new(tokens).1.n_elements())?;
        check_n_parameters("the planner has", Planner::new(planner).1.n_elements())
    }

    fn most_bytes(&self, name: ModelFileName) -> Option<u64> {
        let Self { tokens, planner, .. } = self;
        match name {
            ModelFileName::Encoder | ModelFileName::Signal | ModelFileName::Denoiser => {
                let n_table = tokens.n_steps * tokens.width;
                Some(most_bytes(Tokenizer::new(tokens).1.n_elements() + n_table))
            }
            ModelFileName::Planner | ModelFileName::PlannerMusic | ModelFileName::PlannerStep => {
                Some(most_bytes(Planner::new(planner).1.n_elements()))
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
