//! Normalisation.

use crate::model::graph::{Activation, Graph, GroupNormalization, Result};
use crate::model::parameter::{Init, ParameterId, Role, Scope};

const EPSILON: f64 = 1e-5;
/// Groups at most; fewer where the channels are not divisible.
const MAX_GROUPS: usize = 32;

/// Normalisation over groups of channels and all frames.
#[derive(Clone, Debug)]
pub struct GroupNorm(GroupNormalization);

impl GroupNorm {
    /// Makes `weight` and `bias` for the largest divisor of `channels` that is at most 32 as groups.
    pub fn new(scope: &mut Scope, channels: usize) -> Self {
        let divides = |groups: &usize| channels.is_multiple_of(*groups);
        let groups = (1..=MAX_GROUPS).rev().find(divides).unwrap_or(1);
        Self(GroupNormalization {
            groups,
            epsilon: EPSILON,
            weight: scope.parameter("weight", &[channels], Init::Ones, Role::Vector),
            bias: scope.parameter("bias", &[channels], Init::Zeros, Role::Vector),
        })
    }

    /// act((γ x̂ + β) (1 + s) + h), `film` = \[s | h\]. \[batch, frames, channels\], film \[batch, 2 channels\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        film: Option<&G::Tensor>,
        activation: Activation,
    ) -> Result<G::Tensor> {
        g.group_norm(x, self.0, film, activation)
    }
}

/// Normalisation over the channels of each frame.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    weight: ParameterId,
    bias: ParameterId,
}

impl LayerNorm {
    /// Makes `weight` and `bias` \[channels\].
    pub fn new(scope: &mut Scope, channels: usize) -> Self {
        Self {
            weight: scope.parameter("weight", &[channels], Init::Ones, Role::Vector),
            bias: scope.parameter("bias", &[channels], Init::Zeros, Role::Vector),
        }
    }

    /// \[..., channels\] → \[..., channels\]
    pub fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        g.layer_norm(x, Some([self.weight, self.bias]), EPSILON)
    }
}
