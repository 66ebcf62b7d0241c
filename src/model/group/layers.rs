//! Layers of the networks of a group.
//!
//! Tensors of motion are \[B, N T, d\]: the frames of all N dancers one after the other. `like` is the motion with
//! its dancers in the batch, \[B N, T, …\]; folding between the two moves no number.
//!
//! Queries and keys are turned by the frame of their dancer (rotary position embedding), so that frames of one
//! time have one position, of whichever dancer they are. The reference turns inputs before their projection, and
//! frames of one dancer alone.

use crate::model::graph::{Activation, Attention, Channels, Graph, Result};
use crate::model::layers::{LayerNorm, Linear};
use crate::model::parameter::Scope;

use super::GroupConfig;

/// x + W₂ gelu(W₁ LN x), the branch alone.
#[derive(Clone, Debug)]
pub struct FeedForward {
    norm: LayerNorm,
    layers: [Linear; 2],
    dropout: f64,
}

impl FeedForward {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        let (width, inner) = (config.width, config.expansion * config.width);
        Self {
            norm: LayerNorm::new(&mut scope.at("norm"), width),
            layers: [
                Linear::new(&mut scope.at("0"), width, inner),
                Linear::new(&mut scope.at("1"), inner, width),
            ],
            dropout: config.dropout,
        }
    }

    /// \[…, d\] → \[…, d\]
    pub fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        let h = self.norm.forward(g, x)?;
        let h = self.layers[0].forward(g, &h)?;
        let h = g.activation(&h, Activation::Gelu)?;
        let h = g.dropout(&h, self.dropout)?;
        let h = self.layers[1].forward(g, &h)?;
        g.dropout(&h, self.dropout)
    }
}

/// Self-attention of every sample over its own frames, behind a norm; the branch alone.
#[derive(Clone, Debug)]
pub struct SelfAttention {
    norm: LayerNorm,
    qkv: Linear,
    proj: Linear,
    width: usize,
    heads: usize,
    dropout: f64,
}

impl SelfAttention {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        let width = config.width;
        Self {
            norm: LayerNorm::new(&mut scope.at("norm"), width),
            qkv: Linear::new(&mut scope.at("qkv"), width, 3 * width),
            proj: Linear::new(&mut scope.at("proj"), width, width),
            width,
            heads: config.heads,
            dropout: config.dropout,
        }
    }

    /// Attends within each dancer: the mask m_local of the paper, as a fold into the batch.
    ///
    /// # Shapes
    /// - `x`: \[B, N T, d\]; `like`: \[B N, T, …\] → as `x`
    pub fn local<G: Graph>(&self, g: &mut G, x: &G::Tensor, like: &G::Tensor) -> Result<G::Tensor> {
        let h = self.norm.forward(g, x)?;
        let qkv = self.qkv.forward(g, &h)?;
        let qkv = g.rebatch(&qkv, like)?;
        let qkv = self.turned(g, &qkv)?;
        let h = self.attend(g, &qkv, None)?;
        let h = g.rebatch(&h, x)?;
        let h = self.proj.forward(g, &h)?;
        g.dropout(&h, self.dropout)
    }

    /// Attends over all frames of each sample. \[batch, frames, d\] → the same
    pub fn plain<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        self.local(g, x, x)
    }

    /// Attends over the frames of all dancers and some tokens, which have no place in time: the mask m_global.
    ///
    /// # Shapes
    /// - `tokens`: \[B, n, d\]; `x`: \[B, N T, d\]; `like`: \[B N, T, …\]; `mask`: \[B, n + N T\], dancers who are
    ///   there → \[B, n + N T, d\]
    pub fn global<G: Graph>(
        &self,
        g: &mut G,
        tokens: &G::Tensor,
        x: &G::Tensor,
        like: &G::Tensor,
        mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let h = self.norm.forward(g, x)?;
        let qkv = self.qkv.forward(g, &h)?;
        let qkv = g.rebatch(&qkv, like)?;
        let qkv = self.turned(g, &qkv)?;
        let qkv = g.rebatch(&qkv, x)?;
        let of_tokens = self.norm.forward(g, tokens)?;
        let of_tokens = self.qkv.forward(g, &of_tokens)?;
        let qkv = g.concat_frames(&[&of_tokens, &qkv])?;
        let h = self.attend(g, &qkv, mask)?;
        let h = self.proj.forward(g, &h)?;
        g.dropout(&h, self.dropout)
    }

    /// Queries and keys, turned by their frame, and values beside them.
    fn turned<G: Graph>(&self, g: &mut G, qkv: &G::Tensor) -> Result<G::Tensor> {
        g.rotary_first(qkv, 2 * self.heads, [2 * self.width, 3 * self.width])
    }

    fn attend<G: Graph>(
        &self,
        g: &mut G,
        qkv: &G::Tensor,
        key_mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let part = |i: usize| Channels { tensor: qkv, first: i * self.width };
        g.attention(Attention {
            query: part(0),
            key: part(1),
            value: part(2),
            width: self.width,
            heads: self.heads,
            key_mask,
            causal: false,
        })
    }
}

