//! The convolutions between frames and tokens.
//!
//! Those of MoMask (Guo et al., CVPR 2024, `models/vq/encdec.py` and `resnet.py`), in which the paper of the diffusion
//! decoder leaves widths and depths open; without the dropout of their residual blocks.

use super::TokensConfig;
use crate::model::graph::{Activation, Convolution, Graph, Result};
use crate::model::layers::Conv1d;
use crate::model::parameter::Scope;

/// Ratio of the dilations of a residual block and of the one behind it.
const DILATION_GROWTH: usize = 3;

/// x + conv₁(ReLU(conv₃(ReLU(x)))), the first with a dilation.
#[derive(Clone, Debug)]
struct ResidualBlock {
    wide: Conv1d,
    point: Conv1d,
}

impl ResidualBlock {
    fn new(scope: &mut Scope, channels: usize, dilation: usize) -> Self {
        let wide = Convolution { taps: 3, stride: 1, padding: dilation, dilation };
        Self {
            wide: Conv1d::stepping(&mut scope.at("wide"), channels, channels, wide),
            point: Conv1d::new(&mut scope.at("point"), channels, channels, 1, 1),
        }
    }

    fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        let h = g.activation(x, Activation::Relu)?;
        let h = self.wide.forward(g, &h)?;
        let h = g.activation(&h, Activation::Relu)?;
        let h = self.point.forward(g, &h)?;
        g.add(x, &h)
    }
}

/// Residual blocks, the one that sees farthest first.
fn residual_blocks(scope: &mut Scope, channels: usize, depth: usize) -> Vec<ResidualBlock> {
    let dilations = (0..depth).rev().map(|i| DILATION_GROWTH.pow(i as u32));
    dilations
        .enumerate()
        .map(|(i, dilation)| {
            ResidualBlock::new(&mut scope.at(format!("res.{i}")), channels, dilation)
        })
        .collect()
}

/// A change of the number of frames, and the residual blocks beside it.
#[derive(Clone, Debug)]
struct Level {
    conv: Conv1d,
    res: Vec<ResidualBlock>,
}

/// The sizes of an [`Encoder`].
#[derive(Clone, Debug, PartialEq)]
pub struct EncoderConfig {
    /// Channels of a frame.
    pub inputs: usize,
    /// Channels of a latent.
    pub outputs: usize,
    /// Channels in between.
    pub conv_width: usize,
    /// Residual blocks of a level.
    pub depth: usize,
    /// ρ: frames that a latent stands for, a power of two.
    pub frames_per_token: usize,
}

impl From<&TokensConfig> for EncoderConfig {
    fn from(config: &TokensConfig) -> Self {
        Self {
            inputs: config.motion_dim,
            outputs: config.width,
            conv_width: config.conv_width,
            depth: config.depth,
            frames_per_token: config.frames_per_token,
        }
    }
}

/// E: frames to latents, one for ρ of them; of motion, or of the music that conditions a planner.
#[derive(Clone, Debug)]
pub struct Encoder {
    first: Conv1d,
    levels: Vec<Level>,
    last: Conv1d,
    frames_per_token: usize,
}

impl Encoder {
    /// Makes the network as a part of another.
    pub fn within(root: &mut Scope, config: &EncoderConfig) -> Self {
        let c = config.conv_width;
        let n_levels = config.frames_per_token.trailing_zeros();
        let halving = Convolution { taps: 4, stride: 2, padding: 1, dilation: 1 };
        Self {
            first: Conv1d::new(&mut root.at("first"), config.inputs, c, 3, 1),
            levels: (0..n_levels)
                .map(|i| {
                    let mut scope = root.at(format!("levels.{i}"));
                    let conv = Conv1d::stepping(&mut scope.at("conv"), c, c, halving);
                    Level { conv, res: residual_blocks(&mut scope, c, config.depth) }
                })
                .collect(),
            last: Conv1d::new(&mut root.at("last"), c, config.outputs, 3, 1),
            frames_per_token: config.frames_per_token,
        }
    }

    /// Conv₃ → ReLU → levels of {Conv₄ of stride 2, residual blocks} → Conv₃; the last frame is held to whole tokens.
    ///
    /// \[batch, T, inputs\] → \[batch, ⌈T / ρ⌉, outputs\]
    pub fn forward<G: Graph>(&self, g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
        let x = g.hold_frames(x, self.frames_per_token)?;
        let h = self.first.forward(g, &x)?;
        let mut h = g.activation(&h, Activation::Relu)?;
        for level in &self.levels {
            h = level.conv.forward(g, &h)?;
            for block in &level.res {
                h = block.forward(g, &h)?;
            }
        }
        self.last.forward(g, &h)
    }
}

/// D: codes to a signal for each frame.
#[derive(Clone, Debug)]
pub struct SignalDecoder {
    first: Conv1d,
    levels: Vec<Level>,
    middle: Conv1d,
    last: Conv1d,
}

impl SignalDecoder {
    /// Makes the network as a part of another.
    pub fn within(root: &mut Scope, config: &TokensConfig) -> Self {
        let c = config.conv_width;
        let mut levels = Vec::new();
        let first = Conv1d::new(&mut root.at("first"), config.width, c, 3, 1);
        for i in 0..config.n_levels() {
            let mut scope = root.at(format!("levels.{i}"));
            let res = residual_blocks(&mut scope, c, config.depth);
            levels.push(Level { conv: Conv1d::new(&mut scope.at("conv"), c, c, 3, 1), res });
        }
        Self {
            first,
            levels,
            middle: Conv1d::new(&mut root.at("middle"), c, c, 3, 1),
            last: Conv1d::new(&mut root.at("last"), c, config.width, 3, 1),
        }
    }

    /// Conv₃ → ReLU → levels of {residual blocks, each frame twice, Conv₃} → Conv₃ → ReLU → Conv₃, cropped to the
    /// frames of `like`.
    ///
    /// \[batch, ⌈T / ρ⌉, d\], like \[batch, T, …\] → \[batch, T, d\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        q: &G::Tensor,
        like: &G::Tensor,
    ) -> Result<G::Tensor> {
        let s = self.whole(g, q)?;
        g.crop_frames(&s, like)
    }

    /// The same for all frames that the tokens stand for. \[batch, N, d\] → \[batch, ρ N, d\]
    pub fn whole<G: Graph>(&self, g: &mut G, q: &G::Tensor) -> Result<G::Tensor> {
        let h = self.first.forward(g, q)?;
        let mut h = g.activation(&h, Activation::Relu)?;
        for level in &self.levels {
            for block in &level.res {
                h = block.forward(g, &h)?;
            }
            h = g.upsample(&h, 2)?;
            h = level.conv.forward(g, &h)?;
        }
        let h = self.middle.forward(g, &h)?;
        let h = g.activation(&h, Activation::Relu)?;
        self.last.forward(g, &h)
    }
}
