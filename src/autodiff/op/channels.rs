//! Putting tensors side by side along the last axis, and taking some of its channels.

use std::ops::Range;

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Copies `width` channels of each row: from `from` on in the source to `to` on in the target.
fn copy_channels<E: Element>(
    source: (&[E], usize, usize),
    target: (&mut [E], usize, usize),
    width: usize,
) {
    let (source, n_source, from) = source;
    let (target, n_target, to) = target;
    for (s, t) in source.chunks_exact(n_source).zip(target.chunks_exact_mut(n_target)) {
        t[to..to + width].copy_from_slice(&s[from..from + width]);
    }
}

/// \[..., a\], \[..., b\], … → \[..., a + b + …\]
#[derive(Default)]
pub struct Concat {
    widths: Vec<usize>,
}

impl<E: Element> Operation<E> for Concat {
    fn name(&self) -> &'static str {
        "concat"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let Some((first, rest)) = x.split_first() else {
            return Err(GraphError::shape("concat", "there is nothing to put side by side"));
        };
        let leading = |x: &Tensor<E>| x.shape().split_last().map(|(_, leading)| leading.to_vec());
        for other in rest {
            if leading(other) != leading(first) || leading(first).is_none() {
                let problem = format!(
                    "shapes {:?} and {:?} differ before the last axis",
                    first.shape(),
                    other.shape()
                );
                return Err(GraphError::shape("concat", problem));
            }
        }
        self.widths = x.iter().map(|x| x.channels()).collect();
        let width: usize = self.widths.iter().sum();
        let mut shape = leading(first).unwrap_or_default();
        shape.push(width);
        Ok(run.tensor(&shape, |y| {
            let mut at = 0;
            for x in x {
                copy_channels((x.data(), x.channels(), 0), (y, width, at), x.channels());
                at += x.channels();
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let width = dy.channels();
        let mut first = 0;
        let mut found = Vec::with_capacity(self.widths.len());
        for (&own, &needed) in self.widths.iter().zip(at.needs) {
            let mut shape = dy.shape().to_vec();
            *shape.last_mut().expect("checked by the forward") = own;
            found.push(needed.then(|| {
                at.tensor(&shape, |dx| copy_channels((dy.data(), width, first), (dx, own, 0), own))
            }));
            first += own;
        }
        found
    }
}

/// \[..., channels\] → \[..., end − start\]
pub struct TakeChannels {
    range: Range<usize>,
    shape: Vec<usize>,
}

impl TakeChannels {
    /// Returns the operation.
    pub fn new(range: Range<usize>) -> Self {
        Self { range, shape: Vec::new() }
    }
}

impl<E: Element> Operation<E> for TakeChannels {
    fn name(&self) -> &'static str {
        "channels"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        if self.range.start > self.range.end
            || self.range.end > x.channels()
            || x.shape().is_empty()
        {
            let problem =
                format!("input has shape {:?}, channels {:?} asked for", x.shape(), self.range);
            return Err(GraphError::shape("channels", problem));
        }
        self.shape = x.shape().to_vec();
        let mut shape = self.shape.clone();
        let own = self.range.len();
        *shape.last_mut().expect("checked above") = own;
        Ok(run.tensor(&shape, |y| {
            copy_channels((x.data(), x.channels(), self.range.start), (y, own.max(1), 0), own);
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let own = self.range.len();
        let width = *self.shape.last().expect("checked by the forward");
        at.only(|| {
            at.tensor(&self.shape, |dx| {
                dx.fill(E::ZERO);
                let target = (dx, width, self.range.start);
                copy_channels((dy.data(), own.max(1), 0), target, own);
            })
        })
    }
}
