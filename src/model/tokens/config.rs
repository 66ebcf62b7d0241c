//! The sizes of a tokenizer of motion, and the sizes with names.

use serde::{Deserialize, Serialize};

use crate::model::unet::{ConfigError, MAX_BLOCKS, MAX_TABLE_VALUES, MAX_WIDTH, Preset};
use crate::motion::MOTION_DIM;

/// Frames that a token may stand for, ρ.
const FRAMES_PER_TOKEN: [usize; 5] = [1, 2, 4, 8, 16];

/// The sizes of a [`Tokenizer`](super::Tokenizer).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensConfig {
    /// Channels of motion.
    pub motion_dim: usize,
    /// d: channels of a code, of the signal that is decoded from it, and of the denoiser.
    pub width: usize,
    /// Channels within the convolutional encoder and decoder.
    pub conv_width: usize,
    /// Residual blocks of a level of either; their dilations are 3^(depth − 1), …, 3, 1.
    pub depth: usize,
    /// K: rows of the codebook.
    pub codes: usize,
    /// ρ: frames that a token stands for.
    pub frames_per_token: usize,
    /// Blocks of the denoiser.
    pub blocks: usize,
    /// Frames that a convolution of the denoiser sees.
    pub taps: usize,
    /// Steps of the diffusion.
    pub n_steps: usize,
    /// Whether a linear layer drafts motion from the signal, to which the denoiser adds; networks of release 0.2 have none.
    #[serde(default)]
    pub draft: bool,
}

impl TokensConfig {
    /// Returns the sizes of a preset; none of one that this family does not have.
    pub fn of(preset: Preset) -> Option<Self> {
        let (width, conv_width, depth, codes, blocks) = match preset {
            Preset::Tiny => (48, 32, 2, 32, 2),
            Preset::Small => (128, 128, 3, 1024, 3),
            Preset::Base => (768, 512, 3, 1024, 4),
            Preset::Large => return None,
        };
        let frames_per_token = 4;
        Some(Self {
            motion_dim: MOTION_DIM,
            width,
            conv_width,
            depth,
            codes,
            frames_per_token,
            blocks,
            taps: Self::usual_taps(frames_per_token),
            n_steps: 1000,
            draft: true,
        })
    }

    /// Returns how many frames a convolution of the denoiser sees: fewer tokens need fewer neighbouring frames.
    pub fn usual_taps(frames_per_token: usize) -> usize {
        if frames_per_token <= 2 { 7 } else { 5 }
    }

    /// Returns how often frames are halved on the way to a token.
    pub fn n_levels(&self) -> usize {
        self.frames_per_token.trailing_zeros() as usize
    }

    /// Returns N, the tokens of so many frames; the last may stand for fewer.
    pub fn n_tokens(&self, n_frames: usize) -> usize {
        n_frames.div_ceil(self.frames_per_token)
    }

    /// Refuses sizes of which no network can be made.
    ///
    /// # Errors
    /// One sentence: the number, what it must be, and why.
    pub fn check(&self) -> Result<(), ConfigError> {
        let refuse = |what: String| Err(ConfigError(what));
        for (name, value, least, most) in [
            ("motion_dim", self.motion_dim, 1, MAX_WIDTH),
            ("width", self.width, 2, MAX_WIDTH),
            ("conv_width", self.conv_width, 1, MAX_WIDTH),
            ("depth", self.depth, 1, MAX_DEPTH),
            ("codes", self.codes, 2, MAX_TABLE_VALUES),
            ("blocks", self.blocks, 1, MAX_BLOCKS),
            ("taps", self.taps, 1, MAX_BLOCKS),
            ("n_steps", self.n_steps, 1, MAX_TABLE_VALUES),
        ] {
            if value < least {
                return refuse(format!("{name} is {value}; it must be at least {least}"));
            }
            if value > most {
                return refuse(format!("{name} is {value}; it must be at most {most}"));
            }
        }
        check_frames_per_token(self.frames_per_token)?;
        if !self.width.is_multiple_of(2) {
            return refuse(format!(
                "width is {}; it must be even, since steps are embedded as pairs of a cosine and a sine",
                self.width
            ));
        }
        if self.taps.is_multiple_of(2) {
            return refuse(format!(
                "taps is {}; it must be odd, so that a frame sees as far ahead as back",
                self.taps
            ));
        }
        // All are bounded by now, so that no product can overflow.
        for (name, rows) in [("codes", self.codes), ("n_steps", self.n_steps)] {
            let n_table = rows * self.width;
            if n_table > MAX_TABLE_VALUES {
                return refuse(format!(
                    "{name} {rows} and width {} make a table of {n_table} values; at most {MAX_TABLE_VALUES} are \
                     kept, so lower one of the two",
                    self.width
                ));
            }
        }
        Ok(())
    }
}

