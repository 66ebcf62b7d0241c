//! The engine of a model of a group: our own interpreter, and our tape where sampling is guided by the score.

use std::num::NonZeroUsize;

use ndarray::{Array2, Array3, ArrayView3};
use serde::{Deserialize, Serialize};

use crate::audio::FeatureScale;
use crate::autodiff::op::reduce::{Over, Reduce};
use crate::autodiff::{Eager, Gradients, Interpreter, Parameters, Tape, Tensor};
use crate::diffusion::Schedule;
use crate::generation::engine::EngineError;
use crate::generation::interpreter::{EAGER, EagerWorkers, to_array};
use crate::model::{
    Graph, GroupConfig, GroupInputs, GroupNetworks, GroupScoreInputs, GroupScores,
    Result as GraphResult, condition_scale,
};

/// Runs a model of a group by the interpreter that trains it.
pub struct GroupEngine {
    config: GroupConfig,
    networks: GroupNetworks,
    parameters: Parameters<f32>,
    /// Of the condition.
    scale: FeatureScale,
    workers: EagerWorkers,
}

/// What estimates the clean motion of groups.
pub trait GroupEstimator: Sync {
    /// Returns the name that flags and tables use.
    fn name(&self) -> &'static str;

    /// Returns the length of the noise of the group embedding.
    fn embedding_dim(&self) -> usize;

    /// Estimates clean motion, normalised: \[B N, T, 25\], moved along the gradient of the score where consistency is not 0.
    ///
    /// # Errors
    /// Shapes that do not fit.
    fn predict(&self, inputs: &GroupEngineInputs) -> Result<Array3<f32>, EngineError>;
}

/// The inputs of an estimate of B groups of N dancers.
#[derive(Clone, Copy, Debug)]
pub struct GroupEngineInputs<'a> {
    /// Noisy motion, normalised, \[B N, T, 25\].
    pub x: ArrayView3<'a, f32>,
    /// Step of all groups.
    pub t: usize,
    /// Features as the table has them, then the clock of a network that hears it, \[B, T, condition_dim\].
    pub audio: ArrayView3<'a, f32>,
    pub n_dancers: usize,
    /// Noise of the group embedding, one for all groups, \[d\].
    pub z: &'a [f32],
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// What is moved along ∇ log f, and the factor of the gradient, [`ConsistencyForm::factor`]; 0 for none.
    pub consistency: (ConsistencyForm, f64),
}

/// What is moved along the gradient of log f, the score of the estimate x̂0 of a step.
///
/// The paper moves the mean of the posterior: μ̂ = μ + γ Σ ∇_{x_t} log f (section 4.4), Σ = β̃_t. As a guidance of the
/// estimate, which every sampler can use, each form is x̂0' = x̂0 + γ k_t ∇ log f.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ConsistencyForm {
    /// x̂0' = x̂0 + γ s √(1−ᾱ_t) ∇/rms(∇), ∇ by x̂0 and its root mean square over the numbers of a group.
    ///
    /// A step of γ s standard deviations of what the noise leaves open, uphill. The length of a score's gradient
    /// is nothing that its training fixes: a model of 300 steps moved nothing by the form `Estimate` at s = 300, and
    /// far at 10,000 (docs/groups.md). Yang et al., "Guidance with Spherical Gaussian Constraint for Conditional
    /// Diffusion", ICML 2024, fix the length likewise.
    #[default]
    Direction,
    /// ∇ is by x̂0, k_t = 1 − ᾱ_t.
    ///
    /// Guidance by f^γ asks for E[x0 | x_t, f^γ] = x̂0 + γ (1−ᾱ)/√ᾱ ∇_{x_t} log f. By the chain rule
    /// ∇_{x_t} log f(x̂0) = Jᵀ ∇_{x̂0} log f, and J = ∂x̂0/∂x_t = √ᾱ/(1−ᾱ) Cov[x0 | x_t] (Tweedie's second order), so
    /// the move is γ Cov[x0 | x_t] ∇_{x̂0} log f. Of normalised motion, whose prior is near N(0, I), the covariance is
    /// near (1−ᾱ) I. k_t is at most 1, and nothing goes back through the denoiser.
    Estimate,
    /// ∇ is by x_t, k_t = (1−ᾱ_t)/√ᾱ_t.
    ///
    /// The code base of the published code moves ε̂ (Dhariwal and Nichol, "Diffusion Models Beat GANs", NeurIPS 2021,
    /// algorithm 2): ε̂' = ε̂ − √(1−ᾱ) γ ∇ log f. Then x̂0' = (x_t − √(1−ᾱ) ε̂') / √ᾱ.
    Noise,
    /// ∇ is by x_t, k_t = (1−ᾱ_{t−1})/√ᾱ_{t−1}.
    ///
    /// The paper's: with μ = √ᾱ_{t−1} β_t/(1−ᾱ_t) x̂0 + … and β̃_t = β_t (1−ᾱ_{t−1})/(1−ᾱ_t).
    Mean,
}

