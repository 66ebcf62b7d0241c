//! Dropout.

use rayon::prelude::*;

use super::elementwise::CHUNK;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::random::Stream;
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// In training y = x m / (1 − p) with m = 0 with probability p, else 1; otherwise y = x.
///
/// Which numbers are dropped depends on seed, operation and place alone, so that nothing is kept for
/// the backward. Srivastava et al., "Dropout", JMLR 15, 2014. Any shape.
pub struct Dropout {
    probability: f64,
    random: Option<Stream>,
}

impl Dropout {
    /// Returns the operation.
    pub fn new(probability: f64) -> Self {
        Self { probability, random: None }
    }

    /// y = x m / (1 − p).
    fn drop<E: Element>(&self, stream: Stream, x: &[E], y: &mut [E]) {
        let keep = E::from_f64(1.0 / (1.0 - self.probability));
        let threshold = (self.probability * 2.0_f64.powi(32)) as u64;
        let chunks = y.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK)).enumerate();
        chunks.for_each_init(
            || vec![0_u32; CHUNK],
            |words, (i, (y, x))| {
                let words = &mut words[..x.len()];
                stream.words(i * CHUNK, words);
                for ((y, &x), &word) in y.iter_mut().zip(x).zip(&*words) {
                    *y = if u64::from(word) < threshold { E::ZERO } else { x * keep };
                }
            },
        );
    }
}

impl<E: Element> Operation<E> for Dropout {
    fn name(&self) -> &'static str {
        "dropout"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        if !(0.0..1.0).contains(&self.probability) {
            let problem = format!("probability {} is not in [0, 1)", self.probability);
            return Err(GraphError::shape("dropout", problem));
        }
        self.random = run.random;
        Ok(match self.random {
            Some(stream) => run.tensor(x[0].shape(), |y| self.drop(stream, x[0].data(), y)),
            None => x[0].clone(),
        })
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        at.only(|| match self.random {
            Some(stream) => at.tensor(dy.shape(), |dx| self.drop(stream, dy.data(), dx)),
            None => dy,
        })
    }
}
