//! Rotary position embedding.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Turns channels 2i and 2i + 1 of each head by frame · 10000^(−2i / d), d the channels of a head.
///
/// Su et al., "RoFormer", arXiv 2104.09864, eq. 34. \[batch, frames, channels\] → the same; frames are counted from those
/// of a second input on, if there is one.
pub struct Rotary {
    heads: usize,
    /// Number of the first frame.
    first: usize,
}

impl Rotary {
    /// Returns the operation.
    pub fn new(heads: usize) -> Self {
        Self { heads, first: 0 }
    }

    /// Turns all pairs, backwards for the gradient: a rotation's transpose is its inverse.
    fn turn<E: Element>(&self, shape: &[usize], x: &[E], y: &mut [E], back: bool) {
        let (frames, channels) = (shape[1], shape[2]);
        let dim = channels / self.heads;
        let angles: Vec<_> = (0..frames * dim / 2)
            .map(|i| {
                let (frame, pair) = (i / (dim / 2), i % (dim / 2));
                let angle =
                    (self.first + frame) as f64 * 10_000_f64.powf(-2.0 * pair as f64 / dim as f64);
                let (sin, cos) = angle.sin_cos();
                [cos, if back { -sin } else { sin }].map(E::from_f64)
            })
            .collect();
        let rows = y.chunks_exact_mut(channels).zip(x.chunks_exact(channels));
        for (row, (y, x)) in rows.enumerate() {
            let angles = &angles[row % frames * (dim / 2)..][..dim / 2];
            for (y, x) in y.chunks_exact_mut(dim).zip(x.chunks_exact(dim)) {
                let pairs = y.chunks_exact_mut(2).zip(x.chunks_exact(2)).zip(angles);
                for ((y, x), &[cos, sin]) in pairs {
                    y[0] = x[0] * cos - x[1] * sin;
                    y[1] = x[0] * sin + x[1] * cos;
                }
            }
        }
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
        if self.heads == 0 || !x.channels().is_multiple_of(2 * self.heads) {
            let problem = format!(
                "{} channels cannot be split into pairs of {} heads",
                x.channels(),
                self.heads
            );
            return Err(GraphError::shape("rotary", problem));
        }
        Ok(run.tensor(x.shape(), |y| self.turn(x.shape(), x.data(), y, false)))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let mut found =
            at.only(|| at.tensor(dy.shape(), |dx| self.turn(dy.shape(), dy.data(), dx, true)));
        found.resize_with(at.needs.len(), || None);
        found
    }
}
