//! One vector in place of a whole sample.

use super::binary::add_assign;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::Result;

/// y\[b, t\] = x\[b, t\] where choice\[b\] is 0, else `other`.
///
/// # Shapes
/// inputs: choice \[batch\], other \[channels\], x \[batch, frames, channels\] → as x
#[derive(Default)]
pub struct Select {
    chosen: Vec<bool>,
}

impl<E: Element> Operation<E> for Select {
    fn name(&self) -> &'static str {
        "select"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [choice, other, x] = [x[0], x[1], x[2]];
        expect_axes("select", "input", x, 3, "[batch, frames, channels]")?;
        expect_size("select", "choice", "samples", choice.len(), "input", x.shape()[0])?;
        expect_size("select", "other", "channels", other.len(), "input", x.channels())?;
        self.chosen = choice.data().iter().map(|&c| c > E::ZERO).collect();
        let sample = (x.shape()[1] * x.channels()).max(1);
        Ok(run.tensor(x.shape(), |y| {
            let samples = y.chunks_exact_mut(sample).zip(x.data().chunks_exact(sample));
            for ((y, x), &chosen) in samples.zip(&self.chosen) {
                if chosen {
                    y.chunks_exact_mut(other.len()).for_each(|y| y.copy_from_slice(other.data()));
                } else {
                    y.copy_from_slice(x);
                }
            }
        }))
    }

    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let channels = dy.channels();
        let sample = (dy.shape()[1] * channels).max(1);
        let d_other = at.needs[1].then(|| {
            at.tensor(&[channels], |d| {
                d.fill(E::ZERO);
                for (dy, &chosen) in dy.data().chunks_exact(sample).zip(&self.chosen) {
                    if chosen {
                        dy.chunks_exact(channels).for_each(|row| add_assign(d, row));
                    }
                }
            })
        });
        let dx = at.needs[2].then(|| {
            let samples = dy.data_mut().chunks_exact_mut(sample).zip(&self.chosen);
            for (dy, _) in samples.filter(|(_, chosen)| **chosen) {
                dy.fill(E::ZERO);
            }
            dy
        });
        vec![None, d_other, dx]
    }
}
