//! Training: phrases in, weights that predict out.
//!
//! A [`Dataset`] is read once from the tables of a store; [`Windows`] are cut from it, and a [`Loader`]
//! makes them into batches ahead of time. What is learned and what that costs is in `objective`, `estimate`
//! and `temporal`. Everything depends on seeds and numbers of steps, nothing on threads or clocks.

mod averaged;
mod batch;
mod checkpoint;
mod config;
mod dataset;
mod decoder;
mod diffusion;
mod drive;
mod ema;
mod error;
mod estimate;
mod finetune;
mod group;
mod journal;
mod judge;
mod learner;
mod learning_rate;
mod loader;
mod objective;
mod pairs;
mod parts;
mod pipeline;
mod ranks;
mod sampling;
mod temporal;
mod tokens;
mod window;

pub use batch::{Batch, Chances, PAIR};
pub use checkpoint::{Best, CheckpointKind, Checkpoints, Progress, State};
pub use config::{
    DecoderTraining, DiffusionTraining, FinetuneConfig, NetworkConfig, OptimizerConfig,
    TrainConfig, differences,
};
pub use dataset::{Dataset, DatasetError, DatasetOptions, Ensemble, ExcludedPhrase, Phrase, Split};
pub use decoder::DecoderLearner;
pub use diffusion::{Baselines, DiffusionInputs, DiffusionLearner, WithholdProbabilities};
pub use drive::{Drive, Plan, TrainingEnd, Watch};
pub use ema::{Ema, EmaConfig};
pub use error::TrainingError;
pub use estimate::EstimateLosses;
pub use finetune::{EndToEndLosses, FinetuneLearner};
pub use group::{
    GROUP, GroupLearner, GroupLosses, GroupNetworkConfig, GroupTrainConfig, GroupTraining,
};
pub use journal::{Journal, RowKind};
pub use judge::SampleJudge;
pub use learner::{
    CheckpointState, Learner, Losses, Ownership, PartedLearner, StepResult, Validation,
};
pub use learning_rate::{LearningRate, LearningRateSchedule};
pub use loader::Loader;
pub use objective::{ChannelWeights, Objective, Reconstruction, reconstruction};
#[cfg(feature = "mpi")]
pub use ranks::MpiLink;
pub use ranks::{ByOne, Ranks, RanksError};
pub use sampling::{Condition, Denoiser};
pub use temporal::{TemporalConfig, TemporalLosses, temporal_losses};
pub use tokens::{
    Codebook, CodebookConfig, FrozenTokenizer, PLANNER, PlannerLearner, PlannerNetworkConfig,
    PlannerTrainConfig, PlannerTraining, TOKENS, TokenizerSource, TokensLearner,
    TokensNetworkConfig, TokensTrainConfig, TokensTraining, perplexity,
};
pub use window::{Augmentation, Scales, Windows, fit_scales};
