//! Sums and means over an axis or everything.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Over what is summed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Over {
    /// Every number; the result is a scalar.
    All,
    /// One axis, which is left with size 1.
    Axis(usize),
}

/// Σ x, or Σ x / n. Sums run in f64, in order.
pub struct Reduce {
    over: Over,
    mean: bool,
    shape: Vec<usize>,
}

impl Reduce {
    /// Returns the sum.
    pub fn sum(over: Over) -> Self {
        Self { over, mean: false, shape: Vec::new() }
    }

    /// Returns the mean.
    pub fn mean(over: Over) -> Self {
        Self { over, mean: true, shape: Vec::new() }
    }

    /// Returns the sizes before the axis, of it, and after it.
    fn sizes(&self) -> [usize; 3] {
        match self.over {
            Over::All => [1, self.shape.iter().product(), 1],
            Over::Axis(axis) => {
                let after = self.shape[axis + 1..].iter().product();
                [self.shape[..axis].iter().product(), self.shape[axis], after]
            }
        }
    }
}

impl<E: Element> Operation<E> for Reduce {
    fn name(&self) -> &'static str {
        if self.mean { "mean" } else { "sum" }
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        self.shape = x.shape().to_vec();
        let mut shape = Vec::new();
        if let Over::Axis(axis) = self.over {
            shape.clone_from(&self.shape);
            let Some(size) = shape.get_mut(axis) else {
                let problem = format!("input has shape {:?}, axis {axis} asked for", self.shape);
                return Err(GraphError::shape(Operation::<E>::name(self), problem));
            };
            *size = 1;
        }
        let [_, n, after] = self.sizes();
        let factor = if self.mean { 1.0 / n as f64 } else { 1.0 };
        Ok(run.tensor(&shape, |y| {
            for (i, y) in y.iter_mut().enumerate() {
                let first = i / after * n * after + i % after;
                let sum: f64 = (0..n).map(|k| x.data()[first + k * after].to_f64()).sum();
                *y = E::from_f64(sum * factor);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let [_, n, after] = self.sizes();
        let factor = E::from_f64(if self.mean { 1.0 / n as f64 } else { 1.0 });
        at.only(|| {
            at.tensor(&self.shape, |dx| {
                for (i, dx) in dx.iter_mut().enumerate() {
                    *dx = factor * dy.data()[i / (n * after) * after + i % after];
                }
            })
        })
    }
}