/// Cross-attention of the frames of all dancers to music and step, behind a norm; the branch alone.
#[derive(Clone, Debug)]
pub struct CrossAttention {
    norm: LayerNorm,
    q: Linear,
    kv: Linear,
    proj: Linear,
    width: usize,
    heads: usize,
    dropout: f64,
}

/// The memory of cross-attention.
pub struct Memory<T> {
    /// Music, normalised, \[B, T, d\].
    pub music: T,
    /// Tokens of the step, normalised, \[B, 2, d\].
    pub step: T,
}

impl CrossAttention {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        let width = config.width;
        Self {
            norm: LayerNorm::new(&mut scope.at("norm"), width),
            q: Linear::new(&mut scope.at("q"), width, width),
            kv: Linear::new(&mut scope.at("kv"), width, 2 * width),
            proj: Linear::new(&mut scope.at("proj"), width, width),
            width,
            heads: config.heads,
            dropout: config.dropout,
        }
    }

    /// # Shapes
    /// - `x`: \[B, N T, d\]; `like`: \[B N, T, …\] → as `x`
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        like: &G::Tensor,
        memory: &Memory<G::Tensor>,
    ) -> Result<G::Tensor> {
        let width = self.width;
        let h = self.norm.forward(g, x)?;
        let q = self.q.forward(g, &h)?;
        let q = g.rebatch(&q, like)?;
        let q = g.rotary(&q, self.heads, None)?;
        let q = g.rebatch(&q, x)?;
        let music = self.kv.forward(g, &memory.music)?;
        let step = self.kv.forward(g, &memory.step)?;
        let music = g.rotary_first(&music, self.heads, [width, 2 * width])?;
        let kv = g.concat_frames(&[&music, &step])?;
        let h = g.attention(Attention {
            query: Channels { tensor: &q, first: 0 },
            key: Channels { tensor: &kv, first: 0 },
            value: Channels { tensor: &kv, first: width },
            width,
            heads: self.heads,
            key_mask: None,
            causal: false,
        })?;
        let h = self.proj.forward(g, &h)?;
        g.dropout(&h, self.dropout)
    }
}

/// A pre-norm transformer layer over the frames of each sample.
#[derive(Clone, Debug)]
pub struct EncoderLayer {
    attention: SelfAttention,
    feed_forward: FeedForward,
}

impl EncoderLayer {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        Self {
            attention: SelfAttention::new(&mut scope.at("attn"), config),
            feed_forward: FeedForward::new(&mut scope.at("ff"), config),
        }
    }

    /// \[batch, frames, d\] → the same
    pub fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        let h = self.attention.plain(g, x)?;
        let x = g.add(x, &h)?;
        let h = self.feed_forward.forward(g, &x)?;
        g.add(&x, &h)
    }

    /// As [`EncoderLayer::forward`] with a token before the frames, which is taken away again.
    ///
    /// # Shapes
    /// `token`: \[batch, d\]; `x`: \[batch, frames, d\] → as `x`
    pub fn behind_token<G: Graph>(
        &self,
        g: &mut G,
        token: &G::Tensor,
        x: &G::Tensor,
    ) -> Result<G::Tensor> {
        let with_token = g.concat_frames(&[token, x])?;
        let h = self.forward(g, &with_token)?;
        g.frames(&h, 1, None)
    }
}

/// A pre-norm transformer layer over the frames of all dancers, and tokens before them.
#[derive(Clone, Debug)]
pub struct GlobalLayer {
    attention: SelfAttention,
    feed_forward: FeedForward,
}

impl GlobalLayer {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        Self {
            attention: SelfAttention::new(&mut scope.at("attn"), config),
            feed_forward: FeedForward::new(&mut scope.at("ff"), config),
        }
    }

    /// # Shapes
    /// - `tokens`: \[B, 2, d\]; `x`: \[B, N T, d\]; `like`: \[B N, T, …\]; `mask`: \[B, 2 + N T\] → \[B, 2 + N T, d\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        tokens: &G::Tensor,
        x: &G::Tensor,
        like: &G::Tensor,
        mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let h = self.attention.global(g, tokens, x, like, mask)?;
        let all = g.concat_frames(&[tokens, x])?;
        let all = g.add(&all, &h)?;
        let h = self.feed_forward.forward(g, &all)?;
        g.add(&all, &h)
    }
}

/// Linear(mish c): scale and shift of a branch (FiLM) from a context.
#[derive(Clone, Debug)]
pub struct Film(Linear);

impl Film {
    pub fn new(scope: &mut Scope, width: usize) -> Self {
        Self(Linear::new(scope, width, 2 * width))
    }

    /// (1 + s) x + h. `x`: \[B, frames, d\]; `context`: \[B, d\], after its Mish
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        context: &G::Tensor,
    ) -> Result<G::Tensor> {
        let film = self.0.forward(g, context)?;
        g.modulate(x, &film, 1.0)
    }
}
