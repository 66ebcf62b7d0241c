//! The decoder from a sampled latent to the 25 channels of motion.

mod fusion;

use serde::{Deserialize, Serialize};

use crate::motion::postprocess::FusionVariances;
use crate::motion::{Channel, ChannelLimits, MOTION_DIM};

use super::graph::{Activation, Graph, Result};
use super::layers::{LayerNorm, Linear};
use super::parameter::{ParameterList, Scope};
use super::unet::{ConfigError, MAX_BLOCKS, MAX_WIDTH};
use fusion::{Kinematics, PoseFusion};

/// Below this norm a quaternion is divided by it instead (PyTorch's `normalize`).
const QUATERNION_EPSILON: f64 = 1e-12;

/// The sizes of a [`MotionDecoder`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DecoderConfig {
    /// Channels of the latent.
    pub input_dim: usize,
    pub hidden_dim: usize,
    pub n_blocks: usize,
    /// Width of a block's inner layer, in units of `hidden_dim`.
    pub expansion: usize,
    pub dropout: f64,
    /// The ranges that velocities and accelerations are kept within.
    pub limits: ChannelLimits,
    /// Errors that the heads leave, by which poses and derivatives are brought together in the last layer; without
    /// them each head speaks for itself, as in training. Measured by `export`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fusion: Option<FusionVariances>,
}

impl Default for DecoderConfig {
    /// 2.12 M parameters: the reference's hidden 256 with four blocks.
    fn default() -> Self {
        Self {
            input_dim: MOTION_DIM,
            hidden_dim: 256,
            n_blocks: 4,
            expansion: 4,
            dropout: 0.1,
            limits: ChannelLimits::Wide,
            fusion: None,
        }
    }
}

impl DecoderConfig {
    /// Refuses sizes of which no network can be made.
    ///
    /// # Errors
    /// One sentence: the number and what it must be.
    pub fn check(&self) -> Result<(), ConfigError> {
        for (name, value, least, most) in [
            ("input_dim", self.input_dim, 1, MAX_WIDTH),
            ("hidden_dim", self.hidden_dim, 1, MAX_WIDTH),
            ("n_blocks", self.n_blocks, 0, MAX_BLOCKS),
            ("expansion", self.expansion, 1, MAX_EXPANSION),
        ] {
            if !(least..=most).contains(&value) {
                let rule =
                    format!("{name} of the decoder is {value}; it must be {least} to {most}");
                return Err(ConfigError(rule));
            }
        }
        if !(0.0..1.0).contains(&self.dropout) {
            let rule = "it must lie in [0, 1)";
            return Err(ConfigError(format!("dropout of the decoder is {}; {rule}", self.dropout)));
        }
        if let Some((name, variance)) = self.fusion.as_ref().and_then(FusionVariances::unsound) {
            let rule = "it must be above 0";
            return Err(ConfigError(format!("{name} of the decoder is {variance}; {rule}")));
        }
        Ok(())
    }
}

/// Widest inner layer of a block, in units of its width.
const MAX_EXPANSION: usize = 16;

/// Maps a latent, frame by frame, to motion that keeps its channels' constraints.
#[derive(Clone, Debug)]
pub struct MotionDecoder {
    input_proj: Linear,
    blocks: Vec<Block>,
    heads: Vec<(Channel, Linear)>,
    limits: ChannelLimits,
    fusion: Option<PoseFusion>,
}

/// x + W₂ GELU(W₁ LN(x)), dropout after each of the two.
#[derive(Clone, Debug)]
struct Block {
    norm: LayerNorm,
    inner: Linear,
    outer: Linear,
    dropout: f64,
}

impl Block {
    fn new(scope: &mut Scope, config: &DecoderConfig) -> Self {
        let (hidden, inner) = (config.hidden_dim, config.hidden_dim * config.expansion);
        let mut layers = scope.at("layers");
        Self {
            norm: LayerNorm::new(&mut layers.at("0"), hidden),
            inner: Linear::new(&mut layers.at("1"), hidden, inner),
            outer: Linear::new(&mut layers.at("4"), inner, hidden),
            dropout: config.dropout,
        }
    }

    fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        let h = self.norm.forward(g, x)?;
        let h = self.inner.forward(g, &h)?;
        let h = g.activation(&h, Activation::Gelu)?;
        let h = g.dropout(&h, self.dropout)?;
        let h = self.outer.forward(g, &h)?;
        let h = g.dropout(&h, self.dropout)?;
        g.add(x, &h)
    }
}

impl MotionDecoder {
    /// Makes the decoder and the list of its parameters.
    pub fn new(config: &DecoderConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let decoder = Self::within(&mut Scope::root(&mut list), config);
        (decoder, list)
    }

    /// Makes the decoder as a part of another network.
    pub fn within(root: &mut Scope, config: &DecoderConfig) -> Self {
        let input_proj =
            Linear::new(&mut root.at("input_proj"), config.input_dim, config.hidden_dim);
        let blocks = (0..config.n_blocks)
            .map(|i| Block::new(&mut root.at(format!("blocks.{i}")), config))
            .collect();
        let heads = Channel::ALL.map(|channel| {
            let mut scope = root.at(format!("{}_head", channel.name()));
            (channel, Linear::new(&mut scope, config.hidden_dim, channel.width()))
        });
        let fusion = config.fusion.as_ref().map(PoseFusion::new);
        Self { input_proj, blocks, heads: heads.into(), limits: config.limits, fusion }
    }

    /// Decodes a latent.
    ///
    /// Velocity, acceleration and angular velocity are limit · tanh, the quaternion has unit norm,
    /// the phase is a sigmoid; position and style are free. With fusion, velocity, acceleration and angular velocity
    /// are then those of the fused poses, which no tanh holds.
    ///
    /// # Shapes
    /// `latent`: \[batch, frames, input_dim\] → \[batch, frames, 25\]
    pub fn forward<G: Graph>(&self, g: &mut G, latent: &G::Tensor) -> Result<G::Tensor> {
        let mut h = self.input_proj.forward(g, latent)?;
        for block in &self.blocks {
            h = block.forward(g, &h)?;
        }
        let mut parts = Vec::with_capacity(self.heads.len());
        for (channel, head) in &self.heads {
            let x = head.forward(g, &h)?;
            parts.push(match channel {
                Channel::Position | Channel::Style => x,
                Channel::Velocity | Channel::Acceleration | Channel::AngularVelocity => {
                    let (_, limit) = self.limits.bounds(*channel);
                    let bounded = g.activation(&x, Activation::Tanh)?;
                    g.scale(&bounded, f64::from(limit))?
                }
                Channel::Quaternion => g.normalize(&x, QUATERNION_EPSILON)?,
                Channel::Phase => g.activation(&x, Activation::Sigmoid)?,
            });
        }
        if let Some(fusion) = &self.fusion {
            let [position, velocity, acceleration, quaternion, angular_velocity, ..] =
                parts.as_slice()
            else {
                unreachable!("invariant: a head for each channel of Channel::ALL, in its order")
            };
            let fused = fusion.forward(
                g,
                &Kinematics {
                    position: position.clone(),
                    velocity: velocity.clone(),
                    acceleration: acceleration.clone(),
                    quaternion: quaternion.clone(),
                    angular_velocity: angular_velocity.clone(),
                },
            )?;
            let Kinematics { position, velocity, acceleration, quaternion, angular_velocity } =
                fused;
            parts.splice(..5, [position, velocity, acceleration, quaternion, angular_velocity]);
        }
        let parts: Vec<_> = parts.iter().collect();
        g.concat(&parts)
    }
}
