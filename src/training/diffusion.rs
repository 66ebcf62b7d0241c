//! Training of the UNet: noise is added to motion, and the network learns to tell what was added.

use std::sync::Arc;

use crate::autodiff::{
    AdamW, Arena, Eager, Gradients, Interpreter, Parameters, Tape, Tensor, Threads,
};
use crate::diffusion::Schedule;
use crate::model::{UNet1D, UNetInputs};
use crate::motion::MOTION_DIM;
use crate::motion::style::STYLE_DIM;
use crate::weights::{Archive, Section};

use super::checkpoint::Progress;
use super::config::{DiffusionTraining, NetworkConfig};
use super::drive::{Alone, Learner, Losses, Reducer, Step, Validation};
use super::ema::Ema;
use super::error::TrainingError;
use super::objective::Objective;
use super::sampling::{Denoiser, is_partial, motion_view};
use super::window::{Batch, Windows};

/// Windows of one validation: all of them, or these many with noise and steps of their own.
const MIN_VALIDATION_WINDOWS: usize = 256;
/// A validation of a large library stops here, always at the same windows.
const MAX_VALIDATION_WINDOWS: usize = 1024;

/// Names of a file's sections.
pub(super) const UNET: &str = "unet.";
pub(super) const AVERAGE: &str = "ema.";
pub(super) const MOMENTS: [&str; 2] = ["adam.m.", "adam.v."];

/// Trains a UNet.
pub struct DiffusionLearner {
    unet: Arc<UNet1D>,
    parameters: Parameters<f32>,
    /// Of the parts that are done side by side; the first gathers all.
    gradients: Vec<Gradients<f32>>,
    optimizer: AdamW<f32>,
    ema: Ema<f32>,
    /// Of the parts that are done side by side.
    arenas: Vec<Arena<f32>>,
    threads: Arc<Threads>,
    schedule: Schedule,
    config: DiffusionTraining,
    takes_style: bool,
    seed: u64,
    windows: Arc<Windows>,
    reducer: Box<dyn Reducer>,
}

impl DiffusionLearner {
    /// Begins with weights that depend on the seed.
    ///
    /// # Errors
    /// A configuration that makes no network.
    pub fn new(
        network: &NetworkConfig,
        config: &DiffusionTraining,
        windows: &Arc<Windows>,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        network.check()?;
        let (unet, list) = UNet1D::new(&network.unet);
        let parameters = Parameters::new(list, seed);
        Ok(Self {
            unet: Arc::new(unet),
            gradients: (0..config.side_by_side.max(1))
                .map(|_| Gradients::new(&parameters))
                .collect(),
            optimizer: AdamW::new(config.optimizer.adamw(), &parameters),
            ema: Ema::new(config.ema, &parameters),
            parameters,
            arenas: (0..config.side_by_side.max(1)).map(|_| Arena::default()).collect(),
            threads: Arc::new(Threads::of_process()),
            schedule: Schedule::new(&network.diffusion)?,
            config: config.clone(),
            takes_style: network.unet.style_dim > 0,
            seed,
            windows: Arc::clone(windows),
            reducer: Box::new(Alone),
        })
    }

    /// Has steps run on threads; the results are the same on any.
    pub fn on(mut self, threads: &Arc<Threads>) -> Self {
        self.threads = Arc::clone(threads);
        self
    }

    /// Has gradients pass through a reducer.
    pub fn reducing(mut self, reducer: Box<dyn Reducer>) -> Self {
        self.reducer = reducer;
        self
    }