impl ConsistencyForm {
    /// Returns γ k_t; k_t of [`ConsistencyForm::Direction`] is √(1−ᾱ_t).
    pub fn factor(self, schedule: &Schedule, t: usize, gamma: f64) -> f64 {
        let ratio = |t: Option<usize>| {
            let level = schedule.level(t);
            gamma * level.noise * level.noise / level.signal
        };
        match self {
            Self::Direction => gamma * schedule.level(Some(t)).noise,
            Self::Estimate => gamma * schedule.level(Some(t)).noise.powi(2),
            Self::Noise => ratio(Some(t)),
            Self::Mean => ratio(t.checked_sub(1)),
        }
    }
}

impl ConsistencyForm {
    /// Returns whether the gradient is by x_t, through the denoiser.
    fn is_by_noisy_motion(self) -> bool {
        matches!(self, Self::Noise | Self::Mean)
    }

    /// Returns by what the gradient of a group is multiplied before anything else: 1/rms for its direction.
    fn scale(self, gradient: &[f32]) -> f64 {
        let square = |g: &f32| f64::from(*g).powi(2);
        let rms = (gradient.iter().map(square).sum::<f64>() / gradient.len() as f64).sqrt();
        match self {
            Self::Direction if rms > 0.0 => rms.recip(),
            _ => 1.0,
        }
    }
}