/// Refuses a number of frames that no token stands for.
///
/// # Errors
/// One sentence.
pub(super) fn check_frames_per_token(frames_per_token: usize) -> Result<(), ConfigError> {
    if FRAMES_PER_TOKEN.contains(&frames_per_token) {
        return Ok(());
    }
    Err(ConfigError(format!(
        "a token stands for {frames_per_token} frames; it must be 1, 2, 4, 8 or 16, since each level of the encoder \
         halves them"
    )))
}

/// Dilations grow by three from block to block: the eighth of 8 sees 4,375 frames.
pub(super) const MAX_DEPTH: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    fn tiny() -> TokensConfig {
        TokensConfig::of(Preset::Tiny).expect("a preset of the family")
    }

    #[test]
    fn presets_are_sound_and_the_base_is_the_papers() {
        for preset in [Preset::Tiny, Preset::Small, Preset::Base] {
            let config = TokensConfig::of(preset).expect("a preset of the family");
            assert_eq!(config.check(), Ok(()), "{}", preset.name());
        }
        assert_eq!(TokensConfig::of(Preset::Large), None);
        let base = TokensConfig::of(Preset::Base).expect("a preset of the family");
        assert_eq!((base.width, base.codes, base.frames_per_token, base.taps), (768, 1024, 4, 5));
    }

    #[test]
    fn tokens_are_counted_and_the_last_may_stand_for_fewer_frames() {
        let config = |frames_per_token| TokensConfig { frames_per_token, ..tiny() };
        assert_eq!([1, 2, 4, 8, 16].map(|rho| config(rho).n_levels()), [0, 1, 2, 3, 4]);
        assert_eq!([1, 4, 5, 120, 121].map(|n| config(4).n_tokens(n)), [1, 1, 2, 30, 31]);
        assert_eq!([1, 2, 4, 8, 16].map(TokensConfig::usual_taps), [7, 7, 5, 5, 5]);
    }

    #[test]
    fn sizes_of_which_no_network_can_be_made_are_refused() {
        let refusal = |change: fn(&mut TokensConfig)| {
            let mut config = tiny();
            change(&mut config);
            config.check().expect_err("unsound").to_string()
        };
        assert_eq!(
            refusal(|c| c.frames_per_token = 3),
            "a token stands for 3 frames; it must be 1, 2, 4, 8 or 16, since each level of the encoder halves them"
        );
        assert_eq!(refusal(|c| c.codes = 1), "codes is 1; it must be at least 2");
        assert_eq!(refusal(|c| c.depth = 9), "depth is 9; it must be at most 8");
        assert_eq!(refusal(|c| c.width = 16_386), "width is 16386; it must be at most 16384");
        assert_eq!(
            refusal(|c| c.n_steps = usize::MAX),
            format!("n_steps is {}; it must be at most 33554432", usize::MAX)
        );
        assert_eq!(
            refusal(|c| c.width = 49),
            "width is 49; it must be even, since steps are embedded as pairs of a cosine and a sine"
        );
        assert_eq!(
            refusal(|c| c.taps = 4),
            "taps is 4; it must be odd, so that a frame sees as far ahead as back"
        );
        assert_eq!(
            refusal(|c| (c.codes, c.width) = (1 << 20, 64)),
            "codes 1048576 and width 64 make a table of 67108864 values; at most 33554432 are kept, so lower one \
             of the two"
        );
    }
}
