//! Training of the networks of a group: the denoiser learns to tell clean motion, the score to tell a group from
//! mixed ones.

mod config;
mod inputs;
mod markers;
mod negatives;

use std::sync::Arc;

use crate::autodiff::{Arena, Eager, Gradients, Interpreter as _, Parameters, Tape, Threads};
use crate::diffusion::Schedule;
use crate::model::{GroupConfig, GroupNetworks};

use super::averaged::{NetworkState, keeps_network};
use super::batch::{Batch, PAIR};
use super::diffusion::tape_seed;
use super::drive::{Learner, Losses, NoReduction, Reducer, StepResult, Validation};
use super::error::TrainingError;
use super::window::Windows;
pub use config::{GroupLosses, GroupNetworkConfig, GroupTrainConfig, GroupTraining};
use inputs::{GroupBatch, WithholdAll};

/// Windows of a validation: all of them, or these many with noise and steps of their own.
const MIN_VALIDATION_WINDOWS: usize = 96;
/// A validation of a large library stops here, always at the same windows.
const MAX_VALIDATION_WINDOWS: usize = 256;
/// Windows that a validation does at once.
const VALIDATION_BATCH: usize = 16;

/// Name of the section of the weights of both networks.
pub const GROUP: &str = "group.";
/// Trains the networks of a group.
pub struct GroupLearner {
    networks: Arc<GroupNetworks>,
    network: NetworkState,
    /// Of the parts that are done side by side; the first gathers all.
    gradients: Vec<Gradients<f32>>,
    arenas: Vec<Arena<f32>>,
    threads: Arc<Threads>,
    schedule: Schedule,
    sizes: GroupConfig,
    config: GroupTraining,
    seed: u64,
    windows: Arc<Windows>,
    reducer: Box<dyn Reducer>,
}

impl GroupLearner {
    /// Begins with weights that depend on the seed.
    ///
    /// # Errors
    /// A configuration that makes no network.
    pub fn new(
        network: &GroupNetworkConfig,
        config: &GroupTraining,
        windows: &Arc<Windows>,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        network.check()?;
        let (networks, list) = GroupNetworks::new(&network.group);
        let parameters = Parameters::new(list, seed);
        let n_parts = config.side_by_side.max(1);
        Ok(Self {
            networks: Arc::new(networks),
            gradients: (0..n_parts).map(|_| Gradients::new(&parameters)).collect(),
            network: NetworkState::new(GROUP, parameters, &config.optimizer, config.ema),
            arenas: (0..n_parts).map(|_| Arena::default()).collect(),
            threads: Arc::new(Threads::of_process()),
            schedule: Schedule::new(&network.diffusion)?,
            sizes: network.group.clone(),
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

    /// Computes the gradients of a batch, part by part; returns its losses.
    ///
    /// Pairs of windows are sorted by their number of dancers, so that a part has few places without one, and stay
    /// together.
    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<Losses, TrainingError> {
        let side_by_side = self.gradients.len();
        let n_pairs = batch.n_windows.div_ceil(PAIR);
        let n_parts = (self.config.accumulate * side_by_side).clamp(1, n_pairs);
        let batch = batch.by_number_of_dancers();
        let all = batch.weight();
        let at = |part: usize| (part * n_pairs / n_parts * PAIR).min(batch.n_windows);
        let Self {
            gradients,
            arenas,
            network,
            networks,
            schedule,
            sizes,
            config,
            threads,
            seed,
            windows,
            ..
        } = &mut *self;
        let normalizer = windows.normalizer();
        let parameters = network.live();
        gradients.iter_mut().for_each(Gradients::clear);
        let mut losses = Losses::default();
        for first in (0..n_parts).step_by(side_by_side) {
            let numbers = first..(first + side_by_side).min(n_parts);
            let parts: Vec<_> = numbers.zip(gradients.iter_mut().zip(arenas.iter())).collect();
            let found = threads.side_by_side(parts, |(part, (gradients, arena))| {
                let batch = batch.windows(at(part)..at(part + 1)).without_empty_slots();
                let share = batch.weight() / all.max(1.0);
                let seed = tape_seed(*seed, step * n_parts as u64 + part as u64);
                let mut tape = Tape::new(parameters, arena, Some(seed));
                let given = GroupBatch::of(&batch, schedule, sizes, (&*config).into(), seed);
                let (loss, parts) =
                    given.loss(&mut tape, networks, normalizer, schedule, config)?;
                let weight = tape.constant(&[], &[share as f32]);
                tape.backward_from(loss, weight, gradients)?;
                Ok::<_, TrainingError>((parts, share))
            });
            for part in found {
                let (part, share) = part?;
                losses.add(&part, share);
            }
        }
        let (whole, others) = gradients.split_first_mut().expect("at least one");
        threads.run(|| others.iter_mut().for_each(|other| whole.add_all(other)));
        self.reducer.reduce(&mut self.gradients[0]);
        Ok(losses)
    }

    /// Returns the mean losses of the validation windows with some weights, nothing dropped.
    fn validation_losses(&self, parameters: &Parameters<f32>) -> Result<Losses, TrainingError> {
        let n = self.windows.n_validation();
        let n_wanted = n.clamp(MIN_VALIDATION_WINDOWS, MAX_VALIDATION_WINDOWS);
        let (mut losses, mut weight) = (Losses::default(), 0.0);
        for first in (0..n_wanted).step_by(VALIDATION_BATCH) {
            let range = first..(first + VALIDATION_BATCH).min(n_wanted);
            let batch = self.windows.validation(range)?.by_number_of_dancers();
            let given = GroupBatch::of(
                &batch,
                &self.schedule,
                &self.sizes,
                WithholdAll::default(),
                first as u64,
            );
            let (_, found) = self.threads.run(|| {
                let mut g = Eager::new(parameters, &self.arenas[0]);
                let normalizer = self.windows.normalizer();
                given.loss(&mut g, &self.networks, normalizer, &self.schedule, &self.config)
            })?;
            losses.add(&found, batch.weight());
            weight += batch.weight();
        }
        let mut mean = Losses::default();
        mean.add(&losses, 1.0 / weight.max(1.0));
        Ok(mean)
    }
}

impl Learner for GroupLearner {
    const STAGE: &'static str = "group";

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        let losses = self.differentiate(batch, step)?;
        let learning_rate = self.config.learning_rate.at(step, n_steps);
        let Self { network, gradients, threads, .. } = self;
        let gradient_norm =
            threads.run(|| network.step(&mut gradients[0], losses.total, learning_rate, step));
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

    keeps_network!(network);
}
