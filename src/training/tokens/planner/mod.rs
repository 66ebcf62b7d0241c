//! Training of a planner: the tokens of a tokenizer that does not change any more, from the music.
//!
//! Windows are cut, changed and placed as for the tokenizer, and become tokens when they are learned from, so that
//! motion that is mirrored or stretched has tokens of its own. Parts of the same motion are asked for.

mod config;
mod constraints;
mod inputs;

use std::sync::Arc;

use crate::autodiff::{Arena, Eager, Interpreter as _, Parameters, Tape};
use crate::model::{Planner, PlannerConfig, Tokenizer, TokensConfig};
use crate::motion::MOTION_DIM;
use crate::training::averaged::NetworkState;
use crate::training::batch::Batch;
use crate::training::diffusion::tape_seed;
use crate::training::error::TrainingError;
use crate::training::learner::{
    CheckpointState, Learner, Losses, Ownership, PartedLearner, StepResult, Validation,
};
use crate::training::parts::Parts;
use crate::training::window::Windows;

use super::{MAX_VALIDATION_WINDOWS, MIN_VALIDATION_WINDOWS, VALIDATION_BATCH};
pub use config::{PlannerNetworkConfig, PlannerTrainConfig, PlannerTraining, TokenizerSource};
use inputs::{PlannerBatch, PlannerChances};

/// Numbers of the seeds of masks, apart from those of tapes.
const MASKS: u64 = 1 << 62;

/// Name of the section of the weights.
pub const PLANNER: &str = "planner.";

/// A tokenizer that does not change any more.
#[derive(Clone, Debug)]
pub struct FrozenTokenizer {
    tokenizer: Tokenizer,
    sizes: TokensConfig,
    parameters: Arc<Parameters<f32>>,
}

impl FrozenTokenizer {
    /// Holds a tokenizer; `parameters` are those of [`Tokenizer`].
    pub fn new(sizes: &TokensConfig, parameters: Parameters<f32>) -> Self {
        let parameters = Arc::new(parameters);
        Self { tokenizer: Tokenizer::new(sizes).0, sizes: sizes.clone(), parameters }
    }

    /// Returns the sizes of the tokenizer.
    pub fn sizes(&self) -> &TokensConfig {
        &self.sizes
    }

    /// Returns the tokens of the windows of a batch, \[B, N\], window after window.
    fn tokens(&self, batch: &Batch, arena: &Arena<f32>) -> Result<Vec<u32>, TrainingError> {
        let mut g = Eager::new(&self.parameters, arena);
        let motion = g.constant(&[batch.n_windows, batch.n_frames, MOTION_DIM], &batch.motion);
        let found = self.tokenizer.quantize(&mut g, &motion)?;
        Ok(found.tokens.data().iter().map(|&token| token as u32).collect())
    }
}

/// Trains a planner.
pub struct PlannerLearner {
    planner: Arc<Planner>,
    network: NetworkState,
    tokenizer: FrozenTokenizer,
    parts: Parts,
    sizes: PlannerConfig,
    config: PlannerTraining,
    seed: u64,
    windows: Arc<Windows>,
}

impl PlannerLearner {
    /// Begins with weights that depend on the seed; `windows` are in the scales of the tokenizer.
    ///
    /// # Errors
    /// A configuration that makes no network, or that does not fit the tokenizer.
    pub fn new(
        network: &PlannerNetworkConfig,
        config: &PlannerTraining,
        tokenizer: FrozenTokenizer,
        windows: &Arc<Windows>,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        network.check(tokenizer.sizes())?;
        let sizes = network.planner.clone();
        let (planner, list) = Planner::new(&sizes);
        let parameters = Parameters::new(list, seed);
        Ok(Self {
            planner: Arc::new(planner),
            parts: Parts::new(&parameters, config.accumulate, config.side_by_side),
            network: NetworkState::new(PLANNER, parameters, &config.optimizer, config.ema),
            tokenizer,
            sizes,
            config: config.clone(),
            seed,
            windows: Arc::clone(windows),
        })
    }

