//! How the networks of any family are trained: the course of the command, and what it asks of each family.

use std::sync::Arc;

use anyhow::Context as _;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::budget::{BudgetParams, StageBudget};
use super::ranks::agreed;
use super::session::{ProgressWatch, scales};
use super::{Params, Run, TrainDryRun, TrainSummary, lease, resume_command};
use crate::autodiff::Threads;
use crate::model::Family;
use crate::motion::Normalizer;
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::training::{
    Augmentation, Dataset, PartedLearner, Ranks, Scales, TrainingEnd, TrainingError, Windows,
};

/// What `train` asks of a family of models, or of a part of one that is trained by itself.
pub trait FamilyTraining: Sized {
    /// All settings of a run, as checkpoints keep them.
    type Config: Clone + Serialize + DeserializeOwned;
    type Learner: PartedLearner;

    /// Decides which phrases are learned from.
    const FAMILY: Family;

    /// Makes the settings of flags, and opens the store.
    ///
    /// # Errors
    /// Settings of which no network can be made, and errors of the store.
    fn prepare(params: &Params) -> anyhow::Result<(Self, Location)>;

    fn config(&self) -> &Self::Config;

    fn window_frames(&self) -> usize;

    fn batch_size(&self) -> usize;

    fn augmentation(&self) -> &Augmentation;

    /// Returns what a dry run says would be done.
    fn description(&self) -> String;

    /// Refuses a run of the store that may not be trained on.
    ///
    /// # Errors
    /// One sentence, and errors of the store.
    fn check_run(&self, _run: &Run) -> anyhow::Result<()> {
        Ok(())
    }

    /// Returns how long the network is trained.
    fn budget(&self, budget: &BudgetParams) -> StageBudget {
        StageBudget { share: 1.0, ..budget.of_denoiser(self.batch_size()) }
    }

    /// Returns the scales of inputs, those of the data where nothing else is said.
    fn scales(&self, of_data: Scales) -> Scales {
        of_data
    }

    /// Returns windows with what the network takes beside motion and features.
    fn adapt(&self, windows: Windows) -> Windows;

    /// Makes the learner.
    ///
    /// # Errors
    /// A configuration that makes no network.
    fn learner(&self, windows: &Arc<Windows>, seed: u64) -> Result<Self::Learner, TrainingError>;

    /// Returns the learner with what validations need beside the loss, on the first of several processes.
    ///
    /// # Errors
    /// When frames cannot be read.
    fn judged(
        &self,
        learner: Self::Learner,
        _run: &Run,
        _windows: &Windows,
    ) -> anyhow::Result<Self::Learner> {
        Ok(learner)
    }

    /// Does what comes after the network; nothing where it is all that a run trains.
    ///
    /// # Errors
    /// Errors of training.
    fn finish(
        &self,
        _run: &Run,
        _learner: Self::Learner,
        _machine: &FamilyInputs,
        _account: &mut TrainSummary,
    ) -> anyhow::Result<TrainingEnd> {
        Ok(TrainingEnd::Done)
    }
}

/// What networks of one run have in common.
pub struct FamilyInputs {
    pub dataset: Arc<Dataset>,
    pub scales: Scales,
    pub threads: Arc<Threads>,
}

/// Runs the stage.
///
/// # Errors
/// Settings of which no network can be made, and errors of the store.
pub fn run<F: FamilyTraining>(
    params: &Params,
    ranks: &Arc<Ranks>,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    use crate::training::Learner as _;
    let (family, store) = agreed(ranks, F::prepare(params))?;
    let watch = ProgressWatch(progress);
    let lease = agreed(ranks, lease(params, &store, ranks, &watch))?;
    let run = Run { params, store: &store, watch: &watch, lease: lease.as_ref(), ranks };
    agreed(ranks, run.check_resume(F::Learner::STAGE))?;
    if params.dry_run {
        return dry_run(&run, &family, progress);
    }
    agreed(ranks, family.check_run(&run))?;
    run.sweep();
    train(&run, &family, progress)
}

fn dry_run<F: FamilyTraining>(
    run: &Run,
    family: &F,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let phrases = run.phrases(F::FAMILY, progress)?;
    let windows = family.adapt(Windows::new(
        phrases.dataset,
        Normalizer::identity(),
        Augmentation::default(),
        family.window_frames(),
        0,
    ));
    Ok(Box::new(TrainDryRun {
        run: run.params.run.clone(),
        what: family.description(),
        n_train: windows.n_train(),
        n_validation: windows.n_validation(),
        n_left_out: phrases.left_out.len(),
        steps_per_epoch: windows.n_train().div_ceil(family.batch_size()),
    }))
}

fn train<F: FamilyTraining>(
    run: &Run,
    family: &F,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let Run { params, ranks, .. } = *run;
    let phrases = run.phrases(F::FAMILY, progress)?;
    let threads = Arc::new(params.machine.start_threads()?);
    let of_data = scales(&phrases.dataset, family.window_frames(), run.watch)?;
    let inputs = FamilyInputs { dataset: phrases.dataset, scales: family.scales(of_data), threads };
    let windows = inputs.windows(family, family.augmentation().clone(), params.seed);
    let mut account = TrainSummary::new(&params.run, run.store, phrases.left_out.clone());
    let learner = family.learner(&windows, params.seed)?.on(&inputs.threads);
    let learner = agreed(ranks, learner.among(ranks).map_err(Into::into))?;
    let mut learner = family.judged(learner, run, &windows)?;
    run.begin(family.config())?;
    let budget = family.budget(&params.budget);
    let mut end = run.stage(family.config(), budget, &mut learner, &windows, &mut account)?;
    if end != TrainingEnd::Interrupted {
        end = family.finish(run, learner, &inputs, &mut account)?;
    }
    if end == TrainingEnd::Interrupted {
        return Ok(Box::new(account.interrupted(&resume_command(params))));
    }
    Ok(Box::new(account))
}

impl FamilyInputs {
    /// Returns windows of the phrases, changed at random and with what networks of a family take.
    pub fn windows<F: FamilyTraining>(
        &self,
        family: &F,
        augmentation: Augmentation,
        seed: u64,
    ) -> Arc<Windows> {
        let (dataset, scales) = (Arc::clone(&self.dataset), self.scales.clone());
        let windows = Windows::new(dataset, scales, augmentation, family.window_frames(), seed);
        Arc::new(family.adapt(windows))
    }
}

/// Returns the settings that flags make, and says where a preset is of another family.
///
/// # Errors
/// One sentence where the preset has no such network; `what` says of which kind it would have to be.
pub fn of_preset<C>(params: &Params, config: Option<C>, what: &str) -> anyhow::Result<C> {
    config.with_context(|| {
        format!(
            "--preset {} is none of {what}; give tiny, small or base",
            params.config.network.preset.name()
        )
    })
}

/// Opens the store of a run.
///
/// # Errors
/// An address or options that make none.
pub fn open(params: &Params) -> anyhow::Result<Location> {
    Ok(Location::open(&params.store, &params.client.options())?)
}
