//! What a run of a planner is told.

use serde::{Deserialize, Serialize};

use crate::model::{PlannerConfig, PlannerKind, TokensConfig};
use crate::training::config::OptimizerConfig;
use crate::training::ema::EmaConfig;
use crate::training::error::TrainingError;
use crate::training::learning_rate::LearningRate;
use crate::training::window::Augmentation;

/// The tokenizer whose tokens are planned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokenizerSource {
    pub run: String,
    /// SHA-256 of its weights: tokens of others mean something else.
    pub weights_sha256: String,
}

/// The network of a run, and how its inputs are made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannerNetworkConfig {
    pub planner: PlannerConfig,
    /// Frames of a window, those of the tokenizer.
    pub window_frames: usize,
}

impl PlannerNetworkConfig {
    /// Refuses a network that cannot be made, or that does not fit its tokenizer.
    ///
    /// # Errors
    /// One sentence.
    pub fn check(&self, tokens: &TokensConfig) -> Result<(), TrainingError> {
        self.planner.check()?;
        self.planner.check_fits(tokens)?;
        Ok(())
    }
}

/// How a planner is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannerTraining {
    /// Probability that a token which the network sees is another one, by chance: of the masked kind one of those that
    /// it is asked for, of the other one of those before.
    pub replacement: f64,
    /// Probability that the music is withheld, for guidance.
    pub condition_dropout: f64,
    /// Probability that the clock alone is withheld.
    pub clock_dropout: f64,
    /// Probability that the style is withheld.
    pub style_dropout: f64,
    /// Probability that constraints are withheld, of a network that takes them.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub constraint_dropout: f64,
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

/// Settings of release 0.2 are written as they were.
fn is_zero(x: &f64) -> bool {
    *x == 0.0
}

impl PlannerTraining {
    /// Half of the windows are those of the paper's other task, which has no constraints (section 3.4); of a network
    /// that is always given a trajectory the paper withholds it from a tenth.
    pub const CONSTRAINT_DROPOUT: f64 = 0.5;

    /// Returns the probability that a token is replaced, where nothing is said (paper, section 4.2).
    pub fn usual_replacement(kind: PlannerKind) -> f64 {
        match kind {
            PlannerKind::Masked => 0.1,
            PlannerKind::Autoregressive => 0.2,
        }
    }
}

/// A training run of a planner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannerTrainConfig {
    pub seed: u64,
    pub tokenizer: TokenizerSource,
    pub network: PlannerNetworkConfig,
    pub planner: PlannerTraining,
}
