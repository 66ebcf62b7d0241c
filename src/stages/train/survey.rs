//! How far the runs of a store are trained, for `status`.

use std::collections::BTreeSet;

use super::Train;
use super::session::claim_path;
use crate::stages::Stage as _;
use crate::stages::item_state::ItemState;
use crate::store::{Location, StoreError};
use crate::training::{
    CheckpointKind, Checkpoints, DecoderLearner, DiffusionLearner, FinetuneLearner, GroupLearner,
    Learner as _, PlannerLearner, State, TokensLearner, TrainingError,
};

/// How far one network of a run is trained.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrainedNetwork {
    /// `diffusion`, `decoder`, `group` or `finetune`.
    pub network: &'static str,
    /// Steps that were saved.
    pub step: u64,
    /// Steps in all; none where nothing was saved yet.
    pub n_steps: Option<u64>,
    pub state: ItemState,
}

/// Returns the runs that train or finetune began, in order.
///
/// # Errors
/// [`StoreError`] when the store cannot be listed.
pub fn runs(store: &Location) -> Result<BTreeSet<String>, StoreError> {
    let listed = store.list("runs")?;
    let run = |path: &str| {
        let (run, rest) = path.strip_prefix("runs/")?.split_once('/')?;
        (rest == "train.json" || rest == "finetune.json").then(|| run.to_owned())
    };
    Ok(listed.iter().filter_map(|file| run(&file.path)).collect())
}

/// Returns what train trains first of a run, as checkpoints call it, and of other families than the UNet's alone; none
/// where no such run was begun.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn first_stage(store: &Location, run: &str) -> Result<Option<&'static str>, StoreError> {
    let Some(claim) = store.read_if_there(&claim_path(run, Train::NAME))? else { return Ok(None) };
    let config: serde_json::Value = serde_json::from_slice(&claim).unwrap_or_default();
    // Configurations of other families name what is trained as checkpoints do.
    let families = [GroupLearner::STAGE, TokensLearner::STAGE, PlannerLearner::STAGE];
    let found = families.into_iter().find(|stage| config.get(stage).is_some());
    Ok(Some(found.unwrap_or(DiffusionLearner::STAGE)))
}

/// Returns how far the networks of a run are trained, in the order in which they are.
///
/// A network that is not trained to the end is missing, whether or not it was begun; one that another learns from came
/// to its end.
///
/// # Errors
/// When a checkpoint cannot be read.
pub fn survey(store: &Location, run: &str) -> Result<Vec<TrainedNetwork>, TrainingError> {
    let mut networks = Vec::new();
    if let Some(first) = first_stage(store, run)? {
        if first != DiffusionLearner::STAGE {
            networks.push(network(store, run, first)?);
        } else {
            let decoder = network(store, run, DecoderLearner::STAGE)?;
            let mut diffusion = network(store, run, DiffusionLearner::STAGE)?;
            if decoder.n_steps.is_some() {
                diffusion.state = ItemState::Done;
            }
            networks.extend([diffusion, decoder]);
        }
    }
    if store.read_if_there(&claim_path(run, FinetuneLearner::STAGE))?.is_some() {
        networks.push(network(store, run, FinetuneLearner::STAGE)?);
    }
    Ok(networks)
}

fn network(
    store: &Location,
    run: &str,
    network: &'static str,
) -> Result<TrainedNetwork, TrainingError> {
    let checkpoints = Checkpoints::new(store, run, network);
    let Some(&step) = checkpoints.steps(CheckpointKind::Step)?.last() else {
        return Ok(TrainedNetwork { network, step: 0, n_steps: None, state: ItemState::Missing });
    };
    let state: State<serde_json::Value> = checkpoints.state(CheckpointKind::Step, step)?;
    let is_done = state.progress.has_ended || step >= state.progress.n_steps;
    let n_steps = Some(state.progress.n_steps);
    let state = if is_done { ItemState::Done } else { ItemState::Missing };
    Ok(TrainedNetwork { network, step, n_steps, state })
}
