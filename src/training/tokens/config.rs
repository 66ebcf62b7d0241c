//! What a run of the family `tokens` is told.

use serde::{Deserialize, Serialize};

use crate::diffusion::{DiffusionConfig, Prediction};
use crate::model::TokensConfig;
use crate::training::config::OptimizerConfig;
use crate::training::ema::EmaConfig;
use crate::training::error::TrainingError;
use crate::training::learning_rate::LearningRate;
use crate::training::objective::ChannelWeights;
use crate::training::window::Augmentation;

use super::codebook::CodebookConfig;

/// The networks of a run, and how their inputs are made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensNetworkConfig {
    pub tokens: TokensConfig,
    pub diffusion: DiffusionConfig,
    /// Frames of a window.
    pub window_frames: usize,
}

impl TokensNetworkConfig {
    /// Refuses networks that cannot be made, or that do not fit each other.
    ///
    /// # Errors
    /// One sentence.
    pub fn check(&self) -> Result<(), TrainingError> {
        self.tokens.check()?;
        self.diffusion.check()?;
        let refuse = |what: String| Err(TrainingError::Config(what));
        if self.tokens.n_steps != self.diffusion.n_steps {
            return refuse(format!(
                "the network knows {} steps of diffusion, the schedule has {}; give both the same",
                self.tokens.n_steps, self.diffusion.n_steps
            ));
        }
        if self.diffusion.prediction != Prediction::Sample {
            return refuse(
                "a decoder of tokens predicts clean motion; leave --prediction x0".to_owned(),
            );
        }
        let rho = self.tokens.frames_per_token;
        if self.window_frames == 0 || !self.window_frames.is_multiple_of(rho) {
            return refuse(format!(
                "a window has {} frames; it must have a multiple of the {rho} that a token stands for",
                self.window_frames
            ));
        }
        Ok(())
    }
}

/// How a tokenizer is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensTraining {
    /// Weight of the distance of latents from their codes.
    pub commitment: f64,
    /// Weight of the loss of the draft.
    #[serde(default)]
    pub draft: f64,
    /// How channels are weighed, in the estimate and in the draft.
    #[serde(default)]
    pub channels: ChannelWeights,
    pub codebook: CodebookConfig,
    pub augmentation: Augmentation,
    pub batch_size: usize,
    /// Parts of a batch that are done one after the other, to save memory.
    pub accumulate: usize,
    /// Parts of such a part that are done at once, each by its share of the threads.
    pub side_by_side: usize,
    pub learning_rate: LearningRate,
    pub optimizer: OptimizerConfig,
    pub ema: EmaConfig,
}

impl TokensTraining {
    /// Weight of the distance of latents from their codes, where nothing is said (paper, section 4.1).
    pub const COMMITMENT: f64 = 0.02;
    /// Weight of the loss of the draft, where nothing is said.
    pub const DRAFT: f64 = 1.0;
    /// Weight of position and orientation, where nothing is said: what the other channels follow from.
    pub const POSE: f64 = 8.0;
}

/// A training run of the family `tokens`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensTrainConfig {
    pub seed: u64,
    pub network: TokensNetworkConfig,
    pub tokens: TokensTraining,
}
