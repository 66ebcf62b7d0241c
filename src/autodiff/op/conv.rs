//! Linear layers and convolutions over frames: one product with the weight in its panels.

use crate::autodiff::element::Element;
use crate::autodiff::kernel::{Conv, input_gradient, product, weight_gradient};
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{Convolution, GraphError, ParameterId, Result};

/// y\[t\] = b + Σ_j W_j x\[t · stride + j · dilation − padding\], zero beyond either end; or x Wᵀ + b.
///
/// # Shapes
/// - convolution: \[batch, frames, in\] → \[batch, out frames, out\]
/// - linear: \[..., in\] → \[..., out\]
pub struct Product<E: Element> {
    weight: ParameterId,
    bias: Option<ParameterId>,
    convolution: Option<Convolution>,
    x: Option<Tensor<E>>,
    conv: Option<Conv>,
}

impl<E: Element> Product<E> {
    /// x Wᵀ + b over the last axis.
    pub fn linear(weight: ParameterId, bias: Option<ParameterId>) -> Self {
        Self { weight, bias, convolution: None, x: None, conv: None }
    }

    /// A convolution over the middle axis.
    pub fn convolution(
        weight: ParameterId,
        bias: Option<ParameterId>,
        convolution: Convolution,
    ) -> Self {
        Self { weight, bias, convolution: Some(convolution), x: None, conv: None }
    }

    fn label(&self) -> &'static str {
        if self.convolution.is_some() { "conv1d" } else { "linear" }
    }

    /// Returns how rows meet taps, and the shape of the result's leading axes.
    fn geometry(&self, x: &Tensor<E>) -> Result<(Conv, Vec<usize>)> {
        let Some(c) = self.convolution else {
            let Some((_, leading)) = x.shape().split_last() else {
                return Err(GraphError::shape(
                    "linear",
                    "input is a scalar, expected [..., channels]",
                ));
            };
            return Ok((Conv::linear(x.rows()), leading.to_vec()));
        };
        expect_axes("conv1d", "input", x, 3, "[batch, frames, channels]")?;
        let (batch, frames) = (x.shape()[0], x.shape()[1]);
        if c.taps == 1 && c.stride == 1 && c.padding == 0 {
            return Ok((Conv::linear(batch * frames), vec![batch, frames]));
        }
        let Convolution { taps, stride, padding, dilation } = c;
        let conv = Conv { batch, frames, taps, stride, padding, dilation };
        if conv.out_frames() == 0 {
            let problem = format!(
                "input has {frames} frames and {padding} of padding at either end, weight spans {}",
                conv.span()
            );
            return Err(GraphError::shape("conv1d", problem));
        }
        Ok((conv, vec![batch, conv.out_frames()]))
    }
}

impl<E: Element> Operation<E> for Product<E> {
    fn name(&self) -> &'static str {
        self.label()
    }

    fn parameter(&self) -> Option<ParameterId> {
        Some(self.weight)
    }

    fn parameters(&self) -> [Option<ParameterId>; 2] {
        [Some(self.weight), self.bias]
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        let label = self.label();
        let Some(shape) = run.parameters.weight_shape(self.weight) else {
            let name = &run.parameters.list().get(self.weight).name;
            return Err(GraphError::shape(label, format!("{name} is not a weight")));
        };
        expect_size(label, "input", "channels", x.channels(), "weight", shape.channels)?;
        if let Some(c) = self.convolution {
            expect_size(label, "weight", "taps", shape.taps, "convolution", c.taps)?;
        }
        let (conv, mut out_shape) = self.geometry(x)?;
        out_shape.push(shape.outputs);
        let weight = run.parameters.get(self.weight);
        let bias = self.bias.map(|bias| run.parameters.get(bias));
        let y = run.tensor(&out_shape, |y| {
            product(x.data(), shape.channels, &conv.forward(), weight, bias, y, shape.outputs);
        });
        self.x = run.keep(x);
        self.conv = Some(conv);
        Ok(y)
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let x = self.x.take().expect("kept by the forward");
        let conv = self.conv.take().expect("kept by the forward");
        let shape = at.parameters.weight_shape(self.weight).expect("checked by the forward");
        let (channels, n) = (shape.channels, shape.outputs);
        let (x_of, dy_of) = (x.data(), dy.data());
        let (arena, gradients) = (at.arena, &mut *at.gradients);
        match self.bias {
            Some(bias) => {
                let [(dw, add_w), (db, add_b)] = gradients.write_two(self.weight, bias);
                let add = [add_w, add_b];
                weight_gradient(x_of, channels, dy_of, n, &conv, dw, Some(db), add, arena);
            }
            None => {
                let (dw, add) = gradients.write(self.weight);
                weight_gradient(x_of, channels, dy_of, n, &conv, dw, None, [add; 2], arena);
            }
        }
        let weight = at.parameters.get(self.weight);
        at.only(|| {
            at.tensor(x.shape(), |dx| {
                input_gradient(dy.data(), n, &conv, weight, dx, channels, at.arena);
            })
        })
    }
}
