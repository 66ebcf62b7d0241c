//! The sizes of the networks of a group, and the sizes with names.

use serde::{Deserialize, Serialize};

use crate::audio::FEATURE_DIM;
use crate::model::condition::ConditionConfig;
use crate::model::unet::{ConfigError, MAX_BLOCKS, MAX_TABLE_VALUES, MAX_WIDTH, Preset};
use crate::motion::MOTION_DIM;
use crate::motion::group::MAX_DANCERS;

/// Layers of the mapping from noise and music to the group embedding.
pub const MAPPING_LAYERS: usize = 8;

/// The sizes of a [`GroupDenoiser`](super::GroupDenoiser) and its [`GroupScore`](super::GroupScore).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupConfig {
    /// Channels of motion.
    pub motion_dim: usize,
    /// Channels of every token.
    pub width: usize,
    pub heads: usize,
    /// Width of feed-forward layers, in units of `width`.
    pub expansion: usize,
    /// Layers of the music encoder.
    pub music_layers: usize,
    /// Blocks of the denoiser: local, global, modulation.
    pub blocks: usize,
    /// Layers of the score network: local, global.
    pub score_layers: usize,
    /// Frames that are one token of the score network; 1 in the reference.
    pub score_patch_frames: usize,
    /// Features of a frame of music.
    pub audio_cond_dim: usize,
    /// Whether the clock of the music is given beside its features.
    pub clock: bool,
    /// Whether the music is also added to the frames of its time; the reference has attention alone.
    pub add_audio: bool,
    /// Most dancers of a group in training; larger groups take the embedding of this number.
    pub max_dancers: usize,
    pub dropout: f64,
    /// Steps of the diffusion.
    pub n_steps: usize,
}

impl GroupConfig {
    /// Returns the sizes of a preset; none of one that this family does not have.
    pub fn of(preset: Preset) -> Option<Self> {
        let (width, heads, music_layers, blocks, score_layers, score_patch_frames) = match preset {
            Preset::Tiny => (48, 4, 1, 2, 1, 4),
            Preset::Small => (112, 4, 2, 3, 1, 4),
            Preset::Base => (512, 8, 2, 5, 2, 1),
            Preset::Large => return None,
        };
        Some(Self {
            motion_dim: MOTION_DIM,
            width,
            heads,
            expansion: 2,
            music_layers,
            blocks,
            score_layers,
            score_patch_frames,
            audio_cond_dim: FEATURE_DIM,
            clock: true,
            add_audio: true,
            max_dancers: 5,
            dropout: 0.1,
            n_steps: 1000,
        })
    }

    /// Returns the condition that the networks take: features, and the clock.
    pub fn condition(&self) -> ConditionConfig {
        ConditionConfig { audio_cond_dim: self.audio_cond_dim, clock: self.clock }
    }

    /// Returns the row of the table of numbers of dancers for a group.
    pub fn embedded_number(&self, n_dancers: usize) -> usize {
        n_dancers.clamp(1, self.max_dancers) - 1
    }

    /// Refuses sizes of which no network can be made.
    ///
    /// # Errors
    /// One sentence: the number, what it must be, and why.
    pub fn check(&self) -> Result<(), ConfigError> {
        let refuse = |what: String| Err(ConfigError(what));
        for (name, value, most) in [
            ("motion_dim", self.motion_dim, MAX_WIDTH),
            ("width", self.width, MAX_WIDTH),
            ("heads", self.heads, MAX_WIDTH),
            ("expansion", self.expansion, MAX_BLOCKS),
            ("music_layers", self.music_layers, MAX_BLOCKS),
            ("blocks", self.blocks, MAX_BLOCKS),
            ("score_layers", self.score_layers, MAX_BLOCKS),
            ("score_patch_frames", self.score_patch_frames, MAX_BLOCKS),
            ("audio_cond_dim", self.audio_cond_dim, MAX_WIDTH),
            ("max_dancers", self.max_dancers, MAX_DANCERS),
            ("n_steps", self.n_steps, MAX_TABLE_VALUES),
        ] {
            if value == 0 {
                return refuse(format!("{name} is 0; it must be at least 1"));
            }
            if value > most {
                return refuse(format!("{name} is {value}; it must be at most {most}"));
            }
        }
        // Both are bounded by now, so that the product cannot overflow.
        let n_table = self.n_steps * self.width;
        if n_table > MAX_TABLE_VALUES {
            return refuse(format!(
                "n_steps {} and width {} make a table of {n_table} values; at most {MAX_TABLE_VALUES} are kept, so \
                 lower one of the two",
                self.n_steps, self.width
            ));
        }
        if !self.width.is_multiple_of(2 * self.heads) {
            return refuse(format!(
                "a width of {} does not divide into pairs of {} heads; change heads or the width",
                self.width, self.heads
            ));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse(format!("dropout is {}; it must lie in [0, 1)", self.dropout));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tiny() -> GroupConfig {
        GroupConfig::of(Preset::Tiny).expect("a preset of the family")
    }

    #[test]
    fn presets_are_sound_and_the_largest_is_none_of_a_group() {
        for preset in [Preset::Tiny, Preset::Small, Preset::Base] {
            let config = GroupConfig::of(preset).expect("a preset of the family");
            assert_eq!(config.check(), Ok(()), "{}", preset.name());
        }
        assert_eq!(GroupConfig::of(Preset::Large), None);
    }

    #[test]
    fn sizes_of_which_no_network_can_be_made_are_refused() {
        let refusal = |change: fn(&mut GroupConfig)| {
            let mut config = tiny();
            change(&mut config);
            config.check().expect_err("unsound").to_string()
        };
        assert_eq!(refusal(|c| c.blocks = 0), "blocks is 0; it must be at least 1");
        assert_eq!(refusal(|c| c.max_dancers = 17), "max_dancers is 17; it must be at most 16");
        assert_eq!(refusal(|c| c.width = 16_392), "width is 16392; it must be at most 16384");
        assert_eq!(
            refusal(|c| c.n_steps = usize::MAX),
            format!("n_steps is {}; it must be at most 33554432", usize::MAX)
        );
        assert_eq!(
            refusal(|c| c.heads = 7),
            "a width of 48 does not divide into pairs of 7 heads; change heads or the width"
        );
        assert_eq!(
            refusal(|c| (c.n_steps, c.width) = (1 << 20, 64)),
            "n_steps 1048576 and width 64 make a table of 67108864 values; at most 33554432 are kept, so lower one \
             of the two"
        );
        assert_eq!(refusal(|c| c.dropout = -0.1), "dropout is -0.1; it must lie in [0, 1)");
    }

    #[test]
    fn larger_groups_take_the_embedding_of_the_largest_that_was_trained() {
        let config = tiny();
        assert_eq!([1, 2, 5, 6, 16].map(|n| config.embedded_number(n)), [0, 1, 4, 4, 4]);
    }
}
