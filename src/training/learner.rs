//! What is trained: a network, or both, with its optimizer.

use std::sync::{Arc, Mutex, PoisonError};

use crate::autodiff::Threads;
use crate::weights::{Archive, Section};

use super::averaged::NetworkState;
use super::batch::Batch;
use super::checkpoint::Progress;
use super::error::TrainingError;
use super::parts::Parts;
use super::ranks::Ranks;

/// The loss that is minimised, and its parts by name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Losses {
    pub total: f64,
    /// Names are columns of the table of training.
    pub parts: Vec<(&'static str, f64)>,
}

impl Losses {
    /// Returns them as numbers, to give them to other processes; `names` takes the names of the parts.
    pub fn numbers(&self, names: &Mutex<Vec<&'static str>>) -> Vec<f64> {
        let mut known = names.lock().unwrap_or_else(PoisonError::into_inner);
        *known = self.parts.iter().map(|&(name, _)| name).collect();
        std::iter::once(self.total).chain(self.parts.iter().map(|&(_, value)| value)).collect()
    }

    /// Takes up what [`Losses::numbers`] gave.
    pub fn of_numbers(numbers: &[f64], names: &[&'static str]) -> Self {
        let (total, parts) = numbers.split_first().unwrap_or((&f64::NAN, &[]));
        let parts = names.iter().copied().zip(parts.iter().copied()).collect();
        Self { total: *total, parts }
    }

    /// Adds another's losses, weighted.
    pub fn add(&mut self, other: &Self, weight: f64) {
        self.total += weight * other.total;
        for &(name, value) in &other.parts {
            match self.parts.iter_mut().find(|(known, _)| *known == name) {
                Some((_, sum)) => *sum += weight * value,
                None => self.parts.push((name, weight * value)),
            }
        }
    }
}

/// The result of a training step.
#[derive(Clone, Debug)]
pub struct StepResult {
    pub losses: Losses,
    /// Norm of the gradient before it was clipped.
    pub gradient_norm: f64,
    pub learning_rate: f64,
    pub lr_decoder: Option<f64>,
}

impl StepResult {
    pub(super) fn is_finite(&self) -> bool {
        self.losses.total.is_finite() && self.gradient_norm.is_finite()
    }
}

/// The losses of a validation.
#[derive(Clone, Debug)]
pub struct Validation {
    /// Of the weights that would be used: the average, where there is one.
    pub losses: Losses,
    /// Of the weights themselves, where they are not the ones that would be used.
    pub live: Option<f64>,
    /// Distance of sampled motion from real motion, where motion is sampled.
    pub distance: Option<f64>,
}

/// Says which windows of a batch a process learns from, by the numbers of dancers of them all.
pub type Ownership = Arc<dyn Fn(&[usize]) -> Vec<bool> + Send + Sync>;

/// All windows are this process's.
pub fn all_windows() -> Ownership {
    Arc::new(|n_dancers| vec![true; n_dancers.len()])
}

/// A network, or both, with its optimizer: takes training steps and validates.
pub trait Learner: Send {
    /// Name of the stage, as tables and folders spell it.
    const STAGE: &'static str;

    /// Learns from a batch: step number `step` (from 0) of `n_steps`.
    ///
    /// Where loss or gradient is not finite, nothing changes.
    ///
    /// # Errors
    /// Shapes that do not fit.
    fn step(&mut self, batch: &Batch, step: u64, n_steps: u64)
    -> Result<StepResult, TrainingError>;

    /// Does the work of a step but for the optimizer's, and forgets it, to see how long it takes.
    ///
    /// # Errors
    /// As [`Learner::step`].
    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError>;

    /// Returns how many steps a rehearsal is worth.
    fn steps_of_rehearsal(&self) -> u64 {
        1
    }

    /// Measures what was learned.
    ///
    /// # Errors
    /// As [`Learner::step`], and errors of the store.
    fn validate(&mut self) -> Result<Validation, TrainingError>;

    /// Returns which windows of a batch this process learns from.
    fn ownership(&self) -> Ownership {
        all_windows()
    }

    /// Returns what a checkpoint keeps of it: a network comes first, where there is one.
    fn state(&self) -> Vec<&dyn CheckpointState>;

    /// Returns what a checkpoint keeps of it for writing, in the order of [`Learner::state`].
    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState>;

