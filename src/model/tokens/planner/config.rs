//! The sizes of a planner of tokens, and the sizes with names.

use serde::{Deserialize, Serialize};

use super::constraint::CONSTRAINT_DIM;
use crate::audio::FEATURE_DIM;
use crate::model::condition::ConditionConfig;
use crate::model::tokens::TokensConfig;
use crate::model::tokens::coder::EncoderConfig;
use crate::model::tokens::config::{MAX_DEPTH, check_frames_per_token};
use crate::model::unet::{ConfigError, MAX_BLOCKS, MAX_TABLE_VALUES, MAX_WIDTH, Preset};

/// How tokens are planned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlannerKind {
    /// All tokens of a window at once, the surest first: masked discrete diffusion.
    #[default]
    Masked,
    /// One token after the other, each by those before it.
    Autoregressive,
}

impl PlannerKind {
    /// Returns the name that flags, cards and messages use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Masked => "masked",
            Self::Autoregressive => "autoregressive",
        }
    }
}

/// The sizes of a [`Planner`](super::Planner).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannerConfig {
    pub kind: PlannerKind,
    /// K: tokens that there are, as many as rows of the tokenizer's codebook.
    pub codes: usize,
    /// ρ: frames that a token stands for, as of the tokenizer.
    pub frames_per_token: usize,
    /// d: channels of every position.
    pub width: usize,
    pub heads: usize,
    /// Width of feed-forward layers, in units of `width`.
    pub expansion: usize,
    /// Layers of the transformer.
    pub layers: usize,
    /// Channels within the convolutions that bring the music to the positions of tokens.
    pub conv_width: usize,
    /// Residual blocks of a level of those.
    pub depth: usize,
    /// Features of a frame of music.
    pub audio_cond_dim: usize,
    /// Whether the clock of the music is given beside its features.
    pub clock: bool,
    /// Numbers of a style that is given as a condition; 0 for a network without.
    pub style_dim: usize,
    /// Channels of the constraints of a frame, [`CONSTRAINT_DIM`]; 0 for a network that takes none, as
    /// those of release 0.2.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub constraint_dim: usize,
    pub dropout: f64,
}

/// Sizes of release 0.2 are written as they were.
fn is_zero(n: &usize) -> bool {
    *n == 0
}

impl PlannerConfig {
    /// Returns the sizes of a preset for the tokens of a tokenizer; none of one that this family does not have.
    ///
    /// The base is the paper's: 6 layers of 384 for the masked kind, 9 of 768 for the other.
    pub fn of(preset: Preset, kind: PlannerKind, tokens: &TokensConfig) -> Option<Self> {
        let (width, heads, layers, conv_width, depth) = match (preset, kind) {
            (Preset::Tiny, _) => (48, 4, 2, 32, 1),
            (Preset::Small, _) => (192, 6, 4, 128, 2),
            (Preset::Base, PlannerKind::Masked) => (384, 6, 6, 512, 3),
            (Preset::Base, PlannerKind::Autoregressive) => (768, 12, 9, 512, 3),
            (Preset::Large, _) => return None,
        };
        Some(Self {
            kind,
            codes: tokens.codes,
            frames_per_token: tokens.frames_per_token,
            width,
            heads,
            expansion: 4,
            layers,
            conv_width,
            depth,
            audio_cond_dim: FEATURE_DIM,
            clock: true,
            style_dim: 0,
            constraint_dim: CONSTRAINT_DIM,
            dropout: 0.1,
        })
    }

    /// Returns the condition that the network takes: features, and the clock.
    pub fn condition(&self) -> ConditionConfig {
        ConditionConfig { audio_cond_dim: self.audio_cond_dim, clock: self.clock }
    }

    /// Returns N, the tokens of so many frames; the last may stand for fewer.
    pub fn n_tokens(&self, n_frames: usize) -> usize {
        n_frames.div_ceil(self.frames_per_token)
    }

    /// Returns the numbers that are kept of a position that is done: keys and values of every layer.
    pub fn cache_dim(&self) -> usize {
        2 * self.layers * self.width
    }

