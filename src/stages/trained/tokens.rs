//! What training left of a run of the family `tokens`: a tokenizer, or a planner of its tokens.

use super::{has_best, read_best};
use crate::autodiff::Parameters;
use crate::model::{Planner, Tokenizer};
use crate::store::Location;
use crate::training::{
    CheckpointKind, Checkpoints, Learner as _, PLANNER, PlannerLearner, PlannerTrainConfig, State,
    TOKENS, TokensLearner, TokensTrainConfig, TrainingError,
};

/// A tokenizer that was trained.
pub struct TrainedTokenizer {
    pub state: State<TokensTrainConfig>,
    pub parameters: Parameters<f32>,
}

impl TrainedTokenizer {
    /// Reads the weights of a run that validated best.
    ///
    /// # Errors
    /// [`TrainingError::Missing`] with the command that makes what is missing.
    pub fn read(store: &Location, run: &str) -> Result<Self, TrainingError> {
        let checkpoints = Checkpoints::new(store, run, TokensLearner::STAGE);
        let Some(&step) = checkpoints.steps(CheckpointKind::Best)?.last() else {
            let way_out = match TrainedPlanner::is_of(store, run)? {
                true => "it is a planner, so name the run that it took with --tokenizer".to_owned(),
                false => format!("run motiongen train --family tokens --run {run} first"),
            };
            let (run, what) = (run.to_owned(), "trained tokenizer");
            return Err(TrainingError::Missing { run, what, way_out });
        };
        let list = |config: &TokensTrainConfig| -> Result<_, TrainingError> {
            config.network.check()?;
            Ok(Tokenizer::new(&config.network.tokens).1)
        };
        let (state, parameters) = read_best(&checkpoints, step, TOKENS, list)?;
        Ok(Self { state, parameters })
    }

    /// Returns whether a run has a tokenizer.
    ///
    /// # Errors
    /// When the store cannot be listed.
    pub fn is_of(store: &Location, run: &str) -> Result<bool, TrainingError> {
        has_best(store, run, TokensLearner::STAGE)
    }
}

/// A planner that was trained.
pub struct TrainedPlanner {
    pub state: State<PlannerTrainConfig>,
    pub parameters: Parameters<f32>,
    /// The step at which it validated best.
    pub step: u64,
}

impl TrainedPlanner {
    /// Reads the weights of a run that validated best.
    ///
    /// # Errors
    /// [`TrainingError::Missing`] with the command that makes what is missing.
    pub fn read(store: &Location, run: &str) -> Result<Self, TrainingError> {
        let checkpoints = Checkpoints::new(store, run, PlannerLearner::STAGE);
        let Some(&step) = checkpoints.steps(CheckpointKind::Best)?.last() else {
            let way_out = match TrainedTokenizer::is_of(store, run)? {
                true => format!(
                    "it is a tokenizer; train a planner of its tokens with motiongen train --family tokens --tokenizer \
                     {run} --run NAME and name that run"
                ),
                false => {
                    format!("run motiongen train --family tokens --tokenizer RUN --run {run} first")
                }
            };
            let (run, what) = (run.to_owned(), "trained planner");
            return Err(TrainingError::Missing { run, what, way_out });
        };
        let list = |config: &PlannerTrainConfig| -> Result<_, TrainingError> {
            config.network.planner.check()?;
            Ok(Planner::new(&config.network.planner).1)
        };
        let (state, parameters) = read_best(&checkpoints, step, PLANNER, list)?;
        Ok(Self { state, parameters, step })
    }

    /// Returns whether a run has a planner.
    ///
    /// # Errors
    /// When the store cannot be listed.
    pub fn is_of(store: &Location, run: &str) -> Result<bool, TrainingError> {
        has_best(store, run, PlannerLearner::STAGE)
    }
}