impl GroupEngine {
    /// Makes an engine of so many workers of so many threads each; `parameters` are those of [`GroupNetworks`],
    /// `scale` is that of the features.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        config: &GroupConfig,
        parameters: Parameters<f32>,
        scale: &FeatureScale,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        Ok(Self {
            config: config.clone(),
            networks: GroupNetworks::new(config).0,
            parameters,
            scale: condition_scale(config.condition(), scale),
            workers: EagerWorkers::start(workers)?,
        })
    }

    /// Returns how many calls run at once.
    pub fn n_workers(&self) -> usize {
        self.workers.n_workers()
    }

    /// Returns the sizes of the networks.
    pub fn config(&self) -> &GroupConfig {
        &self.config
    }

    fn moved_estimate(&self, inputs: &GroupEngineInputs) -> Result<Array3<f32>, EngineError> {
        let (groups, frames, dim) = inputs.audio.dim();
        let expected = [groups * inputs.n_dancers, frames, self.config.motion_dim];
        for (what, found, expected) in [
            ("the shape of the noisy motion", inputs.x.shape(), &expected[..]),
            ("the numbers of a frame of music", &[dim][..], &[self.scale.centre.len()][..]),
            ("the noise of the group", &[inputs.z.len()][..], &[self.config.width][..]),
        ] {
            if found != expected {
                let (found, expected) = (found.to_vec(), expected.to_vec());
                return Err(EngineError::Shape { what, found, expected });
            }
        }
        let audio = self.scaled(inputs.audio);
        let x = inputs.x.as_standard_layout();
        self.workers.run(|arena| {
            let given = ForwardInputs { inputs, audio: &audio, x: x.as_slice().expect("in order") };
            let (form, factor) = inputs.consistency;
            let follows_noise = factor != 0.0 && form.is_by_noisy_motion();
            let mut tape = Tape::new(&self.parameters, arena, None);
            let (x0, w, by) = if follows_noise {
                let x = tape.input(inputs.x.shape(), given.x);
                let (x0, w) = self.estimate(&mut tape, &given, &x)?;
                (x0, w, x)
            } else {
                let mut g = Eager::new(&self.parameters, arena);
                let x = g.constant(inputs.x.shape(), given.x);
                let (x0, w) = self.estimate(&mut g, &given, &x)?;
                if factor == 0.0 {
                    return Ok(to_array(&x0));
                }
                let x0 = tape.input(x0.shape(), x0.data());
                (x0.clone(), tape.constant(w.shape(), w.data()), x0)
            };
            let guide = self.consistency(&mut tape, &given, &x0, &w)?;
            let mut moved = to_array(&x0);
            drop((x0, w));
            let mut unused = Gradients::new(&self.parameters);
            let found = tape.backward(guide, &mut unused)?;
            if let Some(gradient) = found.of(&by) {
                let size = (moved.len() / groups).max(1);
                let moved = moved.as_slice_mut().expect("an array made in order");
                let of_groups = moved.chunks_exact_mut(size);
                for (moved, gradient) in of_groups.zip(gradient.data().chunks_exact(size)) {
                    let factor = (factor * form.scale(gradient)) as f32;
                    moved.iter_mut().zip(gradient).for_each(|(x, &g)| *x += factor * g);
                }
            }
            Ok(moved)
        })
    }

    /// Returns music as the networks hear it, in units of its spread, \[groups, T, condition_dim\].
    fn scaled(&self, audio: ArrayView3<f32>) -> Array3<f32> {
        let (groups, frames, dim) = audio.dim();
        let mut audio = audio.as_standard_layout().into_owned();
        let rows = audio.view_mut().into_shape_with_order((groups * frames, dim));
        self.scale.apply(rows.expect("in order"));
        audio
    }

    /// Returns the scores of each group of clean motion at a step, for motion of one number of dancers.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn score(&self, inputs: &GroupEngineInputs) -> Result<Vec<GroupScores<f32>>, EngineError> {
        let audio = self.scaled(inputs.audio);
        let x = inputs.x.as_standard_layout();
        self.workers.run(|arena| {
            let given = ForwardInputs { inputs, audio: &audio, x: x.as_slice().expect("in order") };
            let mut g = Eager::new(&self.parameters, arena);
            let x = g.constant(inputs.x.shape(), given.x);
            let (_, w) = self.estimate(&mut g, &given, &x)?;
            let GroupScores { log_ratio, agreement } = self.scores(&mut g, &given, &x, &w)?;
            let both = log_ratio.data().iter().zip(agreement.data());
            Ok(both.map(|(&log_ratio, &agreement)| GroupScores { log_ratio, agreement }).collect())
        })
    }

    /// Returns the guided estimate and the group embedding.
    fn estimate<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        given: &ForwardInputs,
        x: &Tensor<f32>,
    ) -> GraphResult<(Tensor<f32>, Tensor<f32>)> {
        let ForwardInputs { inputs, audio, .. } = given;
        let groups = audio.dim().0;
        let t = g.constant(&[groups], &vec![inputs.t as f32; groups]);
        let audio = g.constant(audio.shape(), audio.as_slice().expect("in order"));
        let number = given.number(g, &self.config);
        let z: Array2<f32> = Array2::from_shape_fn((groups, inputs.z.len()), |(_, i)| inputs.z[i]);
        let z = g.constant(z.shape(), z.as_slice().expect("in order"));
        let mut forward = |drop: f32| {
            let drop_audio = g.constant(&[groups], &vec![drop; groups]);
            let inputs = GroupInputs {
                x,
                t: &t,
                audio: &audio,
                drop_audio: Some(&drop_audio),
                number: &number,
                z: &z,
                mask: None,
            };
            self.networks.denoiser.forward(g, &inputs)
        };
        let s = inputs.guidance;
        if s == 0.0 || s == 1.0 {
            let found = forward(if s == 0.0 { 1.0 } else { 0.0 })?;
            return Ok((found.x0, found.w));
        }
        let (with, without) = (forward(0.0)?, forward(1.0)?);
        let (with_x0, without_x0) = (g.scale(&with.x0, s)?, g.scale(&without.x0, 1.0 - s)?);
        Ok((g.add(&with_x0, &without_x0)?, with.w))
    }

    /// Returns Σ of what consistency moves along over all groups, a scalar: of groups the agreement of their dancers, of a
    /// soloist, who has nobody to agree with, log f.
    fn consistency<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        given: &ForwardInputs,
        x0: &Tensor<f32>,
        w: &Tensor<f32>,
    ) -> GraphResult<Tensor<f32>> {
        let GroupScores { log_ratio, agreement } = self.scores(g, given, x0, w)?;
        let each = if given.inputs.n_dancers > 1 { agreement } else { log_ratio };
        g.apply(Reduce::sum(Over::All), &[&each])
    }

    fn scores<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        given: &ForwardInputs,
        x0: &Tensor<f32>,
        w: &Tensor<f32>,
    ) -> GraphResult<GroupScores<Tensor<f32>>> {
        let rows = x0.shape()[0];
        let t = g.constant(&[rows], &vec![given.inputs.t as f32; rows]);
        let number = given.number(g, &self.config);
        let inputs = GroupScoreInputs { x0, t: &t, w, number: &number, mask: None, there: None };
        self.networks.score.forward(g, &inputs)
    }
}

impl GroupEstimator for GroupEngine {
    fn name(&self) -> &'static str {
        EAGER
    }

    fn embedding_dim(&self) -> usize {
        self.config.width
    }

    fn predict(&self, inputs: &GroupEngineInputs) -> Result<Array3<f32>, EngineError> {
        self.moved_estimate(inputs)
    }
}

/// Inputs whose music is scaled.
struct ForwardInputs<'a, 'b> {
    inputs: &'a GroupEngineInputs<'b>,
    audio: &'a Array3<f32>,
    x: &'a [f32],
}

impl ForwardInputs<'_, '_> {
    fn number<I: Interpreter<Element = f32>>(&self, g: &I, config: &GroupConfig) -> Tensor<f32> {
        let groups = self.audio.dim().0;
        let row = config.embedded_number(self.inputs.n_dancers) as f32;
        g.constant(&[groups], &vec![row; groups])
    }
}

#[cfg(test)]
mod tests;
