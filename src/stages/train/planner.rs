//! `train --family tokens --tokenizer RUN`: a planner learns which tokens go with music.

use std::sync::Arc;

use anyhow::{Context as _, ensure};

use super::budget::StageBudget;
use super::ranks::agreed;
use super::session::{ProgressWatch, check_run_name, scales};
use super::{Params, Run, TrainDryRun, TrainSummary, lease, resume_command};
use crate::model::{Family, Planner};
use crate::motion::Normalizer;
use crate::stages::trained::{TrainedPlanner, TrainedTokenizer};
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::training::{
    Augmentation, FrozenTokenizer, Learner as _, PlannerLearner, PlannerTrainConfig, Ranks, Scales,
    TokenizerSource, TrainingEnd, Windows,
};

/// Runs the stage.
///
/// # Errors
/// A run that is no tokenizer, settings of which no network can be made, and what the store says.
pub fn run(
    params: &Params,
    ranks: &Arc<Ranks>,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let checked = || -> anyhow::Result<_> {
        let tokenizer = params.config.tokens.tokenizer.as_deref().unwrap_or_default();
        check_run_name(tokenizer).with_context(|| format!("--tokenizer {tokenizer:?}"))?;
        ensure!(
            tokenizer != params.run,
            "--run and --tokenizer are both {tokenizer}; give the planner a name of its own with --run"
        );
        let store = Location::open(&params.store, &params.client.options())?;
        ensure!(
            !TrainedPlanner::is_of(&store, tokenizer)?,
            "--tokenizer {tokenizer} is a planner; name the run of the tokenizer that it was trained with"
        );
        ensure!(
            !TrainedTokenizer::is_of(&store, &params.run)?,
            "run {} is a tokenizer; give the planner a name of its own with --run",
            params.run
        );
        let trained = TrainedTokenizer::read(&store, tokenizer)?;
        let config = config(params, tokenizer, &trained)?;
        Ok((config, trained, store))
    };
    let (config, trained, store) = agreed(ranks, checked())?;
    let watch = ProgressWatch(progress);
    let lease = agreed(ranks, lease(params, &store, ranks, &watch))?;
    let mut run = Run { params, store: &store, watch: &watch, lease: lease.as_ref(), ranks };
    agreed(ranks, run.check_resume(PlannerLearner::STAGE))?;
    if params.dry_run {
        return run.dry_run_of_planner(&config, progress);
    }
    run.sweep();
    run.train_planner(&config, trained, progress)
}

/// Returns the configuration that the flags make for the tokens of a tokenizer.
fn config(
    params: &Params,
    tokenizer: &str,
    trained: &TrainedTokenizer,
) -> anyhow::Result<PlannerTrainConfig> {
    let network = &trained.state.config.network;
    let source = TokenizerSource {
        run: tokenizer.to_owned(),
        weights_sha256: crate::stages::export::weights_sha256(&trained.parameters),
    };
    let config = params.config.planner_config(params.seed, source, network).with_context(|| {
        format!(
            "--preset {} is none of a planner; give tiny, small or base",
            params.config.network.preset.name()
        )
    })?;
    let asked = params.config.network.window_frames;
    let of_tokenizer = network.window_frames;
    ensure!(
        asked == of_tokenizer,
        "--window-frames {asked} is not the {of_tokenizer} of tokenizer {tokenizer}, whose tokens mean nothing in other \
         windows; give --window-frames {of_tokenizer}"
    );
    if let Some(codes) = params.config.tokens.codes {
        ensure!(
            codes == network.tokens.codes,
            "--codes {codes} is not the {} of tokenizer {tokenizer}; leave --codes out",
            network.tokens.codes
        );
    }
    config.network.check(&network.tokens)?;
    check_numbers(&config)?;
    Ok(config)
}

fn check_numbers(config: &PlannerTrainConfig) -> anyhow::Result<()> {
    let training = &config.planner;
    for (flag, x) in [
        ("--token-replacement", training.replacement),
        ("--condition-dropout", training.condition_dropout),
        ("--clock-dropout", training.clock_dropout),
        ("--style-dropout", training.style_dropout),
        ("--constraint-dropout", training.constraint_dropout),
        ("--time-stretch", training.augmentation.stretch),
    ] {
        ensure!((0.0..1.0).contains(&x), "{flag} {x} is no share; give a number from 0 to below 1");
    }
    let peak = training.learning_rate.peak;
    ensure!(
        peak > 0.0 && peak.is_finite(),
        "--learning-rate {peak} is not above 0; give a positive number"
    );
    Ok(())
}

impl Run<'_> {
    fn dry_run_of_planner(
        &self,
        config: &PlannerTrainConfig,
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
        let n_elements = Planner::new(&config.network.planner).1.n_elements();
        Ok(Box::new(TrainDryRun {
            run: self.params.run.clone(),
            what: format!(
                "train a planner ({}) of the tokens of {}, {n_elements} parameters",
                config.network.planner.kind.name(),
                config.tokenizer.run
            ),
            n_train: windows.n_train(),
            n_validation: windows.n_validation(),
            n_left_out: phrases.left_out.len(),
            steps_per_epoch: windows.n_train().div_ceil(config.planner.batch_size),
        }))
    }

    fn train_planner(
        &mut self,
        config: &PlannerTrainConfig,
        trained: TrainedTokenizer,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let params = self.params;
        let machine = &params.machine;
        let phrases = self.phrases(Family::Tokens, progress)?;
        let threads = Arc::new(machine.start_threads()?);
        let n_frames = config.network.window_frames;
        let features = scales(&phrases.dataset, n_frames, self.watch)?.features;
        // Tokens are those of motion in the units of their tokenizer.
        let scales = Scales { motion: trained.state.scales.motion.clone(), features };
        let windows = Windows::new(
            Arc::clone(&phrases.dataset),
            scales,
            config.planner.augmentation.clone(),
            n_frames,
            params.seed,
        );
        let windows = Arc::new(windows.heard_by(config.network.planner.condition()));
        let tokenizer =
            FrozenTokenizer::new(&trained.state.config.network.tokens, trained.parameters);
        let mut account = TrainSummary::new(&params.run, self.store, phrases.left_out.clone());
        let learner = PlannerLearner::new(
            &config.network,
            &config.planner,
            tokenizer,
            &windows,
            params.seed,
        )?
        .on(&threads);
        let mut learner = agreed(self.ranks, learner.among(self.ranks).map_err(Into::into))?;
        self.begin(config)?;
        let steps =
            StageBudget { share: 1.0, ..params.budget.of_denoiser(config.planner.batch_size) };
        let end = self.stage(config, steps, &mut learner, &windows, &mut account)?;
        if end == TrainingEnd::Interrupted {
            return Ok(Box::new(account.interrupted(&resume_command(params))));
        }
        Ok(Box::new(account))
    }
}
