//! Linear layers and convolutions.

use crate::model::graph::{Convolution, Graph, Result};
use crate::model::parameter::{Init, ParameterId, Role, Scope};

/// x Wᵀ + b over the last axis.
#[derive(Clone, Debug)]
pub struct Linear {
    weight: ParameterId,
    bias: ParameterId,
}

impl Linear {
    /// Makes `weight` \[outputs, inputs\] and `bias` \[outputs\].
    pub fn new(scope: &mut Scope, inputs: usize, outputs: usize) -> Self {
        Self::with(scope, inputs, outputs, Init::fan_in(inputs))
    }

    /// Makes a layer that begins at zero, so that its result is zero until it has learned.
    pub fn zeros(scope: &mut Scope, inputs: usize, outputs: usize) -> Self {
        Self::with(scope, inputs, outputs, Init::Zeros)
    }

    fn with(scope: &mut Scope, inputs: usize, outputs: usize, init: Init) -> Self {
        Self {
            weight: scope.parameter("weight", &[outputs, inputs], init, Role::Weight),
            bias: scope.parameter("bias", &[outputs], init, Role::Vector),
        }
    }

    /// \[..., inputs\] → \[..., outputs\]
    pub fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        g.linear(x, self.weight, Some(self.bias))
    }
}

/// A convolution over frames.
#[derive(Clone, Debug)]
pub struct Conv1d {
    weight: ParameterId,
    bias: ParameterId,
    convolution: Convolution,
}

impl Conv1d {
    /// Makes a convolution with an odd number of taps that keeps the frames (stride 1) or leaves one
    /// in `stride`.
    pub fn new(
        scope: &mut Scope,
        inputs: usize,
        outputs: usize,
        taps: usize,
        stride: usize,
    ) -> Self {
        let convolution = Convolution { taps, stride, padding: taps / 2, dilation: 1 };
        Self::stepping(scope, inputs, outputs, convolution)
    }

    /// Makes a convolution that begins at zero, so that a fresh network's output is zero.
    pub fn zeros(scope: &mut Scope, inputs: usize, outputs: usize, taps: usize) -> Self {
        let convolution = Convolution { taps, stride: 1, padding: taps / 2, dilation: 1 };
        Self::with(scope, inputs, outputs, convolution, Init::Zeros)
    }

    /// Makes a convolution that steps over frames in a way of its own.
    pub fn stepping(
        scope: &mut Scope,
        inputs: usize,
        outputs: usize,
        convolution: Convolution,
    ) -> Self {
        Self::with(scope, inputs, outputs, convolution, Init::fan_in(inputs * convolution.taps))
    }

    fn with(
        scope: &mut Scope,
        inputs: usize,
        outputs: usize,
        convolution: Convolution,
        init: Init,
    ) -> Self {
        let shape = [outputs, inputs, convolution.taps];
        Self {
            weight: scope.parameter("weight", &shape, init, Role::Weight),
            bias: scope.parameter("bias", &[outputs], init, Role::Vector),
            convolution,
        }
    }

    /// \[batch, frames, inputs\] → \[batch, frames / stride, outputs\]
    pub fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        g.conv1d(x, self.weight, Some(self.bias), self.convolution)
    }
}
