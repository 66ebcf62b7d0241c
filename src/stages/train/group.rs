//! `train --family group`: a transformer learns to remove noise from the motion of groups, and a score to tell groups
//! from mixed ones.

use std::sync::Arc;

use anyhow::{Context as _, ensure};

use super::budget::StageBudget;
use super::ranks::agreed;
use super::session::{ProgressWatch, scales};
use super::{Params, Run, TrainDryRun, TrainSummary, lease, resume_command};
use crate::model::{Family, GroupNetworks};
use crate::motion::Normalizer;
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::training::{
    Augmentation, GroupLearner, GroupTrainConfig, Learner as _, PAIR, Ranks, TrainingEnd, Windows,
};

/// Runs the stage.
///
/// # Errors
/// Settings of which no network can be made, and what the store says.
pub fn run(
    params: &Params,
    ranks: &Arc<Ranks>,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let checked = || -> anyhow::Result<_> {
        let config = params.config.group_config(params.seed).with_context(|| {
            format!(
                "--preset {} is none of the family group; give tiny, small or base",
                params.config.network.preset.name()
            )
        })?;
        config.network.check()?;
        check_numbers(&config)?;
        Ok((config, Location::open(&params.store, &params.client.options())?))
    };
    let (config, store) = agreed(ranks, checked())?;
    let watch = ProgressWatch(progress);
    let lease = agreed(ranks, lease(params, &store, ranks, &watch))?;
    let mut run = Run { params, store: &store, watch: &watch, lease: lease.as_ref(), ranks };
    agreed(ranks, run.check_resume(GroupLearner::STAGE))?;
    if params.dry_run {
        return run.dry_run_of_group(&config, progress);
    }
    run.sweep();
    run.train_group(&config, progress)
}

fn check_numbers(config: &GroupTrainConfig) -> anyhow::Result<()> {
    let training = &config.group;
    for (flag, x) in [
        ("--condition-dropout", training.condition_dropout),
        ("--clock-dropout", training.clock_dropout),
        ("--time-stretch", training.augmentation.stretch),
    ] {
        ensure!((0.0..1.0).contains(&x), "{flag} {x} is no share; give a number from 0 to below 1");
    }
    for (flag, x) in
        [("--markers-loss", training.losses.markers), ("--contrast-loss", training.losses.contrast)]
    {
        ensure!(x.is_finite() && x >= 0.0, "{flag} {x} is no weight; give 0 or more");
    }
    let n = training.batch_size;
    ensure!(
        n.is_multiple_of(PAIR) || training.losses.contrast == 0.0,
        "--batch-size {n} is odd; groups are told from mixed ones in pairs to the same music, so give {} or {}",
        n - 1,
        n + 1
    );
    let peak = training.learning_rate.peak;
    ensure!(
        peak > 0.0 && peak.is_finite(),
        "--learning-rate {peak} is not above 0; give a positive number"
    );
    Ok(())
}

impl Run<'_> {
    fn dry_run_of_group(
        &self,
        config: &GroupTrainConfig,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let phrases = self.phrases(Family::Group, progress)?;
        let windows = Windows::new(
            phrases.dataset,
            Normalizer::identity(),
            Augmentation::default(),
            config.network.window_frames,
            0,
        )
        .paired();
        let n_elements = GroupNetworks::new(&config.network.group).1.n_elements();
        Ok(Box::new(TrainDryRun {
            run: self.params.run.clone(),
            what: format!("train a denoiser and a score of groups, {n_elements} parameters"),
            n_train: windows.n_train(),
            n_validation: windows.n_validation(),
            n_left_out: phrases.left_out.len(),
            steps_per_epoch: windows.n_train().div_ceil(config.group.batch_size),
        }))
    }

    fn train_group(
        &mut self,
        config: &GroupTrainConfig,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let params = self.params;
        let machine = &params.machine;
        let phrases = self.phrases(Family::Group, progress)?;
        let threads = Arc::new(machine.start_threads()?);
        let n_frames = config.network.window_frames;
        let scales = scales(&phrases.dataset, n_frames, self.watch)?;
        let windows = Windows::new(
            Arc::clone(&phrases.dataset),
            scales,
            config.group.augmentation.clone(),
            n_frames,
            params.seed,
        );
        let windows = Arc::new(windows.paired().heard_by(config.network.group.condition()));
        let mut account = TrainSummary::new(&params.run, self.store, phrases.left_out.clone());
        let learner =
            GroupLearner::new(&config.network, &config.group, &windows, params.seed)?.on(&threads);
        let mut learner = agreed(self.ranks, learner.among(self.ranks).map_err(Into::into))?;
        self.begin(config)?;
        let steps =
            StageBudget { share: 1.0, ..params.budget.of_denoiser(config.group.batch_size) };
        let end = self.stage(config, steps, &mut learner, &windows, &mut account)?;
        if end == TrainingEnd::Interrupted {
            return Ok(Box::new(account.interrupted(&resume_command(params))));
        }
        Ok(Box::new(account))
    }
}
