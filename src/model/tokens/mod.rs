//! A tokenizer of motion: frames to tokens, and tokens back to frames by diffusion (MoTok).
//!
//! Gu et al., arXiv 2603.19227, 2026, section 3.1. An encoder E makes a latent of every ρ frames; a codebook replaces it
//! by the nearest of K rows, whose number is the token; a decoder D makes a signal for each frame of the rows, of which
//! a linear layer drafts motion; a denoiser f predicts what is missing to clean motion from noisy motion and that signal. Tokens keep what is danced, and the diffusion
//! the fine detail. A [`Planner`] says which tokens go with a piece of music.

mod coder;
mod config;
mod denoiser;
mod planner;

pub use self::coder::{Encoder, SignalDecoder};
pub use self::config::TokensConfig;
pub use self::denoiser::SignalDenoiser;
pub use self::planner::{
    CONSTRAINT_DIM, ConditionInputs, KeysAndValues, PlanConditions, Planner, PlannerConfig,
    PlannerInputs, PlannerKind, PlannerStep, PlannerStepInputs, PoseConstraint,
};
use super::graph::{Graph, Result};
use super::layers::Linear;
use super::parameter::{Init, ParameterId, ParameterList, Role, Scope};

/// The networks and the codebook; see the module.
#[derive(Clone, Debug)]
pub struct Tokenizer {
    encoder: Encoder,
    codebook: ParameterId,
    decoder: SignalDecoder,
    draft: Option<Linear>,
    denoiser: SignalDenoiser,
}

/// What a tokenizer says of motion.
pub struct Quantized<T> {
    /// h, \[batch, N, d\].
    pub latents: T,
    /// z, the tokens, whole numbers in 0..K, \[batch, N\].
    pub tokens: T,
    /// q, the rows of the codebook, without a gradient, \[batch, N, d\].
    pub codes: T,
}

impl Tokenizer {
    /// Makes the networks and the list of their parameters.
    pub fn new(config: &TokensConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let mut root = Scope::root(&mut list);
        let deviation = 1.0 / (config.width as f64).sqrt();
        let tokenizer = Self {
            encoder: Encoder::within(&mut root.at("encoder"), &config.into()),
            // Training begins with latents of its first batch instead.
            codebook: root.parameter(
                "codebook",
                &[config.codes, config.width],
                Init::Normal { deviation },
                Role::Code,
            ),
            decoder: SignalDecoder::within(&mut root.at("decoder"), config),
            draft: config
                .draft
                .then(|| Linear::new(&mut root.at("draft"), config.width, config.motion_dim)),
            denoiser: SignalDenoiser::within(&mut root.at("denoiser"), config),
        };
        (tokenizer, list)
    }

    /// Returns the codebook, \[K, d\].
    pub fn codebook(&self) -> ParameterId {
        self.codebook
    }

    /// h = E(x), z_n = argmin_k ‖h_n − c_k‖², q_n = c_{z_n}.
    ///
    /// `x`: clean motion, normalised, \[batch, T, motion_dim\]; N = ⌈T / ρ⌉
    pub fn quantize<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<Quantized<G::Tensor>> {
        let latents = self.encoder.forward(g, x)?;
        let tokens = g.nearest_row(&latents, self.codebook)?;
        let codes = self.codes(g, &tokens)?;
        Ok(Quantized { latents, tokens, codes })
    }

    /// z of [`Tokenizer::quantize`] alone. \[batch, T, motion_dim\] → \[batch, N\]
    pub fn tokens<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        let latents = self.encoder.forward(g, x)?;
        g.nearest_row(&latents, self.codebook)
    }

    /// Returns the rows of the codebook that tokens name: \[batch, N\] → \[batch, N, d\].
    pub fn codes<G: Graph>(&self, g: &mut G, tokens: &G::Tensor) -> Result<G::Tensor> {
        g.embedding(self.codebook, tokens)
    }

    /// s = D(q), a signal for each frame of `like`.
    ///
    /// \[batch, N, d\], like \[batch, T, …\] → \[batch, T, d\]
    pub fn signal<G: Graph>(
        &self,
        g: &mut G,
        q: &G::Tensor,
        like: &G::Tensor,
    ) -> Result<G::Tensor> {
        self.decoder.forward(g, q, like)
    }

    /// s = D(q) for all frames that the tokens stand for. \[batch, N, d\] → \[batch, ρ N, d\]
    pub fn whole_signal<G: Graph>(&self, g: &mut G, q: &G::Tensor) -> Result<G::Tensor> {
        self.decoder.whole(g, q)
    }

    /// x̃ = W s + b, the motion that the signal alone gives; none of a network without the layer.
    ///
    /// Deviation: the paper's signal is seen by the denoiser alone. A channel that changes slowly, such as a place, shows
    /// through noise of nearly every step, so that tokens learn little of it there; the draft must be made of tokens
    /// alone. With its loss it is the plain convolutional decoder of the paper's ablation (section 4.4).
    ///
    /// \[batch, T, d\] → \[batch, T, motion_dim\]
    pub fn draft<G: Graph>(&self, g: &mut G, s: &G::Tensor) -> Result<Option<G::Tensor>> {
        self.draft.as_ref().map(|draft| draft.forward(g, s)).transpose()
    }

    /// x̂0 = x̃ + f(x_t, t, s), without a draft f alone; see `SignalDenoiser::forward`.
    pub fn denoise<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        t: &G::Tensor,
        s: &G::Tensor,
    ) -> Result<G::Tensor> {
        let change = self.denoiser.forward(g, x, t, s)?;
        match self.draft(g, s)? {
            Some(draft) => g.add(&draft, &change),
            None => Ok(change),
        }
    }
}

#[cfg(test)]
mod tests;
