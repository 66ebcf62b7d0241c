//! Training of a tokenizer: its networks by gradients, its codebook by averages of latents; and of a planner of its
//! tokens (`planner`).

mod codebook;
mod config;
mod inputs;
mod planner;

use std::sync::{Arc, Mutex, PoisonError};

use crate::autodiff::{Eager, Interpreter as _, Parameters, Stream, Tape};
use crate::diffusion::Schedule;
use crate::model::{Tokenizer, TokensConfig};
use crate::motion::MOTION_DIM;

use super::averaged::NetworkState;
use super::batch::Batch;
use super::diffusion::tape_seed;
use super::error::TrainingError;
use super::learner::{CheckpointState, Learner, Losses, PartedLearner, StepResult, Validation};
use super::parts::Parts;
use super::window::Windows;
pub use codebook::{Codebook, CodebookConfig, perplexity};
use codebook::{candidates, counts};
pub use config::{TokensNetworkConfig, TokensTrainConfig, TokensTraining};
use inputs::{Latents, TokensBatch};
pub use planner::{
    FrozenTokenizer, PLANNER, PlannerLearner, PlannerNetworkConfig, PlannerTrainConfig,
    PlannerTraining, TokenizerSource,
};

/// Windows of a validation: all of them, or these many with noise and steps of their own.
const MIN_VALIDATION_WINDOWS: usize = 96;
/// A validation of a large library stops here, always at the same windows.
const MAX_VALIDATION_WINDOWS: usize = 256;
/// Windows that a validation does at once.
const VALIDATION_BATCH: usize = 16;

/// Streams of random numbers, two for each step, apart from those of windows.
const CODES: u64 = 7 << 60;

/// Name of the section of the weights, codebook included.
pub const TOKENS: &str = "tokens.";

/// Trains a tokenizer.
pub struct TokensLearner {
    tokenizer: Arc<Tokenizer>,
    network: NetworkState,
    codebook: Codebook<f32>,
    parts: Parts,
    schedule: Schedule,
    sizes: TokensConfig,
    config: TokensTraining,
    seed: u64,
    windows: Arc<Windows>,
}

impl TokensLearner {
    /// Begins with weights that depend on the seed.
    ///
    /// # Errors
    /// A configuration that makes no network.
    pub fn new(
        network: &TokensNetworkConfig,
        config: &TokensTraining,
        windows: &Arc<Windows>,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        network.check()?;
        let sizes = network.tokens.clone();
        let (tokenizer, list) = Tokenizer::new(&sizes);
        let parameters = Parameters::new(list, seed);
        Ok(Self {
            tokenizer: Arc::new(tokenizer),
            parts: Parts::new(&parameters, config.accumulate, config.side_by_side),
            network: NetworkState::new(TOKENS, parameters, &config.optimizer, config.ema),
            codebook: Codebook::new(&config.codebook, sizes.codes, sizes.width),
            schedule: Schedule::new(&network.diffusion)?,
            sizes,
            config: config.clone(),
            seed,
            windows: Arc::clone(windows),
        })
    }

    /// Computes the gradients of a batch, part by part; returns its losses and its latents.
    fn differentiate(
        &mut self,
        batch: &Batch,
        step: u64,
    ) -> Result<(Losses, Latents), TrainingError> {
        let Self { parts, network, tokenizer, schedule, sizes, config, seed, .. } = &mut *self;
        let n_parts = parts.number(batch.n_windows);
        let at = |part: usize| part * batch.n_windows / n_parts;
        let all = batch.weight();
        let share = |part: usize| batch.windows(at(part)..at(part + 1)).weight() / all.max(1.0);
        let parameters = network.live();
        let names = Mutex::new(Vec::new());
        let found = parts.differentiate(n_parts, |part| {
            let number = part.number;
            let batch = batch.windows(at(number)..at(number + 1));
            let seed = tape_seed(*seed, step * n_parts as u64 + number as u64);
            let mut tape = Tape::new(parameters, part.arena, Some(seed));
            let given = TokensBatch::of(&batch, schedule, sizes.frames_per_token);
            let (loss, losses, latents) = given.loss(&mut tape, tokenizer, config)?;
            part.backward(tape, loss, share(number))?;
            Ok((losses.numbers(&names), latents.numbers()))
        })?;
        let names = names.into_inner().unwrap_or_else(PoisonError::into_inner);
        let (of_parts, of_latents): (Vec<_>, Vec<_>) = found.into_iter().unzip();
        let mut losses = Losses::default();
        for (number, part) in parts.of_all(n_parts, of_parts)?.iter().enumerate() {
            losses.add(&Losses::of_numbers(part, &names), share(number));
        }
        let mut latents = Latents::default();
        for part in parts.of_all(n_parts, of_latents)? {
            latents.extend(Latents::of_numbers(&part, sizes.width));
        }
        losses.parts.push(("perplexity", perplexity(&counts(&latents.tokens, self.sizes.codes))));
        Ok((losses, latents))
    }

