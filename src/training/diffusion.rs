//! Training of the UNet: noise is added to motion, and the network learns to tell what was added.

use std::borrow::Cow;
use std::sync::Arc;

use crate::audio::FEATURE_DIM;
use crate::autodiff::{Eager, Interpreter, Parameters, Tape, Tensor};
use crate::diffusion::Schedule;
use crate::model::{Graph as _, UNet1D, UNetInputs};
use crate::motion::style::STYLE_DIM;
use crate::motion::{MOTION_DIM, Normalizer};

use super::averaged::NetworkState;
use super::batch::Batch;
use super::config::{DiffusionTraining, NetworkConfig};
use super::error::TrainingError;
use super::judge::{SampleJudge, sampled_distance};
use super::learner::{
    CheckpointState, Learner, Losses, Ownership, PartedLearner, StepResult, Validation,
};
use super::objective::Objective;
use super::parts::Parts;
use super::sampling::{Denoiser, is_partial, motion_view};
use super::window::Windows;

/// Windows of one validation: all of them, or these many with noise and steps of their own.
const MIN_VALIDATION_WINDOWS: usize = 256;
/// A validation of a large library stops here, always at the same windows.
const MAX_VALIDATION_WINDOWS: usize = 1024;

/// Name of the section of the UNet's weights.
pub(super) const UNET: &str = "unet.";

/// Losses on the validation windows that a trained network should be far below.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Baselines {
    /// Of the mean of all that was to be told, which is the best constant for squared errors.
    pub constant: f64,
    /// Of nothing: the last convolution of a UNet begins with zeros.
    pub untrained: f64,
}

