//! The decoder from a sampled latent to the columns of motion.

mod fusion;

use serde::{Deserialize, Serialize};

use crate::motion::postprocess::FusionVariances;
use crate::motion::{BODY, ChannelLimits, ColumnRole, Columns, Layout, MOTION_DIM};

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
    layout: Layout,
    heads: Vec<(Columns, Linear)>,
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
        Self::of_layout(root, config, BODY)
    }

    /// Makes the decoder of any layout, a head for each of its groups.
    ///
    /// # Panics
    /// When poses are to be fused and the layout lacks one of their derivatives.
    pub fn of_layout(root: &mut Scope, config: &DecoderConfig, layout: Layout) -> Self {
        let input_proj =
            Linear::new(&mut root.at("input_proj"), config.input_dim, config.hidden_dim);
        let blocks = (0..config.n_blocks)
            .map(|i| Block::new(&mut root.at(format!("blocks.{i}")), config))
            .collect();
        let heads = layout.groups().map(|columns| {
            let mut scope = root.at(format!("{}_head", columns.group.name));
            (columns, Linear::new(&mut scope, config.hidden_dim, columns.width()))
        });
        let heads = heads.collect();
        let fusion = config.fusion.as_ref().map(PoseFusion::new);
        let is_whole = layout.body().derived().count() == 3;
        assert!(is_whole || fusion.is_none(), "fusion needs every derivative of the poses");
        Self { input_proj, blocks, layout, heads, limits: config.limits, fusion }
    }

    /// Decodes a latent.
    ///
    /// Vectors (velocity, acceleration, angular velocity) are limit · tanh, turns have unit norm, phases are
    /// sigmoids; places and free columns are as they come. With fusion, velocity, acceleration and angular velocity
    /// are then those of the fused poses, which no tanh holds.
    ///
    /// # Shapes
    /// `latent`: \[batch, frames, input_dim\] → \[batch, frames, columns\]
    pub fn forward<G: Graph>(&self, g: &mut G, latent: &G::Tensor) -> Result<G::Tensor> {
        let mut h = self.input_proj.forward(g, latent)?;
        for block in &self.blocks {
            h = block.forward(g, &h)?;
        }
        let mut parts = Vec::with_capacity(self.heads.len());
        for (columns, head) in &self.heads {
            let x = head.forward(g, &h)?;
            parts.push(match columns.group.role {
                ColumnRole::Place | ColumnRole::Free => x,
                ColumnRole::Vector => {
                    let (_, limit) = self.limits.of(columns.group);
                    let bounded = g.activation(&x, Activation::Tanh)?;
                    g.scale(&bounded, f64::from(limit))?
                }
                ColumnRole::Turn => g.normalize(&x, QUATERNION_EPSILON)?,
                ColumnRole::Phase => g.activation(&x, Activation::Sigmoid)?,
            });
        }
        if let Some(fusion) = &self.fusion {
            let places = self.kinematic_heads();
            let [position, velocity, acceleration, quaternion, angular_velocity] =
                places.map(|i| parts[i].clone());
            let decoded =
                Kinematics { position, velocity, acceleration, quaternion, angular_velocity };
            let fused = fusion.forward(g, &decoded)?;
            let Kinematics { position, velocity, acceleration, quaternion, angular_velocity } =
                fused;
            let fused = [position, velocity, acceleration, quaternion, angular_velocity];
            for (i, fused) in places.into_iter().zip(fused) {
                parts[i] = fused;
            }
        }
        let parts: Vec<_> = parts.iter().collect();
        g.concat(&parts)
    }

    /// Returns which heads say position, velocity, acceleration, orientation and angular velocity.
    fn kinematic_heads(&self) -> [usize; 5] {
        let body = self.layout.body();
        let groups = [
            Some(body.position),
            body.velocity,
            body.acceleration,
            Some(body.orientation),
            body.angular_velocity,
        ];
        groups.map(|wanted| {
            let is_wanted = |(columns, _): &(Columns, Linear)| Some(*columns) == wanted;
            self.heads.iter().position(is_wanted).expect("invariant: fusion has every derivative")
        })
    }
}
