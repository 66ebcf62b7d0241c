//! A network in training: its weights, their running average, and the optimizer's moments.

use std::sync::Arc;

use crate::autodiff::{AdamW, Gradients, Parameters, SHARD_CHUNK, norm_of, part_of, squares};
use crate::weights::{Archive, Section};

use super::checkpoint::Progress;
use super::config::OptimizerConfig;
use super::ema::{Ema, EmaConfig};
use super::error::TrainingError;
use super::learner::CheckpointState;
use super::ranks::Ranks;

/// Names of a checkpoint's sections beside that of the weights.
pub(super) const AVERAGE: &str = "ema.";
pub(super) const MOMENTS: [&str; 2] = ["adam.m.", "adam.v."];

/// The state of one network in training: parameters, optimizer and moving average, and how they are saved.
pub struct NetworkState {
    /// Section of the weights.
    prefix: &'static str,
    parameters: Parameters<f32>,
    optimizer: AdamW<f32>,
    ema: Ema<f32>,
    ema_config: EmaConfig,
    /// Those that keep a share of the average and of the moments each.
    ranks: Arc<Ranks>,
}

impl NetworkState {
    /// Begins with some weights.
    pub fn new(
        prefix: &'static str,
        parameters: Parameters<f32>,
        optimizer: &OptimizerConfig,
        ema: EmaConfig,
    ) -> Self {
        Self {
            prefix,
            optimizer: AdamW::new(optimizer.adamw(), &parameters),
            ema: Ema::new(ema, &parameters),
            ema_config: ema,
            parameters,
            ranks: Ranks::alone(),
        }
    }

    /// Keeps a share of the average and of the moments alone, before the first step.
    pub fn among(&mut self, ranks: &Arc<Ranks>) {
        self.ranks = Arc::clone(ranks);
        self.ema = Ema::new(self.ema_config, &self.parameters).shared(ranks.shard());
    }

    /// Returns the weights themselves.
    pub fn live(&self) -> &Parameters<f32> {
        &self.parameters
    }

    /// Returns the weights themselves for writing; the caller keeps gaps and padding zero.
    pub fn live_mut(&mut self) -> &mut Parameters<f32> {
        &mut self.parameters
    }

    /// Returns the weights to use.
    pub fn average(&self) -> &Parameters<f32> {
        self.ema.average()
    }

    /// Takes step number `step` (from 0); returns the norm of the gradient before it was clipped. `gradients` needs to
    /// hold the process's share alone.
    ///
    /// Where loss or gradient is not finite, nothing changes, and the norm is not finite.
    ///
    /// # Errors
    /// When another process is gone.
    pub fn step(
        &mut self,
        gradients: &mut Gradients<f32>,
        loss: f64,
        learning_rate: f64,
        step: u64,
    ) -> Result<f64, TrainingError> {
        if !loss.is_finite() {
            return Ok(f64::NAN);
        }
        let shard = self.ranks.shard();
        let norm = norm_of(&self.squares(gradients)?);
        let rate = |_: &_| learning_rate;
        self.optimizer.step_shard(&mut self.parameters, gradients, norm, shard, rate);
        if norm.is_finite() {
            self.ranks.spread(self.parameters.all_mut())?;
            self.ema.after_step(step + 1, &self.parameters);
        }
        Ok(norm)
    }

    /// Returns Σ x² of every chunk of the gradient, those of other processes included.
    fn squares(&self, gradients: &mut Gradients<f32>) -> Result<Vec<f64>, TrainingError> {
        let values = gradients.all();
        let own = squares(values, self.ranks.shard());
        if self.ranks.is_alone() {
            return Ok(own);
        }
        let n_chunks = values.len().div_ceil(SHARD_CHUNK);
        let all = self.ranks.share_numbers(&own)?;
        let size = self.ranks.size();
        let of_chunk = |chunk: usize| all[chunk % size].get(chunk / size).copied();
        Ok((0..n_chunks).map(|chunk| of_chunk(chunk).unwrap_or(f64::NAN)).collect())
    }
}

impl CheckpointState for NetworkState {
    fn collect_average(&mut self) -> Result<(), TrainingError> {
        Ok(self.ranks.collect(self.ema.average_mut().all_mut())?)
    }

    fn collect(&mut self) -> Result<(), TrainingError> {
        self.collect_average()?;
        for moment in self.optimizer.moments_mut() {
            self.ranks.collect(moment.as_slice_mut().expect("one run of memory"))?;
        }
        Ok(())
    }

    fn release(&mut self) {
        let shard = self.ranks.shard();
        if shard.is_whole() || !self.ranks.is_first() {
            return;
        }
        let average = self.ema.average_mut();
        *average = average.part(shard);
        for moment in self.optimizer.moments_mut() {
            *moment = part_of(moment.as_slice().expect("one run of memory"), shard);
        }
    }

    fn sections(&self) -> Vec<Section<'_, f32>> {
        let plan = self.parameters.plan();
        let ([m, v], _) = self.optimizer.state();
        vec![
            Section { prefix: self.prefix, plan, values: self.parameters.all() },
            Section { prefix: AVERAGE, plan, values: self.average().all() },
            Section { prefix: MOMENTS[0], plan, values: m },
            Section { prefix: MOMENTS[1], plan, values: v },
        ]
    }

    fn best(&self) -> Vec<Section<'_, f32>> {
        let plan = self.parameters.plan();
        vec![Section { prefix: self.prefix, plan, values: self.average().all() }]
    }

    fn n_updates(&self) -> (u64, u64) {
        (self.optimizer.state().1, self.ema.n_updates())
    }

    fn restore(
        &mut self,
        archive: &Archive,
        place: &str,
        at: &Progress,
    ) -> Result<(), TrainingError> {
        let read = |prefix: &str| section(archive, prefix, &self.parameters, place);
        let (parameters, average) = (read(self.prefix)?, read(AVERAGE)?);
        let [m, v] = [read(MOMENTS[0])?, read(MOMENTS[1])?];
        let shard = self.ranks.shard();
        self.optimizer.restore_shard([m.all(), v.all()], at.n_updates, shard);
        self.ema = Ema::resume(self.ema_config, average, at.n_averaged).shared(shard);
        self.parameters = parameters;
        Ok(())
    }
}

/// Reads a section of a checkpoint that lies as `like` does.
pub(super) fn section(
    archive: &Archive,
    prefix: &str,
    like: &Parameters<f32>,
    place: &str,
) -> Result<Parameters<f32>, TrainingError> {
    let place = place.to_owned();
    archive
        .section(prefix, like.list().clone())
        .map_err(|source| TrainingError::Weights { place, source })
}
