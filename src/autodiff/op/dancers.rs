//! Dancers of a group between the batch and the frames: folding, unfolding, repeating for each of them.

use rayon::prelude::*;

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

    fn forward(&mut self, x: &[&Tensor<E>], _: &Run<E>) -> Result<Tensor<E>> {
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
        Ok(x.clone().reshaped(&shape))
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

/// Σ_n m\[n\] x\[n\] / Σ m: the mean of each frame over the dancers of a group that are there; 0 where none is.
///
/// # Shapes
/// x \[batch · dancers, frames, channels\], like \[batch, …\], mask \[batch, dancers\] if any → \[batch, frames, channels\]
#[derive(Default)]
pub struct MeanDancers {
    from: Vec<usize>,
    /// Share of every dancer in the mean of its group, \[batch · dancers\].
    shares: Vec<f64>,
}

impl<E: Element> Operation<E> for MeanDancers {
    fn name(&self) -> &'static str {
        "mean_dancers"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, like, mask) = (x[0], x[1], x.get(2));
        let (&[rows, frames, channels], Some(&batch)) = (x.shape(), like.shape().first()) else {
            let problem =
                format!("input has shape {:?}, expected [rows, frames, channels]", x.shape());
            return Err(GraphError::shape("mean_dancers", problem));
        };
        if batch == 0 || !rows.is_multiple_of(batch) {
            let problem = format!("{rows} dancers cannot be split into {batch} groups alike");
            return Err(GraphError::shape("mean_dancers", problem));
        }
        let n_dancers = rows / batch;
        if let Some(mask) = mask
            && mask.shape() != [batch, n_dancers]
        {
            let problem = format!(
                "mask has shape {:?}, input expects {:?}",
                mask.shape(),
                [batch, n_dancers]
            );
            return Err(GraphError::shape("mean_dancers", problem));
        }
        let is_there = |row: usize| mask.map_or(1.0, |mask| mask.data()[row].to_f64());
        self.shares = (0..batch)
            .flat_map(|b| {
                let rows = b * n_dancers..(b + 1) * n_dancers;
                let sum: f64 = rows.clone().map(is_there).sum();
                rows.map(move |row| if sum > 0.0 { is_there(row) / sum } else { 0.0 })
            })
            .collect();
        self.from = x.shape().to_vec();
        let size = (frames * channels).max(1);
        Ok(run.tensor(&[batch, frames, channels], |y| {
            y.fill(E::ZERO);
            for (i, (x, &share)) in x.data().chunks_exact(size).zip(&self.shares).enumerate() {
                let share = E::from_f64(share);
                let y = &mut y[i / n_dancers * size..][..size];
                y.iter_mut().zip(x).for_each(|(y, &x)| *y += share * x);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let size = self.from.iter().skip(1).product::<usize>().max(1);
        let n_dancers = self.shares.len() / dy.shape()[0].max(1);
        let dx = at.needs[0].then(|| {
            at.tensor(&self.from, |dx| {
                for (i, (dx, &share)) in dx.chunks_exact_mut(size).zip(&self.shares).enumerate() {
                    let share = E::from_f64(share);
                    let dy = &dy.data()[i / n_dancers * size..][..size];
                    dx.iter_mut().zip(dy).for_each(|(dx, &dy)| *dx = share * dy);
                }
            })
        });
        let mut found = vec![dx];
        found.resize_with(at.needs.len(), || None);
        found
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
            y.par_chunks_exact_mut(sample).zip(&self.index).for_each(|(y, &i)| {
                y.copy_from_slice(&x.data()[i * sample..][..sample]);
            });
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
