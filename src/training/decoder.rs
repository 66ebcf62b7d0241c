//! Training of the decoder: from latents that are a little off to the motion that they should be.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::Array3;

use crate::autodiff::{Arena, Eager, Gradients, Interpreter, Parameters, Stream, Tape, Threads};
use crate::diffusion::{Schedule, ddim_update};
use crate::model::{DecoderConfig, MotionDecoder, ParameterList};
use crate::motion::{ChannelLimits, ColumnRole, MOTION_DIM, Normalizer};

use super::averaged::NetworkState;
use super::batch::Batch;
use super::config::DecoderTraining;
use super::diffusion::tape_seed;
use super::error::TrainingError;
use super::learner::{CheckpointState, Learner, Losses, StepResult, Validation};
use super::objective::{Reconstruction, reconstruction};
use super::sampling::{Condition, Denoiser, motion_view};
use super::window::Windows;

/// Windows of a validation.
const N_VALIDATION: usize = 64;

/// Name of the section of the decoder's weights.
pub(super) const DECODER: &str = "decoder.";

/// Stream of what the sampler draws beside a window's own noise.
const STARTS: u64 = 7 << 60;

/// Trains a decoder on the latents of a UNet that stays as it is.
pub struct DecoderLearner<'u> {
    decoder: MotionDecoder,
    network: NetworkState,
    gradients: Gradients<f32>,
    arena: Arena<f32>,
    threads: Arc<Threads>,
    denoiser: Denoiser<'u>,
    schedule: Schedule,
    config: DecoderTraining,
    seed: u64,
    windows: Arc<Windows>,
}

impl<'u> DecoderLearner<'u> {
    /// Begins with weights that depend on the seed.
    pub fn new(
        decoder: &DecoderConfig,
        config: &DecoderTraining,
        denoiser: Denoiser<'u>,
        schedule: Schedule,
        windows: &Arc<Windows>,
        seed: u64,
    ) -> Self {
        let (limits, (decoder, list)) = (decoder.limits, MotionDecoder::new(decoder));
        let parameters = near_the_data(list, windows.normalizer(), limits, seed);
        Self {
            decoder,
            gradients: Gradients::new(&parameters),
            network: NetworkState::new(DECODER, parameters, &config.optimizer, config.ema),
            arena: Arena::default(),
            threads: Arc::new(Threads::of_process()),
            denoiser,
            schedule,
            config: config.clone(),
            seed,
            windows: Arc::clone(windows),
        }
    }

    /// Has steps run on threads; the results are the same on any.
    pub fn on(mut self, threads: &Arc<Threads>) -> Self {
        self.threads = Arc::clone(threads);
        self
    }

    /// Returns the latents to decode: those of a batch, made noisy, or what the UNet makes of them.
    fn latents(
        &self,
        batch: &Batch,
        is_sampled: bool,
        number: u64,
    ) -> Result<Vec<f32>, TrainingError> {
        if !is_sampled {
            return Ok(self.noised(batch));
        }
        let mut start = [0.0_f64];
        Stream::new(self.seed, STARTS + number).uniform(0, &mut start);
        let share = self.config.sampled_from * start[0];
        let last = self.schedule.len() - 1;
        let t = ((share * self.schedule.len() as f64) as usize).min(last);
        self.sampled(batch, t)
    }

    /// x0 + √((1 − ᾱ)/ᾱ) ε: x_t as a sampler that stopped at t would take it for clean.
    fn noised(&self, batch: &Batch) -> Vec<f32> {
        let frame = batch.n_frames * MOTION_DIM;
        let mut latents = batch.motion.clone();
        let windows = latents.chunks_exact_mut(frame).zip(batch.noise.chunks_exact(frame));
        for ((latents, noise), chance) in windows.zip(&batch.chances) {
            let share = self.config.noised_to * chance.step;
            let t = ((share * self.schedule.len() as f64) as usize).min(self.schedule.len() - 1);
            let level = self.schedule.level(Some(t));
            let factor = (level.noise / level.signal) as f32;
            for (x, z) in latents.iter_mut().zip(noise) {
                *x += factor * z;
            }
        }
        latents
    }

