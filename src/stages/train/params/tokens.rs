//! The flags of the family tokens, and the configuration that they make.

use super::ConfigParams;
use crate::model::TokensConfig;
use crate::stages::RARE;
use crate::training::{
    Augmentation, CodebookConfig, TokensNetworkConfig, TokensTrainConfig, TokensTraining,
    TrainConfig,
};

/// The tokens of a tokenizer, and how its codebook is learned.
#[derive(Clone, Debug, clap::Args)]
pub struct TokensParams {
    /// Frames that a token stands for: 1, 2, 4, 8 or 16.
    #[arg(long, value_name = "N", default_value_t = 4, help_heading = "Tokens", hide_short_help = RARE)]
    pub frames_per_token: usize,
    /// Rows of the codebook, so many tokens there are [default: the preset's]
    #[arg(long, value_name = "K", help_heading = "Tokens", hide_short_help = RARE)]
    pub codes: Option<usize>,
    /// Weight of the distance of latents from their codes.
    #[arg(long, value_name = "X", default_value_t = TokensTraining::COMMITMENT, help_heading = "Tokens", hide_short_help = RARE)]
    pub commitment_loss: f64,
    /// Share of a code's averages that stays at a step.
    #[arg(long, value_name = "X", default_value_t = CodebookConfig::default().decay,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub codebook_decay: f64,
    /// Latents of a batch that a code has to stand for, on average, or it is put in the place of another latent; a
    /// batch has --batch-size × --window-frames / --frames-per-token of them.
    #[arg(long, value_name = "X", default_value_t = CodebookConfig::default().least_usage,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub least_usage: f64,
}

impl ConfigParams {
    /// Returns the configuration of a tokenizer that the flags make; none for a preset that it does not have.
    pub fn tokens_config(&self, seed: u64) -> Option<TokensTrainConfig> {
        let sizes = TokensConfig::of(self.network.preset)?;
        let TrainConfig { network, diffusion, .. } = self.config(seed);
        let TokensParams { frames_per_token, codes, commitment_loss, codebook_decay, least_usage } =
            self.tokens;
        Some(TokensTrainConfig {
            seed,
            network: TokensNetworkConfig {
                tokens: TokensConfig {
                    codes: codes.unwrap_or(sizes.codes),
                    frames_per_token,
                    taps: TokensConfig::usual_taps(frames_per_token),
                    n_steps: network.diffusion.n_steps,
                    ..sizes
                },
                diffusion: network.diffusion,
                window_frames: network.window_frames,
            },
            tokens: TokensTraining {
                commitment: commitment_loss,
                codebook: CodebookConfig { decay: codebook_decay, least_usage },
                // No music is heard, so that none is made noisy.
                augmentation: Augmentation { condition_noise: 0.0, ..diffusion.augmentation },
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
