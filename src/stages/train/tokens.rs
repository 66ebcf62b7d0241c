//! `train --family tokens`: a tokenizer learns to write motion as tokens, and to make motion of them.

use std::sync::Arc;

use anyhow::{Context as _, ensure};

use super::budget::StageBudget;
use super::ranks::agreed;
use super::session::{ProgressWatch, scales};
use super::{Params, Run, TrainDryRun, TrainSummary, lease, resume_command};
use crate::model::{Family, Tokenizer};
use crate::motion::Normalizer;
use crate::stages::trained::TrainedPlanner;
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::training::{
    Augmentation, ChannelWeights, Learner as _, Ranks, TokensLearner, TokensTrainConfig,
    TrainingEnd, Windows,
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
        let config = params.config.tokens_config(params.seed).with_context(|| {
            format!(
                "--preset {} is none of the family tokens; give tiny, small or base",
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
    agreed(ranks, run.check_resume(TokensLearner::STAGE))?;
    if params.dry_run {
        return run.dry_run_of_tokens(&config, progress);
    }
    let is_free = || -> anyhow::Result<()> {
        ensure!(
            !TrainedPlanner::is_of(&store, &params.run)?,
            "run {} is a planner; give the tokenizer a name of its own with --run",
            params.run
        );
        Ok(())
    };
    agreed(ranks, is_free())?;
    run.sweep();
    run.train_tokens(&config, progress)
}

fn check_numbers(config: &TokensTrainConfig) -> anyhow::Result<()> {
    let training = &config.tokens;
    let codebook = &training.codebook;
    for (flag, x) in
        [("--time-stretch", training.augmentation.stretch), ("--codebook-decay", codebook.decay)]
    {
        ensure!((0.0..1.0).contains(&x), "{flag} {x} is no share; give a number from 0 to below 1");
    }
    let ChannelWeights { style, vertical, pose } = training.channels;
    for (flag, weight) in [
        ("--commitment-loss", training.commitment),
        ("--draft-loss", training.draft),
        ("--style-weight", style),
        ("--vertical-weight", vertical),
        ("--pose-weight", pose),
    ] {
        ensure!(
            weight.is_finite() && weight >= 0.0,
            "{flag} {weight} is no weight; give 0 or more"
        );
    }
    for (flag, x) in
        [("--learning-rate", training.learning_rate.peak), ("--least-usage", codebook.least_usage)]
    {
        ensure!(x > 0.0 && x.is_finite(), "{flag} {x} is not above 0; give a positive number");
    }
    Ok(())
}

impl Run<'_> {
    fn dry_run_of_tokens(
        &self,
        config: &TokensTrainConfig,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let phrases = self.phrases(Family::Tokens, progress)?;
        let windows = Windows::new(
            phrases.dataset,
            Normalizer::identity(),
            Augmentation::default(),
            config.network.window_frames,
            0,
        );
        let n_elements = Tokenizer::new(&config.network.tokens).1.n_elements();
        Ok(Box::new(TrainDryRun {
            run: self.params.run.clone(),
            what: format!(
                "train a tokenizer of {} codes, {n_elements} parameters",
                config.network.tokens.codes
            ),
            n_train: windows.n_train(),
            n_validation: windows.n_validation(),
            n_left_out: phrases.left_out.len(),
            steps_per_epoch: windows.n_train().div_ceil(config.tokens.batch_size),
        }))
    }

    fn train_tokens(
        &mut self,
        config: &TokensTrainConfig,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let params = self.params;
        let machine = &params.machine;
        let phrases = self.phrases(Family::Tokens, progress)?;
        let threads = Arc::new(machine.start_threads()?);
        let n_frames = config.network.window_frames;
        let scales = scales(&phrases.dataset, n_frames, self.watch)?;
        let windows = Arc::new(Windows::new(
            Arc::clone(&phrases.dataset),
            scales,
            config.tokens.augmentation.clone(),
            n_frames,
            params.seed,
        ));
        let mut account = TrainSummary::new(&params.run, self.store, phrases.left_out.clone());
        let learner = TokensLearner::new(&config.network, &config.tokens, &windows, params.seed)?
            .on(&threads);
        let mut learner = agreed(self.ranks, learner.among(self.ranks).map_err(Into::into))?;
        self.begin(config)?;
        let steps =
            StageBudget { share: 1.0, ..params.budget.of_denoiser(config.tokens.batch_size) };
        let end = self.stage(config, steps, &mut learner, &windows, &mut account)?;
        if end == TrainingEnd::Interrupted {
            return Ok(Box::new(account.interrupted(&resume_command(params))));
        }
        Ok(Box::new(account))
    }
}
