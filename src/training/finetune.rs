//! End-to-end fine-tuning: the UNet and the decoder together, with gradients through the sampler.
//!
//! Reference, section 7. The loss is w_diff · L_diffusion + w_dec · (L_position + L_quaternion) +
//! w_temp · L_temporal, the last two of motion that was sampled in a few steps and decoded.
//!
//! The reference samples from noise. There is then nothing that tells which of all motions that suit the
//! music the phrase's is, so what is nearest to it on average is their mean, and that is what both networks
//! learn: motion that agrees with itself because it stands still. Here sampling begins with the phrase's
//! motion made noisy ([`FinetuneConfig::start`]), and its step knows where it should lead.

use std::sync::Arc;

use ndarray::ArrayViewMut2;

use crate::autodiff::{
    AdamW, Arena, Eager, Gradients, Interpreter, Parameters, Tape, Tensor, Threads,
};
use crate::diffusion::{Schedule, Spacing, steps};
use crate::model::{Graph, Parameter};
use crate::motion::vector::norm;
use crate::motion::{Columns, Layout, MOTION_DIM};
use crate::units::FPS;
use crate::weights::{Archive, Section};

use super::averaged::{MOMENTS, section};
use super::batch::Batch;
use super::checkpoint::Progress;
use super::config::{FinetuneConfig, NetworkConfig};
use super::decoder::DECODER;
use super::diffusion::{DiffusionInputs, UNET, WithholdProbabilities, tape_seed};
use super::error::TrainingError;
use super::learner::{CheckpointState, Learner, Losses, StepResult, Validation};
use super::objective::{Objective, reconstruction};
use super::pipeline::{Pipeline, weighted_sum};
use super::sampling::motion_view;
use super::temporal::{TemporalLosses, temporal_losses};
use super::window::Windows;

/// Windows of a validation.
const N_VALIDATION: usize = 64;

/// Section of both networks beside the optimizer's.
const BOTH: &str = "model.";

/// Motion that was sampled and decoded, with its losses.
struct SampledMotion<T> {
    position: T,
    quaternion: T,
    temporal: TemporalLosses<T>,
    decoded: T,
}

/// The losses of end-to-end training, and the decoded motion that they measure.
pub struct EndToEndLosses<T> {
    pub total: T,
    pub diffusion: T,
    pub position: T,
    pub quaternion: T,
    pub temporal: TemporalLosses<T>,
    /// \[batch, frames, 25\], in metres and the like.
    pub decoded: T,
}

/// The parameters of both networks, whose names begin with `unet.` and `decoder.`, and their optimizer.
struct BothNetworks {
    parameters: Parameters<f32>,
    optimizer: AdamW<f32>,
}

/// Trains both networks together.
pub struct FinetuneLearner {
    pipeline: Pipeline,
    networks: BothNetworks,
    gradients: Gradients<f32>,
    arena: Arena<f32>,
    threads: Arc<Threads>,
    schedule: Schedule,
    objective: Objective,
    withhold: WithholdProbabilities,
    config: FinetuneConfig,
    windows: Arc<Windows>,
}

impl FinetuneLearner {
    /// Begins with trained networks; the UNet's prediction keeps its objective, and its conditions are withheld as
    /// they were, so that guidance finds what it needs.
    ///
    /// # Errors
    /// A configuration that makes no network; more sampling steps than there are.
    pub fn new(
        network: &NetworkConfig,
        (objective, withhold): (&Objective, WithholdProbabilities),
        config: &FinetuneConfig,
        windows: &Arc<Windows>,
        [unet, decoder]: [&Parameters<f32>; 2],
    ) -> Result<Self, TrainingError> {
        network.check()?;
        let schedule = Schedule::new(&network.diffusion)?;
        steps(config.first_step(schedule.len()), config.num_steps, Spacing::Linspace)?;
        let (pipeline, list) = Pipeline::new(network);
        let parameters = Parameters::from_fn(list, |parameter| {
            let (source, name) = split(parameter, unet, decoder);
            let id = source.list().by_name()[name];
            source.unpacked(id)
        });
        Ok(Self {
            pipeline,
            gradients: Gradients::new(&parameters),
            networks: BothNetworks {
                optimizer: AdamW::new(config.optimizer.adamw(), &parameters),
                parameters,
            },
            arena: Arena::default(),
            threads: Arc::new(Threads::of_process()),
            schedule,
            objective: objective.clone(),
            withhold,
            config: config.clone(),
            windows: Arc::clone(windows),
        })
    }

