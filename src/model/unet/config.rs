//! The sizes of a UNet, and the sizes with names.

use serde::{Deserialize, Serialize};

use crate::audio::FEATURE_DIM;
use crate::model::condition::ConditionConfig;
use crate::motion::MOTION_DIM;

/// The sizes of a [`UNet1D`](super::UNet1D).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// Whether the clock of the music (`motion::clock`) is given beside its features; networks of release 0.1
    /// have none.
    #[serde(default)]
    pub clock: bool,
    pub time_embed_dim: usize,
    pub context_dim: usize,
    /// Whether the music is added to the first level, frame by frame; the reference draws it without.
    pub add_audio: bool,
    /// Numbers of a style that is given as a condition; 0 for a network without.
    pub style_dim: usize,
    pub dropout: f64,
    /// Steps of the diffusion.
    pub n_steps: usize,
    /// Whether inner values of a level are computed again for its gradient instead of kept.
    pub use_checkpoint: bool,
}

/// A size with a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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

    /// Returns the sizes, as the reference draws them: without a clock.
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
            clock: false,
            time_embed_dim: dim,
            context_dim: dim,
            add_audio: true,
            style_dim: 0,
            dropout: 0.1,
            n_steps: 1000,
            use_checkpoint: false,
        }
    }
}

impl UNetConfig {
    /// Returns the numbers of a frame of the condition: features, then the clock.
    pub fn condition_dim(&self) -> usize {
        ConditionConfig::from(self).dim()
    }

    /// Returns the heads of attention at a width.
    pub fn heads(&self, width: usize) -> usize {
        self.num_head_channels.map_or(self.num_heads, |channels| width / channels)
    }

    /// Refuses sizes of which no network can be made.
    ///
    /// # Errors
    /// One sentence: the number, what it must be, and why.
    pub fn check(&self) -> Result<(), ConfigError> {
        let refuse = |what: String| Err(ConfigError(what));
        if self.widths.is_empty() || self.widths.contains(&0) {
            return refuse(format!(
                "widths {:?}: a network has at least one level, and each at least one channel",
                self.widths
            ));
        }
        if self.widths.len() > MAX_LEVELS {
            let n = self.widths.len();
            return refuse(format!(
                "widths: {n} levels halve the frames {} times; use at most {MAX_LEVELS}",
                n - 1
            ));
        }
        if let Some(width) = self.widths.iter().find(|&&width| width > MAX_WIDTH) {
            return refuse(format!("widths has {width}; use at most {MAX_WIDTH} channels"));
        }
        for (name, value, most) in [
            ("in_channels", self.in_channels, MAX_WIDTH),
            ("out_channels", self.out_channels, MAX_WIDTH),
            ("num_res_blocks", self.num_res_blocks, MAX_BLOCKS),
            ("num_heads", self.num_heads, MAX_WIDTH),
            ("num_head_channels", self.num_head_channels.unwrap_or(1), MAX_WIDTH),
            ("audio_cond_dim", self.audio_cond_dim, MAX_WIDTH),
            ("context_dim", self.context_dim, MAX_WIDTH),
            ("time_embed_dim", self.time_embed_dim, MAX_WIDTH),
            ("n_steps", self.n_steps, MAX_TABLE_VALUES),
        ] {
            if value == 0 && name != "time_embed_dim" {
                return refuse(format!("{name} is 0; it must be at least 1"));
            }
            if value > most {
                return refuse(format!("{name} is {value}; it must be at most {most}"));
            }
        }
        if self.style_dim > MAX_WIDTH {
            let value = self.style_dim;
            return refuse(format!("style_dim is {value}; it must be at most {MAX_WIDTH}"));
        }
        // Both are bounded by now, so that the product cannot overflow.
        if self.n_steps * self.time_embed_dim > MAX_TABLE_VALUES {
            return refuse(format!(
                "n_steps {} and time_embed_dim {} make a table of {} values; at most \
                 {MAX_TABLE_VALUES} are kept, so lower one of the two",
                self.n_steps,
                self.time_embed_dim,
                self.n_steps * self.time_embed_dim
            ));
        }
        if self.time_embed_dim == 0 || !self.time_embed_dim.is_multiple_of(2) {
            return refuse(format!(
                "time_embed_dim is {}; it must be even and positive: half sines, half cosines",
                self.time_embed_dim
            ));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse(format!("dropout is {}; it must lie in [0, 1)", self.dropout));
        }
        if let Some(level) = self.attention_levels.iter().find(|&&l| l >= self.widths.len()) {
            return refuse(format!(
                "attention_levels has level {level}, the network levels 0 to {}; leave it out",
                self.widths.len() - 1
            ));
        }
        // The bottleneck attends whatever the levels do.
        let last = self.widths.len() - 1;
        let decoder = (1..last).filter(|level| self.attention_levels.contains(level));
        let outputs = decoder.map(|level| self.widths[level - 1]);
        let levels = self.attention_levels.iter().map(|&level| self.widths[level]);
        for width in levels.chain(outputs).chain([self.widths[last]]) {
            let heads = self.heads(width);
            if heads == 0 || !width.is_multiple_of(heads) {
                return refuse(format!(
                    "a width of {width} does not divide into {heads} heads of attention; change \
                     num_heads, num_head_channels or the width"
                ));
            }
            if self.num_head_channels.is_some_and(|channels| channels * heads != width) {
                return refuse(format!(
                    "a width of {width} does not divide into heads of {} channels; change \
                     num_head_channels or the width",
                    width / heads
                ));
            }
        }
        Ok(())
    }
}

