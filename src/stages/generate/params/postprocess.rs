//! What the user asks of post-processing.

use anyhow::bail;
use clap::{Args as _, FromArgMatches as _};

use crate::motion::ChannelLimits;
use crate::motion::postprocess::{
    Coherence, FusionVariances, Hemisphere, PostProcessConfig, SavitzkyGolay,
};
use crate::motion::rates::MotionRange;
use crate::stages::RARE;

/// What is done to decoded motion.
#[derive(Clone, Debug, clap::Args)]
pub struct PostProcessParams {
    /// Leave decoded motion as it is.
    #[arg(long, help_heading = "Post-processing", hide_short_help = RARE)]
    pub raw: bool,
    /// How far each channel may go.
    #[arg(long, value_enum, default_value_t = ChannelLimits::Wide, help_heading = "Post-processing",
          hide_short_help = RARE)]
    pub limits: ChannelLimits,
    /// Let motion be faster than nearly all that the model was trained on (99.9 % of its frames).
    #[arg(long, help_heading = "Post-processing", hide_short_help = RARE)]
    pub any_speed: bool,
    /// Signs of quaternions: continuous in time, or w ≥ 0 in every frame as in the reference.
    #[arg(long, value_enum, default_value_t = Hemisphere::Sequential,
          help_heading = "Post-processing", hide_short_help = RARE)]
    pub hemisphere: Hemisphere,
    /// Frames of a weighted mean of the orientations; an odd number [default: none]
    #[arg(long, value_name = "N", help_heading = "Post-processing", hide_short_help = RARE)]
    pub smooth_quaternions: Option<usize>,
    /// Never let the phase fall within a bar.
    #[arg(long, help_heading = "Post-processing", hide_short_help = RARE)]
    pub monotonic_phase: bool,
    /// Leave the phase as it was decoded, instead of the phase of the music's bars.
    #[arg(long, help_heading = "Post-processing", hide_short_help = RARE)]
    pub decoded_phase: bool,
    /// Velocities, accelerations and angular velocities: as decoded, half of each as in the reference, derived
    /// from positions and orientations, or fused with them by least squares and then
    /// derived [default: fuse, by the errors that the model's card has; derive for one of release 0.1]
    #[arg(long, value_enum, help_heading = "Post-processing", hide_short_help = RARE)]
    pub coherence: Option<Coherence>,
    /// Frames of the reference's moving average; an odd number [default: none]
    #[arg(long, value_name = "N", help_heading = "Post-processing", hide_short_help = RARE)]
    pub moving_average: Option<usize>,
    /// Smooths by polynomials of an order over a window of frames; 0 for none; with --coherence derive or
    /// fuse [default: 11,3 with derive]
    #[arg(long, value_name = "WINDOW,ORDER", value_delimiter = ',', num_args = 1..,
          help_heading = "Post-processing", hide_short_help = RARE)]
    pub savitzky_golay: Vec<usize>,
}

impl PostProcessParams {
    /// Returns what is done unless the user says otherwise.
    pub fn usual() -> Self {
        let command = Self::augment_args(clap::Command::new("usual"));
        Self::from_arg_matches(&command.get_matches_from(["usual"]))
            .expect("invariant: every flag of post-processing has a default")
    }

    /// Returns the configuration for a model.
    ///
    /// # Errors
    /// A window that is even or an order that is too high, in a sentence.
    pub fn config(
        &self,
        (range, measured): (Option<MotionRange>, Option<FusionVariances>),
    ) -> anyhow::Result<PostProcessConfig> {
        // Of a model whose errors were not measured, as those of release 0.1, velocities are derived.
        let usual = if measured.is_some() { Coherence::Fuse } else { Coherence::Derive };
        let coherence = self.coherence.unwrap_or(usual);
        let mut config = PostProcessConfig {
            limits: self.limits,
            hemisphere: self.hemisphere,
            smooth_quaternions: self.smooth_quaternions.is_some(),
            enforce_phase_monotonic: self.monotonic_phase,
            relock_phase: !self.decoded_phase,
            coherence,
            apply_smoothing: self.moving_average.is_some(),
            savitzky_golay: match self.savitzky_golay[..] {
                [] if coherence == Coherence::Derive => Some(SavitzkyGolay::default()),
                [] | [0] | [0, _] => None,
                [window, order] => Some(SavitzkyGolay { window, order }),
                _ => bail!("--savitzky-golay takes two numbers: WINDOW,ORDER, such as 7,3"),
            },
            fusion_variances: (coherence == Coherence::Fuse).then(|| measured.unwrap_or_default()),
            range: range.filter(|range| range.is_sound() && !self.any_speed),
            ..PostProcessConfig::default()
        };
        if let Some(window) = self.smooth_quaternions {
            config.quat_smooth_window = window;
        }
        if let Some(size) = self.moving_average {
            config.smoothing_kernel_size = size;
        }
        if self.raw {
            config = PostProcessConfig { limits: self.limits, ..PostProcessConfig::nothing() };
        }
        config.check()?;
        Ok(config)
    }
}