    /// Has steps run on threads; the results are the same on any.
    pub fn on(mut self, threads: &Arc<Threads>) -> Self {
        self.threads = Arc::clone(threads);
        self
    }

    /// Returns the parameters of both networks; names begin with `unet.` and `decoder.`.
    pub fn parameters(&self) -> &Parameters<f32> {
        &self.networks.parameters
    }

    /// Returns all losses of a batch.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn losses<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        batch: &Batch,
    ) -> Result<EndToEndLosses<Tensor<f32>>, TrainingError> {
        let diffusion = self.diffusion(g, batch)?;
        let sampled = self.sampled(g, batch)?;
        let rest = self.total(g, &sampled)?;
        let total = weighted_sum(g, &[(&diffusion, self.config.diffusion_weight), (&rest, 1.0)])?;
        let SampledMotion { position, quaternion, temporal, decoded } = sampled;
        Ok(EndToEndLosses { total, diffusion, position, quaternion, temporal, decoded })
    }

    /// The loss of the UNet's prediction.
    fn diffusion<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        batch: &Batch,
    ) -> Result<Tensor<f32>, TrainingError> {
        let Self { pipeline, schedule, .. } = self;
        let given = DiffusionInputs::of(batch, schedule, self.withhold, pipeline.takes_style);
        given.loss(g, &pipeline.unet, self.windows.normalizer(), schedule, &self.objective)
    }

    /// The losses of motion that is sampled and decoded.
    fn sampled<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        batch: &Batch,
    ) -> Result<SampledMotion<Tensor<f32>>, TrainingError> {
        let Self { pipeline, schedule, config: c, .. } = self;
        // The sample begins with the same noise that was added for the prediction, in reverse: independent
        // of where a network that sees only the other went, and no further draw.
        let noise: Vec<f32> = batch.noise.iter().rev().copied().collect();
        let from = c.first_step(schedule.len());
        let x = if from == schedule.len() { noise } else { self.noised(batch, &noise, from - 1) };
        let latent = pipeline.sample(g, schedule, (from, c.num_steps), &x, batch)?;
        let decoded = pipeline.decoder.forward(g, &latent)?;
        let normalizer = self.windows.normalizer();
        let found = reconstruction(g, normalizer, &decoded, &batch.motion, &batch.mask)?;
        let temporal = temporal_losses(g, normalizer.layout(), &c.temporal, &decoded, &batch.mask)?;
        let (position, quaternion) = (found.position, found.quaternion);
        Ok(SampledMotion { position, quaternion, temporal, decoded })
    }

    /// The weighted sum of what is said of sampled motion.
    fn total<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        sampled: &SampledMotion<Tensor<f32>>,
    ) -> Result<Tensor<f32>, TrainingError> {
        let c = &self.config;
        let mut terms =
            vec![(&sampled.position, c.decoder_weight), (&sampled.quaternion, c.decoder_weight)];
        terms.extend(sampled.temporal.all().map(|loss| (loss, c.temporal_weight)));
        weighted_sum(g, &terms)
    }

    /// The motion of a batch at step t of the diffusion, \[batch, frames, 25\].
    fn noised(&self, batch: &Batch, noise: &[f32], t: usize) -> Vec<f32> {
        let (n, frames) = (batch.n_windows, batch.n_frames);
        let x0 = motion_view(&batch.motion, n, frames);
        let noised = self.schedule.add_noise(x0, motion_view(noise, n, frames), &vec![t; n]);
        noised.iter().copied().collect()
    }

    /// Motion as it will be generated: sampled from noise alone, and decoded.
    fn generated(&self, batch: &Batch) -> Result<Tensor<f32>, TrainingError> {
        let Self { pipeline, schedule, config, .. } = self;
        let mut g = Eager::new(&self.networks.parameters, &self.arena);
        let noise: Vec<f32> = batch.noise.iter().rev().copied().collect();
        let plan = (schedule.len(), config.num_steps);
        let latent = pipeline.sample(&mut g, schedule, plan, &noise, batch)?;
        Ok(pipeline.decoder.forward(&mut g, &latent)?)
    }

    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<Losses, TrainingError> {
        self.gradients.clear();
        // A tape for either part of the sum, one after the other, so that what backward needs of the
        // prediction is not kept while motion is sampled: a tenth of the memory of a step of `base`.
        let tape = |part: u64| {
            let seed = tape_seed(self.config.seed, 2 * step + part);
            Tape::new(&self.networks.parameters, &self.arena, Some(seed))
        };
        let mut first = tape(0);
        let diffusion = self.diffusion(&mut first, batch)?;
        let diffusion_value = value(&diffusion);
        let weighted = first.scale(&diffusion, self.config.diffusion_weight)?;
        first.backward(weighted, &mut self.gradients)?;
        let mut second = tape(1);
        let sampled = self.sampled(&mut second, batch)?;
        let rest = self.total(&mut second, &sampled)?;
        let total = self.config.diffusion_weight * diffusion_value + value(&rest);
        let losses = named(
            total,
            diffusion_value,
            &sampled.position,
            &sampled.quaternion,
            &sampled.temporal,
        );
        drop(sampled);
        second.backward(rest, &mut self.gradients)?;
        Ok(losses)
    }
}