/// Trains a UNet.
pub struct DiffusionLearner {
    unet: Arc<UNet1D>,
    network: NetworkState,
    parts: Parts,
    schedule: Schedule,
    config: DiffusionTraining,
    takes_style: bool,
    seed: u64,
    windows: Arc<Windows>,
    judge: Option<Box<dyn SampleJudge>>,
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
            parts: Parts::new(&parameters, config.accumulate, config.side_by_side),
            network: NetworkState::new(UNET, parameters, &config.optimizer, config.ema),
            schedule: Schedule::new(&network.diffusion)?,
            config: config.clone(),
            takes_style: network.unet.style_dim > 0,
            seed,
            windows: Arc::clone(windows),
            judge: None,
        })
    }

    /// Has validations sample motion, by whose distance the best is chosen.
    pub fn judged_by(mut self, judge: impl SampleJudge + 'static) -> Self {
        self.judge = Some(Box::new(judge));
        self
    }

    /// Computes the gradients of a batch, part by part; returns its loss.
    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<f64, TrainingError> {
        let Self { parts, network, unet, schedule, config, takes_style, seed, windows, .. } =
            &mut *self;
        let n_parts = parts.number(batch.n_windows);
        let at = |part: usize| part * batch.n_windows / n_parts;
        let weights = parts.weights(n_parts, |part| {
            let mask = &batch.mask[at(part) * batch.n_frames..at(part + 1) * batch.n_frames];
            mask.iter().map(|&w| f64::from(w)).sum()
        })?;
        let all: f64 = weights.iter().sum();
        let (withhold, takes_style, seed) =
            (WithholdProbabilities::of(config), *takes_style, *seed);
        let normalizer = windows.normalizer();
        let parameters = network.live();
        let losses = parts.differentiate(n_parts, |part| {
            let number = part.number;
            let batch = batch.windows(at(number)..at(number + 1));
            // Parts weigh as much as they have frames, so that any number of parts has one loss.
            let share = weights[number] / all.max(1.0);
            let seed = tape_seed(seed, step * n_parts as u64 + number as u64);
            let mut tape = Tape::new(parameters, part.arena, Some(seed));
            let given = DiffusionInputs::of(&batch, schedule, withhold, takes_style);
            let loss = given.loss(&mut tape, unet, normalizer, schedule, &config.objective)?;
            let value = share * f64::from(loss.scalar());
            part.backward(tape, loss, share)?;
            Ok(vec![value])
        })?;
        Ok(parts.of_all(n_parts, losses)?.into_iter().flatten().sum())
    }

    /// Returns the mean loss of the validation windows with some weights, nothing dropped.
    fn validation_loss(&self, parameters: &Parameters<f32>) -> Result<f64, TrainingError> {
        let [loss] = self.mean_over_validation(|given| {
            let mut g = Eager::new(parameters, self.parts.arena());
            let (normalizer, objective) = (self.windows.normalizer(), &self.config.objective);
            let loss = given.loss(&mut g, &self.unet, normalizer, &self.schedule, objective)?;
            Ok([loss.scalar().into()])
        })?;
        Ok(loss)
    }

    /// Returns the losses on the validation windows of predictors that ignore their input.
    ///
    /// # Errors
    /// The error of reading the windows.
    pub fn baselines(&self) -> Result<Baselines, TrainingError> {
        let mean = self.mean_over_validation(|given| Ok(given.mean_target()))?;
        let [constant, untrained] = self.mean_over_validation(|given| {
            let batch = given.batch;
            let shape = [batch.n_windows, batch.n_frames, MOTION_DIM];
            let mut g = Eager::new(self.network.live(), self.parts.arena());
            let mut loss_of = |frame: [f32; MOTION_DIM]| {
                let says = g.constant(&shape, &frame.repeat(batch.n_windows * batch.n_frames));
                let (normalizer, objective) = (self.windows.normalizer(), &self.config.objective);
                let loss = given.loss_of(&mut g, &says, normalizer, &self.schedule, objective)?;
                Ok::<_, TrainingError>(loss.scalar().into())
            };
            Ok([loss_of(mean.map(|x| x as f32))?, loss_of([0.0; MOTION_DIM])?])
        })?;
        Ok(Baselines { constant, untrained })
    }

    /// Returns the means of some numbers over the frames of the validation windows, nothing dropped.
    fn mean_over_validation<const N: usize>(
        &self,
        mean_losses: impl Fn(&DiffusionInputs) -> Result<[f64; N], TrainingError> + Sync,
    ) -> Result<[f64; N], TrainingError> {
        let n = self.windows.n_validation();
        let n_wanted = n.clamp(MIN_VALIDATION_WINDOWS, MAX_VALIDATION_WINDOWS);
        let (mut sums, mut count) = ([0.0; N], 0.0);
        let size = self.config.batch_size.min(32);
        for first in (0..n_wanted).step_by(size) {
            let batch = self.windows.validation(first..(first + size).min(n_wanted))?;
            let weight: f64 = batch.mask.iter().map(|&w| f64::from(w)).sum();
            let given = DiffusionInputs::of(
                &batch,
                &self.schedule,
                WithholdProbabilities::of(&self.config),
                self.takes_style,
            );
            let found = self.parts.threads().run(|| mean_losses(&given))?;
            for (sum, value) in sums.iter_mut().zip(found) {
                *sum += weight * value;
            }
            count += weight;
        }
        Ok(sums.map(|sum| sum / count.max(1.0)))
    }

    fn sampled_distance(&self) -> Result<Option<f64>, TrainingError> {
        let Some(judge) = &self.judge else { return Ok(None) };
        let (denoiser, normalizer) = (self.denoiser(), self.windows.normalizer());
        let distance = || sampled_distance(judge.as_ref(), &denoiser, &self.schedule, normalizer);
        self.parts.threads().run(distance)
    }

    /// Returns the UNet with its averaged weights, for sampling.
    pub fn denoiser(&self) -> Denoiser<'_> {
        Denoiser {
            unet: &self.unet,
            parameters: self.network.average(),
            arena: self.parts.arena(),
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
pub struct WithholdProbabilities {
    pub audio: f64,
    pub style: f64,
    pub clock: f64,
}

impl WithholdProbabilities {
    /// Returns those of a configuration.
    pub fn of(config: &DiffusionTraining) -> Self {
        Self {
            audio: config.condition_dropout,
            style: config.style_dropout,
            clock: config.clock_dropout,
        }
    }
}

/// Inputs of the denoiser for a batch, with its target.
pub struct DiffusionInputs<'a> {
    batch: &'a Batch,
    pub t: Vec<usize>,
    x_t: Vec<f32>,
    target: Vec<f32>,
    audio: Cow<'a, [f32]>,
    drop_audio: Vec<f32>,
    style: Option<Vec<f32>>,
}

