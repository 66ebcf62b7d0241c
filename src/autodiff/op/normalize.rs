//! Rows of unit norm.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::Result;

/// y = x / max(‖x‖, ε) over the last axis, as PyTorch's `normalize`. \[..., channels\] → the same
pub struct Normalize<E: Element> {
    epsilon: f64,
    x: Option<Tensor<E>>,
}

impl<E: Element> Normalize<E> {
    /// Returns the operation.
    pub fn new(epsilon: f64) -> Self {
        Self { epsilon, x: None }
    }
}

fn norm<E: Element>(row: &[E]) -> E {
    row.iter().map(|&x| x * x).sum::<E>().sqrt()
}

impl<E: Element> Operation<E> for Normalize<E> {
    fn name(&self) -> &'static str {
        "normalize"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        let channels = x.channels().max(1);
        let epsilon = E::from_f64(self.epsilon);
        self.x = run.keep(x);
        Ok(run.tensor(x.shape(), |y| {
            for (y, x) in y.chunks_exact_mut(channels).zip(x.data().chunks_exact(channels)) {
                let n = norm(x);
                let n = if n < epsilon { epsilon } else { n };
                for (y, &x) in y.iter_mut().zip(x) {
                    *y = x / n;
                }
            }
        }))
    }

    /// dx = (dy − y (y · dy)) / ‖x‖; where ε takes the norm's place, dx = dy / ε.
    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let x = self.x.take().expect("kept by the forward");
        let channels = x.channels().max(1);
        let epsilon = E::from_f64(self.epsilon);
        at.only(|| {
            for (d, x) in
                dy.data_mut().chunks_exact_mut(channels).zip(x.data().chunks_exact(channels))
            {
                let n = norm(x);
                if n > epsilon {
                    let along = d.iter().zip(x).map(|(&d, &x)| d * x).sum::<E>() / (n * n);
                    d.iter_mut().zip(x).for_each(|(d, &x)| *d = (*d - x * along) / n);
                } else {
                    d.iter_mut().for_each(|d| *d /= epsilon);
                }
            }
            dy
        })
    }
}
