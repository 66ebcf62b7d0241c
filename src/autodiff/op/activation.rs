//! The functions that stand between layers.

use super::elementwise::{map, update};
use crate::autodiff::element::{Element, sigmoid};
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{Activation, Result};

/// Applies an [`Activation`] to each number. Any shape.
pub struct Activate<E: Element> {
    activation: Activation,
    x: Option<Tensor<E>>,
}

impl<E: Element> Activate<E> {
    /// Returns the operation.
    pub fn new(activation: Activation) -> Self {
        Self { activation, x: None }
    }
}

/// x σ(x): Hendrycks and Gimpel, "Gaussian Error Linear Units", arXiv 1606.08415, sec. 2.
#[inline(always)]
pub fn silu<E: Element>(x: E) -> E {
    x * sigmoid(x)
}

/// d silu / dx = σ(x) (1 + x (1 − σ(x))).
#[inline(always)]
pub fn silu_slope<E: Element>(x: E) -> E {
    let s = sigmoid(x);
    s * (E::ONE + x * (E::ONE - s))
}

/// x Φ(x) = x (1 + erf(x / √2)) / 2 (Hendrycks and Gimpel, sec. 2).
#[inline(always)]
fn gelu<E: Element>(x: E) -> E {
    let half = E::from_f64(0.5);
    half * x * (E::ONE + (x * E::from_f64(std::f64::consts::FRAC_1_SQRT_2)).erf())
}

/// d gelu / dx = Φ(x) + x φ(x).
#[inline(always)]
fn gelu_slope<E: Element>(x: E) -> E {
    let half = E::from_f64(0.5);
    let normal = half * (E::ONE + (x * E::from_f64(std::f64::consts::FRAC_1_SQRT_2)).erf());
    let density =
        E::from_f64(0.5 * std::f64::consts::FRAC_2_SQRT_PI * std::f64::consts::FRAC_1_SQRT_2);
    normal + x * density * (-half * x * x).exp()
}

/// ln(1 + e^x), without overflow.
#[inline(always)]
fn softplus<E: Element>(x: E) -> E {
    x.larger(E::ZERO) + (-x.abs()).exp().ln_1p()
}

/// x tanh(softplus(x)): Misra, "Mish", arXiv 1908.08681, eq. 1.
#[inline(always)]
fn mish<E: Element>(x: E) -> E {
    x * softplus(x).tanh()
}

/// d mish / dx = w + x σ(x) (1 − w²), w = tanh(softplus(x)).
#[inline(always)]
fn mish_slope<E: Element>(x: E) -> E {
    let w = softplus(x).tanh();
    w + x * sigmoid(x) * (E::ONE - w * w)
}

/// y = act(x).
pub fn apply<E: Element>(activation: Activation, x: &[E], y: &mut [E]) {
    match activation {
        Activation::Identity => y.copy_from_slice(x),
        Activation::Silu => map(x, y, silu),
        Activation::Gelu => map(x, y, gelu),
        // Written so that NaN stays NaN.
        Activation::Relu => map(x, y, |x| if x < E::ZERO { E::ZERO } else { x }),
        Activation::LeakyRelu { slope } => {
            let slope = E::from_f64(slope);
            map(x, y, move |x| if x > E::ZERO { x } else { slope * x });
        }
        Activation::Mish => map(x, y, mish),
        Activation::Tanh => map(x, y, E::tanh),
        Activation::Sigmoid => map(x, y, sigmoid),
    }
}

/// d = d · act'(x).
pub fn differentiate<E: Element>(activation: Activation, d: &mut [E], x: &[E]) {
    match activation {
        Activation::Identity => {}
        Activation::Silu => update(d, x, |d, x| d * silu_slope(x)),
        Activation::Gelu => update(d, x, |d, x| d * gelu_slope(x)),
        Activation::Relu => update(d, x, |d, x| if x > E::ZERO { d } else { E::ZERO }),
        Activation::LeakyRelu { slope } => {
            let slope = E::from_f64(slope);
            update(d, x, move |d, x| if x > E::ZERO { d } else { slope * d });
        }
        Activation::Mish => update(d, x, |d, x| d * mish_slope(x)),
        Activation::Tanh => update(d, x, |d, x| {
            let y = x.tanh();
            d * (E::ONE - y * y)
        }),
        Activation::Sigmoid => update(d, x, |d, x| {
            let y = sigmoid(x);
            d * y * (E::ONE - y)
        }),
    }
}

impl<E: Element> Operation<E> for Activate<E> {
    fn name(&self) -> &'static str {
        match self.activation {
            Activation::Identity => "identity",
            Activation::Silu => "silu",
            Activation::Gelu => "gelu",
            Activation::Relu => "relu",
            Activation::LeakyRelu { .. } => "leaky_relu",
            Activation::Mish => "mish",
            Activation::Tanh => "tanh",
            Activation::Sigmoid => "sigmoid",
        }
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        self.x = run.keep(x[0]);
        Ok(run.tensor(x[0].shape(), |y| apply(self.activation, x[0].data(), y)))
    }

    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let x = self.x.take().expect("kept by the forward");
        at.only(|| {
            differentiate(self.activation, dy.data_mut(), x.data());
            dy
        })
    }
}