    /// Returns the number that stands for a token which is not known, \[MASK\]: the one behind the last.
    pub fn mask_token(&self) -> usize {
        self.codes
    }

    /// Returns the rows of the table of tokens: all of them and, of the masked kind, \[MASK\].
    pub fn n_rows(&self) -> usize {
        match self.kind {
            PlannerKind::Masked => self.codes + 1,
            PlannerKind::Autoregressive => self.codes,
        }
    }

    /// Returns the convolutions that bring the music to the positions of tokens.
    pub(super) fn music(&self) -> EncoderConfig {
        self.encoder(self.condition().dim())
    }

    /// Returns the convolutions that bring constraints there, of a network that takes them.
    pub(super) fn constraints(&self) -> Option<EncoderConfig> {
        (self.constraint_dim > 0).then(|| self.encoder(self.constraint_dim))
    }

    fn encoder(&self, inputs: usize) -> EncoderConfig {
        EncoderConfig {
            inputs,
            outputs: self.width,
            conv_width: self.conv_width,
            depth: self.depth,
            frames_per_token: self.frames_per_token,
        }
    }

    /// Refuses sizes of which no network can be made.
    ///
    /// # Errors
    /// One sentence: the number, what it must be, and why.
    pub fn check(&self) -> Result<(), ConfigError> {
        let refuse = |what: String| Err(ConfigError(what));
        for (name, value, least, most) in [
            ("codes", self.codes, 2, MAX_TABLE_VALUES),
            ("width", self.width, 1, MAX_WIDTH),
            ("heads", self.heads, 1, MAX_WIDTH),
            ("expansion", self.expansion, 1, MAX_BLOCKS),
            ("layers", self.layers, 1, MAX_BLOCKS),
            ("conv_width", self.conv_width, 1, MAX_WIDTH),
            ("depth", self.depth, 1, MAX_DEPTH),
            ("audio_cond_dim", self.audio_cond_dim, 1, MAX_WIDTH),
            ("style_dim", self.style_dim, 0, MAX_WIDTH),
            ("constraint_dim", self.constraint_dim, 0, MAX_WIDTH),
        ] {
            if value < least {
                return refuse(format!("{name} is {value}; it must be at least {least}"));
            }
            if value > most {
                return refuse(format!("{name} is {value}; it must be at most {most}"));
            }
        }
        check_frames_per_token(self.frames_per_token)?;
        if !self.width.is_multiple_of(2 * self.heads) {
            return refuse(format!(
                "a width of {} does not divide into pairs of {} heads; change heads or the width",
                self.width, self.heads
            ));
        }
        // Both are bounded by now, so that the product cannot overflow.
        let n_table = self.n_rows() * self.width;
        if n_table > MAX_TABLE_VALUES {
            return refuse(format!(
                "codes {} and width {} make a table of {n_table} values; at most {MAX_TABLE_VALUES} are kept, so \
                 lower one of the two",
                self.codes, self.width
            ));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse(format!("dropout is {}; it must lie in [0, 1)", self.dropout));
        }
        Ok(())
    }

