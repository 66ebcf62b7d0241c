//! Rows of a table by index: fixed tables, learned ones, and the nearest row of a codebook.

use std::sync::Arc;

use ndarray::Array2;

use super::binary::add_assign;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, ParameterId, Result};

/// Reads an index: a whole number below `rows`.
fn row_index<E: Element>(operation: &'static str, x: E, rows: usize) -> Result<usize> {
    let x = x.to_f64();
    if x >= 0.0 && x < rows as f64 && x.fract() == 0.0 {
        return Ok(x as usize);
    }
    let problem = format!("index {x} is not a whole number below {rows}, the rows of the table");
    Err(GraphError::shape(operation, problem))
}

fn indices<E: Element>(operation: &'static str, x: &Tensor<E>, rows: usize) -> Result<Vec<usize>> {
    x.data().iter().map(|&x| row_index(operation, x, rows)).collect()
}

/// Rows of a fixed table, kept in f64: \[...\] → \[..., columns\]. No gradient.
pub struct Gather(pub Arc<Array2<f64>>);

impl<E: Element> Operation<E> for Gather {
    fn name(&self) -> &'static str {
        "gather"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let index = indices("gather", x[0], self.0.nrows())?;
        let mut shape = x[0].shape().to_vec();
        shape.push(self.0.ncols());
        Ok(run.tensor(&shape, |y| {
            for (y, i) in y.chunks_exact_mut(self.0.ncols().max(1)).zip(index) {
                for (y, &x) in y.iter_mut().zip(self.0.row(i)) {
                    *y = E::from_f64(x);
                }
            }
        }))
    }

    fn backward(&mut self, _: Tensor<E>, _: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![None]
    }
}

/// Rows of a learned table, \[rows, channels\]: \[...\] → \[..., channels\].
pub struct Embed {
    table: ParameterId,
    index: Vec<usize>,
}

impl Embed {
    /// Returns the operation.
    pub fn new(table: ParameterId) -> Self {
        Self { table, index: Vec::new() }
    }
}

impl<E: Element> Operation<E> for Embed {
    fn name(&self) -> &'static str {
        "embedding"
    }

    fn parameter(&self) -> Option<ParameterId> {
        Some(self.table)
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let parameter = run.parameters.list().get(self.table);
        let &[rows, channels] = parameter.shape.as_slice() else {
            let problem = format!(
                "{} has shape {:?}, expected [rows, channels]",
                parameter.name, parameter.shape
            );
            return Err(GraphError::shape("embedding", problem));
        };
        self.index = indices("embedding", x[0], rows)?;
        let table = run.parameters.get(self.table);
        let mut shape = x[0].shape().to_vec();
        shape.push(channels);
        Ok(run.tensor(&shape, |y| {
            for (y, i) in y.chunks_exact_mut(channels.max(1)).zip(&self.index) {
                y.copy_from_slice(&table[i * channels..][..channels]);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let channels = dy.channels();
        let (target, add) = at.gradients.write(self.table);
        if !add {
            target.fill(E::ZERO);
        }
        for (dy, i) in dy.data().chunks_exact(channels).zip(&self.index) {
            add_assign(&mut target[i * channels..][..channels], dy);
        }
        vec![None]
    }
}

/// The nearest row of a codebook in place of each row: vector quantisation.
///
/// y = c_k, k = argmin ‖x − c_k‖², ties to the first. The gradient passes straight through to x
/// (van den Oord et al., "Neural Discrete Representation Learning", NIPS 2017, sec. 3.2); the codebook
/// itself is learned by averages, not by gradients.
///
/// # Shapes
/// x: \[..., channels\]; codebook: \[rows, channels\] → \[..., channels\]
pub struct Quantize;

/// Returns the nearest row of the codebook for each row.
pub fn nearest_rows<E: Element>(x: &Tensor<E>, codebook: &Tensor<E>) -> Vec<usize> {
    let channels = codebook.channels().max(1);
    let distance = |a: &[E], b: &[E]| a.iter().zip(b).map(|(&a, &b)| (a - b) * (a - b)).sum::<E>();
    let nearest = |row: &[E]| {
        let mut best = (0, None);
        for (k, code) in codebook.data().chunks_exact(channels).enumerate() {
            let d = distance(row, code);
            if best.1.is_none_or(|least| d < least) {
                best = (k, Some(d));
            }
        }
        best.0
    };
    x.data().chunks_exact(channels).map(nearest).collect()
}

impl<E: Element> Operation<E> for Quantize {
    fn name(&self) -> &'static str {
        "quantize"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [x, codebook] = [x[0], x[1]];
        expect_size(
            "quantize",
            "input",
            "channels",
            x.channels(),
            "codebook",
            codebook.channels(),
        )?;
        if codebook.is_empty() {
            return Err(GraphError::shape("quantize", "the codebook has no rows"));
        }
        let channels = x.channels();
        let index = nearest_rows(x, codebook);
        Ok(run.tensor(x.shape(), |y| {
            for (y, k) in y.chunks_exact_mut(channels).zip(index) {
                y.copy_from_slice(&codebook.data()[k * channels..][..channels]);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![at.needs[0].then_some(dy), None]
    }
}