    /// Puts the rows of the codebook where latents of a batch are.
    fn begin_codebook(&mut self, batch: &Batch, step: u64) -> Result<(), TrainingError> {
        let Self { network, tokenizer, parts, sizes, .. } = &*self;
        let latents = parts.threads().run(|| {
            let mut g = Eager::new(network.live(), parts.arena());
            let shape = [batch.n_windows, batch.n_frames, MOTION_DIM];
            let motion = g.constant(&shape, &batch.motion);
            let found = tokenizer.quantize(&mut g, &motion)?;
            let mut latents = Latents::default();
            latents.add(&found.latents, &found.tokens, batch, sizes.frames_per_token);
            Ok::<_, TrainingError>(latents)
        })?;
        let candidates = self.candidates(&latents, step);
        let (id, Self { network, codebook, .. }) = (self.tokenizer.codebook(), self);
        codebook.begin(codes_of(network.live_mut(), id), &candidates);
        Ok(())
    }

    /// Draws latents that rows may be put at.
    fn candidates(&self, latents: &Latents, step: u64) -> Vec<f32> {
        let random = [0, 1].map(|i| Stream::new(self.seed, CODES + 2 * step + i));
        candidates(&latents.values, self.sizes.width, self.sizes.codes, random)
    }

    /// Returns the mean losses of the validation windows with some weights.
    fn validation_losses(&self, parameters: &Parameters<f32>) -> Result<Losses, TrainingError> {
        let n = self.windows.n_validation();
        let n_wanted = n.clamp(MIN_VALIDATION_WINDOWS, MAX_VALIDATION_WINDOWS);
        let (mut losses, mut weight, mut tokens) = (Losses::default(), 0.0, Vec::new());
        for first in (0..n_wanted).step_by(VALIDATION_BATCH) {
            let range = first..(first + VALIDATION_BATCH).min(n_wanted);
            let batch = self.windows.validation(range)?;
            let given = TokensBatch::of(&batch, &self.schedule, self.sizes.frames_per_token);
            let (_, found, latents) = self.parts.threads().run(|| {
                let mut g = Eager::new(parameters, self.parts.arena());
                given.loss(&mut g, &self.tokenizer, &self.config)
            })?;
            losses.add(&found, batch.weight());
            weight += batch.weight();
            tokens.extend(latents.tokens);
        }
        let mut mean = Losses::default();
        mean.add(&losses, 1.0 / weight.max(1.0));
        mean.parts.push(("perplexity", perplexity(&counts(&tokens, self.sizes.codes))));
        Ok(mean)
    }
}

/// Returns the codebook of a network for writing, \[K, d\].
fn codes_of(parameters: &mut Parameters<f32>, id: crate::model::ParameterId) -> &mut [f32] {
    let range = parameters.plan().range(id);
    &mut parameters.all_mut()[range]
}

impl Learner for TokensLearner {
    const STAGE: &'static str = "tokens";

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        if !self.codebook.is_begun() {
            self.begin_codebook(batch, step)?;
        }
        let (losses, latents) = self.differentiate(batch, step)?;
        let taken = self.take_step(losses, self.config.learning_rate.at(step, n_steps), step)?;
        if taken.gradient_norm.is_finite() {
            // The draw of the first step was for the first places.
            let candidates = self.candidates(&latents, step + 1);
            let (id, Self { network, codebook, .. }) = (self.tokenizer.codebook(), self);
            let codes = codes_of(network.live_mut(), id);
            codebook.update(codes, &latents.values, &latents.tokens, &candidates);
        }
        Ok(taken)
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.differentiate(batch, 0).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let losses = self.validation_losses(self.network.average())?;
        let live = self.validation_losses(self.network.live())?;
        Ok(Validation { losses, live: Some(live.total), distance: None })
    }

    fn state(&self) -> Vec<&dyn CheckpointState> {
        vec![&self.network, &self.codebook]
    }

    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState> {
        vec![&mut self.network, &mut self.codebook]
    }
}

impl PartedLearner for TokensLearner {
    fn parts_and_network(&mut self) -> (&mut Parts, &mut NetworkState) {
        (&mut self.parts, &mut self.network)
    }
}