impl<'a> DiffusionInputs<'a> {
    /// Adds noise to a batch, and withholds what chance withholds.
    pub fn of(
        batch: &'a Batch,
        schedule: &Schedule,
        withhold: WithholdProbabilities,
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
        let audio = without_clock(batch, withhold.clock);
        Self { batch, t, x_t, target, audio, drop_audio, style }
    }

    /// Returns the loss of the network's prediction.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn loss<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        unet: &UNet1D,
        normalizer: &Normalizer,
        schedule: &Schedule,
        objective: &Objective,
    ) -> Result<Tensor<f32>, TrainingError> {
        let y = self.predict(g, unet)?;
        self.loss_of(g, &y, normalizer, schedule, objective)
    }

    /// Returns the loss of any prediction, \[batch, frames, 25\].
    fn loss_of<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        prediction: &Tensor<f32>,
        normalizer: &Normalizer,
        schedule: &Schedule,
        objective: &Objective,
    ) -> Result<Tensor<f32>, TrainingError> {
        let target = g.constant(prediction.shape(), &self.target);
        let mask = &self.batch.mask;
        let layout = normalizer.layout();
        let loss = objective.loss(g, layout, schedule, &self.t, [prediction, &target], mask)?;
        let x_t = g.constant(prediction.shape(), &self.x_t);
        let estimate_loss = objective.estimate.loss(
            g,
            normalizer,
            (schedule, &self.t),
            [prediction, &x_t],
            (&self.batch.motion, mask),
        )?;
        Ok(match estimate_loss {
            Some(estimate_loss) => g.add(&loss, &estimate_loss)?,
            None => loss,
        })
    }

    /// Returns the mean of what should be told, channel by channel, over frames that count.
    fn mean_target(&self) -> [f64; MOTION_DIM] {
        let (mut sums, mut n) = ([0.0; MOTION_DIM], 0.0);
        for (frame, &w) in self.target.chunks_exact(MOTION_DIM).zip(&self.batch.mask) {
            let w = f64::from(w);
            for (sum, &x) in sums.iter_mut().zip(frame) {
                *sum += w * f64::from(x);
            }
            n += w;
        }
        sums.map(|sum| sum / n.max(1.0))
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
        let n_features = self.audio.len() / (n * frames);
        let x = g.constant(&[n, frames, MOTION_DIM], &self.x_t);
        let steps: Vec<f32> = self.t.iter().map(|&t| t as f32).collect();
        let t = g.constant(&[n], &steps);
        let audio = g.constant(&[n, frames, n_features], &self.audio);
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

/// Returns the condition of a batch, the clock of windows by chance all zeros: not known.
pub(super) fn without_clock(batch: &Batch, probability: f64) -> Cow<'_, [f32]> {
    let window = batch.audio.len() / batch.n_windows.max(1);
    let width = window / batch.n_frames.max(1);
    let mut audio = Cow::Borrowed(batch.audio.as_slice());
    if width == FEATURE_DIM {
        return audio;
    }
    for (i, chance) in batch.chances.iter().enumerate() {
        if chance.no_clock < probability {
            let frames = audio.to_mut()[i * window..(i + 1) * window].chunks_exact_mut(width);
            frames.for_each(|frame| frame[FEATURE_DIM..].fill(0.0));
        }
    }
    audio
}

impl Learner for DiffusionLearner {
    const STAGE: &'static str = "diffusion";

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        let loss = self.differentiate(batch, step)?;
        let losses = Losses { total: loss, parts: vec![("diffusion", loss)] };
        self.take_step(losses, self.config.learning_rate.at(step, n_steps), step)
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        self.differentiate(batch, 0).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let loss = self.validation_loss(self.network.average())?;
        let live = self.validation_loss(self.network.live())?;
        let mut parts = vec![("diffusion", loss)];
        let distance = self.sampled_distance()?;
        parts.extend(distance.map(|distance| ("sampled_distance", distance)));
        let losses = Losses { total: loss, parts };
        Ok(Validation { losses, live: Some(live), distance })
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

impl PartedLearner for DiffusionLearner {
    fn parts_and_network(&mut self) -> (&mut Parts, &mut NetworkState) {
        (&mut self.parts, &mut self.network)
    }
}

#[cfg(test)]
mod tests;
