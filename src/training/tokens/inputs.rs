//! A batch as a tokenizer sees it, and its losses.

use crate::autodiff::op::loss::{Cost, Loss};
use crate::autodiff::{Interpreter, Tensor};
use crate::diffusion::Schedule;
use crate::model::{Graph, Tokenizer};
use crate::motion::{BODY, MOTION_DIM};
use crate::training::batch::Batch;
use crate::training::error::TrainingError;
use crate::training::learner::Losses;
use crate::training::sampling::motion_view;

use super::config::TokensTraining;

/// Where the smooth L1 turns from squared to linear, in spreads of a channel; PyTorch's, since the paper says nothing.
const BETA: f64 = 1.0;

/// Latents that count, and the tokens that stand for them.
#[derive(Clone, Debug, Default)]
pub struct Latents {
    /// \[M, d\]
    pub values: Vec<f32>,
    /// \[M\]
    pub tokens: Vec<usize>,
}

impl Latents {
    /// Adds those of a tensor, \[batch, N, d\], whose first frame counts.
    pub fn add(
        &mut self,
        latents: &Tensor<f32>,
        tokens: &Tensor<f32>,
        batch: &Batch,
        frames_per_token: usize,
    ) {
        let (n, d) = (tokens.shape()[1], latents.channels());
        for (i, (h, &token)) in latents.data().chunks_exact(d).zip(tokens.data()).enumerate() {
            let frame = i / n * batch.n_frames + i % n * frames_per_token;
            if batch.mask[frame] > 0.0 {
                self.values.extend(h);
                self.tokens.push(token as usize);
            }
        }
    }

    /// Returns them as numbers, to give them to other processes.
    pub fn numbers(&self) -> Vec<f64> {
        let tokens = self.tokens.iter().map(|&token| token as f64);
        tokens.chain(self.values.iter().map(|&h| f64::from(h))).collect()
    }

    /// Takes up what [`Latents::numbers`] gave, of latents of d numbers.
    pub fn of_numbers(numbers: &[f64], d: usize) -> Self {
        let (tokens, values) = numbers.split_at(numbers.len() / (1 + d));
        let tokens = tokens.iter().map(|&token| token as usize).collect();
        Self { values: values.iter().map(|&h| h as f32).collect(), tokens }
    }

    /// Adds those of another part of a batch.
    pub fn extend(&mut self, other: Self) {
        self.values.extend(other.values);
        self.tokens.extend(other.tokens);
    }
}

/// Smooth L1 of √w_c (x − x0) over frames that count.
fn of_motion<I: Interpreter<Element = f32>>(
    g: &mut I,
    x: &Tensor<f32>,
    x0: &Tensor<f32>,
    mask: &Tensor<f32>,
    training: &TokensTraining,
) -> Result<Tensor<f32>, TrainingError> {
    let [x, x0] = training.channels.scaled(g, BODY, [x, x0], f64::sqrt)?;
    Ok(g.apply(Loss::new(Cost::SmoothL1 { beta: BETA }), &[&x, &x0, mask])?)
}

/// Inputs of the networks for a batch of B windows of T frames, with its target.
pub struct TokensBatch<'a> {
    batch: &'a Batch,
    /// Step of each window, \[B\].
    t: Vec<f32>,
    /// \[B, T, 25\]
    x_t: Vec<f32>,
    frames_per_token: usize,
}

impl<'a> TokensBatch<'a> {
    /// Adds noise to a batch, as its chances say.
    pub fn of(batch: &'a Batch, schedule: &Schedule, frames_per_token: usize) -> Self {
        let (n, frames) = (batch.n_windows, batch.n_frames);
        let step = |u: f64| ((u * schedule.len() as f64) as usize).min(schedule.len() - 1);
        let t: Vec<usize> = batch.chances.iter().map(|chance| step(chance.step)).collect();
        let (x0, noise) =
            (motion_view(&batch.motion, n, frames), motion_view(&batch.noise, n, frames));
        let x_t = schedule.add_noise(x0, noise, &t).into_raw_vec_and_offset().0;
        let t = t.into_iter().map(|t| t as f32).collect();
        Self { batch, t, x_t, frames_per_token }
    }

    /// L = l(x̂0) + λ_d l(x̃) + λ ⟨(h − sg(q))²⟩ over frames, and tokens, that count.
    ///
    /// l is smooth L1 of √w_c (x̂0 − x0), w_c the weights of channels.
    ///
    /// Returns the loss, its parts, and the latents.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn loss<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        tokenizer: &Tokenizer,
        training: &TokensTraining,
    ) -> Result<(Tensor<f32>, Losses, Latents), TrainingError> {
        let Batch { n_windows: n, n_frames: frames, .. } = *self.batch;
        let motion = g.constant(&[n, frames, MOTION_DIM], &self.batch.motion);
        let x_t = g.constant(&[n, frames, MOTION_DIM], &self.x_t);
        let t = g.constant(&[n], &self.t);
        let mask = g.constant(&[n, frames], &self.batch.mask);

        let found = tokenizer.quantize(g, &motion)?;
        let q = g.straight_through(&found.latents, &found.codes)?;
        let s = tokenizer.signal(g, &q, &x_t)?;
        let x0 = tokenizer.denoise(g, &x_t, &t, &s)?;
        let simple = of_motion(g, &x0, &motion, &mask, training)?;
        let draft = tokenizer.draft(g, &s)?;
        let draft =
            draft.map(|draft| of_motion(g, &draft, &motion, &mask, training)).transpose()?;

        // A constant: codes are drawn to latents by averages, and latents to codes by this.
        let codes = g.constant(found.codes.shape(), found.codes.data());
        let counts = g.stride_mask(&mask, self.frames_per_token)?;
        let of_latents = [&found.latents, &codes, &counts];
        let commitment = g.apply(Loss::new(Cost::Squared), &of_latents)?;

        let mut losses = Losses { total: 0.0, parts: Vec::new() };
        losses.parts.push(("diffusion", simple.scalar().into()));
        losses.parts.push(("commitment", commitment.scalar().into()));
        let commitment = g.scale(&commitment, training.commitment)?;
        let mut loss = g.add(&simple, &commitment)?;
        if let Some(draft) = draft {
            losses.parts.push(("reconstruction", draft.scalar().into()));
            let draft = g.scale(&draft, training.draft)?;
            loss = g.add(&loss, &draft)?;
        }
        losses.total = loss.scalar().into();
        let mut latents = Latents::default();
        latents.add(&found.latents, &found.tokens, self.batch, self.frames_per_token);
        Ok((loss, losses, latents))
    }
}
