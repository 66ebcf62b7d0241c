//! Dancers of a group between the batch and the frames: folding, unfolding, repeating for each of them.

use super::binary::add_assign;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// The same numbers in the same order, in as many samples as the second input has.
///
/// # Shapes
/// x \[rows, frames, …\], like \[batch, …\] → \[batch, rows · frames / batch, …\]
#[derive(Default)]
pub struct Rebatch {
    from: Vec<usize>,
}

impl<E: Element> Operation<E> for Rebatch {
    fn name(&self) -> &'static str {
        "rebatch"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, like) = (x[0], x[1]);
        let (Some([rows, frames]), Some(&batch)) = (x.shape().first_chunk(), like.shape().first())
        else {
            let problem =
                format!("input has shape {:?}, expected [rows, frames, channels]", x.shape());
            return Err(GraphError::shape("rebatch", problem));
        };
        if batch == 0 || !(rows * frames).is_multiple_of(batch) {
            let problem =
                format!("{rows} × {frames} frames cannot be split into {batch} samples alike");
            return Err(GraphError::shape("rebatch", problem));
        }
        let mut shape = x.shape().to_vec();
        (shape[0], shape[1]) = (batch, rows * frames / batch);
        self.from = x.shape().to_vec();
        Ok(run.tensor(&shape, |y| y.copy_from_slice(x.data())))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![at.needs[0].then(|| dy.reshaped(&self.from)), None]
    }
}

/// Each sample as often, one after the other, as the second input has samples for it.
///
/// # Shapes
/// x \[batch, …\], like \[rows, …\] → \[rows, …\], rows a multiple of batch; the gradient of a sample is the sum over
/// its repetitions
#[derive(Default)]
pub struct RepeatBatch {
    batch: usize,
    times: usize,
}

impl<E: Element> Operation<E> for RepeatBatch {
    fn name(&self) -> &'static str {
        "repeat_batch"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, like) = (x[0], x[1]);
        let (Some(&batch), Some(&rows)) = (x.shape().first(), like.shape().first()) else {
            let problem = format!("input has shape {:?}, expected [batch, …]", x.shape());
            return Err(GraphError::shape("repeat_batch", problem));
        };
        if batch == 0 || !rows.is_multiple_of(batch) {
            let problem = format!("{batch} samples cannot be repeated to {rows}");
            return Err(GraphError::shape("repeat_batch", problem));
        }
        (self.batch, self.times) = (batch, rows / batch);
        let mut shape = x.shape().to_vec();
        shape[0] = rows;
        let sample = (x.len() / batch).max(1);
        Ok(run.tensor(&shape, |y| {
            for (i, y) in y.chunks_exact_mut(sample).enumerate() {
                y.copy_from_slice(&x.data()[i / self.times * sample..][..sample]);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let mut shape = dy.shape().to_vec();
        shape[0] = self.batch;
        let sample = shape.iter().skip(1).product::<usize>().max(1);
        let dx = at.needs[0].then(|| {
            at.tensor(&shape, |dx| {
                dx.fill(E::ZERO);
                for (i, dy) in dy.data().chunks_exact(sample).enumerate() {
                    add_assign(&mut dx[i / self.times * sample..][..sample], dy);
                }
            })
        });
        vec![dx, None]
    }
}

/// Samples by index: y\[i\] = x\[index\[i\]\]; the gradient of a sample is the sum over those that took it.
///
/// # Shapes
/// \[batch, …\] → \[index.len(), …\]
pub struct TakeSamples {
    index: Vec<usize>,
    shape: Vec<usize>,
}

impl TakeSamples {
    /// Returns the operation.
    pub fn new(index: Vec<usize>) -> Self {
        Self { index, shape: Vec::new() }
    }
}

impl<E: Element> Operation<E> for TakeSamples {
    fn name(&self) -> &'static str {
        "take_samples"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        let batch = x.shape().first().copied().unwrap_or(0);
        if let Some(i) = self.index.iter().find(|&&i| i >= batch) {
            let problem = format!("input has {batch} samples, number {i} is taken");
            return Err(GraphError::shape("take_samples", problem));
        }
        self.shape = x.shape().to_vec();
        let mut shape = self.shape.clone();
        shape[0] = self.index.len();
        let sample = (x.len() / batch.max(1)).max(1);
        Ok(run.tensor(&shape, |y| {
            for (y, &i) in y.chunks_exact_mut(sample).zip(&self.index) {
                y.copy_from_slice(&x.data()[i * sample..][..sample]);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let sample = self.shape.iter().skip(1).product::<usize>().max(1);
        at.only(|| {
            at.tensor(&self.shape, |dx| {
                dx.fill(E::ZERO);
                for (dy, &i) in dy.data().chunks_exact(sample).zip(&self.index) {
                    add_assign(&mut dx[i * sample..][..sample], dy);
                }
            })
        })
    }
}
