//! Rotary position embedding.

use rayon::prelude::*;

use super::elementwise::{CHUNK, copy};
use crate::autodiff::element::Element;
use crate::autodiff::kernel::vectorized;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Turns channels 2i and 2i + 1 of each head by frame · 10000^(−2i / d), d the channels of a head.
///
/// Su et al., "RoFormer", arXiv 2104.09864, eq. 34. \[batch, frames, channels\] → the same; frames are counted from those
/// of a second input on, if there is one.
///
/// Where only the first channels are turned, the others are left.
pub struct Rotary {
    heads: usize,
    /// Channels that are turned; all where absent.
    turned: Option<usize>,
    /// Number of the first frame.
    first: usize,
}

/// Numbers that are turned side by side.
const LANES: usize = 16;

vectorized! {
    /// Turns the pairs of one head; cosines are there twice, sines with the sign of their half.
    fn turn_head<E: Element>(x: &mut [E], cos: &[E], sin: &[E]) {
        let whole = x.len() / LANES * LANES;
        let (run, rest) = x.split_at_mut(whole);
        let angles = cos.chunks_exact(LANES).zip(sin.chunks_exact(LANES));
        for (x, (cos, sin)) in run.chunks_exact_mut(LANES).zip(angles) {
            let old: [E; LANES] = std::array::from_fn(|i| x[i]);
            for (i, (x, (&cos, &sin))) in x.iter_mut().zip(cos.iter().zip(sin)).enumerate() {
                *x = old[i] * cos + old[i ^ 1] * sin;
            }
        }
        let angles = cos[whole..].chunks_exact(2).zip(sin[whole..].chunks_exact(2));
        for (x, (cos, sin)) in rest.chunks_exact_mut(2).zip(angles) {
            (x[0], x[1]) = (x[0] * cos[0] + x[1] * sin[0], x[1] * cos[1] + x[0] * sin[1]);
        }
    }
}

impl Rotary {
    /// Returns the operation.
    pub fn new(heads: usize) -> Self {
        Self { heads, turned: None, first: 0 }
    }

    /// Turns the first channels alone.
    pub fn of_first(heads: usize, turned: usize) -> Self {
        Self { turned: Some(turned), ..Self::new(heads) }
    }

    /// Turns all pairs, backwards for the gradient: a rotation's transpose is its inverse.
    fn turn<E: Element>(&self, shape: &[usize], x: &mut [E], back: bool) {
        let (frames, channels) = (shape[1], shape[2]);
        let turned = self.turned.unwrap_or(channels);
        let dim = turned / self.heads;
        let rates: Vec<_> =
            (0..dim / 2).map(|pair| 10_000_f64.powf(-2.0 * pair as f64 / dim as f64)).collect();
        let (mut cosines, mut sines) = (vec![E::ZERO; frames * dim], vec![E::ZERO; frames * dim]);
        let rows = cosines.par_chunks_exact_mut(dim).zip(sines.par_chunks_exact_mut(dim));
        rows.with_min_len(LANES).enumerate().for_each(|(frame, (cosines, sines))| {
            let pairs = cosines.chunks_exact_mut(2).zip(sines.chunks_exact_mut(2)).zip(&rates);
            for ((cosines, sines), rate) in pairs {
                let (sin, cos) = ((self.first + frame) as f64 * rate).sin_cos();
                let sin = if back { -sin } else { sin };
                cosines.fill(E::from_f64(cos));
                sines.copy_from_slice(&[-sin, sin].map(E::from_f64));
            }
        });
        let rows = (CHUNK / channels).max(1);
        x.par_chunks_mut(rows * channels).enumerate().for_each(|(i, chunk)| {
            for (row, x) in chunk.chunks_exact_mut(channels).enumerate() {
                let frame = (i * rows + row) % frames;
                let [cos, sin] = [&cosines, &sines].map(|angles| &angles[frame * dim..][..dim]);
                x[..turned].chunks_exact_mut(dim).for_each(|x| turn_head(x, cos, sin));
            }
        });
    }
}

impl<E: Element> Operation<E> for Rotary {
    fn name(&self) -> &'static str {
        "rotary"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, past) = (x[0], x.get(1));
        expect_axes("rotary", "input", x, 3, "[batch, frames, channels]")?;
        if let Some(past) = past {
            expect_axes("rotary", "the past", past, 3, "[batch, frames, channels]")?;
            self.first = past.shape()[1];
        }
        let turned = self.turned.unwrap_or(x.channels());
        if self.heads == 0 || !turned.is_multiple_of(2 * self.heads) {
            let problem =
                format!("{turned} channels cannot be split into pairs of {} heads", self.heads);
            return Err(GraphError::shape("rotary", problem));
        }
        if turned == 0 || turned > x.channels() {
            let problem = format!("input has {} channels, {turned} are turned", x.channels());
            return Err(GraphError::shape("rotary", problem));
        }
        Ok(run.tensor(x.shape(), |y| {
            copy(x.data(), y);
            self.turn(x.shape(), y, false);
        }))
    }

    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let mut found = at.only(|| {
            let shape = dy.shape().to_vec();
            self.turn(&shape, dy.data_mut(), true);
            dy
        });
        found.resize_with(at.needs.len(), || None);
        found
    }
}
