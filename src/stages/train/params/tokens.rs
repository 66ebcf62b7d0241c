//! The flags of the family tokens, and the configuration that they make.

use super::ConfigParams;
use crate::model::{PlannerConfig, PlannerKind, Preset, TokensConfig};
use crate::motion::style::STYLE_DIM;
use crate::stages::RARE;
use crate::training::{
    Augmentation, ChannelWeights, CodebookConfig, LearningRate, PlannerNetworkConfig,
    PlannerTrainConfig, PlannerTraining, TokenizerSource, TokensNetworkConfig, TokensTrainConfig,
    TokensTraining, TrainConfig,
};

/// The tokens of a tokenizer, how its codebook is learned, and how its tokens are planned.
#[derive(Clone, Debug, clap::Args)]
pub struct TokensParams {
    /// Run of a tokenizer whose tokens are planned: what is trained is a planner, which makes tokens for music.
    #[arg(long, value_name = "RUN", help_heading = "Tokens", hide_short_help = RARE)]
    pub tokenizer: Option<String>,
    /// How a planner makes tokens: all at once, the surest first, or one after the other.
    #[arg(long, value_enum, default_value_t = PlannerKind::Masked, help_heading = "Tokens", hide_short_help = RARE)]
    pub planner: PlannerKind,
    /// Probability that a token which a planner sees is replaced by any other [default: 0.1 masked, 0.2 autoregressive]
    #[arg(long, value_name = "P", help_heading = "Tokens", hide_short_help = RARE)]
    pub token_replacement: Option<f64>,
    /// Let a planner know nothing of constraints, as those of release 0.2.
    #[arg(long, help_heading = "Tokens", hide_short_help = RARE)]
    pub no_constraints: bool,
    /// Probability that a window of a planner goes without constraints, parts of its own motion that are asked for.
    #[arg(long, value_name = "P", default_value_t = PlannerTraining::CONSTRAINT_DROPOUT,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub constraint_dropout: f64,
    /// Frames that a token stands for: 1, 2, 4, 8 or 16.
    #[arg(long, value_name = "N", default_value_t = 4, help_heading = "Tokens", hide_short_help = RARE)]
    pub frames_per_token: usize,
    /// Rows of the codebook, so many tokens there are [default: the preset's]
    #[arg(long, value_name = "K", help_heading = "Tokens", hide_short_help = RARE)]
    pub codes: Option<usize>,
    /// Weight of the draft, motion that a linear layer reads from the tokens' signal and the denoiser adds to.
    #[arg(long, value_name = "X", default_value_t = TokensTraining::DRAFT, help_heading = "Tokens", hide_short_help = RARE)]
    pub draft_loss: f64,
    /// Let the denoiser alone read tokens, as the paper has it: they keep little of what changes slowly.
    #[arg(long, help_heading = "Tokens", hide_short_help = RARE)]
    pub no_draft: bool,
    /// Weight of the distance of latents from their codes.
    #[arg(long, value_name = "X", default_value_t = TokensTraining::COMMITMENT, help_heading = "Tokens", hide_short_help = RARE)]
    pub commitment_loss: f64,
    /// Share of a code's averages that stays at a step.
    #[arg(long, value_name = "X", default_value_t = CodebookConfig::default().decay,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub codebook_decay: f64,
    /// Latents of a batch that a code has to stand for, on average, or it is put in the place of another latent; a
    /// batch has --batch-size × --window-frames / --frames-per-token of them [default: a tenth of what a code would have,
    /// were all used alike; at most 1]
    #[arg(long, value_name = "X", help_heading = "Tokens", hide_short_help = RARE)]
    pub least_usage: Option<f64>,
}

/// Returns the learning rate that suits a tokenizer, whose encoder learns faster than a denoiser.
fn tokenizer_learning_rate(preset: Preset) -> f64 {
    match preset {
        Preset::Tiny | Preset::Small => 2e-3,
        // The paper's.
        Preset::Base | Preset::Large => 2e-4,
    }
}

