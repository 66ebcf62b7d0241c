//! A batch as a planner sees it, and its loss.

use std::borrow::Cow;
use std::ops::Range;

use crate::autodiff::op::softmax::CrossEntropy;
use crate::autodiff::{Interpreter, Stream, Tensor};
use crate::diffusion::n_masked;
use crate::model::{Planner, PlannerConfig, PlannerInputs, PlannerKind, Result};
use crate::training::batch::Batch;
use crate::training::diffusion::without_clock;

use super::PlannerTraining;
use super::constraints::DrawnConstraints;
use crate::motion::Normalizer;

/// Share of the masked tokens that are not replaced which the network sees as \[MASK\]; it sees the others as they are
/// (MoMask, as BERT).
const HIDDEN: f64 = 0.88;
/// Numbers drawn for each token: its place in the order of masking, its fate, and the token in its place.
const N_DRAWN: usize = 3;

/// Share of the validation windows that go without constraints, as many as with: a planner is there for both.
const UNCONSTRAINED_VALIDATION: f64 = 0.5;

/// Probabilities of what chance does to the inputs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannerChances {
    pub replacement: f64,
    /// Of the tokens that are asked for, those that are seen as they are.
    pub shown: f64,
    pub audio: f64,
    pub clock: f64,
    pub style: f64,
    /// Of constraints, for a network that takes them.
    pub constraints: f64,
}

impl PlannerChances {
    /// Those of a validation: all that is asked for is hidden, and nothing withheld but constraints.
    pub const VALIDATION: Self = Self {
        replacement: 0.0,
        shown: 0.0,
        audio: 0.0,
        clock: 0.0,
        style: 0.0,
        constraints: UNCONSTRAINED_VALIDATION,
    };
}

impl From<&PlannerTraining> for PlannerChances {
    fn from(config: &PlannerTraining) -> Self {
        Self {
            replacement: config.replacement,
            shown: 1.0 - HIDDEN,
            audio: config.condition_dropout,
            clock: config.clock_dropout,
            style: config.style_dropout,
            constraints: config.constraint_dropout,
        }
    }
}

/// Inputs of a planner for a batch of B windows of N tokens, with what it is asked for.
pub struct PlannerBatch<'a> {
    batch: &'a Batch,
    audio: Cow<'a, [f32]>,
    drop_audio: Vec<f32>,
    style: Option<Vec<f32>>,
    constraints: Option<DrawnConstraints>,
    /// What the network sees, \[B, N\].
    seen: Vec<f32>,
    /// What it is asked for, \[B, N\].
    labels: Vec<f32>,
    /// Tokens whose first frame counts, \[B, N\].
    mask: Vec<f32>,
    /// 1 for tokens that are asked for, else 0, \[B, N\].
    weights: Vec<f32>,
    n_tokens: usize,
}