/// More levels would need phrases of thousands of frames.
const MAX_LEVELS: usize = 10;
/// Channels that a layer may have, eight times those of the widest preset.
pub(in crate::model) const MAX_WIDTH: usize = 16_384;
/// Blocks that a level or a decoder may have.
pub(in crate::model) const MAX_BLOCKS: usize = 64;
/// Values of the table of steps, 256 MB in f64.
pub(in crate::model) const MAX_TABLE_VALUES: usize = 1 << 25;

/// Sizes of which no network can be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ConfigError(pub String);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_sound() {
        for preset in Preset::ALL {
            assert_eq!(preset.config().check(), Ok(()), "{}", preset.name());
        }
    }

    #[test]
    fn what_no_network_can_be_made_of_is_refused_in_a_sentence() {
        let refusal = |change: fn(&mut UNetConfig)| {
            let mut config = Preset::Tiny.config();
            change(&mut config);
            config.check().expect_err("unsound").to_string()
        };
        assert_eq!(
            refusal(|c| c.widths = vec![]),
            "widths []: a network has at least one level, and each at least one channel"
        );
        assert_eq!(
            refusal(|c| c.widths = vec![8; 11]),
            "widths: 11 levels halve the frames 10 times; use at most 10"
        );
        assert_eq!(refusal(|c| c.num_res_blocks = 0), "num_res_blocks is 0; it must be at least 1");
        assert_eq!(
            refusal(|c| c.time_embed_dim = 33),
            "time_embed_dim is 33; it must be even and positive: half sines, half cosines"
        );
        assert_eq!(refusal(|c| c.dropout = 1.0), "dropout is 1; it must lie in [0, 1)");
        assert_eq!(
            refusal(|c| c.attention_levels = vec![1, 3]),
            "attention_levels has level 3, the network levels 0 to 2; leave it out"
        );
        assert_eq!(
            refusal(|c| c.num_heads = 5),
            "a width of 48 does not divide into 5 heads of attention; change num_heads, \
             num_head_channels or the width"
        );
        assert_eq!(
            refusal(|c| c.num_head_channels = Some(0)),
            "num_head_channels is 0; it must be at least 1"
        );
        assert_eq!(
            refusal(|c| c.num_head_channels = Some(20)),
            "a width of 48 does not divide into heads of 24 channels; change num_head_channels or \
             the width"
        );
    }

    #[test]
    fn sizes_that_no_memory_holds_are_refused() {
        let refusal = |change: fn(&mut UNetConfig)| {
            let mut config = Preset::Tiny.config();
            change(&mut config);
            config.check().expect_err("too large").to_string()
        };
        assert_eq!(
            refusal(|c| c.widths[1] = usize::MAX),
            format!("widths has {}; use at most 16384 channels", usize::MAX)
        );
        assert_eq!(
            refusal(|c| c.num_res_blocks = 1_000_000_000),
            "num_res_blocks is 1000000000; it must be at most 64"
        );
        assert_eq!(
            refusal(|c| c.n_steps = usize::MAX),
            format!("n_steps is {}; it must be at most 33554432", usize::MAX)
        );
        assert_eq!(
            refusal(|c| c.n_steps = 2_000_000),
            "n_steps 2000000 and time_embed_dim 32 make a table of 64000000 values; at most \
             33554432 are kept, so lower one of the two"
        );
        assert_eq!(
            refusal(|c| c.style_dim = 20_001),
            "style_dim is 20001; it must be at most 16384"
        );
    }
}
