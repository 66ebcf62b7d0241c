//! A fixed filter over frames, for each channel its own.

use std::sync::Arc;

use ndarray::Array2;

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Mirror, Result};

/// y\[t, c\] = Σ_j h\[c, j\] x\[t + j − m\], m = ⌊taps / 2⌋; beyond its ends x is mirrored.
///
/// \[batch, frames, channels\] → the same
pub struct FilterFrames {
    /// h, \[channels, taps\], which is no parameter and learns nothing.
    pub kernel: Arc<Array2<f64>>,
    pub mirror: Mirror,
}

impl FilterFrames {
    /// Filters, or for the gradient applies the transpose, which gives to the frame that a tap was taken from.
    fn apply<E: Element>(&self, shape: &[usize], x: &[E], y: &mut [E], is_transposed: bool) {
        let (frames, channels, taps) = (shape[1], shape[2], self.kernel.ncols());
        let kernel: Vec<E> = self.kernel.t().iter().map(|&h| E::from_f64(h)).collect();
        let half = (taps / 2) as isize;
        y.fill(E::ZERO);
        let sample = (frames * channels).max(1);
        for (y, x) in y.chunks_exact_mut(sample).zip(x.chunks_exact(sample)) {
            for t in 0..frames {
                for (j, h) in kernel.chunks_exact(channels).enumerate() {
                    let place = t as isize + j as isize - half;
                    let Some((taken, sign)) = self.mirror.frame(place, frames) else { continue };
                    let (from, to) = if is_transposed { (t, taken) } else { (taken, t) };
                    let sign = E::from_f64(sign);
                    let x = &x[from * channels..][..channels];
                    let y = &mut y[to * channels..][..channels];
                    for ((y, &x), &h) in y.iter_mut().zip(x).zip(h) {
                        *y += sign * h * x;
                    }
                }
            }
        }
    }
}

impl<E: Element> Operation<E> for FilterFrames {
    fn name(&self) -> &'static str {
        "filter_frames"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        expect_axes("filter_frames", "input", x, 3, "[batch, frames, channels]")?;
        let (channels, taps) = self.kernel.dim();
        if x.channels() != channels || taps % 2 == 0 {
            let problem = format!(
                "input has {} channels, the filter has {channels} with {taps} taps, of which an odd number is asked",
                x.channels()
            );
            return Err(GraphError::shape("filter_frames", problem));
        }
        Ok(run.tensor(x.shape(), |y| self.apply(x.shape(), x.data(), y, false)))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        at.only(|| at.tensor(dy.shape(), |dx| self.apply(dy.shape(), dy.data(), dx, true)))
    }
}
