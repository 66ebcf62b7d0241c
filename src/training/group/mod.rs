//! Training of the networks of a group: the denoiser learns to tell clean motion, the score to tell a group from
//! mixed ones.

mod config;
mod inputs;
mod markers;
mod negatives;

use std::sync::{Arc, Mutex, PoisonError};

use crate::autodiff::{Eager, Parameters, Tape};
use crate::diffusion::Schedule;
use crate::model::{GroupConfig, GroupNetworks};

use super::averaged::NetworkState;
use super::batch::{Batch, PAIR, order_by_dancers};
use super::diffusion::tape_seed;
use super::error::TrainingError;
use super::learner::{
    CheckpointState, Learner, Losses, Ownership, PartedLearner, StepResult, Validation,
};
use super::parts::Parts;
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
    parts: Parts,
    schedule: Schedule,
    sizes: GroupConfig,
    config: GroupTraining,
    seed: u64,
    windows: Arc<Windows>,
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
        Ok(Self {
            networks: Arc::new(networks),
            parts: Parts::new(&parameters, config.accumulate, config.side_by_side),
            network: NetworkState::new(GROUP, parameters, &config.optimizer, config.ema),
            schedule: Schedule::new(&network.diffusion)?,
            sizes: network.group.clone(),
            config: config.clone(),
            seed,
            windows: Arc::clone(windows),
        })
    }

    /// Computes the gradients of a batch, part by part; returns its losses.
    ///
    /// Pairs of windows are sorted by their number of dancers, so that a part has few places without one, and stay
    /// together.
    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<Losses, TrainingError> {
        let Self { parts, network, networks, schedule, sizes, config, seed, windows, .. } =
            &mut *self;
        let n_pairs = batch.n_windows.div_ceil(PAIR);
        let n_parts = parts.number(n_pairs);
        let batch = batch.by_number_of_dancers();
        let at = |part: usize| (part * n_pairs / n_parts * PAIR).min(batch.n_windows);
        let of_part = |part: usize| batch.windows(at(part)..at(part + 1));
        let weights = parts.weights(n_parts, |part| of_part(part).weight())?;
        let all: f64 = weights.iter().sum();
        let normalizer = windows.normalizer();
        let parameters = network.live();
        let names = Mutex::new(Vec::new());
        let found = parts.differentiate(n_parts, |part| {
            let number = part.number;
            let batch = of_part(number).without_empty_slots();
            let share = weights[number] / all.max(1.0);
            let seed = tape_seed(*seed, step * n_parts as u64 + number as u64);
            let mut tape = Tape::new(parameters, part.arena, Some(seed));
            let given = GroupBatch::of(&batch, schedule, sizes, (&*config).into(), seed);
            let (loss, losses) = given.loss(&mut tape, networks, normalizer, schedule, config)?;
            part.backward(tape, loss, share)?;
            Ok(losses.numbers(&names))
        })?;
        let names = names.into_inner().unwrap_or_else(PoisonError::into_inner);
        let mut losses = Losses::default();
        for (part, share) in parts.of_all(n_parts, found)?.iter().zip(weights) {
            losses.add(&Losses::of_numbers(part, &names), share / all.max(1.0));
        }
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
            let (_, found) = self.parts.threads().run(|| {
                let mut g = Eager::new(parameters, self.parts.arena());
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
        self.take_step(losses, self.config.learning_rate.at(step, n_steps), step)
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.differentiate(batch, 0).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let losses = self.validation_losses(self.network.average())?;
        let live = self.validation_losses(self.network.live())?;
        Ok(Validation { losses, live: Some(live.total), distance: None })
    }

    fn ownership(&self) -> Ownership {
        let in_order = self.parts.ownership(PAIR);
        Arc::new(move |n_dancers| {
            let order = order_by_dancers(n_dancers);
            let sorted: Vec<usize> = order.iter().map(|&i| n_dancers[i]).collect();
            let mut owned = vec![false; order.len()];
            order.into_iter().zip(in_order(&sorted)).for_each(|(i, is_own)| owned[i] = is_own);
            owned
        })
    }

    fn state(&self) -> Vec<&dyn CheckpointState> {
        vec![&self.network]
    }

    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState> {
        vec![&mut self.network]
    }
}

impl PartedLearner for GroupLearner {
    fn parts_and_network(&mut self) -> (&mut Parts, &mut NetworkState) {
        (&mut self.parts, &mut self.network)
    }
}