impl<'a> PlannerBatch<'a> {
    /// Masks and replaces tokens, \[B, N\], and withholds conditions, as the batch's chances and the seed say.
    ///
    /// Of the masked kind n_masked(u) of the tokens that count are asked for, u the chance of the window; they are
    /// replaced by any token, else seen as \[MASK\], a few as they are. Of the autoregressive kind all are asked for, and
    /// what comes before may be replaced.
    pub fn of(
        batch: &'a Batch,
        tokens: &[u32],
        (sizes, normalizer): (&PlannerConfig, &Normalizer),
        chances: PlannerChances,
        seed: u64,
    ) -> Self {
        let n_tokens = sizes.n_tokens(batch.n_frames);
        let labels: Vec<f32> = tokens.iter().map(|&token| token as f32).collect();
        let frames = batch.mask.chunks_exact(batch.n_frames.max(1));
        let mask: Vec<f32> =
            frames.flat_map(|mask| mask.iter().step_by(sizes.frames_per_token).copied()).collect();
        let (mut seen, mut weights) = (labels.clone(), vec![0.0; labels.len()]);
        let mut drawn = vec![0.0_f64; N_DRAWN * n_tokens];
        for (b, chance) in batch.chances.iter().enumerate() {
            Stream::new(seed, b as u64).uniform(0, &mut drawn);
            let (order, rest) = drawn.split_at(n_tokens);
            let (fates, others) = rest.split_at(n_tokens);
            let other = |n: usize| ((others[n] * sizes.codes as f64) as usize).min(sizes.codes - 1);
            let own = b * n_tokens..(b + 1) * n_tokens;
            let (seen, weights) = (&mut seen[own.clone()], &mut weights[own.clone()]);
            let mut counting: Vec<usize> =
                (0..n_tokens).filter(|&n| mask[own.start + n] > 0.0).collect();
            match sizes.kind {
                PlannerKind::Masked => {
                    counting.sort_by(|&a, &b| order[a].total_cmp(&order[b]));
                    counting.truncate(n_masked(counting.len(), chance.step));
                    for n in counting {
                        weights[n] = 1.0;
                        let is_shown =
                            fates[n] >= 1.0 - (1.0 - chances.replacement) * chances.shown;
                        if fates[n] < chances.replacement {
                            seen[n] = other(n) as f32;
                        } else if !is_shown {
                            seen[n] = sizes.mask_token() as f32;
                        }
                    }
                }
                PlannerKind::Autoregressive => {
                    for n in counting {
                        weights[n] = 1.0;
                        if fates[n] < chances.replacement {
                            seen[n] = other(n) as f32;
                        }
                    }
                }
            }
        }
        let dropped = |x: f64, probability: f64| x < probability;
        let style = (sizes.style_dim > 0).then(|| {
            let mut style = batch.style.clone();
            for (style, chance) in style.chunks_exact_mut(sizes.style_dim).zip(&batch.chances) {
                if dropped(chance.no_style, chances.style) {
                    // A style of zeros adds nothing but the layer's bias: none was asked for.
                    style.fill(0.0);
                }
            }
            style
        });
        let drop_audio = batch.chances.iter();
        let drop_audio =
            drop_audio.map(|c| f32::from(u8::from(dropped(c.no_audio, chances.audio))));
        Self {
            batch,
            audio: without_clock(batch, chances.clock),
            drop_audio: drop_audio.collect(),
            style,
            constraints: (sizes.constraint_dim > 0)
                .then(|| DrawnConstraints::new(batch, normalizer, chances.constraints, seed)),
            seen,
            labels,
            mask,
            weights,
            n_tokens,
        }
    }

    /// Returns how many tokens of some windows are asked for.
    pub fn weight(&self, windows: Range<usize>) -> f64 {
        let own = windows.start * self.n_tokens..windows.end * self.n_tokens;
        self.weights[own].iter().map(|&w| f64::from(w)).sum()
    }

    /// L = −⟨ln p(z_n)⟩ over the tokens that are asked for, of some windows.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn loss<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        planner: &Planner,
        windows: Range<usize>,
    ) -> Result<Tensor<f32>> {
        let (n, frames) = (windows.len(), self.batch.n_frames);
        let part = |values: &[f32]| -> Vec<f32> {
            let width = values.len() / self.batch.n_windows.max(1);
            values[windows.start * width..windows.end * width].to_vec()
        };
        let audio = part(&self.audio);
        let condition_dim = audio.len() / (n * frames).max(1);
        let audio = g.constant(&[n, frames, condition_dim], &audio);
        let [seen, labels, mask, weights] = [&self.seen, &self.labels, &self.mask, &self.weights]
            .map(|values| g.constant(&[n, self.n_tokens], &part(values)));
        let drop_audio = g.constant(&[n], &part(&self.drop_audio));
        let style = self.style.as_ref().map(|style| {
            let style = part(style);
            g.constant(&[n, style.len() / n.max(1)], &style)
        });
        let constraints = self.constraints.as_ref().map(|drawn| {
            let channels = part(&drawn.channels);
            let width = channels.len() / (n * frames).max(1);
            (g.constant(&[n, frames, width], &channels), g.constant(&[n], &part(&drawn.dropped)))
        });
        let inputs = PlannerInputs {
            tokens: &seen,
            audio: &audio,
            drop_audio: Some(&drop_audio),
            style: style.as_ref(),
            constraints: constraints.as_ref().map(|(channels, _)| channels),
            drop_constraints: constraints.as_ref().map(|(_, dropped)| dropped),
            mask: Some(&mask),
        };
        let logits = planner.forward(g, &inputs)?;
        g.apply(CrossEntropy::default(), &[&logits, &labels, &weights])
    }
}

#[cfg(test)]
mod tests;