    /// Computes the gradients of a batch, part by part; returns its loss.
    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<f64, TrainingError> {
        let Self { parts, network, planner, tokenizer, sizes, config, seed, windows, .. } =
            &mut *self;
        let n_parts = parts.number(batch.n_windows);
        let at = |part: usize| part * batch.n_windows / n_parts;
        let windows = Arc::clone(windows);
        let (seed, sizes) = (*seed, (&*sizes, windows.normalizer()));
        let parameters = network.live();
        let tokens = parts.threads().run(|| tokenizer.tokens(batch, parts.arena()))?;
        // Of the whole batch, so that masks do not depend on how it is parted.
        let masks = tape_seed(seed, MASKS + step);
        let given = PlannerBatch::of(batch, &tokens, sizes, (&*config).into(), masks);
        let weights = parts.weights(n_parts, |part| given.weight(at(part)..at(part + 1)))?;
        let all: f64 = weights.iter().sum();
        let losses = parts.differentiate(n_parts, |part| {
            let number = part.number;
            let share = weights[number] / all.max(1.0);
            let seed = tape_seed(seed, step * n_parts as u64 + number as u64);
            let mut tape = Tape::new(parameters, part.arena, Some(seed));
            let loss = given.loss(&mut tape, planner, at(number)..at(number + 1))?;
            let value = f64::from(loss.scalar());
            part.backward(tape, loss, share)?;
            Ok(vec![share * value])
        })?;
        Ok(parts.of_all(n_parts, losses)?.into_iter().flatten().sum())
    }

    /// Returns the mean loss of the validation windows with some weights.
    ///
    /// Shares that are masked are spread evenly, and all that is asked for is hidden.
    fn validation_loss(&self, parameters: &Parameters<f32>) -> Result<f64, TrainingError> {
        let n = self.windows.n_validation();
        let n_wanted = n.clamp(MIN_VALIDATION_WINDOWS, MAX_VALIDATION_WINDOWS);
        let (mut sum, mut weight) = (0.0, 0.0);
        for first in (0..n_wanted).step_by(VALIDATION_BATCH) {
            let range = first..(first + VALIDATION_BATCH).min(n_wanted);
            let batch = self.windows.validation(range)?;
            let (sizes, chances) =
                ((&self.sizes, self.windows.normalizer()), PlannerChances::VALIDATION);
            let of_batch = self.parts.threads().run(|| {
                let tokens = self.tokenizer.tokens(&batch, self.parts.arena())?;
                let given = PlannerBatch::of(&batch, &tokens, sizes, chances, first as u64);
                let mut g = Eager::new(parameters, self.parts.arena());
                let windows = 0..batch.n_windows;
                let loss = given.loss(&mut g, &self.planner, windows.clone())?;
                Ok::<_, TrainingError>((f64::from(loss.scalar()), given.weight(windows)))
            })?;
            sum += of_batch.0 * of_batch.1;
            weight += of_batch.1;
        }
        Ok(sum / weight.max(1.0))
    }
}

/// Returns a loss that has no parts.
fn whole(total: f64) -> Losses {
    Losses { total, parts: Vec::new() }
}

impl Learner for PlannerLearner {
    const STAGE: &'static str = "planner";

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        let loss = self.differentiate(batch, step)?;
        self.take_step(whole(loss), self.config.learning_rate.at(step, n_steps), step)
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.differentiate(batch, 0).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let loss = self.validation_loss(self.network.average())?;
        let live = self.validation_loss(self.network.live())?;
        Ok(Validation { losses: whole(loss), live: Some(live), distance: None })
    }

    fn ownership(&self) -> Ownership {
        self.parts.ownership(1)
    }

    fn state(&self) -> Vec<&dyn CheckpointState> {
        vec![&self.network]
    }

    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState> {
        vec![&mut self.network]
    }
}

impl PartedLearner for PlannerLearner {
    fn parts_and_network(&mut self) -> (&mut Parts, &mut NetworkState) {
        (&mut self.parts, &mut self.network)
    }
}
