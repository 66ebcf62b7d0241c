//! The sizes of a UNet, and the sizes with names.

use crate::audio::FEATURE_DIM;
use crate::motion::MOTION_DIM;

/// The sizes of a [`UNet1D`](super::UNet1D).
#[derive(Clone, Debug, PartialEq)]
pub struct UNetConfig {
    /// Channels of the noisy motion.
    pub in_channels: usize,
    /// Channels of the prediction.
    pub out_channels: usize,
    /// Channels of each level; each has half the frames of the one above.
    pub widths: Vec<usize>,
    /// Residual blocks of a level; in the decoder one makes way for attention.
    pub num_res_blocks: usize,
    /// Levels that attend.
    pub attention_levels: Vec<usize>,
    /// Heads of attention, unless `num_head_channels` says how many channels a head has.
    pub num_heads: usize,
    pub num_head_channels: Option<usize>,
    /// Whether time scales and shifts the second norm of a block, or is added before it.
    pub use_scale_shift_norm: bool,
    /// Features of a frame of music.
    pub audio_cond_dim: usize,
    pub time_embed_dim: usize,
    pub context_dim: usize,
    /// Numbers of a style that is given as a condition; 0 for a network without.
    pub style_dim: usize,
    pub dropout: f64,
    /// Steps of the diffusion.
    pub n_steps: usize,
    /// Whether inner values of a level are computed again for its gradient instead of kept.
    pub use_checkpoint: bool,
}

/// A size with a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Preset {
    /// For tests.
    Tiny,
    /// For the demo.
    Small,
    /// The 116 M parameters that the reference states.
    Base,
    /// The configuration that the reference prints, which has 225 M.
    Large,
}

impl Preset {
    /// Every preset, by size.
    pub const ALL: [Self; 4] = [Self::Tiny, Self::Small, Self::Base, Self::Large];

    /// Returns the name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tiny => "tiny",
            Self::Small => "small",
            Self::Base => "base",
            Self::Large => "large",
        }
    }

    /// Returns the sizes.
    pub fn config(self) -> UNetConfig {
        let (widths, dim): (&[usize], _) = match self {
            Self::Tiny => (&[40, 48, 64], 32),
            Self::Small => (&[48, 96, 160, 192], 128),
            Self::Base => (&[256, 512, 1024, 1152], 256),
            Self::Large => (&[256, 512, 1024, 2048], 256),
        };
        UNetConfig {
            in_channels: MOTION_DIM,
            out_channels: MOTION_DIM,
            widths: widths.to_vec(),
            num_res_blocks: 2,
            attention_levels: (1..widths.len()).collect(),
            num_heads: if self == Self::Tiny { 4 } else { 8 },
            num_head_channels: None,
            use_scale_shift_norm: true,
            audio_cond_dim: FEATURE_DIM,
            time_embed_dim: dim,
            context_dim: dim,
            style_dim: 0,
            dropout: 0.1,
            n_steps: 1000,
            use_checkpoint: false,
        }
    }
}

impl UNetConfig {
    /// Returns the heads of attention at a width.
    pub fn heads(&self, width: usize) -> usize {
        self.num_head_channels.map_or(self.num_heads, |channels| width / channels)
    }
}
