//! The embedding of a group: what all its dancers have in common.

use super::GroupConfig;
use super::config::MAPPING_LAYERS;
use crate::model::graph::{Activation, Graph, Result};
use crate::model::layers::Linear;
use crate::model::parameter::{Init, ParameterId, Role, Scope};

/// Slope of the mapping's leaky ReLU below 0.
const SLOPE: f64 = 0.2;
/// ε of the norm of the mapping's input.
const EPSILON: f64 = 1e-8;

/// w = MLP₈((z + c̄) / ‖z + c̄‖ √d) + e_n, z ~ N(0, I), c̄ the mean of the encoded music (paper, eq. 5).
///
/// The mapping's input is normalised as in the published code, here to length √d, so that its numbers are of order
/// one (Karras et al., "StyleGAN", CVPR 2019, whose mapping it is).
#[derive(Clone, Debug)]
pub struct GroupEmbedding {
    mapping: Vec<Linear>,
    numbers: ParameterId,
    width: usize,
}

impl GroupEmbedding {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        let d = config.width;
        let init = Init::Normal { deviation: 1.0 };
        Self {
            mapping: (0..MAPPING_LAYERS)
                .map(|i| Linear::new(&mut scope.at(format!("mapping.{i}")), d, d))
                .collect(),
            numbers: scope.parameter("numbers", &[config.max_dancers, d], init, Role::Table),
            width: d,
        }
    }

    /// Returns e_n. \[B\] → \[B, d\]
    pub fn number<G: Graph>(&self, g: &mut G, number: &G::Tensor) -> Result<G::Tensor> {
        g.embedding(self.numbers, number)
    }

    /// All \[B, d\] → w, \[B, d\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        z: &G::Tensor,
        mean_music: &G::Tensor,
        e_n: &G::Tensor,
    ) -> Result<G::Tensor> {
        let h = g.add(z, mean_music)?;
        let h = g.normalize(&h, EPSILON)?;
        let mut h = g.scale(&h, (self.width as f64).sqrt())?;
        for layer in &self.mapping {
            h = layer.forward(g, &h)?;
            h = g.activation(&h, Activation::LeakyRelu { slope: SLOPE })?;
        }
        g.add(&h, e_n)
    }
}
