//! Products of two tensors, matrix by matrix.

use rayon::prelude::*;

use crate::autodiff::element::Element;
use crate::autodiff::kernel::{Matrix, MatrixMut, matmul};
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::Result;

/// A B for each sample. \[batch, m, k\], \[batch, k, n\] → \[batch, m, n\]
pub struct BatchProduct<E: Element> {
    kept: Option<[Tensor<E>; 2]>,
}

impl<E: Element> Default for BatchProduct<E> {
    fn default() -> Self {
        Self { kept: None }
    }
}

/// Computes C = A B, sample by sample; `ta` and `tb` say that A or B is given transposed.
fn product<E: Element>(
    [m, k, n]: [usize; 3],
    (a, ta): (&[E], bool),
    (b, tb): (&[E], bool),
    c: &mut [E],
) {
    let samples = c.par_chunks_mut((m * n).max(1)).enumerate();
    samples.for_each_init(Vec::new, |scratch, (i, c)| {
        let (a, b) = (&a[i * m * k..][..m * k], &b[i * k * n..][..k * n]);
        let a = if ta {
            Matrix { data: a, strides: [1, m] }
        } else {
            Matrix { data: a, strides: [k, 1] }
        };
        let b = if tb {
            Matrix { data: b, strides: [1, k] }
        } else {
            Matrix { data: b, strides: [n, 1] }
        };
        let c = MatrixMut { data: c, row_stride: n };
        matmul([m, k, n], E::ONE, a, b, c, false, scratch);
    });
}

impl<E: Element> Operation<E> for BatchProduct<E> {
    fn name(&self) -> &'static str {
        "matmul"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [a, b] = [x[0], x[1]];
        expect_axes("matmul", "first input", a, 3, "[batch, m, k]")?;
        expect_axes("matmul", "second input", b, 3, "[batch, k, n]")?;
        expect_size("matmul", "second input", "samples", b.shape()[0], "first", a.shape()[0])?;
        expect_size("matmul", "second input", "rows", b.shape()[1], "first", a.shape()[2])?;
        let [batch, m, k] = [0, 1, 2].map(|i| a.shape()[i]);
        let n = b.shape()[2];
        if run.recording {
            self.kept = Some([a.clone(), b.clone()]);
        }
        Ok(run.tensor(&[batch, m, n], |c| {
            product([m, k, n], (a.data(), false), (b.data(), false), c)
        }))
    }

    /// dA = dC Bᵀ, dB = Aᵀ dC.
    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let [a, b] = self.kept.take().expect("kept by the forward");
        let [_, m, k] = [0, 1, 2].map(|i| a.shape()[i]);
        let n = b.shape()[2];
        let dy = dy.data();
        vec![
            at.needs[0].then(|| {
                at.tensor(a.shape(), |d| product([m, n, k], (dy, false), (b.data(), true), d))
            }),
            at.needs[1].then(|| {
                at.tensor(b.shape(), |d| product([k, m, n], (a.data(), true), (dy, false), d))
            }),
        ]
    }
}
