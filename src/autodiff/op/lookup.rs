//! Rows of a table by index: fixed tables, learned ones, and the number of the nearest row.

use std::sync::Arc;

use ndarray::Array2;
use rayon::prelude::*;

use super::binary::add_assign;
use crate::autodiff::element::Element;
use crate::autodiff::kernel::vectorized;
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

/// The number of the nearest row of a table for each row: vector quantisation.
///
/// y = argmin_k ‖x − c_k‖², ties to the first. Numbers have no gradient.
///
/// # Shapes
/// x \[..., channels\]; table \[rows, channels\] → \[...\]
pub struct NearestRow(pub ParameterId);

/// Numbers that are summed side by side.
const LANES: usize = 16;

vectorized! {
    /// Returns the row of a table, one behind the other, that is nearest to x.
    fn nearest<E: Element>(x: &[E], table: &[E]) -> usize {
        let (mut best, mut least) = (0, E::from_f64(f64::INFINITY));
        for (k, row) in table.chunks_exact(x.len()).enumerate() {
            let mut lanes = [E::ZERO; LANES];
            let (a, b) = (x.chunks_exact(LANES), row.chunks_exact(LANES));
            let rest = a.remainder().iter().zip(b.remainder());
            for (a, b) in a.zip(b) {
                for (lane, (&a, &b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
                    *lane += (a - b) * (a - b);
                }
            }
            for (lane, (&a, &b)) in lanes.iter_mut().zip(rest) {
                *lane += (a - b) * (a - b);
            }
            let distance = lanes.iter().copied().sum::<E>();
            if distance < least {
                (best, least) = (k, distance);
            }
        }
        best
    }
}

impl<E: Element> Operation<E> for NearestRow {
    fn name(&self) -> &'static str {
        "nearest_row"
    }

    fn parameter(&self) -> Option<ParameterId> {
        Some(self.0)
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        let parameter = run.parameters.list().get(self.0);
        let &[rows, channels] = parameter.shape.as_slice() else {
            let problem = format!(
                "{} has shape {:?}, expected [rows, channels]",
                parameter.name, parameter.shape
            );
            return Err(GraphError::shape("nearest_row", problem));
        };
        expect_size("nearest_row", "input", "channels", x.channels(), &parameter.name, channels)?;
        if rows == 0 || channels == 0 {
            let problem = format!("{} has no numbers", parameter.name);
            return Err(GraphError::shape("nearest_row", problem));
        }
        let table = run.parameters.get(self.0);
        let shape = x.shape().split_last().map(|(_, leading)| leading).unwrap_or_default();
        Ok(run.tensor(shape, |y| {
            y.par_iter_mut()
                .zip(x.data().par_chunks_exact(channels))
                .for_each(|(y, x)| *y = E::from_f64(nearest(x, table) as f64));
        }))
    }

    fn backward(&mut self, _: Tensor<E>, _: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![None]
    }
}

/// A value in place of x that passes its gradient to x: x + sg(value − x).
///
/// van den Oord et al., "Neural Discrete Representation Learning", NIPS 2017, section 3.2.
///
/// # Shapes
/// x, value \[...\] → the same
pub struct StraightThrough;

impl<E: Element> Operation<E> for StraightThrough {
    fn name(&self) -> &'static str {
        "straight_through"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [x, value] = [x[0], x[1]];
        if x.shape() != value.shape() {
            let problem = format!("value has shape {:?}, input {:?}", value.shape(), x.shape());
            return Err(GraphError::shape("straight_through", problem));
        }
        Ok(run.tensor(value.shape(), |y| y.copy_from_slice(value.data())))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![at.needs[0].then_some(dy), None]
    }
}