    /// Computes the gradients of a batch, part by part; returns its loss.
    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<f64, TrainingError> {
        let side_by_side = self.gradients.len();
        let n_parts = (self.config.accumulate * side_by_side).clamp(1, batch.n_windows);
        let all: f64 = batch.mask.iter().map(|&w| f64::from(w)).sum();
        let at = |part: usize| part * batch.n_windows / n_parts;
        let Self {
            gradients,
            arenas,
            parameters,
            unet,
            schedule,
            config,
            threads,
            takes_style,
            seed,
            ..
        } = &mut *self;
        let (withhold, takes_style, seed) = (Withhold::of(config), *takes_style, *seed);
        gradients.iter_mut().for_each(Gradients::clear);
        let mut loss = 0.0;
        for first in (0..n_parts).step_by(side_by_side) {
            let numbers = first..(first + side_by_side).min(n_parts);
            let parts: Vec<_> = numbers.zip(gradients.iter_mut().zip(arenas.iter())).collect();
            let losses = threads.side_by_side(parts, |(part, (gradients, arena))| {
                let windows = batch.windows(at(part)..at(part + 1));
                // Parts weigh as much as they have frames, so that any number of parts has one loss.
                let share = windows.mask.iter().map(|&w| f64::from(w)).sum::<f64>() / all.max(1.0);
                let seed = tape_seed(seed, step * n_parts as u64 + part as u64);
                let mut tape = Tape::new(parameters, arena, Some(seed));
                let given = Given::of(&windows, schedule, withhold, takes_style);
                let loss = given.loss(&mut tape, unet, schedule, &config.objective)?;
                let value = share * f64::from(loss.scalar());
                let weight = tape.constant(&[], &[share as f32]);
                tape.backward_from(loss, weight, gradients)?;
                Ok::<_, TrainingError>(value)
            });
            for part in losses {
                loss += part?;
            }
        }
        let (whole, others) = gradients.split_first_mut().expect("at least one");
        threads.run(|| others.iter_mut().for_each(|other| whole.add_all(other)));
        self.reducer.reduce(&mut self.gradients[0]);
        Ok(loss)
    }

    /// Returns the mean loss of the validation windows with some weights, nothing dropped.
    fn validation_loss(&self, parameters: &Parameters<f32>) -> Result<f64, TrainingError> {
        let n = self.windows.n_validation();
        let n_wanted = n.clamp(MIN_VALIDATION_WINDOWS, MAX_VALIDATION_WINDOWS);
        let (mut sum, mut count) = (0.0, 0.0);
        let size = self.config.batch_size.min(32);
        for first in (0..n_wanted).step_by(size) {
            let batch = self.windows.validation(first..(first + size).min(n_wanted))?;
            let weight: f64 = batch.mask.iter().map(|&w| f64::from(w)).sum();
            let given =
                Given::of(&batch, &self.schedule, Withhold::of(&self.config), self.takes_style);
            let loss = self.threads.run(|| {
                let mut g = Eager::new(parameters, &self.arenas[0]);
                given.loss(&mut g, &self.unet, &self.schedule, &self.config.objective)
            })?;
            sum += weight * f64::from(loss.scalar());
            count += weight;
        }
        Ok(sum / count.max(1.0))
    }

    /// Returns the UNet with its averaged weights, for sampling.
    pub fn denoiser(&self) -> Denoiser<'_> {
        Denoiser {
            unet: &self.unet,
            parameters: self.ema.average(),
            arena: &self.arenas[0],
            takes_style: self.takes_style,
        }
    }
}

