//! Tokens beside frames: frames of several tensors one after the other, and the mask of both.

use rayon::prelude::*;

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Frames of several tensors one after the other; a vector is one frame.
///
/// # Shapes
/// \[batch, a, channels\] or \[batch, channels\], … → \[batch, a + b + …, channels\]
#[derive(Default)]
pub struct ConcatFrames {
    shapes: Vec<Vec<usize>>,
}

/// Returns \[batch, frames, channels\] of a tensor or of a vector for each sample.
fn axes_of(shape: &[usize]) -> Result<[usize; 3]> {
    match *shape {
        [batch, frames, channels] => Ok([batch, frames, channels]),
        [batch, channels] => Ok([batch, 1, channels]),
        _ => {
            let problem = format!("input has shape {shape:?}, expected [batch, frames, channels]");
            Err(GraphError::shape("concat_frames", problem))
        }
    }
}

impl<E: Element> Operation<E> for ConcatFrames {
    fn name(&self) -> &'static str {
        "concat_frames"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let Some(first) = x.first() else {
            return Err(GraphError::shape("concat_frames", "there is nothing to join"));
        };
        let [batch, _, channels] = axes_of(first.shape())?;
        let mut frames = 0;
        for x in x {
            let [b, t, c] = axes_of(x.shape())?;
            if (b, c) != (batch, channels) {
                let problem = format!(
                    "shapes {:?} and {:?} differ in batch or channels",
                    first.shape(),
                    x.shape()
                );
                return Err(GraphError::shape("concat_frames", problem));
            }
            frames += t;
        }
        self.shapes = x.iter().map(|x| x.shape().to_vec()).collect();
        Ok(run.tensor(&[batch, frames, channels], |y| {
            y.par_chunks_exact_mut((frames * channels).max(1)).enumerate().for_each(|(b, y)| {
                let mut rest = y;
                for x in x {
                    let n = x.len() / batch;
                    let (part, behind) = std::mem::take(&mut rest).split_at_mut(n);
                    part.copy_from_slice(&x.data()[b * n..][..n]);
                    rest = behind;
                }
            });
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let batch = dy.shape()[0];
        let sample = dy.len() / batch.max(1);
        let mut first = 0;
        let mut found = Vec::with_capacity(self.shapes.len());
        for (shape, &needed) in self.shapes.iter().zip(at.needs) {
            let n = shape.iter().skip(1).product::<usize>();
            found.push(needed.then(|| {
                at.tensor(shape, |dx| {
                    dx.par_chunks_exact_mut(n.max(1)).enumerate().for_each(|(b, dx)| {
                        dx.copy_from_slice(&dy.data()[b * sample + first..][..n]);
                    });
                })
            }));
            first += n;
        }
        found
    }
}

/// A mask of frames with tokens before them, all of which count: \[batch, frames\] → \[batch, n + frames\].
pub struct TokenMask {
    pub n: usize,
}

impl<E: Element> Operation<E> for TokenMask {
    fn name(&self) -> &'static str {
        "token_mask"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        expect_axes("token_mask", "mask", x[0], 2, "[batch, frames]")?;
        let (batch, frames) = (x[0].shape()[0], x[0].shape()[1]);
        let width = self.n + frames;
        Ok(run.tensor(&[batch, width], |y| {
            for (b, y) in y.chunks_exact_mut(width.max(1)).enumerate() {
                let (tokens, rest) = y.split_at_mut(self.n);
                tokens.fill(E::ONE);
                rest.copy_from_slice(&x[0].data()[b * frames..][..frames]);
            }
        }))
    }

    fn backward(&mut self, _: Tensor<E>, _: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![None]
    }
}
