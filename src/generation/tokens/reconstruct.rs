//! Motion that is written as tokens and made again.

use ndarray::{Array2, ArrayView2, Axis, concatenate};

use super::engine::TokenEngine;
use crate::diffusion::{SamplerConfig, Schedule};
use crate::generation::engine::EngineError;
use crate::motion::{MOTION_DIM, Placement};

/// What makes motion of tokens.
#[derive(Clone, Copy, Debug)]
pub enum Decoding<'a> {
    /// The diffusion decoder.
    Diffusion { sampler: &'a SamplerConfig, schedule: &'a Schedule },
    /// The draft alone: one linear layer behind the convolutional decoder.
    Draft,
}

/// A motion that was written as tokens and made again, where it was danced.
#[derive(Clone, Debug, PartialEq)]
pub struct Reconstruction {
    /// One for every ρ frames of each window.
    pub tokens: Vec<u32>,
    /// \[T, 25\]
    pub motion: Array2<f32>,
}

impl TokenEngine {
    /// Writes motion, `[T, 25]`, as tokens, and makes it of them again, window by window, each where it was.
    ///
    /// `change` may put other tokens in the place of those of a window. Same motion and seed, same reconstruction.
    ///
    /// # Errors
    /// A token that the codebook does not have, a draft of a network that makes none, and what the sampler refuses.
    pub fn reconstruct(
        &self,
        motion: ArrayView2<f32>,
        decoding: Decoding,
        seed: u64,
        change: impl Fn(&mut [u32]),
    ) -> Result<Reconstruction, EngineError> {
        let windows = self.windows(motion);
        let mut tokens = self.tokens(&windows)?;
        let n_frames: Vec<usize> = windows.iter().map(Array2::nrows).collect();
        let mut first = 0;
        for n in &n_frames {
            let n_tokens = self.sizes().n_tokens(*n);
            change(&mut tokens[first..first + n_tokens]);
            first += n_tokens;
        }
        let mut made = match decoding {
            Decoding::Diffusion { sampler, schedule } => {
                self.motion(&tokens, &n_frames, (sampler, schedule), seed)?
            }
            Decoding::Draft => self.draft(&tokens, &n_frames)?,
        };
        let places = motion.axis_chunks_iter(Axis(0), self.window_frames());
        for (window, was) in made.iter_mut().zip(places) {
            if let Some(placement) = Placement::of_first(was) {
                placement.restore(window);
            }
        }
        let views: Vec<_> = made.iter().map(|window| window.view()).collect();
        let motion =
            concatenate(Axis(0), &views).unwrap_or_else(|_| Array2::zeros((0, MOTION_DIM)));
        Ok(Reconstruction { tokens, motion })
    }
}