    /// Noise up to step t, and some steps of DDIM back to clean.
    fn sampled(&self, batch: &Batch, t: usize) -> Result<Vec<f32>, TrainingError> {
        let (n, frames) = (batch.n_windows, batch.n_frames);
        let (x0, noise) =
            (motion_view(&batch.motion, n, frames), motion_view(&batch.noise, n, frames));
        let mut x = self.schedule.add_noise(x0, noise, &vec![t; n]);
        let n_steps = self.config.sampler_steps.clamp(1, t + 1);
        let condition = Condition::of(batch);
        for i in 0..n_steps {
            let at = t * (n_steps - i) / n_steps;
            let next = (i + 1 < n_steps).then(|| t * (n_steps - i - 1) / n_steps);
            let steps = vec![at; n];
            let prediction = self.denoiser.predict(x.view(), &steps, &condition)?;
            let (x0, epsilon) = self.schedule.estimate(prediction.view(), x.view(), &steps);
            let update = ddim_update(&self.schedule, at, next, 0.0);
            x = combine(update.x0, &x0, update.epsilon, &epsilon);
        }
        Ok(x.into_raw_vec_and_offset().0)
    }

    /// Returns how far the decoded latents are from the batch's motion.
    fn losses<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        batch: &Batch,
        latents: &[f32],
    ) -> Result<Reconstruction<crate::autodiff::Tensor<f32>>, TrainingError> {
        let latents = g.constant(&[batch.n_windows, batch.n_frames, MOTION_DIM], latents);
        let decoded = self.decoder.forward(g, &latents)?;
        let normalizer = self.windows.normalizer();
        Ok(reconstruction(g, normalizer, &decoded, &batch.motion, &batch.mask)?)
    }

    fn differentiate(&mut self, batch: &Batch, step: u64) -> Result<Losses, TrainingError> {
        let every = self.config.sampled_every;
        let is_sampled = every > 0 && step % every == every - 1;
        let latents = self.latents(batch, is_sampled, step)?;
        self.gradients.clear();
        let seed = tape_seed(self.seed, step);
        let mut tape = Tape::new(self.network.live(), &self.arena, Some(seed));
        let found = self.losses(&mut tape, batch, &latents)?;
        let losses = named(&found);
        tape.backward(found.all, &mut self.gradients)?;
        Ok(losses)
    }

    fn validation_losses(&self, parameters: &Parameters<f32>) -> Result<Losses, TrainingError> {
        let mut sum = Losses::default();
        let n = N_VALIDATION.div_ceil(self.config.batch_size.max(1));
        for i in 0..n {
            let first = i * self.config.batch_size;
            let batch = self.windows.validation(first..first + self.config.batch_size)?;
            // Half of them are the UNet's, from steps that are spread evenly.
            let share = self.config.sampled_from * (i as f64 + 0.5) / n as f64;
            let t = (share * self.schedule.len() as f64) as usize;
            let latents = if i % 2 == 0 { self.noised(&batch) } else { self.sampled(&batch, t)? };
            let mut g = Eager::new(parameters, &self.arena);
            let found = self.losses(&mut g, &batch, &latents)?;
            sum.add(&named(&found), 1.0 / n as f64);
        }
        Ok(sum)
    }
}

/// Fills parameters so that the heads begin with motion of the usual centre and spread.
///
/// A head that starts as any layer does speaks of accelerations of ± 50 m/s², twenty times what dancers
/// do, and spends its first thousand steps on that. Rows of its weight are multiplied by the spread of
/// their channel over its limit (tanh is linear near 0), biases become the centre.
fn near_the_data(
    list: ParameterList,
    normalizer: &Normalizer,
    limits: ChannelLimits,
    seed: u64,
) -> Parameters<f32> {
    let plain = Parameters::<f32>::new(list.clone(), seed);
    let ids: BTreeMap<String, _> =
        list.iter().map(|(id, parameter)| (parameter.name.clone(), id)).collect();
    Parameters::from_fn(list, |parameter| {
        let mut values = plain.unpacked(ids[&parameter.name]);
        let head = normalizer.layout().groups().find_map(|columns| {
            let rest = parameter.name.strip_prefix(columns.group.name)?.strip_prefix("_head.")?;
            Some((columns, rest == "bias"))
        });
        let Some((columns, is_bias)) = head else { return values };
        let limit = match columns.group.role {
            ColumnRole::Vector => limits.of(columns.group).1,
            ColumnRole::Place | ColumnRole::Free => 1.0,
            // Of unit norm and within 0 to 1 whatever the weights.
            ColumnRole::Turn | ColumnRole::Phase => return values,
        };
        let row = values.len() / columns.width();
        for (values, i) in values.chunks_exact_mut(row).zip(columns.range()) {
            for x in values {
                *x = if is_bias { normalizer.centre[i] } else { *x * normalizer.scale[i] } / limit;
            }
        }
        values
    })
}

