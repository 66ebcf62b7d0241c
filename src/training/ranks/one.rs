//! A network that is too small to be shared out: the first process trains it, the others receive its losses.

use std::sync::Arc;

use crate::training::TrainingError;
use crate::training::batch::Batch;
use crate::training::learner::{
    CheckpointState, Learner, Losses, Ownership, StepResult, Validation,
};

use super::Ranks;

/// A learner that the first process has, and no other.
pub struct ByOne<L> {
    ranks: Arc<Ranks>,
    learner: Option<L>,
}

impl<L> ByOne<L> {
    /// Makes the learner on the first process, where `of` is given; on others there is none.
    ///
    /// # Errors
    /// Errors of `learner`.
    pub fn new<T, E>(
        ranks: &Arc<Ranks>,
        of: Option<T>,
        learner: impl FnOnce(T) -> Result<L, E>,
    ) -> Result<Self, E> {
        let learner = of.map(learner).transpose()?;
        Ok(Self { ranks: Arc::clone(ranks), learner })
    }
}

impl<L: Learner> Learner for ByOne<L> {
    const STAGE: &'static str = L::STAGE;

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        let Some(learner) = &mut self.learner else {
            let found = self.ranks.of_first(&[])?;
            let at = |i: usize| found.get(i).copied().unwrap_or(f64::NAN);
            let losses = Losses { total: at(0), parts: Vec::new() };
            let (gradient_norm, learning_rate) = (at(1), at(2));
            return Ok(StepResult { losses, gradient_norm, learning_rate, lr_decoder: None });
        };
        let taken = learner.step(batch, step, n_steps)?;
        self.ranks.of_first(&[taken.losses.total, taken.gradient_norm, taken.learning_rate])?;
        Ok(taken)
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.learner.as_mut().map_or(Ok(()), |learner| learner.rehearse(batch))
    }

    fn steps_of_rehearsal(&self) -> u64 {
        self.learner.as_ref().map_or(1, L::steps_of_rehearsal)
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let nothing = Validation { losses: Losses::default(), live: None, distance: None };
        self.learner.as_mut().map_or(Ok(nothing), L::validate)
    }

    fn ownership(&self) -> Ownership {
        let is_first = self.ranks.is_first();
        Arc::new(move |n_dancers| vec![is_first; n_dancers.len()])
    }

    fn state(&self) -> Vec<&dyn CheckpointState> {
        self.learner.as_ref().map_or_else(Vec::new, L::state)
    }

    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState> {
        self.learner.as_mut().map_or_else(Vec::new, L::state_mut)
    }
}
