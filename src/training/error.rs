//! What keeps training from going on.

use crate::diffusion::DiffusionError;
use crate::model::{ConfigError, GraphError};
use crate::store::StoreError;
use crate::weights::WeightsError;

use super::dataset::DatasetError;
use super::ranks::RanksError;

/// Why training could not begin or go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainingError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error(transparent)]
    Network(#[from] GraphError),
    #[error(transparent)]
    Diffusion(#[from] DiffusionError),
    #[error(transparent)]
    Ranks(#[from] RanksError),
    #[error("{0}")]
    Config(String),
    #[error(
        "run {run} exists with another configuration: {}; give the run another name, or the \
         settings that it has", .differences.join("; ")
    )]
    OtherConfig { run: String, differences: Vec<String> },
    #[error(
        "run {run} has checkpoints of {stage} up to step {step}; continue it with --resume, start it \
         anew with --force, or give the run another name"
    )]
    Exists { run: String, stage: &'static str, step: u64 },
    #[error(
        "run {run} was trained on other data: its phrases have the digest {known}, those of the store \
         now {found}; train another run, or start this one anew with --force"
    )]
    OtherData { run: String, known: String, found: String },
    #[error("run {run} has no {what}; {way_out}")]
    Missing { run: String, what: &'static str, way_out: String },
    #[error("checkpoint {place}: {reason}")]
    Checkpoint { place: String, reason: String },
    #[error("checkpoint {place}")]
    Weights {
        place: String,
        #[source]
        source: WeightsError,
    },
    #[error(
        "{stage}: loss or gradient was not finite {n} times in a row, last at step {step} with the \
         phrases {}; the last good checkpoint is {checkpoint}. Look at these phrases, or lower the \
         learning rate", .phrases.join(", ")
    )]
    NotFinite { stage: &'static str, n: u32, step: u64, phrases: Vec<String>, checkpoint: String },
    #[error(
        "{stage}: the checkpoint of step {step} could not be saved; the last good one is {checkpoint}"
    )]
    NotSaved {
        stage: &'static str,
        step: u64,
        checkpoint: String,
        #[source]
        source: Box<TrainingError>,
    },
}

impl From<ConfigError> for TrainingError {
    fn from(error: ConfigError) -> Self {
        Self::Config(error.0)
    }
}