fn named(found: &Reconstruction<crate::autodiff::Tensor<f32>>) -> Losses {
    let value = |x: &crate::autodiff::Tensor<f32>| f64::from(x.scalar());
    Losses {
        total: value(&found.all),
        parts: vec![
            ("reconstruction", value(&found.all)),
            ("decoder_position", value(&found.position)),
            ("decoder_quaternion", value(&found.quaternion)),
        ],
    }
}

/// a x + b y.
fn combine(a: f64, x: &Array3<f32>, b: f64, y: &Array3<f32>) -> Array3<f32> {
    let (a, b) = (a as f32, b as f32);
    ndarray::Zip::from(x).and(y).map_collect(|&x, &y| a * x + b * y)
}

impl Learner for DecoderLearner<'_> {
    const STAGE: &'static str = "decoder";

    fn step(
        &mut self,
        batch: &Batch,
        step: u64,
        n_steps: u64,
    ) -> Result<StepResult, TrainingError> {
        let threads = Arc::clone(&self.threads);
        let learning_rate = self.config.learning_rate.at(step, n_steps);
        threads.run(|| {
            let losses = self.differentiate(batch, step)?;
            let gradient_norm =
                self.network.step(&mut self.gradients, losses.total, learning_rate, step)?;
            Ok(StepResult { losses, gradient_norm, learning_rate, lr_decoder: None })
        })
    }

    fn rehearse(&mut self, batch: &Batch) -> Result<(), TrainingError> {
        // Steps are of two kinds; what counts is how long they take on average.
        let every = self.config.sampled_every.max(1);
        let threads = Arc::clone(&self.threads);
        for step in 0..every {
            threads.run(|| self.differentiate(batch, step))?;
        }
        Ok(())
    }

    fn steps_of_rehearsal(&self) -> u64 {
        self.config.sampled_every.max(1)
    }

    fn validate(&mut self) -> Result<Validation, TrainingError> {
        let threads = Arc::clone(&self.threads);
        let losses = threads.run(|| self.validation_losses(self.network.average()))?;
        let live = threads.run(|| self.validation_losses(self.network.live()))?.total;
        Ok(Validation { losses, live: Some(live), distance: None })
    }

    fn state(&self) -> Vec<&dyn CheckpointState> {
        vec![&self.network]
    }

    fn state_mut(&mut self) -> Vec<&mut dyn CheckpointState> {
        vec![&mut self.network]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Scope;
    use crate::motion::layout::tests::ROOT;

    #[test]
    fn the_root_alone_is_decoded_within_the_bounds_of_its_roles() {
        let config = DecoderConfig { input_dim: 5, hidden_dim: 8, ..DecoderConfig::default() };
        let mut list = ParameterList::default();
        let decoder = MotionDecoder::of_layout(&mut Scope::root(&mut list), &config, ROOT);
        let mut normalizer = Normalizer::identity_of(ROOT);
        normalizer.centre[1] = 0.9;
        normalizer.centre[4] = 5.0;
        normalizer.centre[12] = 1e3;
        let parameters = near_the_data(list, &normalizer, ChannelLimits::Wide, 7);
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        // Nothing but biases is left of a latent through weights of zeros.
        let still = Parameters::from_fn(parameters.list().clone(), |parameter| {
            let values = parameters.unpacked(parameters.list().by_name()[parameter.name.as_str()]);
            if parameter.name.ends_with("bias") { values } else { vec![0.0; values.len()] }
        });
        let latent = g.input(&[1, 3, 5], &[0.5; 15]);
        let mut of_biases = Eager::new(&still, &arena);
        for (g, exact) in [(&mut g, false), (&mut of_biases, true)] {
            let found = decoder.forward(g, &latent).expect("shapes fit");
            assert_eq!(found.shape(), [1, 3, 13]);
            for row in found.data().chunks_exact(13) {
                let norm = row[6..10].iter().map(|x| x * x).sum::<f32>().sqrt();
                assert!((norm - 1.0).abs() < 1e-5, "{norm}");
                assert!(row[3..6].iter().all(|x| x.abs() <= 50.0));
                assert!(row[10..].iter().all(|x| x.abs() <= 20.0));
                if exact {
                    // A bias of 5 / 50 within a tanh, and one that the limit holds.
                    assert_eq!(row[1], 0.9);
                    assert!((row[4] - 50.0 * 0.1_f32.tanh()).abs() < 1e-4, "{}", row[4]);
                    assert!((row[12] - 20.0).abs() < 1e-4, "{}", row[12]);
                }
            }
        }
    }
}