    /// Puts the weights to use together on the first of several processes.
    ///
    /// # Errors
    /// When another process is gone.
    fn collect_average(&mut self) -> Result<(), TrainingError> {
        self.state_mut().into_iter().try_for_each(|state| state.collect_average())
    }

    /// Puts all numbers together on the first of several processes.
    ///
    /// # Errors
    /// When another process is gone.
    fn collect(&mut self) -> Result<(), TrainingError> {
        self.state_mut().into_iter().try_for_each(|state| state.collect())
    }

    /// Keeps a process's own share of the numbers again.
    fn release(&mut self) {
        self.state_mut().into_iter().for_each(|state| state.release());
    }

    /// Returns all numbers, to go on from.
    fn sections(&self) -> Vec<Section<'_, f32>> {
        self.state().into_iter().flat_map(|state| state.sections()).collect()
    }

    /// Returns the weights to use.
    fn best(&self) -> Vec<Section<'_, f32>> {
        self.state().into_iter().flat_map(|state| state.best()).collect()
    }

    /// Returns how many updates optimizer and average of the network have seen.
    fn n_updates(&self) -> (u64, u64) {
        self.state().first().map_or((0, 0), |state| state.n_updates())
    }

    /// Takes up the numbers of [`Learner::sections`].
    ///
    /// # Errors
    /// When they are not those of these networks.
    fn restore(
        &mut self,
        archive: &Archive,
        place: &str,
        at: &Progress,
    ) -> Result<(), TrainingError> {
        self.state_mut().into_iter().try_for_each(|state| state.restore(archive, place, at))
    }
}

/// What a checkpoint keeps of a learner: a network with its optimizer and its average, or what belongs to one.
pub trait CheckpointState {
    /// Puts the weights to use together on the first of several processes that keep a share each.
    ///
    /// # Errors
    /// When another process is gone.
    fn collect_average(&mut self) -> Result<(), TrainingError> {
        Ok(())
    }

    /// Puts all numbers together on the first of several processes that keep a share each.
    ///
    /// # Errors
    /// When another process is gone.
    fn collect(&mut self) -> Result<(), TrainingError> {
        Ok(())
    }

    /// Gives the memory back in which others' shares were put together.
    fn release(&mut self) {}

    /// Returns all numbers, to go on from.
    fn sections(&self) -> Vec<Section<'_, f32>>;

    /// Returns the weights to use, as a file's sections; none where they are a network's already.
    fn best(&self) -> Vec<Section<'_, f32>> {
        Vec::new()
    }

    /// Returns how many updates optimizer and average have seen.
    fn n_updates(&self) -> (u64, u64) {
        (0, 0)
    }

    /// Takes up the numbers of [`CheckpointState::sections`].
    ///
    /// # Errors
    /// When they are not those of the same shapes.
    fn restore(
        &mut self,
        archive: &Archive,
        place: &str,
        at: &Progress,
    ) -> Result<(), TrainingError>;
}

/// A learner of one network that does the parts of a batch by themselves, on threads and by several processes.
pub trait PartedLearner: Learner + Sized {
    /// Returns the parts of a batch and the network.
    fn parts_and_network(&mut self) -> (&mut Parts, &mut NetworkState);

    /// Has steps run on threads; the results are the same on any.
    fn on(mut self, threads: &Arc<Threads>) -> Self {
        self.parts_and_network().0.on(threads);
        self
    }

    /// Trains together with other processes.
    ///
    /// # Errors
    /// When the parts of a batch cannot be shared out evenly.
    fn among(mut self, ranks: &Arc<Ranks>) -> Result<Self, TrainingError> {
        let (parts, network) = self.parts_and_network();
        parts.among(ranks)?;
        network.among(ranks);
        Ok(self)
    }

    /// Takes step number `step` by the gradients of a batch, whose losses are given.
    ///
    /// # Errors
    /// When another process is gone.
    fn take_step(
        &mut self,
        losses: Losses,
        learning_rate: f64,
        step: u64,
    ) -> Result<StepResult, TrainingError> {
        let (parts, network) = self.parts_and_network();
        let threads = Arc::clone(parts.threads());
        let gradient_norm =
            threads.run(|| network.step(parts.gradients(), losses.total, learning_rate, step))?;
        Ok(StepResult { losses, gradient_norm, learning_rate, lr_decoder: None })
    }
}
