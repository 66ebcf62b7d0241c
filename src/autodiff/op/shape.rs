//! The same numbers under another shape, or with axes in another order.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// The same numbers in the same order under another shape.
pub struct Reshape {
    to: Vec<usize>,
    from: Vec<usize>,
}

impl Reshape {
    /// Returns the operation.
    pub fn new(to: &[usize]) -> Self {
        Self { to: to.to_vec(), from: Vec::new() }
    }
}

impl<E: Element> Operation<E> for Reshape {
    fn name(&self) -> &'static str {
        "reshape"
    }

    fn forward(&mut self, x: &[&Tensor<E>], _: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        if x.len() != self.to.iter().product::<usize>() {
            let problem = format!("{:?} and {:?} differ in length", x.shape(), self.to);
            return Err(GraphError::shape("reshape", problem));
        }
        self.from = x.shape().to_vec();
        Ok(x.clone().reshaped(&self.to))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        at.only(|| dy.reshaped(&self.from))
    }
}

/// Axes in another order: axis i of the result is axis `order[i]` of the input.
pub struct Transpose {
    order: Vec<usize>,
}

impl Transpose {
    /// Returns the operation.
    pub fn new(order: &[usize]) -> Self {
        Self { order: order.to_vec() }
    }
}

/// Copies a tensor with its axes in another order.
fn permute<E: Element>(
    x: &Tensor<E>,
    order: &[usize],
    new: impl FnOnce(&[usize], &dyn Fn(&mut [E])) -> Tensor<E>,
) -> Tensor<E> {
    let view = x.view().permuted_axes(order.to_vec());
    let shape = view.shape().to_vec();
    new(&shape, &|y: &mut [E]| {
        for (y, &x) in y.iter_mut().zip(&view) {
            *y = x;
        }
    })
}

impl<E: Element> Operation<E> for Transpose {
    fn name(&self) -> &'static str {
        "transpose"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let mut sorted = self.order.clone();
        sorted.sort_unstable();
        if sorted != (0..x[0].shape().len()).collect::<Vec<_>>() {
            let problem =
                format!("input has shape {:?}, axes {:?} asked for", x[0].shape(), self.order);
            return Err(GraphError::shape("transpose", problem));
        }
        Ok(permute(x[0], &self.order, |shape, fill| run.tensor(shape, fill)))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let mut inverse = vec![0; self.order.len()];
        for (i, &axis) in self.order.iter().enumerate() {
            inverse[axis] = i;
        }
        at.only(|| permute(&dy, &inverse, |shape, fill| at.tensor(shape, fill)))
    }
}