/// Returns the seed of a tape, by which dropout differs from step to step.
pub(super) fn tape_seed(seed: u64, number: u64) -> u64 {
    // The finalizer of SplitMix64 (Steele, Lea and Flood, 2014) keeps neighbouring seeds apart.
    let z = seed.wrapping_add(number.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Probabilities with which conditions are withheld.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Withhold {
    pub audio: f64,
    pub style: f64,
}

impl Withhold {
    fn of(config: &DiffusionTraining) -> Self {
        Self { audio: config.condition_dropout, style: config.style_dropout }
    }
}

/// What the network is given of a batch, and what it should say.
pub struct Given<'a> {
    batch: &'a Batch,
    pub t: Vec<usize>,
    x_t: Vec<f32>,
    target: Vec<f32>,
    drop_audio: Vec<f32>,
    style: Option<Vec<f32>>,
}

impl<'a> Given<'a> {
    /// Adds noise to a batch, and withholds what chance withholds.
    pub fn of(
        batch: &'a Batch,
        schedule: &Schedule,
        withhold: Withhold,
        takes_style: bool,
    ) -> Self {
        let (n, frames) = (batch.n_windows, batch.n_frames);
        let t: Vec<usize> = batch
            .chances
            .iter()
            .map(|chance| ((chance.step * schedule.len() as f64) as usize).min(schedule.len() - 1))
            .collect();
        let (x0, noise) =
            (motion_view(&batch.motion, n, frames), motion_view(&batch.noise, n, frames));
        let x_t = schedule.add_noise(x0, noise, &t).into_raw_vec_and_offset().0;
        let target = schedule.target(x0, noise, &t).into_raw_vec_and_offset().0;
        let drop_audio = batch
            .chances
            .iter()
            .map(|chance| f32::from(u8::from(chance.no_audio < withhold.audio)))
            .collect();
        let style = takes_style.then(|| {
            let mut style = batch.style.clone();
            for (style, chance) in style.chunks_exact_mut(STYLE_DIM).zip(&batch.chances) {
                if chance.no_style < withhold.style {
                    // A style of zeros adds nothing but the projection's bias: none was asked for.
                    style.fill(0.0);
                }
            }
            style
        });
        Self { batch, t, x_t, target, drop_audio, style }
    }

    /// Returns the loss of the network's prediction.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn loss<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        unet: &UNet1D,
        schedule: &Schedule,
        objective: &Objective,
    ) -> Result<Tensor<f32>, TrainingError> {
        let y = self.predict(g, unet)?;
        let target = g.constant(y.shape(), &self.target);
        let mask = &self.batch.mask;
        Ok(objective.loss(g, schedule, &self.t, [&y, &target], mask)?)
    }

    /// Returns the network's prediction, \[batch, frames, 25\].
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn predict<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        unet: &UNet1D,
    ) -> Result<Tensor<f32>, TrainingError> {
        let (n, frames) = (self.batch.n_windows, self.batch.n_frames);
        let n_features = self.batch.audio.len() / (n * frames);
        let x = g.constant(&[n, frames, MOTION_DIM], &self.x_t);
        let steps: Vec<f32> = self.t.iter().map(|&t| t as f32).collect();
        let t = g.constant(&[n], &steps);
        let audio = g.constant(&[n, frames, n_features], &self.batch.audio);
        let drop_audio = g.constant(&[n], &self.drop_audio);
        let mask = is_partial(&self.batch.mask).then(|| g.constant(&[n, frames], &self.batch.mask));
        let style = self.style.as_ref().map(|style| g.constant(&[n, STYLE_DIM], style));
        let inputs = UNetInputs {
            x: &x,
            t: &t,
            audio: &audio,
            drop_audio: Some(&drop_audio),
            mask: mask.as_ref(),
            style: style.as_ref(),
        };
        Ok(unet.forward(g, inputs)?)
    }
}

impl Learner for DiffusionLearner {
    const STAGE: &'static str = "diffusion";

    fn step(&mut self, batch: &Batch, step: u64, n_steps: u64) -> Result<Step, TrainingError> {
        let loss = self.differentiate(batch, step)?;
        let learning_rate = self.config.learning_rate.at(step, n_steps);
        // A loss that is not finite has a gradient that is not, and then the optimizer does nothing.
        let gradient_norm = if loss.is_finite() {
            let Self { optimizer, parameters, gradients, .. } = self;
            self.threads.run(|| optimizer.step(parameters, &mut gradients[0], learning_rate))
        } else {
            f64::NAN
        };
        if gradient_norm.is_finite() {
            let Self { ema, parameters, .. } = self;
            self.threads.run(|| ema.after_step(step + 1, parameters));
        }
        let losses = Losses { total: loss, parts: vec![("diffusion", loss)] };
        Ok(Step { losses, gradient_norm, learning_rate, lr_decoder: None })
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.differentiate(batch, 0).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let loss = self.validation_loss(self.ema.average())?;
        let live = self.validation_loss(&self.parameters)?;
        let losses = Losses { total: loss, parts: vec![("diffusion", loss)] };
        Ok(Validation { losses, live: Some(live) })
    }

    fn sections(&self) -> Vec<Section<'_, f32>> {
        let plan = self.parameters.plan();
        let ([m, v], _) = self.optimizer.state();
        vec![
            Section { prefix: UNET, plan, values: self.parameters.all() },
            Section { prefix: AVERAGE, plan, values: self.ema.average().all() },
            Section { prefix: MOMENTS[0], plan, values: m },
            Section { prefix: MOMENTS[1], plan, values: v },
        ]
    }

    fn best(&self) -> Vec<Section<'_, f32>> {
        let plan = self.parameters.plan();
        vec![Section { prefix: UNET, plan, values: self.ema.average().all() }]
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
        let (parameters, average) = (read(UNET)?, read(AVERAGE)?);
        let [m, v] = [read(MOMENTS[0])?, read(MOMENTS[1])?];
        self.optimizer.restore([m.all(), v.all()], at.n_updates);
        self.ema = Ema::resume(self.config.ema, average, at.n_averaged);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_of_tapes_differ() {
        let mut seen: Vec<_> =
            (0..20).flat_map(|seed| (0..20).map(move |n| tape_seed(seed, n))).collect();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), 400);
    }
}
