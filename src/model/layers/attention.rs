//! The attention block of the UNet: to itself, then to the music.

use super::{Conv1d, GroupNorm};
use crate::model::graph::{Activation, Attention, Channels, Graph, Result};
use crate::model::parameter::Scope;

/// Self-attention and cross-attention, each behind a norm and around a skip.
#[derive(Clone, Debug)]
pub struct AttentionBlock {
    norm: GroupNorm,
    qkv: Conv1d,
    proj: Conv1d,
    cross_norm: GroupNorm,
    q_cross: Conv1d,
    kv_cross: Conv1d,
    proj_cross: Conv1d,
    width: usize,
    heads: usize,
}

impl AttentionBlock {
    /// Makes a block of `width` channels in `heads` heads, with a context of `context_dim` channels.
    pub fn new(scope: &mut Scope, width: usize, heads: usize, context_dim: usize) -> Self {
        let mut conv =
            |name: &str, inputs, outputs| Conv1d::new(&mut scope.at(name), inputs, outputs, 1, 1);
        let qkv = conv("qkv", width, 3 * width);
        let proj = conv("proj", width, width);
        let q_cross = conv("q_cross", width, width);
        let kv_cross = conv("kv_cross", context_dim, 2 * width);
        let proj_cross = conv("proj_cross", width, width);
        let norm = GroupNorm::new(&mut scope.at("norm"), width);
        let cross_norm = GroupNorm::new(&mut scope.at("cross_norm"), width);
        Self { norm, qkv, proj, cross_norm, q_cross, kv_cross, proj_cross, width, heads }
    }

    /// # Shapes
    /// - `x`: \[batch, frames, width\]; `mask`: \[batch, frames\], frames that count
    /// - `context`: \[batch, context frames, context_dim\]; `context_mask`: \[batch, context frames\]
    /// - returns \[batch, frames, width\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        mask: Option<&G::Tensor>,
        context: &G::Tensor,
        context_mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let Self { width, heads, .. } = *self;
        let h = self.norm.forward(g, x, None, Activation::Identity)?;
        let qkv = self.qkv.forward(g, &h)?;
        let part = |i| Channels { tensor: &qkv, first: i * width };
        let h = g.attention(Attention {
            query: part(0),
            key: part(1),
            value: part(2),
            width,
            heads,
            key_mask: mask,
            causal: false,
        })?;
        let h = self.proj.forward(g, &h)?;
        let x = g.add(x, &h)?;

        let h = self.cross_norm.forward(g, &x, None, Activation::Identity)?;
        let q = self.q_cross.forward(g, &h)?;
        let kv = self.kv_cross.forward(g, context)?;
        let h = g.attention(Attention {
            query: Channels { tensor: &q, first: 0 },
            key: Channels { tensor: &kv, first: 0 },
            value: Channels { tensor: &kv, first: width },
            width,
            heads,
            key_mask: context_mask,
            causal: false,
        })?;
        let h = self.proj_cross.forward(g, &h)?;
        g.add(&x, &h)
    }
}