fn value(x: &Tensor<f32>) -> f64 {
    f64::from(x.scalar())
}

/// Returns where a parameter of both networks comes from, and what it is called there.
fn split<'a>(
    parameter: &'a Parameter,
    unet: &'a Parameters<f32>,
    decoder: &'a Parameters<f32>,
) -> (&'a Parameters<f32>, &'a str) {
    match parameter.name.strip_prefix(UNET) {
        Some(name) => (unet, name),
        None => (decoder, parameter.name.strip_prefix(DECODER).unwrap_or(&parameter.name)),
    }
}

fn named(
    total: f64,
    diffusion: f64,
    position: &Tensor<f32>,
    quaternion: &Tensor<f32>,
    temporal: &TemporalLosses<Tensor<f32>>,
) -> Losses {
    let mut parts = vec![
        ("diffusion", diffusion),
        ("decoder_position", value(position)),
        ("decoder_quaternion", value(quaternion)),
    ];
    let temporal = TemporalLosses::<()>::NAMES.into_iter().zip(temporal.all());
    parts.extend(temporal.map(|(name, loss)| (name, value(loss))));
    Losses { total, parts }
}

/// Mean |v − f Δp| and |a − f Δv|, and whether every turn keeps |q · q'| above a target.
struct Coherence {
    velocity_m_s: f64,
    acceleration_m_s2: f64,
    is_smooth: bool,
}

impl Coherence {
    /// Measures the first `n` frames of one motion; errors of what the layout lacks are 0.
    fn of(layout: Layout, frames: &[f32], n: usize, target_dot: f64) -> Self {
        let at = |t: usize, i: usize| f64::from(frames[t * layout.width() + i]);
        let body = layout.body();
        let n_pairs = n.saturating_sub(1).max(1);
        let error = |of: Option<Columns>, derivative: Option<Columns>| {
            let (Some(of), Some(derivative)) = (of, derivative) else { return 0.0 };
            let (of, derivative) = (of.first, derivative.first);
            let differences = (0..n.saturating_sub(1)).flat_map(|t| {
                (0..3).map(move |i| {
                    (at(t, derivative + i) - FPS * (at(t + 1, of + i) - at(t, of + i))).abs()
                })
            });
            differences.sum::<f64>() / (3 * n_pairs) as f64
        };
        let is_smooth = (0..n.saturating_sub(1)).all(|t| {
            let dot: f64 = body.orientation.range().map(|i| at(t, i) * at(t + 1, i)).sum();
            dot.abs() >= target_dot
        });
        Self {
            velocity_m_s: error(Some(body.position), body.velocity),
            acceleration_m_s2: error(body.velocity, body.acceleration),
            is_smooth,
        }
    }
}

