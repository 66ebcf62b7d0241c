//! Loops over all numbers, shared out in fixed chunks, and functions of one number.

use rayon::prelude::*;

use crate::autodiff::element::Element;
use crate::autodiff::kernel::vectorized;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::Result;

/// Numbers of a chunk; work of fewer is not shared out.
pub const CHUNK: usize = 1 << 15;

vectorized! {
    /// y = f(x).
    pub fn map_slice<E: Element, F: Fn(E) -> E>(x: &[E], y: &mut [E], f: F) {
        for (y, &x) in y.iter_mut().zip(x) {
            *y = f(x);
        }
    }

    /// y = f(a, b).
    pub fn zip_slice<E: Element, F: Fn(E, E) -> E>(a: &[E], b: &[E], y: &mut [E], f: F) {
        for ((y, &a), &b) in y.iter_mut().zip(a).zip(b) {
            *y = f(a, b);
        }
    }

    /// y = f(y, x).
    pub fn update_slice<E: Element, F: Fn(E, E) -> E>(y: &mut [E], x: &[E], f: F) {
        for (y, &x) in y.iter_mut().zip(x) {
            *y = f(*y, x);
        }
    }
}

/// y = f(x), in parallel.
pub fn map<E: Element>(x: &[E], y: &mut [E], f: impl Fn(E) -> E + Copy + Sync) {
    assert_eq!(x.len(), y.len(), "as many results as numbers");
    if x.len() <= CHUNK {
        return map_slice(x, y, f);
    }
    let chunks = y.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK));
    chunks.for_each(|(y, x)| map_slice(x, y, f));
}

/// y = x, in parallel.
pub fn copy<E: Element>(x: &[E], y: &mut [E]) {
    assert_eq!(x.len(), y.len(), "as many results as numbers");
    y.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK)).for_each(|(y, x)| y.copy_from_slice(x));
}

/// y = f(a, b), in parallel.
pub fn zip<E: Element>(a: &[E], b: &[E], y: &mut [E], f: impl Fn(E, E) -> E + Copy + Sync) {
    assert!(a.len() == y.len() && b.len() == y.len(), "as many results as numbers");
    if a.len() <= CHUNK {
        return zip_slice(a, b, y, f);
    }
    let chunks = y.par_chunks_mut(CHUNK).zip(a.par_chunks(CHUNK)).zip(b.par_chunks(CHUNK));
    chunks.for_each(|((y, a), b)| zip_slice(a, b, y, f));
}

/// y = f(y, x), in parallel.
pub fn update<E: Element>(y: &mut [E], x: &[E], f: impl Fn(E, E) -> E + Copy + Sync) {
    assert_eq!(x.len(), y.len(), "as many results as numbers");
    if x.len() <= CHUNK {
        return update_slice(y, x, f);
    }
    let chunks = y.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK));
    chunks.for_each(|(y, x)| update_slice(y, x, f));
}

/// A function of one number that losses and samplers use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Function {
    /// scale · x + shift.
    Affine {
        scale: f64,
        shift: f64,
    },
    Exp,
    /// ln x.
    Ln,
    /// √x.
    Sqrt,
    /// x².
    Square,
    /// |x|; its derivative at 0 is 0.
    Abs,
    /// min(max(x, low), high); its derivative outside is 0.
    Clamp {
        low: f64,
        high: f64,
    },
}

/// Applies a [`Function`] to each number. Any shape.
pub struct Map<E: Element> {
    function: Function,
    x: Option<Tensor<E>>,
}

impl<E: Element> Map<E> {
    /// Returns the operation.
    pub fn new(function: Function) -> Self {
        Self { function, x: None }
    }
}

impl<E: Element> Operation<E> for Map<E> {
    fn name(&self) -> &'static str {
        match self.function {
            Function::Affine { .. } => "affine",
            Function::Exp => "exp",
            Function::Ln => "ln",
            Function::Sqrt => "sqrt",
            Function::Square => "square",
            Function::Abs => "abs",
            Function::Clamp { .. } => "clamp",
        }
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        if !matches!(self.function, Function::Affine { .. }) {
            self.x = run.keep(x);
        }
        let source = x.data();
        Ok(run.tensor(x.shape(), |y| match self.function {
            Function::Affine { scale, shift } => {
                let (scale, shift) = (E::from_f64(scale), E::from_f64(shift));
                map(source, y, move |x| scale * x + shift);
            }
            Function::Exp => map(source, y, E::exp),
            Function::Ln => map(source, y, E::ln),
            Function::Sqrt => map(source, y, E::sqrt),
            Function::Square => map(source, y, |x| x * x),
            Function::Abs => map(source, y, E::abs),
            Function::Clamp { low, high } => {
                let (low, high) = (E::from_f64(low), E::from_f64(high));
                map(source, y, move |x| {
                    if x < low {
                        low
                    } else if x > high {
                        high
                    } else {
                        x
                    }
                });
            }
        }))
    }

    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        if !at.needs[0] {
            return vec![None];
        }
        if let Function::Affine { scale, .. } = self.function {
            let scale = E::from_f64(scale);
            let copy = dy.clone();
            return vec![Some(
                at.tensor(copy.shape(), |dx| map(copy.data(), dx, move |d| scale * d)),
            )];
        }
        let x = self.x.take().expect("kept by the forward");
        let half = E::from_f64(0.5);
        let dy_of = dy.data_mut();
        match self.function {
            Function::Affine { .. } => {}
            Function::Exp => update(dy_of, x.data(), |d, x| d * x.exp()),
            Function::Ln => update(dy_of, x.data(), |d, x| d / x),
            Function::Sqrt => update(dy_of, x.data(), move |d, x| half * d / x.sqrt()),
            Function::Square => update(dy_of, x.data(), |d, x| (x + x) * d),
            Function::Abs => update(dy_of, x.data(), |d, x| {
                if x > E::ZERO {
                    d
                } else if x < E::ZERO {
                    -d
                } else {
                    E::ZERO
                }
            }),
            Function::Clamp { low, high } => {
                let (low, high) = (E::from_f64(low), E::from_f64(high));
                update(dy_of, x.data(), move |d, x| if x < low || x > high { E::ZERO } else { d });
            }
        }
        vec![Some(dy)]
    }
}

/// Numbers that are summed at a time: they stay in the processor's first cache.
const SUMMED: usize = 1 << 11;

/// own ← Σ numbers, slot by slot in their order; `own` stands for a slot that has none.
///
/// The order of sums does not depend on the threads.
pub fn sum_in_order(own: &mut [f32], numbers: &[Option<&[f32]>]) {
    own.par_chunks_mut(SUMMED).enumerate().for_each(|(i, own)| {
        let at = i * SUMMED..i * SUMMED + own.len();
        let mut sum = [0.0; SUMMED];
        let sum = &mut sum[..own.len()];
        for (slot, numbers) in numbers.iter().enumerate() {
            let numbers = numbers.map_or(&*own, |numbers| &numbers[at.clone()]);
            match slot {
                0 => sum.copy_from_slice(numbers),
                _ => update(sum, numbers, |x, y| x + y),
            }
        }
        own.copy_from_slice(sum);
    });
}
