//! How long networks are trained.

use std::time::Duration;

use crate::stages::RARE;
use crate::store::Patience;
use crate::training::Plan;

/// Share of a time budget that the decoder gets.
const DECODER_SHARE: f64 = 0.1;

/// When training ends, and what happens on the way.
#[derive(Clone, Debug, clap::Args)]
pub struct BudgetParams {
    /// Times that the UNet sees all phrases [default: 100, without --steps and --minutes]
    #[arg(long, value_name = "N", help_heading = "Budget")]
    pub epochs: Option<u64>,
    /// Steps of the UNet.
    #[arg(long, value_name = "N", help_heading = "Budget")]
    pub steps: Option<u64>,
    /// Minutes that training may take, over all its resumptions; a tenth is the decoder's.
    #[arg(long, value_name = "M", help_heading = "Budget")]
    pub minutes: Option<f64>,
    /// Steps of the decoder.
    #[arg(long, value_name = "N", default_value_t = 2000, help_heading = "Budget",
          hide_short_help = RARE)]
    pub decoder_steps: u64,
    /// Epochs from one validation to the next.
    #[arg(long, value_name = "N", default_value_t = 5, help_heading = "Budget",
          hide_short_help = RARE)]
    pub validate_every: u64,
    /// Validations without improvement after which training ends; 0 for never.
    #[arg(long, value_name = "N", default_value_t = 0, help_heading = "Budget",
          hide_short_help = RARE)]
    pub patience: u64,
    /// Which checkpoint of a UNet is kept: the one of least validation loss, or the one whose motion, sampled for windows of
    /// the validation songs, moves most as real motion does.
    #[arg(long, value_enum, default_value_t, value_name = "WHICH", help_heading = "Budget",
          hide_short_help = RARE)]
    pub keep: KeptCheckpoint,
    #[command(flatten)]
    pub saving: SavingParams,
}

/// By what the checkpoint that is kept is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum KeptCheckpoint {
    /// The loss of a validation.
    #[default]
    Loss,
    /// How far sampled motion is from real motion.
    Motion,
}

/// When checkpoints are written.
#[derive(Clone, Debug, clap::Args)]
pub struct SavingParams {
    /// Epochs from one checkpoint to the next.
    #[arg(long, value_name = "N", default_value_t = 10, help_heading = "Budget",
          hide_short_help = RARE)]
    pub save_every: u64,
    /// Steps from one checkpoint to the next, beside --save-every.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..),
          help_heading = "Budget", hide_short_help = RARE)]
    pub save_every_steps: Option<u64>,
    /// Longest time between two checkpoints, in minutes.
    #[arg(long, value_name = "M", default_value_t = 10.0, help_heading = "Budget",
          hide_short_help = RARE)]
    pub save_every_minutes: f64,
}

/// Returns `m` minutes, or the longest time that there is.
pub fn minutes(m: f64) -> Duration {
    Duration::try_from_secs_f64(m * 60.0).unwrap_or(Duration::MAX)
}

/// How long a network is trained: by steps, epochs, or its share of the time.
#[derive(Clone, Copy, Debug)]
pub struct StageBudget {
    pub n_steps: Option<u64>,
    pub n_epochs: Option<u64>,
    pub share: f64,
    pub batch_size: usize,
}

impl BudgetParams {
    /// Returns how long a denoiser is trained, which has the budget but for the decoder's share.
    pub fn of_denoiser(&self, batch_size: usize) -> StageBudget {
        let is_bounded = self.steps.is_some() || self.minutes.is_some();
        let n_epochs = self.epochs.or_else(|| (!is_bounded).then_some(100));
        StageBudget { n_steps: self.steps, n_epochs, share: 1.0 - DECODER_SHARE, batch_size }
    }

    /// Returns how long the decoder is trained.
    pub fn of_decoder(&self, batch_size: usize) -> StageBudget {
        let n_steps = Some(self.decoder_steps);
        StageBudget { n_steps, n_epochs: None, share: DECODER_SHARE, batch_size }
    }

    /// Returns the plan of a stage that trains on `n_train` windows, for a store that is waited for as long as
    /// `store_patience`.
    pub fn plan(&self, budget: StageBudget, n_train: usize, store_patience: Patience) -> Plan {
        let StageBudget { n_steps, n_epochs, share, batch_size } = budget;
        Plan {
            n_steps,
            n_epochs,
            time: self.minutes.map(|m| minutes(share * m)),
            windows_per_epoch: n_train as u64,
            batch_size: batch_size as u64,
            validate_first: false,
            validate_every_epochs: self.validate_every,
            save_every_epochs: self.saving.save_every,
            save_every_steps: self.saving.save_every_steps,
            save_every: minutes(self.saving.save_every_minutes),
            patience: (self.patience > 0).then_some(self.patience),
            store_patience,
        }
    }
}