impl Learner for FinetuneLearner {
    const STAGE: &'static str = "finetune";

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        _n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        let threads = Arc::clone(&self.threads);
        let FinetuneConfig { lr_diffusion, lr_decoder, .. } = self.config;
        threads.run(|| {
            let losses = self.differentiate(batch, step)?;
            let gradient_norm = if losses.total.is_finite() {
                let BothNetworks { parameters, optimizer } = &mut self.networks;
                optimizer.step_by(parameters, &mut self.gradients, |parameter| {
                    if parameter.name.starts_with(UNET) { lr_diffusion } else { lr_decoder }
                })
            } else {
                f64::NAN
            };
            let lr_decoder = Some(lr_decoder);
            Ok(StepResult { losses, gradient_norm, learning_rate: lr_diffusion, lr_decoder })
        })
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        let threads = Arc::clone(&self.threads);
        threads.run(|| self.differentiate(batch, 0)).map(|_| ())
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let mut sum = Losses::default();
        let size = self.config.batch_size.max(1);
        let n = N_VALIDATION.div_ceil(size);
        for i in 0..n {
            let batch = self.windows.validation(i * size..(i + 1) * size)?;
            let found = self.threads.run(|| {
                let mut g = Eager::new(&self.networks.parameters, &self.arena);
                self.losses(&mut g, &batch)
            })?;
            let EndToEndLosses { total, diffusion, position, quaternion, temporal, .. } = &found;
            let mut losses = named(value(total), value(diffusion), position, quaternion, temporal);
            let decoded = self.threads.run(|| self.generated(&batch))?;
            let motions = decoded.data().chunks_exact(batch.n_frames * MOTION_DIM);
            let target = self.config.temporal.target_quaternion_dot;
            let layout = self.windows.normalizer().layout();
            let measured: Vec<_> = motions
                .zip(batch.mask.chunks_exact(batch.n_frames))
                .map(|(motion, mask)| {
                    let n_frames = mask.iter().filter(|&&w| w > 0.0).count();
                    Coherence::of(layout, motion, n_frames, target)
                })
                .collect();
            let mut real = batch.motion.clone();
            for motion in real.chunks_exact_mut(batch.n_frames * MOTION_DIM) {
                let rows = ArrayViewMut2::from_shape((batch.n_frames, MOTION_DIM), motion);
                self.windows.normalizer().denormalize(rows.expect("frames of 25 channels"));
            }
            let speed = |frames: &[f32]| -> f64 {
                let rows = frames.chunks_exact(MOTION_DIM).zip(&batch.mask);
                let counted = rows.filter(|(_, w)| **w > 0.0);
                let Some(velocity) = layout.body().velocity else { return 0.0 };
                let at = |row: &[f32], i: usize| f64::from(row[velocity.first + i]);
                counted.map(|(row, _)| norm(std::array::from_fn(|i| at(row, i)))).sum()
            };
            let speed_ratio = speed(decoded.data()) / speed(&real).max(f64::MIN_POSITIVE);
            let mean = |value: &dyn Fn(&Coherence) -> f64| {
                measured.iter().map(value).sum::<f64>() / measured.len() as f64
            };
            losses.parts.extend([
                ("velocity_error", mean(&|c| c.velocity_m_s)),
                ("acceleration_error", mean(&|c| c.acceleration_m_s2)),
                ("quaternion_pass_rate", mean(&|c| f64::from(u8::from(c.is_smooth)))),
                ("speed_ratio", speed_ratio),
            ]);
            sum.add(&losses, 1.0 / n as f64);
        }
        Ok(Validation { losses: sum, live: None, distance: None })
    }

    fn state(&self) -> Vec<&dyn CheckpointState> {
        vec![&self.networks]
    }

    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState> {
        vec![&mut self.networks]
    }
}

impl CheckpointState for BothNetworks {
    fn sections(&self) -> Vec<Section<'_, f32>> {
        let plan = self.parameters.plan();
        let ([m, v], _) = self.optimizer.state();
        vec![
            Section { prefix: BOTH, plan, values: self.parameters.all() },
            Section { prefix: MOMENTS[0], plan, values: m },
            Section { prefix: MOMENTS[1], plan, values: v },
        ]
    }

    fn best(&self) -> Vec<Section<'_, f32>> {
        vec![Section { prefix: "", plan: self.parameters.plan(), values: self.parameters.all() }]
    }

    fn n_updates(&self) -> (u64, u64) {
        (self.optimizer.state().1, 0)
    }

    fn restore(
        &mut self,
        archive: &Archive,
        place: &str,
        at: &Progress,
    ) -> Result<(), TrainingError> {
        let read = |prefix: &str| section(archive, prefix, &self.parameters, place);
        let parameters = read(BOTH)?;
        let [m, v] = [read(MOMENTS[0])?, read(MOMENTS[1])?];
        self.optimizer.restore([m.all(), v.all()], at.n_updates);
        self.parameters = parameters;
        Ok(())
    }
}
