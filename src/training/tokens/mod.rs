//! Training of a tokenizer: its networks by gradients, its codebook by averages of latents; and of a planner of its
//! tokens (`planner`).

mod codebook;
mod config;
mod inputs;
mod planner;

use std::sync::Arc;

use crate::autodiff::{
    Arena, Eager, Gradients, Interpreter as _, Parameters, Stream, Tape, Threads,
};
use crate::diffusion::Schedule;
use crate::model::{Tokenizer, TokensConfig};
use crate::motion::MOTION_DIM;
use crate::weights::{Archive, Section};

use super::averaged::NetworkState;
use super::batch::Batch;
use super::checkpoint::Progress;
use super::diffusion::tape_seed;
use super::drive::{Learner, Losses, NoReduction, Reducer, StepResult, Validation};
use super::error::TrainingError;
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
    /// Of the parts that are done side by side; the first gathers all.
    gradients: Vec<Gradients<f32>>,
    arenas: Vec<Arena<f32>>,
    threads: Arc<Threads>,
    schedule: Schedule,
    sizes: TokensConfig,
    config: TokensTraining,
    seed: u64,
    windows: Arc<Windows>,
    reducer: Box<dyn Reducer>,
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
        let n_parts = config.side_by_side.max(1);
        Ok(Self {
            tokenizer: Arc::new(tokenizer),
            gradients: (0..n_parts).map(|_| Gradients::new(&parameters)).collect(),
            network: NetworkState::new(TOKENS, parameters, &config.optimizer, config.ema),
            codebook: Codebook::new(&config.codebook, sizes.codes, sizes.width),
            arenas: (0..n_parts).map(|_| Arena::default()).collect(),
            threads: Arc::new(Threads::of_process()),
            schedule: Schedule::new(&network.diffusion)?,
            sizes,
            config: config.clone(),
            seed,
            windows: Arc::clone(windows),
            reducer: Box::new(NoReduction),
        })
    }

    /// Has steps run on threads; the results are the same on any.
    pub fn on(mut self, threads: &Arc<Threads>) -> Self {
        self.threads = Arc::clone(threads);
        self
    }

    /// Computes the gradients of a batch, part by part; returns its losses and its latents.
    fn differentiate(
        &mut self,
        batch: &Batch,
        step: u64,
    ) -> Result<(Losses, Latents), TrainingError> {
        let side_by_side = self.gradients.len();
        let n_parts = (self.config.accumulate * side_by_side).clamp(1, batch.n_windows);
        let all = batch.weight();
        let at = |part: usize| part * batch.n_windows / n_parts;
        let seed = self.seed;
        let Self {
            gradients, arenas, network, tokenizer, schedule, sizes, config, threads, ..
        } = &mut *self;
        let parameters = network.live();
        gradients.iter_mut().for_each(Gradients::clear);
        let (mut losses, mut latents) = (Losses::default(), Latents::default());
        for first in (0..n_parts).step_by(side_by_side) {
            let numbers = first..(first + side_by_side).min(n_parts);
            let parts: Vec<_> = numbers.zip(gradients.iter_mut().zip(arenas.iter())).collect();
            let found = threads.side_by_side(parts, |(part, (gradients, arena))| {
                let batch = batch.windows(at(part)..at(part + 1));
                let share = batch.weight() / all.max(1.0);
                let seed = tape_seed(seed, step * n_parts as u64 + part as u64);
                let mut tape = Tape::new(parameters, arena, Some(seed));
                let given = TokensBatch::of(&batch, schedule, sizes.frames_per_token);
                let (loss, parts, latents) = given.loss(&mut tape, tokenizer, config.commitment)?;
                let weight = tape.constant(&[], &[share as f32]);
                tape.backward_from(loss, weight, gradients)?;
                Ok::<_, TrainingError>((parts, share, latents))
            });
            for part in found {
                let (part, share, of_part) = part?;
                losses.add(&part, share);
                latents.extend(of_part);
            }
        }
        let (whole, others) = gradients.split_first_mut().expect("at least one");
        threads.run(|| others.iter_mut().for_each(|other| whole.add_all(other)));
        self.reducer.reduce(&mut self.gradients[0]);
        losses.parts.push(("perplexity", perplexity(&counts(&latents.tokens, self.sizes.codes))));
        Ok((losses, latents))
    }

    /// Puts the rows of the codebook where latents of a batch are.
    fn begin_codebook(&mut self, batch: &Batch, step: u64) -> Result<(), TrainingError> {
        let Self { network, tokenizer, arenas, threads, sizes, .. } = &*self;
        let latents = threads.run(|| {
            let mut g = Eager::new(network.live(), &arenas[0]);
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
            let (_, found, latents) = self.threads.run(|| {
                let mut g = Eager::new(parameters, &self.arenas[0]);
                given.loss(&mut g, &self.tokenizer, self.config.commitment)
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
        let learning_rate = self.config.learning_rate.at(step, n_steps);
        let Self { network, gradients, threads, .. } = self;
        let gradient_norm =
            threads.run(|| network.step(&mut gradients[0], losses.total, learning_rate, step));
        if gradient_norm.is_finite() {
            // The draw of the first step was for the first places.
            let candidates = self.candidates(&latents, step + 1);
            let (id, Self { network, codebook, .. }) = (self.tokenizer.codebook(), self);
            let codes = codes_of(network.live_mut(), id);
            codebook.update(codes, &latents.values, &latents.tokens, &candidates);
        }
        Ok(StepResult { losses, gradient_norm, learning_rate, lr_decoder: None })
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.differentiate(batch, 0).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let losses = self.validation_losses(self.network.average())?;
        let live = self.validation_losses(self.network.live())?;
        Ok(Validation { losses, live: Some(live.total), distance: None })
    }

    fn sections(&self) -> Vec<Section<'_, f32>> {
        let mut sections = self.network.sections();
        sections.push(self.codebook.section());
        sections
    }

    fn best(&self) -> Vec<Section<'_, f32>> {
        self.network.best()
    }

    fn n_updates(&self) -> (u64, u64) {
        self.network.n_updates()
    }

    fn restore(
        &mut self,
        archive: &Archive,
        place: &str,
        at: &Progress,
    ) -> Result<(), TrainingError> {
        self.network.restore(archive, place, at)?;
        self.codebook.restore(archive, place)
    }
}
