//! `train --family tokens`: a tokenizer learns to write motion as tokens, and to make motion of them.

use std::sync::Arc;

use anyhow::ensure;

use super::family::{FamilyTraining, of_preset, open};
use super::numbers::{check_positive, check_share, check_weight};
use super::{Params, Run};
use crate::model::{Family, Tokenizer};
use crate::stages::trained::TrainedPlanner;
use crate::store::Location;
use crate::training::{
    Augmentation, ChannelWeights, TokensLearner, TokensTrainConfig, TrainingError, Windows,
};

/// The training of a tokenizer.
pub struct TokensRun(TokensTrainConfig);

impl FamilyTraining for TokensRun {
    type Config = TokensTrainConfig;
    type Learner = TokensLearner;

    const FAMILY: Family = Family::Tokens;

    fn prepare(params: &Params) -> anyhow::Result<(Self, Location)> {
        let config = params.config.tokens_config(params.seed);
        let config = of_preset(params, config, "the family tokens")?;
        config.network.check()?;
        check_numbers(&config)?;
        Ok((Self(config), open(params)?))
    }

    fn config(&self) -> &TokensTrainConfig {
        &self.0
    }

    fn window_frames(&self) -> usize {
        self.0.network.window_frames
    }

    fn batch_size(&self) -> usize {
        self.0.tokens.batch_size
    }

    fn augmentation(&self) -> &Augmentation {
        &self.0.tokens.augmentation
    }

    fn description(&self) -> String {
        let config = &self.0.network.tokens;
        let n_elements = Tokenizer::new(config).1.n_elements();
        format!("train a tokenizer of {} codes, {n_elements} parameters", config.codes)
    }

    fn check_run(&self, run: &Run) -> anyhow::Result<()> {
        ensure!(
            !TrainedPlanner::is_of(run.store, &run.params.run)?,
            "run {} is a planner; give the tokenizer a name of its own with --run",
            run.params.run
        );
        Ok(())
    }

    fn adapt(&self, windows: Windows) -> Windows {
        windows
    }

    fn learner(&self, windows: &Arc<Windows>, seed: u64) -> Result<TokensLearner, TrainingError> {
        TokensLearner::new(&self.0.network, &self.0.tokens, windows, seed)
    }
}

fn check_numbers(config: &TokensTrainConfig) -> anyhow::Result<()> {
    let training = &config.tokens;
    let codebook = &training.codebook;
    check_share("--time-stretch", training.augmentation.stretch)?;
    check_share("--codebook-decay", codebook.decay)?;
    check_weight("--commitment-loss", training.commitment)?;
    check_weight("--draft-loss", training.draft)?;
    let ChannelWeights { style, vertical, pose } = training.channels;
    check_weight("--style-weight", style)?;
    check_weight("--vertical-weight", vertical)?;
    check_weight("--pose-weight", pose)?;
    check_positive("--learning-rate", training.learning_rate.peak)?;
    check_positive("--least-usage", codebook.least_usage)
}
