//! What a run of the family `group` is told.

use serde::{Deserialize, Serialize};

use crate::diffusion::{DiffusionConfig, Prediction};
use crate::model::GroupConfig;
use crate::training::config::OptimizerConfig;
use crate::training::ema::EmaConfig;
use crate::training::error::TrainingError;
use crate::training::learning_rate::LearningRate;
use crate::training::objective::Objective;
use crate::training::window::Augmentation;

/// The networks of a run, and how their inputs are made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupNetworkConfig {
    pub group: GroupConfig,
    pub diffusion: DiffusionConfig,
    /// Frames of a window.
    pub window_frames: usize,
}

impl GroupNetworkConfig {
    /// Refuses networks that cannot be made, or that do not fit each other.
    ///
    /// # Errors
    /// One sentence.
    pub fn check(&self) -> Result<(), TrainingError> {
        self.group.check()?;
        self.diffusion.check()?;
        let refuse = |what: String| Err(TrainingError::Config(what));
        if self.group.n_steps != self.diffusion.n_steps {
            return refuse(format!(
                "the network knows {} steps of diffusion, the schedule has {}; give both the same",
                self.group.n_steps, self.diffusion.n_steps
            ));
        }
        if self.diffusion.prediction != Prediction::Sample {
            return refuse(
                "a network of a group predicts clean motion, which its score looks at; leave --prediction x0"
                    .to_owned(),
            );
        }
        if self.window_frames < 4 {
            return refuse(format!(
                "a window has {} frames; it must have at least 4",
                self.window_frames
            ));
        }
        Ok(())
    }
}

/// Weights of what is made small beside the distance of the estimate.
///
/// L = L_simple + λ_markers L_markers + λ_contrast L_nce, and the losses on the estimate of [`Objective`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroupLosses {
    /// Of points fixed to each body, 1/m²: in place of the paper's joints.
    pub markers: f64,
    /// Of telling a group from mixed ones (paper 1e-3, published code 1e-5).
    pub contrast: f64,
    /// Mixed groups beside each group (published code 8, paper 10).
    pub n_negatives: usize,
}

impl Default for GroupLosses {
    fn default() -> Self {
        Self { markers: 1.0, contrast: 1e-2, n_negatives: 8 }
    }
}

/// How the networks of a group are trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupTraining {
    pub objective: Objective,
    pub losses: GroupLosses,
    pub augmentation: Augmentation,
    /// Probability that a group goes without its music, for guidance.
    pub condition_dropout: f64,
    /// Probability that a group goes without its clock alone.
    pub clock_dropout: f64,
    pub batch_size: usize,
    /// Parts of a batch that are done one after the other, to save memory.
    pub accumulate: usize,
    /// Parts of such a part that are done at once, each by its share of the threads.
    pub side_by_side: usize,
    pub learning_rate: LearningRate,
    pub optimizer: OptimizerConfig,
    pub ema: EmaConfig,
}

/// A training run of the family `group`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupTrainConfig {
    pub seed: u64,
    pub network: GroupNetworkConfig,
    pub group: GroupTraining,
}
