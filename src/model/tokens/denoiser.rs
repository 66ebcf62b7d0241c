//! The diffusion decoder: noisy motion and a signal to clean motion.

use std::sync::Arc;

use ndarray::Array2;

use super::TokensConfig;
use crate::model::graph::{Activation, Graph, Result};
use crate::model::layers::{Conv1d, Linear};
use crate::model::parameter::{Init, ParameterId, Role, Scope};
use crate::model::unet::time_table;

/// ε of every normalisation (MAR, `models/diffloss.py`).
const EPSILON: f64 = 1e-6;

/// f: predicts clean motion from noisy motion, step and signal.
#[derive(Clone, Debug)]
pub struct SignalDenoiser {
    table: Arc<Array2<f64>>,
    time: [Linear; 2],
    input: Linear,
    blocks: Vec<Block>,
    /// Scale and shift before the last layer.
    modulation: Linear,
    out: Linear,
}

/// h ← h + conv_k(SiLU(h)); h ← h + gate ⊙ MLP((1 + scale) LN(h) + shift).
///
/// The second is a block of MAR (Li et al., "Autoregressive Image Generation without Vector Quantization", NeurIPS
/// 2024), in which scale, shift and gate come of the signal of each frame.
#[derive(Clone, Debug)]
struct Block {
    conv: Conv1d,
    norm: [ParameterId; 2],
    modulation: Linear,
    mlp: [Linear; 2],
    width: usize,
}

impl Block {
    fn new(scope: &mut Scope, config: &TokensConfig) -> Self {
        let d = config.width;
        let mut norm = scope.at("norm");
        let norm = [
            norm.parameter("weight", &[d], Init::Ones, Role::Vector),
            norm.parameter("bias", &[d], Init::Zeros, Role::Vector),
        ];
        Self {
            conv: Conv1d::new(&mut scope.at("conv"), d, d, config.taps, 1),
            norm,
            modulation: Linear::zeros(&mut scope.at("modulation"), d, 3 * d),
            mlp: [
                Linear::new(&mut scope.at("mlp.0"), d, d),
                Linear::new(&mut scope.at("mlp.1"), d, d),
            ],
            width: d,
        }
    }

    fn forward<G: Graph>(&self, g: &mut G, h: &G::Tensor, e: &G::Tensor) -> Result<G::Tensor> {
        let d = self.width;
        let r = g.activation(h, Activation::Silu)?;
        let r = self.conv.forward(g, &r)?;
        let h = g.add(h, &r)?;
        let m = self.modulation.forward(g, e)?;
        let (film, gate) = (g.channels(&m, 0..2 * d)?, g.channels(&m, 2 * d..3 * d)?);
        let r = g.layer_norm(&h, Some(self.norm), EPSILON)?;
        let r = g.modulate(&r, &film, 1.0)?;
        let r = self.mlp[0].forward(g, &r)?;
        let r = g.activation(&r, Activation::Silu)?;
        let r = self.mlp[1].forward(g, &r)?;
        let r = g.mul(&gate, &r)?;
        g.add(&h, &r)
    }
}

impl SignalDenoiser {
    /// Makes the network as a part of another.
    pub fn within(root: &mut Scope, config: &TokensConfig) -> Self {
        let d = config.width;
        Self {
            table: Arc::new(time_table(config.n_steps, d)),
            time: [
                Linear::new(&mut root.at("time.0"), d, d),
                Linear::new(&mut root.at("time.1"), d, d),
            ],
            input: Linear::new(&mut root.at("input"), config.motion_dim, d),
            blocks: (0..config.blocks)
                .map(|i| Block::new(&mut root.at(format!("blocks.{i}")), config))
                .collect(),
            modulation: Linear::zeros(&mut root.at("modulation"), d, 2 * d),
            out: Linear::zeros(&mut root.at("out"), d, config.motion_dim),
        }
    }

    /// Predicts clean motion; a fresh network predicts zero, whose modulations all begin at zero (MAR).
    ///
    /// e = t_emb + s, and SiLU(e) modulates every frame of every block.
    ///
    /// # Shapes
    /// - `x`: noisy motion, normalised, \[batch, T, motion_dim\]; `t`: steps, \[batch\], whole numbers in 0..n_steps
    /// - `s`: the signal, \[batch, T, d\]
    /// - returns \[batch, T, motion_dim\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        t: &G::Tensor,
        s: &G::Tensor,
    ) -> Result<G::Tensor> {
        let t = g.gather(&self.table, t)?;
        let t = self.time[0].forward(g, &t)?;
        let t = g.activation(&t, Activation::Silu)?;
        let t = self.time[1].forward(g, &t)?;
        let e = g.add_to_frames(s, &t)?;
        let e = g.activation(&e, Activation::Silu)?;
        let mut h = self.input.forward(g, x)?;
        for block in &self.blocks {
            h = block.forward(g, &h, &e)?;
        }
        let film = self.modulation.forward(g, &e)?;
        let h = g.layer_norm(&h, None, EPSILON)?;
        let h = g.modulate(&h, &film, 1.0)?;
        self.out.forward(g, &h)
    }
}
