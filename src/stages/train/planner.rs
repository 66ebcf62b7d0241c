//! `train --family tokens --tokenizer RUN`: a planner learns which tokens go with music.

use std::sync::Arc;

use anyhow::{Context as _, ensure};

use super::Params;
use super::family::{FamilyTraining, of_preset, open};
use super::numbers::{check_positive, check_share};
use super::session::check_run_name;
use crate::model::{Family, Planner};
use crate::motion::Normalizer;
use crate::stages::trained::{TrainedPlanner, TrainedTokenizer};
use crate::store::Location;
use crate::training::{
    Augmentation, FrozenTokenizer, PlannerLearner, PlannerTrainConfig, Scales, TokenizerSource,
    TrainingError, Windows,
};

/// The training of a planner.
pub struct PlannerRun {
    config: PlannerTrainConfig,
    tokenizer: FrozenTokenizer,
    /// Units of the motion that the tokenizer writes as tokens.
    normalizer: Normalizer,
}

impl FamilyTraining for PlannerRun {
    type Config = PlannerTrainConfig;
    type Learner = PlannerLearner;

    const FAMILY: Family = Family::Tokens;

    fn prepare(params: &Params) -> anyhow::Result<(Self, Location)> {
        let tokenizer = params.config.tokens.tokenizer.as_deref().unwrap_or_default();
        check_run_name(tokenizer).with_context(|| format!("--tokenizer {tokenizer:?}"))?;
        ensure!(
            tokenizer != params.run,
            "--run and --tokenizer are both {tokenizer}; give the planner a name of its own with --run"
        );
        let store = open(params)?;
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
        let TrainedTokenizer { state, parameters } = trained;
        let tokenizer = FrozenTokenizer::new(&state.config.network.tokens, parameters);
        Ok((Self { config, tokenizer, normalizer: state.scales.motion }, store))
    }

    fn config(&self) -> &PlannerTrainConfig {
        &self.config
    }

    fn window_frames(&self) -> usize {
        self.config.network.window_frames
    }

    fn batch_size(&self) -> usize {
        self.config.planner.batch_size
    }

    fn augmentation(&self) -> &Augmentation {
        &self.config.planner.augmentation
    }

    fn description(&self) -> String {
        let PlannerTrainConfig { network, tokenizer, .. } = &self.config;
        let n_elements = Planner::new(&network.planner).1.n_elements();
        format!(
            "train a planner ({}) of the tokens of {}, {n_elements} parameters",
            network.planner.kind.name(),
            tokenizer.run
        )
    }

    /// Tokens are those of motion in the units of their tokenizer.
    fn scales(&self, of_data: Scales) -> Scales {
        Scales { motion: self.normalizer.clone(), ..of_data }
    }

    fn adapt(&self, windows: Windows) -> Windows {
        windows.heard_by(self.config.network.planner.condition())
    }

    fn learner(&self, windows: &Arc<Windows>, seed: u64) -> Result<PlannerLearner, TrainingError> {
        let PlannerTrainConfig { network, planner, .. } = &self.config;
        PlannerLearner::new(network, planner, self.tokenizer.clone(), windows, seed)
    }
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
    let config = params.config.planner_config(params.seed, source, network);
    let config = of_preset(params, config, "a planner")?;
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
        check_share(flag, x)?;
    }
    check_positive("--learning-rate", training.learning_rate.peak)
}