impl ConfigParams {
    /// Returns the configuration of a tokenizer that the flags make; none for a preset that it does not have.
    pub fn tokens_config(&self, seed: u64) -> Option<TokensTrainConfig> {
        let sizes = TokensConfig::of(self.network.preset)?;
        let TrainConfig { network, diffusion, .. } = self.config(seed);
        let TokensParams {
            frames_per_token,
            codes,
            draft_loss,
            no_draft,
            commitment_loss,
            codebook_decay,
            least_usage,
            ..
        } = self.tokens;
        let codes = codes.unwrap_or(sizes.codes);
        // Where a batch has few latents for each code, MoMask's 1 would replace codes that are in use.
        let n_latents = diffusion.batch_size * network.window_frames / frames_per_token.max(1);
        let of_usual = CodebookConfig::usual_least_usage(n_latents, codes);
        let codebook =
            CodebookConfig { decay: codebook_decay, least_usage: least_usage.unwrap_or(of_usual) };
        let learning_rate = LearningRate {
            peak: self
                .optimizer
                .learning_rate
                .unwrap_or(tokenizer_learning_rate(self.network.preset)),
            ..diffusion.learning_rate
        };
        Some(TokensTrainConfig {
            seed,
            network: TokensNetworkConfig {
                tokens: TokensConfig {
                    codes,
                    frames_per_token,
                    taps: TokensConfig::usual_taps(frames_per_token),
                    n_steps: network.diffusion.n_steps,
                    draft: !no_draft,
                    ..sizes
                },
                diffusion: network.diffusion,
                window_frames: network.window_frames,
            },
            tokens: TokensTraining {
                commitment: commitment_loss,
                draft: draft_loss,
                channels: ChannelWeights {
                    pose: self.diffusion.pose_weight.unwrap_or(TokensTraining::POSE),
                    ..diffusion.objective.channels
                },
                codebook,
                // No music is heard, so that none is made noisy.
                augmentation: Augmentation { condition_noise: 0.0, ..diffusion.augmentation },
                batch_size: diffusion.batch_size,
                accumulate: diffusion.accumulate,
                side_by_side: diffusion.side_by_side,
                learning_rate,
                optimizer: diffusion.optimizer,
                ema: diffusion.ema,
            },
        })
    }

    /// Returns the configuration of a planner that the flags make, for the tokens of a tokenizer; none for a preset that
    /// it does not have.
    pub fn planner_config(
        &self,
        seed: u64,
        tokenizer: TokenizerSource,
        network: &TokensNetworkConfig,
    ) -> Option<PlannerTrainConfig> {
        let kind = self.tokens.planner;
        let sizes = PlannerConfig::of(self.network.preset, kind, &network.tokens)?;
        let TrainConfig { diffusion, .. } = self.config(seed);
        let usual = PlannerTraining::usual_replacement(kind);
        let is_constrained = !self.tokens.no_constraints;
        Some(PlannerTrainConfig {
            seed,
            tokenizer,
            network: PlannerNetworkConfig {
                planner: PlannerConfig {
                    clock: !self.network.no_clock,
                    style_dim: if self.network.style { STYLE_DIM } else { 0 },
                    constraint_dim: if is_constrained { sizes.constraint_dim } else { 0 },
                    dropout: self.network.dropout.unwrap_or(sizes.dropout),
                    ..sizes
                },
                window_frames: network.window_frames,
            },
            planner: PlannerTraining {
                replacement: self.tokens.token_replacement.unwrap_or(usual),
                condition_dropout: diffusion.condition_dropout,
                clock_dropout: diffusion.clock_dropout,
                style_dropout: diffusion.style_dropout,
                constraint_dropout: if is_constrained {
                    self.tokens.constraint_dropout
                } else {
                    0.0
                },
                augmentation: diffusion.augmentation,
                batch_size: diffusion.batch_size,
                accumulate: diffusion.accumulate,
                side_by_side: diffusion.side_by_side,
                learning_rate: diffusion.learning_rate,
                optimizer: diffusion.optimizer,
                ema: diffusion.ema,
            },
        })
    }
}
