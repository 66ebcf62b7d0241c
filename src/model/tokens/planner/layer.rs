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

/// Keys, which are turned by their position, and values of positions that are done, \[batch, positions, d\] each.
#[derive(Clone, Debug)]
pub struct KeysAndValues<T> {
    pub keys: T,
    pub values: T,
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
        let Self { width, heads, .. } = *self;
        let (qk, qkv) = self.projected(g, h, None)?;
        let r = g.attention(Attention {
            query: Channels { tensor: &qk, first: 0 },
            key: Channels { tensor: &qk, first: width },
            value: Channels { tensor: &qkv, first: 2 * width },
            width,
            heads,
            key_mask: mask,
            causal: self.is_causal,
        })?;
        self.fed_forward(g, h, &r)
    }

    /// The layer at positions that stand behind others, whose keys and values are known.
    ///
    /// # Shapes
    /// - `h`: \[batch, n, d\]; `past`: those of the positions before, \[batch, P, d\] each, none where there are none
    /// - returns \[batch, n, d\], and the keys and values of all positions so far, \[batch, P + n, d\] each
    pub fn step<G: Graph>(
        &self,
        g: &mut G,
        h: &G::Tensor,
        past: Option<&KeysAndValues<G::Tensor>>,
    ) -> Result<(G::Tensor, KeysAndValues<G::Tensor>)> {
        let Self { width, heads, .. } = *self;
        let (qk, qkv) = self.projected(g, h, past.map(|past| &past.keys))?;
        let mut keys = g.channels(&qk, width..2 * width)?;
        let mut values = g.channels(&qkv, 2 * width..3 * width)?;
        if let Some(past) = past {
            keys = g.concat_frames(&[&past.keys, &keys])?;
            values = g.concat_frames(&[&past.values, &values])?;
        }
        let r = g.attention(Attention {
            query: Channels { tensor: &qk, first: 0 },
            key: Channels { tensor: &keys, first: 0 },
            value: Channels { tensor: &values, first: 0 },
            width,
            heads,
            key_mask: None,
            causal: self.is_causal,
        })?;
        Ok((self.fed_forward(g, h, &r)?, KeysAndValues { keys, values }))
    }

    /// Returns queries and keys, which are turned, and beside them all three as they were projected.
    fn projected<G: Graph>(
        &self,
        g: &mut G,
        h: &G::Tensor,
        past: Option<&G::Tensor>,
    ) -> Result<(G::Tensor, G::Tensor)> {
        let r = self.norms[0].forward(g, h)?;
        let qkv = self.qkv.forward(g, &r)?;
        let qk = g.channels(&qkv, 0..2 * self.width)?;
        Ok((g.rotary(&qk, 2 * self.heads, past)?, qkv))
    }

    /// Adds what attention found to its input, and then what the feed-forward layer makes of that.
    fn fed_forward<G: Graph>(
        &self,
        g: &mut G,
        h: &G::Tensor,
        attended: &G::Tensor,
    ) -> Result<G::Tensor> {
        let r = self.proj.forward(g, attended)?;
        let r = g.dropout(&r, self.dropout)?;
        let h = g.add(h, &r)?;

        let r = self.norms[1].forward(g, &h)?;
        let r = self.feed_forward[0].forward(g, &r)?;
        let r = g.activation(&r, Activation::Gelu)?;
        let r = self.feed_forward[1].forward(g, &r)?;
        let r = g.dropout(&r, self.dropout)?;
        g.add(&h, &r)
    }
}
