//! The layer of a planner's transformer.

use super::PlannerConfig;
use super::config::PlannerKind;
use crate::model::graph::{Activation, Attention, Channels, Graph, Result};
use crate::model::layers::{LayerNorm, Linear};
use crate::model::parameter::Scope;

/// h ← h + A(LN h); h ← h + W₂ gelu(W₁ LN h), where A is attention of several heads, whose queries and keys are turned
/// by their position (rotary position embedding) instead of having it added.
///
/// Xiong et al., "On Layer Normalization in the Transformer Architecture", ICML 2020 (pre-norm).
#[derive(Clone, Debug)]
pub struct PlannerLayer {
    norms: [LayerNorm; 2],
    qkv: Linear,
    proj: Linear,
    feed_forward: [Linear; 2],
    width: usize,
    heads: usize,
    is_causal: bool,
    dropout: f64,
}

impl PlannerLayer {
    /// Makes a layer as a part of a network.
    pub fn new(scope: &mut Scope, config: &PlannerConfig) -> Self {
        let (d, inner) = (config.width, config.expansion * config.width);
        Self {
            norms: [
                LayerNorm::new(&mut scope.at("attn.norm"), d),
                LayerNorm::new(&mut scope.at("ff.norm"), d),
            ],
            qkv: Linear::new(&mut scope.at("attn.qkv"), d, 3 * d),
            proj: Linear::new(&mut scope.at("attn.proj"), d, d),
            feed_forward: [
                Linear::new(&mut scope.at("ff.0"), d, inner),
                Linear::new(&mut scope.at("ff.1"), inner, d),
            ],
            width: d,
            heads: config.heads,
            is_causal: config.kind == PlannerKind::Autoregressive,
            dropout: config.dropout,
        }
    }

    /// # Shapes
    /// - `h`: \[batch, positions, d\]; `mask`: \[batch, positions\], 1 for positions that count
    /// - returns \[batch, positions, d\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        h: &G::Tensor,
        mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let Self { width, heads, dropout, .. } = *self;
        let r = self.norms[0].forward(g, h)?;
        let qkv = self.qkv.forward(g, &r)?;
        let qk = g.channels(&qkv, 0..2 * width)?;
        let qk = g.rotary(&qk, 2 * heads)?;
        let r = g.attention(Attention {
            query: Channels { tensor: &qk, first: 0 },
            key: Channels { tensor: &qk, first: width },
            value: Channels { tensor: &qkv, first: 2 * width },
            width,
            heads,
            key_mask: mask,
            causal: self.is_causal,
        })?;
        let r = self.proj.forward(g, &r)?;
        let r = g.dropout(&r, dropout)?;
        let h = g.add(h, &r)?;

        let r = self.norms[1].forward(g, &h)?;
        let r = self.feed_forward[0].forward(g, &r)?;
        let r = g.activation(&r, Activation::Gelu)?;
        let r = self.feed_forward[1].forward(g, &r)?;
        let r = g.dropout(&r, dropout)?;
        g.add(&h, &r)
    }
}
