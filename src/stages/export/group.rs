//! A run of the family `group` becomes a model: a denoiser and a score, checked through onnxruntime.

mod checks;

use std::num::NonZeroUsize;

use anyhow::Context as _;
use bytes::Bytes;

use super::Params;
use super::checks::CheckResults;
use super::family::{CardMeasures, FamilyExport};
use super::files::{
    ExportedFiles, NetworkFile, alphas_cumprod, encode, entries, program, weights_sha256,
};
use super::tuning::group_sampling_defaults;
use crate::autodiff::Parameters;
use crate::generation::{
    FamilyCard as _, GroupCard, GroupEngine, GroupProvenance, LearnedFrom, MODEL_FORMAT,
    ModelFileName, SamplingDefaults, own_channels, own_features,
};
use crate::model::{Family, GroupNetworks, ParameterId, ParameterList};
use crate::onnx::{Runtime, group_denoiser, group_score};
use crate::stages::trained::{has_best, read_best};
use crate::stages::{Progress, learned};
use crate::store::Location;
use crate::training::{
    CheckpointKind, Checkpoints, Dataset, GROUP, GroupLearner, GroupTrainConfig, Learner as _,
    State, TrainingError,
};
use crate::units::FPS;
use checks::checks;

/// A run of the family `group` that was trained.
pub struct TrainedGroup {
    state: State<GroupTrainConfig>,
    parameters: Parameters<f32>,
    step: u64,
}

impl TrainedGroup {
    /// Returns whether a run is one of the family `group`.
    ///
    /// # Errors
    /// When the store cannot be listed.
    pub fn is_of(store: &Location, run: &str) -> anyhow::Result<bool> {
        Ok(has_best(store, run, GroupLearner::STAGE)?)
    }

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

impl FamilyExport for TrainedGroup {
    type Card = GroupCard;

    const FAMILY: Family = Family::Group;

    fn of_run(store: &Location, params: &Params) -> anyhow::Result<Self> {
        Ok(Self::read(store, &params.run)?)
    }

    fn learned_from(
        &self,
        store: &Location,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<LearnedFrom>> {
        let Params { run, machine, dry_run, .. } = params;
        learned::of_group(store, run, &self.state.data, machine, progress, *dry_run)
    }

    fn sampling(
        &self,
        dataset: &Dataset,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<SamplingDefaults>> {
        let network = &self.state.config.network;
        let scales = &self.state.scales;
        let engine = GroupEngine::new(
            &network.group,
            self.parameters.clone(),
            &scales.features,
            (NonZeroUsize::MIN, params.machine.threads),
        )
        .context("while starting threads")?;
        group_sampling_defaults(&engine, network, &scales.motion, dataset, progress)
    }

    fn files(
        &mut self,
        params: &Params,
        CardMeasures { learned_from, motion_range, sampling, .. }: CardMeasures,
    ) -> anyhow::Result<ExportedFiles<GroupCard>> {
        let network = &self.state.config.network;
        let scales = &self.state.scales;
        let mut card = GroupCard {
            format: MODEL_FORMAT,
            family: Family::Group,
            name: params.model.clone(),
            program: program(),
            provenance: GroupProvenance {
                run: params.run.clone(),
                step: self.step,
                validation_loss: self.state.progress.best.map(|best| best.loss),
                data: self.state.data.clone(),
                learned_from,
            },
            precision: params.precision,
            group: network.group.clone(),
            diffusion: network.diffusion.clone(),
            alphas_cumprod: alphas_cumprod(&network.diffusion)?,
            n_parameters: self.parameters.list().n_elements(),
            weights_sha256: weights_sha256(&self.parameters),
            window_frames: network.window_frames,
            fps: FPS,
            channels: own_channels(),
            features: own_features(),
            normalizer: scales.motion.clone(),
            feature_scale: scales.features.clone(),
            motion_range,
            sampling,
            licence: params.licence.clone(),
            files: Vec::new(),
        };
        let bytes = files(self, params, &card)?;
        card.files = entries(&bytes);
        ExportedFiles::new(card, bytes)
    }

    fn checks(
        &self,
        files: &ExportedFiles<GroupCard>,
        _dataset: &Dataset,
        params: &Params,
        (runtime, _): (&Runtime, &dyn Progress),
    ) -> anyhow::Result<CheckResults> {
        checks(self, params, &files.bytes, runtime)
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
