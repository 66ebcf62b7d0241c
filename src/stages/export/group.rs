//! A run of the family `group` becomes a model: a denoiser and a score, checked through onnxruntime.

mod checks;
mod summary;

use std::num::NonZeroUsize;

use anyhow::Context as _;
use bytes::Bytes;

use super::files::{
    ExportedFiles, NetworkFile, alphas_cumprod, encode, entries, program, weights_sha256,
};
use super::{Export, MAX_TRAIN_PHRASES, Params, motion_range, put_in_place, tuning};
use crate::autodiff::Parameters;
use crate::generation::{
    FamilyCard as _, GroupCard, GroupEngine, GroupProvenance, MODEL_FORMAT, ModelFileName,
    own_channels, own_features,
};
use crate::model::{Family, GroupNetworks, ParameterId, ParameterList};
use crate::onnx::{group_denoiser, group_score};
use crate::stages::learned;
use crate::stages::model_files::folder_of;
use crate::stages::train::session::{ProgressWatch, read_phrases};
use crate::stages::trained::{has_best, read_best};
use crate::stages::{Progress, Stage as _, Summary};
use crate::store::Location;
use crate::training::{
    CheckpointKind, Checkpoints, GROUP, GroupLearner, GroupTrainConfig, Learner as _, State,
    TrainingError,
};
use crate::units::FPS;
use checks::checks;
use summary::GroupExportSummary;

/// Returns whether a run is one of the family `group`.
///
/// # Errors
/// When the store cannot be listed.
pub fn is_of_group(store: &Location, run: &str) -> anyhow::Result<bool> {
    Ok(has_best(store, run, GroupLearner::STAGE)?)
}

/// Runs the stage.
///
/// # Errors
/// What export says of a run of any family.
pub fn run(
    params: &Params,
    store: &Location,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let trained = TrainedGroup::read(store, &params.run)?;
    let machine = &params.machine;
    let watch = ProgressWatch(progress);
    let (most, is_dry_run) = (Some(MAX_TRAIN_PHRASES), params.dry_run);
    let phrases = read_phrases(
        store,
        Export::NAME,
        (machine, Family::Group),
        most,
        progress,
        &watch,
        is_dry_run,
    )?;
    let data = &trained.state.data;
    let learned_from = learned::of_group(store, &params.run, data, machine, progress, is_dry_run)?;
    let network = &trained.state.config.network;
    let scales = &trained.state.scales;
    let engine = GroupEngine::new(
        &network.group,
        trained.parameters.clone(),
        &scales.features,
        (NonZeroUsize::MIN, machine.threads),
    )
    .context("while starting threads")?;
    let dataset = &phrases.dataset;
    let sampling =
        tuning::group_sampling_defaults(&engine, network, &scales.motion, dataset, progress)?;
    drop(engine);
    let range = motion_range(dataset)?;
    let mut card = GroupCard {
        format: MODEL_FORMAT,
        family: Family::Group,
        name: params.model.clone(),
        program: program(),
        provenance: GroupProvenance {
            run: params.run.clone(),
            step: trained.step,
            validation_loss: trained.state.progress.best.map(|best| best.loss),
            data: data.clone(),
            learned_from,
        },
        precision: params.precision,
        group: network.group.clone(),
        diffusion: network.diffusion.clone(),
        alphas_cumprod: alphas_cumprod(&network.diffusion)?,
        n_parameters: trained.parameters.list().n_elements(),
        weights_sha256: weights_sha256(&trained.parameters),
        window_frames: network.window_frames,
        fps: FPS,
        channels: own_channels(),
        features: own_features(),
        normalizer: scales.motion.clone(),
        feature_scale: scales.features.clone(),
        motion_range: range,
        sampling,
        licence: params.licence.clone(),
        files: Vec::new(),
    };
    let bytes = files(&trained, params, &card)?;
    card.files = entries(&bytes);
    let files = ExportedFiles::new(card, bytes)?;
    let place = store.url_of(&folder_of(&params.model));
    let summary = |is_up_to_date, checks| {
        let (card, place) = (files.card.clone(), place.clone());
        Box::new(GroupExportSummary { card, place, checks, is_up_to_date, is_dry_run })
    };
    if is_dry_run {
        return Ok(summary(false, Vec::new()));
    }
    let results =
        put_in_place(params, store, (&files.bytes, &files.card_text), progress, |runtime| {
            checks(&trained, params, &files.bytes, runtime)
        })?;
    Ok(match results {
        Some(results) => summary(false, results.rows),
        None => summary(true, Vec::new()),
    })
}

/// A run that was trained.
struct TrainedGroup {
    state: State<GroupTrainConfig>,
    parameters: Parameters<f32>,
    step: u64,
}

impl TrainedGroup {
    fn read(store: &Location, run: &str) -> Result<Self, TrainingError> {
        let checkpoints = Checkpoints::new(store, run, GroupLearner::STAGE);
        let Some(&step) = checkpoints.steps(CheckpointKind::Best)?.last() else {
            let way_out = format!("run motiongen train --family group --run {run} first");
            let (run, what) = (run.to_owned(), "trained denoiser of groups");
            return Err(TrainingError::Missing { run, what, way_out });
        };
        let list = |config: &GroupTrainConfig| Ok(GroupNetworks::new(&config.network.group).1);
        let (state, parameters) = read_best(&checkpoints, step, GROUP, list)?;
        Ok(Self { state, parameters, step })
    }

    /// Returns the values of a parameter of one of the two networks.
    fn values(&self, is_denoiser: bool, list: &ParameterList, id: ParameterId) -> Vec<f32> {
        let name = &list.get(id).name;
        let mut all = self.parameters.list().iter();
        let found = all.find(|(_, p)| GroupNetworks::own_name(&p.name) == (is_denoiser, name));
        let (id, _) = found.expect("invariant: both networks are in the list");
        self.parameters.unpacked(id)
    }
}

/// Writes both networks down, and checks them against the rules of the format.
fn files(
    trained: &TrainedGroup,
    params: &Params,
    card: &GroupCard,
) -> anyhow::Result<Vec<(ModelFileName, Bytes)>> {
    let (config, storage) = (&card.group, params.precision);
    let (_, list) = crate::model::GroupDenoiser::new(config);
    let weights = |id: ParameterId| trained.values(true, &list, id);
    let denoiser = group_denoiser(config, &weights, &card.feature_scale, storage)?;
    let (_, list) = crate::model::GroupScore::new(config);
    let weights = |id: ParameterId| trained.values(false, &list, id);
    let score = group_score(config, &weights, storage)?;
    let own =
        [("family", card.family.name().to_owned()), ("group", serde_json::to_string(&card.group)?)];
    let network = |graph, name| NetworkFile {
        graph,
        name,
        weights_sha256: &card.weights_sha256,
        // The largest preset has 250 MB.
        weights_beside: None,
    };
    let networks =
        vec![network(denoiser, ModelFileName::Denoiser), network(score, ModelFileName::Score)];
    encode(networks, card.shared(), &own)
}