    /// Refuses a tokenizer whose tokens are not those that are planned.
    ///
    /// # Errors
    /// One sentence with both numbers.
    pub fn check_fits(&self, tokens: &TokensConfig) -> Result<(), ConfigError> {
        for (what, own, of_tokenizer) in [
            ("tokens", self.codes, tokens.codes),
            ("frames a token", self.frames_per_token, tokens.frames_per_token),
        ] {
            if own != of_tokenizer {
                return Err(ConfigError(format!(
                    "the planner knows {own} {what}, the tokenizer {of_tokenizer}; take the planner that was trained \
                     with this tokenizer"
                )));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens() -> TokensConfig {
        TokensConfig::of(Preset::Tiny).expect("a preset of the family")
    }

    fn tiny() -> PlannerConfig {
        PlannerConfig::of(Preset::Tiny, PlannerKind::Masked, &tokens()).expect("a preset")
    }

    #[test]
    fn presets_are_sound_and_the_base_is_the_papers() {
        for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
            for preset in [Preset::Tiny, Preset::Small, Preset::Base] {
                let config = PlannerConfig::of(preset, kind, &tokens()).expect("a preset");
                assert_eq!(config.check(), Ok(()), "{} {}", preset.name(), kind.name());
            }
            assert_eq!(PlannerConfig::of(Preset::Large, kind, &tokens()), None);
        }
        let base = |kind| PlannerConfig::of(Preset::Base, kind, &tokens()).expect("a preset");
        let sizes = |config: PlannerConfig| (config.width, config.layers);
        assert_eq!(sizes(base(PlannerKind::Masked)), (384, 6));
        assert_eq!(sizes(base(PlannerKind::Autoregressive)), (768, 9));
    }

    #[test]
    fn only_the_masked_kind_knows_the_mask() {
        let config = tiny();
        assert_eq!((config.codes, config.mask_token(), config.n_rows()), (32, 32, 33));
        let other = PlannerConfig { kind: PlannerKind::Autoregressive, ..config };
        assert_eq!(other.n_rows(), 32);
    }

    #[test]
    fn sizes_of_which_no_network_can_be_made_are_refused() {
        let refusal = |change: fn(&mut PlannerConfig)| {
            let mut config = tiny();
            change(&mut config);
            config.check().expect_err("unsound").to_string()
        };
        assert_eq!(refusal(|c| c.codes = 1), "codes is 1; it must be at least 2");
        assert_eq!(refusal(|c| c.layers = 0), "layers is 0; it must be at least 1");
        assert_eq!(refusal(|c| c.depth = 9), "depth is 9; it must be at most 8");
        assert_eq!(refusal(|c| c.width = 16_392), "width is 16392; it must be at most 16384");
        assert_eq!(
            refusal(|c| c.frames_per_token = 6),
            "a token stands for 6 frames; it must be 1, 2, 4, 8 or 16, since each level of the encoder halves them"
        );
        assert_eq!(
            refusal(|c| c.heads = 5),
            "a width of 48 does not divide into pairs of 5 heads; change heads or the width"
        );
        assert_eq!(
            refusal(|c| (c.codes, c.width, c.heads) = (1 << 20, 64, 2)),
            "codes 1048576 and width 64 make a table of 67108928 values; at most 33554432 are kept, so lower one \
             of the two"
        );
        assert_eq!(refusal(|c| c.dropout = 1.0), "dropout is 1; it must lie in [0, 1)");
    }

    #[test]
    fn sizes_of_release_0_2_are_read_and_written_as_they_were() {
        let text = r#"{"kind":"masked","codes":32,"frames_per_token":4,"width":48,"heads":4,"expansion":4,"layers":2,"conv_width":32,"depth":1,"audio_cond_dim":163,"clock":true,"style_dim":0,"dropout":0.1}"#;
        let read: PlannerConfig = serde_json::from_str(text).expect("sizes of 0.2");
        assert_eq!(read, PlannerConfig { constraint_dim: 0, ..tiny() });
        assert_eq!(serde_json::to_string(&read).expect("JSON"), text);
        let own = serde_json::to_string(&tiny()).expect("JSON");
        assert_eq!(serde_json::from_str::<PlannerConfig>(&own).expect("JSON"), tiny());
    }

    #[test]
    fn the_tokens_of_another_tokenizer_are_refused() {
        let tokens = tokens();
        assert_eq!(tiny().check_fits(&tokens), Ok(()));
        let refusal =
            |tokens: TokensConfig| tiny().check_fits(&tokens).expect_err("unfit").to_string();
        assert_eq!(
            refusal(TokensConfig { codes: 37, ..tokens.clone() }),
            "the planner knows 32 tokens, the tokenizer 37; take the planner that was trained with this tokenizer"
        );
        assert_eq!(
            refusal(TokensConfig { frames_per_token: 8, ..tokens }),
            "the planner knows 4 frames a token, the tokenizer 8; take the planner that was trained with this \
             tokenizer"
        );
    }
}
