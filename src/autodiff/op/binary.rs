//! Sums, differences and products of two tensors, whose axes of size 1 are repeated.

use ndarray::{ArrayViewD, Axis, IxDyn, Zip};

use super::elementwise::{map, update, zip};
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// y += x.
pub fn add_assign<E: Element>(y: &mut [E], x: &[E]) {
    update(y, x, |y, x| y + x);
}

/// The operation on two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pair {
    Add,
    Subtract,
    Multiply,
}

/// a + b, a − b or a b.
///
/// Missing leading axes count as 1, and axes of size 1 are repeated, as in NumPy. The gradient of what
/// was repeated is the sum over its repetitions.
pub struct Binary<E: Element> {
    pair: Pair,
    kept: Option<[Tensor<E>; 2]>,
    shapes: [Vec<usize>; 2],
}

impl<E: Element> Binary<E> {
    /// Returns the operation.
    pub fn new(pair: Pair) -> Self {
        Self { pair, kept: None, shapes: [Vec::new(), Vec::new()] }
    }
}

/// Returns the shape that both repeat to, if there is one.
fn common_shape(a: &[usize], b: &[usize]) -> Option<Vec<usize>> {
    let n = a.len().max(b.len());
    let size = |shape: &[usize], i: usize| (i + shape.len()).checked_sub(n).map_or(1, |i| shape[i]);
    (0..n)
        .map(|i| match (size(a, i), size(b, i)) {
            (a, b) if a == b => Some(a),
            (1, b) => Some(b),
            (a, 1) => Some(a),
            _ => None,
        })
        .collect()
}

/// Sums `d` over the axes along which a tensor of `shape` was repeated.
fn sum_to<E: Element>(d: ArrayViewD<E>, shape: &[usize], target: &mut [E]) {
    let extra = d.ndim() - shape.len();
    let mut sum = d.to_owned();
    for axis in (0..d.ndim()).rev() {
        let size = axis.checked_sub(extra).map_or(1, |i| shape[i]);
        if size == 1 && sum.shape()[axis] != 1 {
            let folded = sum.fold_axis(Axis(axis), E::ZERO, |&a, &b| a + b);
            sum = folded.insert_axis(Axis(axis));
        }
    }
    for (target, &sum) in target.iter_mut().zip(&sum) {
        *target = sum;
    }
}

impl<E: Element> Operation<E> for Binary<E> {
    fn name(&self) -> &'static str {
        match self.pair {
            Pair::Add => "add",
            Pair::Subtract => "subtract",
            Pair::Multiply => "multiply",
        }
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [a, b] = [x[0], x[1]];
        self.shapes = [a.shape().to_vec(), b.shape().to_vec()];
        if self.pair == Pair::Multiply && run.recording {
            self.kept = Some([a.clone(), b.clone()]);
        }
        let apply = |a: E, b: E| match self.pair {
            Pair::Add => a + b,
            Pair::Subtract => a - b,
            Pair::Multiply => a * b,
        };
        if a.shape() == b.shape() {
            return Ok(run.tensor(a.shape(), |y| match self.pair {
                Pair::Add => zip(a.data(), b.data(), y, |a, b| a + b),
                Pair::Subtract => zip(a.data(), b.data(), y, |a, b| a - b),
                Pair::Multiply => zip(a.data(), b.data(), y, |a, b| a * b),
            }));
        }
        let Some(shape) = common_shape(a.shape(), b.shape()) else {
            let problem =
                format!("{:?} and {:?} cannot be repeated to one shape", a.shape(), b.shape());
            return Err(GraphError::shape(self.name(), problem));
        };
        let (a, b) = (a.view(), b.view());
        Ok(run.tensor(&shape, |y| {
            let y = ndarray::ArrayViewMutD::from_shape(IxDyn(&shape), y).expect("its own shape");
            let a = a.broadcast(IxDyn(&shape)).expect("checked");
            let b = b.broadcast(IxDyn(&shape)).expect("checked");
            Zip::from(y).and(a).and(b).for_each(|y, &a, &b| *y = apply(a, b));
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let kept = self.kept.take();
        let gradient = |side: usize| -> Tensor<E> {
            let own = &self.shapes[side];
            let full = match (self.pair, side, &kept) {
                (Pair::Add, ..) | (Pair::Subtract, 0, _) => dy.clone(),
                (Pair::Subtract, ..) => at.tensor(dy.shape(), |d| map(dy.data(), d, |x| -x)),
                (Pair::Multiply, _, Some(kept)) => {
                    let other = &kept[1 - side];
                    at.tensor(dy.shape(), |d| {
                        if other.shape() == dy.shape() {
                            return zip(dy.data(), other.data(), d, |d, x| d * x);
                        }
                        let shape = IxDyn(dy.shape());
                        let d = ndarray::ArrayViewMutD::from_shape(shape.clone(), d);
                        let other = other.view();
                        let other = other.broadcast(shape).expect("checked by the forward");
                        Zip::from(d.expect("its own shape"))
                            .and(dy.view())
                            .and(other)
                            .for_each(|d, &dy, &x| *d = dy * x);
                    })
                }
                (Pair::Multiply, _, None) => unreachable!("kept by the forward"),
            };
            if full.shape() == own {
                return full;
            }
            at.tensor(own, |d| sum_to(full.view(), own, d))
        };
        (0..2).map(|side| at.needs[side].then(|| gradient(side))).collect()
    }
}

/// x\[b, t\] + v\[b\]: a vector for each sample, added to all its frames.
///
/// `x`: \[batch, frames, channels\]; `v`: \[batch, channels\]
#[derive(Default)]
pub struct AddToFrames {
    frames: usize,
}

impl<E: Element> Operation<E> for AddToFrames {
    fn name(&self) -> &'static str {
        "add_to_frames"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [x, v] = [x[0], x[1]];
        let [batch, frames, channels] = *x.shape() else {
            let problem =
                format!("input has shape {:?}, expected [batch, frames, channels]", x.shape());
            return Err(GraphError::shape("add_to_frames", problem));
        };
        if v.shape() != [batch, channels] {
            let problem =
                format!("vector has shape {:?}, input expects {:?}", v.shape(), [batch, channels]);
            return Err(GraphError::shape("add_to_frames", problem));
        }
        self.frames = frames;
        Ok(run.tensor(x.shape(), |y| {
            let rows = y.chunks_exact_mut(channels).zip(x.data().chunks_exact(channels));
            for (i, (y, x)) in rows.enumerate() {
                let v = &v.data()[i / frames * channels..][..channels];
                for ((y, &x), &v) in y.iter_mut().zip(x).zip(v) {
                    *y = x + v;
                }
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let [batch, _, channels] = *dy.shape() else { unreachable!("checked by the forward") };
        let dv = at.needs[1].then(|| {
            at.tensor(&[batch, channels], |dv| {
                dv.fill(E::ZERO);
                for (i, row) in dy.data().chunks_exact(channels).enumerate() {
                    add_assign(&mut dv[i / self.frames * channels..][..channels], row);
                }
            })
        });
        vec![at.needs[0].then_some(dy), dv]
    }
}
