//! A block of the denoiser: each dancer and the music, all dancers, the group.

use super::GroupConfig;
use super::layers::{CrossAttention, FeedForward, Film, GlobalLayer, Memory, SelfAttention};
use crate::model::graph::{Graph, Result};
use crate::model::layers::Linear;
use crate::model::parameter::Scope;

/// ε of the variances of group modulation.
const EPSILON: f64 = 1e-8;

/// Local decoder layer → global attention → group modulation.
///
/// h̃ = S(w) ⊙ (h − μ) / √(σ² + ε) + b(w), μ and σ² of each channel over all frames of all dancers of the group
/// (paper, eq. 7); \[S, b\] = linear(w), without the 1 of FiLM.
#[derive(Clone, Debug)]
pub struct GroupBlock {
    self_attention: SelfAttention,
    cross_attention: CrossAttention,
    feed_forward: FeedForward,
    films: [Film; 3],
    global: GlobalLayer,
    modulation: Linear,
}

impl GroupBlock {
    pub fn new(scope: &mut Scope, config: &GroupConfig) -> Self {
        let d = config.width;
        Self {
            self_attention: SelfAttention::new(&mut scope.at("attn"), config),
            cross_attention: CrossAttention::new(&mut scope.at("cross"), config),
            feed_forward: FeedForward::new(&mut scope.at("ff"), config),
            films: [0, 1, 2].map(|i| Film::new(&mut scope.at(format!("films.{i}")), d)),
            global: GlobalLayer::new(&mut scope.at("global"), config),
            modulation: Linear::new(&mut scope.at("modulation"), d, 2 * d),
        }
    }

    /// # Shapes
    /// - `h`: \[B, N T, d\]; `token`: \[B, d\] or \[B, 1, d\], of the number of dancers; `w`: \[B, d\]
    /// - `x`: the motion with its dancers in the batch, \[B N, T, …\]; `context`: \[B, d\]
    /// - `masks`: 1 for dancers of the group, 0 for empty places, \[B, N T\], and the same with two tokens before them
    /// - returns \[B, N T, d\] and the token, \[B, 1, d\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        h: &G::Tensor,
        token: &G::Tensor,
        w: &G::Tensor,
        (x, context, memory): (&G::Tensor, &G::Tensor, &Memory<G::Tensor>),
        masks: Option<(&G::Tensor, &G::Tensor)>,
    ) -> Result<(G::Tensor, G::Tensor)> {
        let y = self.self_attention.local(g, h, x)?;
        let y = self.films[0].forward(g, &y, context)?;
        let h = g.add(h, &y)?;
        let y = self.cross_attention.forward(g, &h, x, memory)?;
        let y = self.films[1].forward(g, &y, context)?;
        let h = g.add(&h, &y)?;
        let y = self.feed_forward.forward(g, &h)?;
        let y = self.films[2].forward(g, &y, context)?;
        let h = g.add(&h, &y)?;

        let tokens = g.concat_frames(&[token, w])?;
        let all =
            self.global.forward(g, &tokens, &h, x, masks.map(|(_, with_tokens)| with_tokens))?;
        let token = g.frames(&all, 0, Some(1))?;
        let h = g.frames(&all, 2, None)?;

        let h = g.normalize_frames(&h, masks.map(|(mask, _)| mask), EPSILON)?;
        let film = self.modulation.forward(g, w)?;
        let h = g.modulate(&h, &film, 0.0)?;
        Ok((h, token))
    }
}
