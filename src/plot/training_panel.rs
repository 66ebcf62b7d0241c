//! The stages of a training run and the panels of their plots.

use std::str::FromStr;

use super::value_axis::ValueScale;
use super::{PlotError, names_of, panel_named};

/// A stage of training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum TrainingStage {
    /// the UNet
    Diffusion,
    /// the motion decoder
    Decoder,
    /// both, end to end
    Finetune,
    /// the networks of groups
    Group,
    /// a tokenizer
    Tokens,
    /// a planner of tokens
    Planner,
}

impl TrainingStage {
    /// Every stage, in the order in which they are trained.
    pub const ALL: [Self; 6] =
        [Self::Diffusion, Self::Decoder, Self::Finetune, Self::Group, Self::Tokens, Self::Planner];

    /// Returns the stage's name, as in the log of training.
    pub fn name(self) -> &'static str {
        match self {
            Self::Diffusion => "diffusion",
            Self::Decoder => "decoder",
            Self::Finetune => "finetune",
            Self::Group => "group",
            Self::Tokens => "tokens",
            Self::Planner => "planner",
        }
    }

    /// Returns the panels that are drawn unless others are asked for: of fine-tuning the six of the
    /// reference's `plot_losses`.
    pub fn usual_panels(self) -> &'static [TrainingPanel] {
        use TrainingPanel as P;
        match self {
            Self::Diffusion | Self::Decoder | Self::Planner => {
                &[P::Loss, P::GradientNorm, P::LearningRate]
            }
            Self::Group => &[P::Loss, P::Diffusion, P::Contrast, P::GradientNorm, P::LearningRate],
            Self::Tokens => {
                &[P::Loss, P::Commitment, P::Perplexity, P::GradientNorm, P::LearningRate]
            }
            Self::Finetune => &[
                P::Loss,
                P::Diffusion,
                P::DecoderPosition,
                P::VelocityCoherence,
                P::AccelerationCoherence,
                P::Jerk,
            ],
        }
    }

    /// Returns every panel that the stage has. What would only repeat the loss is none.
    pub fn panels(self) -> &'static [TrainingPanel] {
        use TrainingPanel as P;
        match self {
            Self::Diffusion | Self::Planner => self.usual_panels(),
            Self::Decoder => &[
                P::Loss,
                P::DecoderPosition,
                P::DecoderQuaternion,
                P::GradientNorm,
                P::LearningRate,
            ],
            Self::Finetune => &[
                P::Loss,
                P::Diffusion,
                P::DecoderPosition,
                P::VelocityCoherence,
                P::AccelerationCoherence,
                P::Jerk,
                P::DecoderQuaternion,
                P::QuaternionDelta,
                P::PhaseMonotonic,
                P::PositionSmoothness,
                P::GradientNorm,
                P::LearningRate,
            ],
            Self::Group => {
                &[P::Loss, P::Diffusion, P::Markers, P::Contrast, P::GradientNorm, P::LearningRate]
            }
            Self::Tokens => &[
                P::Loss,
                P::Diffusion,
                P::Commitment,
                P::Perplexity,
                P::GradientNorm,
                P::LearningRate,
            ],
        }
    }

    pub(super) fn heading(self) -> &'static str {
        match self {
            Self::Diffusion => "Diffusion",
            Self::Decoder => "Decoder",
            Self::Finetune => "Fine-tuning",
            Self::Group => "Groups",
            Self::Tokens => "Tokenizer",
            Self::Planner => "Planner",
        }
    }

    /// Returns what the stage trains.
    pub(super) fn meaning(self) -> &'static str {
        match self {
            Self::Diffusion => "the UNet",
            Self::Decoder => "the motion decoder",
            Self::Finetune => "the UNet and the decoder, end to end",
            Self::Group => "the denoiser and the score of groups",
            Self::Tokens => "encoder, codebook, signal and denoiser",
            Self::Planner => "which tokens go with music",
        }
    }
}

/// A panel of a plot of training, which shows one quantity over the steps of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TrainingPanel {
    Loss,
    Diffusion,
    DecoderPosition,
    VelocityCoherence,
    AccelerationCoherence,
    Jerk,
    DecoderQuaternion,
    QuaternionDelta,
    PhaseMonotonic,
    PositionSmoothness,
    Markers,
    Contrast,
    Commitment,
    Perplexity,
    GradientNorm,
    LearningRate,
}

impl TrainingPanel {
    /// Every panel, in the order in which they are drawn.
    pub const ALL: [Self; 16] = [
        Self::Loss,
        Self::Diffusion,
        Self::DecoderPosition,
        Self::VelocityCoherence,
        Self::AccelerationCoherence,
        Self::Jerk,
        Self::DecoderQuaternion,
        Self::QuaternionDelta,
        Self::PhaseMonotonic,
        Self::PositionSmoothness,
        Self::Markers,
        Self::Contrast,
        Self::Commitment,
        Self::Perplexity,
        Self::GradientNorm,
        Self::LearningRate,
    ];

    /// Returns the quantity's name, as in the log of training.
    pub fn name(self) -> &'static str {
        match self {
            Self::Loss => "loss",
            Self::Diffusion => "diffusion",
            Self::DecoderPosition => "decoder_position",
            Self::VelocityCoherence => "velocity_coherence",
            Self::AccelerationCoherence => "acceleration_coherence",
            Self::Jerk => "jerk",
            Self::DecoderQuaternion => "decoder_quaternion",
            Self::QuaternionDelta => "quaternion_delta",
            Self::PhaseMonotonic => "phase_monotonic",
            Self::PositionSmoothness => "position_smoothness",
            Self::Markers => "markers",
            Self::Contrast => "contrast",
            Self::Commitment => "commitment",
            Self::Perplexity => "perplexity",
            Self::GradientNorm => "gradient_norm",
            Self::LearningRate => "learning_rate",
        }
    }

    pub(super) fn heading(self, stage: TrainingStage) -> &'static str {
        match self {
            Self::Loss if stage == TrainingStage::Finetune => "Total loss",
            Self::Loss => "Loss",
            Self::Diffusion => "Diffusion",
            Self::DecoderPosition => "Decoder position",
            Self::VelocityCoherence => "Velocity coherence",
            Self::AccelerationCoherence => "Acceleration coherence",
            Self::Jerk => "Jerk",
            Self::DecoderQuaternion => "Decoder quaternion",
            Self::QuaternionDelta => "Quaternion delta",
            Self::PhaseMonotonic => "Phase",
            Self::PositionSmoothness => "Position smoothness",
            Self::Markers => "Markers",
            Self::Contrast => "Contrast",
            Self::Commitment => "Commitment",
            Self::Perplexity => "Perplexity",
            Self::GradientNorm => "Gradient norm",
            Self::LearningRate => "Learning rate",
        }
    }

    /// Returns what the values mean, shown where it has room.
    pub(super) fn meaning(self) -> &'static str {
        match self {
            Self::Loss => "what is minimised",
            Self::Diffusion => "error of the denoiser’s prediction",
            Self::DecoderPosition => "squared error of decoded positions",
            Self::VelocityCoherence => "velocities against steps of the position",
            Self::AccelerationCoherence => "accelerations against steps of the velocity",
            Self::Jerk => "steps of the acceleration",
            Self::DecoderQuaternion => "squared error of decoded quaternions",
            Self::QuaternionDelta => "turns that are too far for one frame",
            Self::PhaseMonotonic => "falls of the phase within bars",
            Self::PositionSmoothness => "steps of the position beyond 0.5 m",
            Self::Markers => "squared error of points fixed to bodies",
            Self::Contrast => "cross-entropy of telling groups from mixed ones",
            Self::Commitment => "squared distance of latents from their codes",
            Self::Perplexity => "codes in use, were all used alike",
            Self::GradientNorm => "before it is clipped",
            Self::LearningRate => "",
        }
    }

    pub(super) fn unit(self) -> &'static str {
        match self {
            Self::DecoderPosition | Self::Markers => "m²",
            Self::Perplexity => "codes",
            Self::PositionSmoothness => "m",
            _ => "",
        }
    }

    /// Returns how values become heights: losses differ by factors.
    pub(super) fn scale(self) -> ValueScale {
        match self {
            Self::Perplexity | Self::GradientNorm | Self::LearningRate => ValueScale::Linear,
            _ => ValueScale::Log,
        }
    }

    /// Returns the names of every panel, as messages list them.
    pub fn known() -> String {
        names_of(&Self::ALL, Self::name)
    }
}

impl FromStr for TrainingPanel {
    type Err = PlotError;

    fn from_str(name: &str) -> Result<Self, PlotError> {
        panel_named(&Self::ALL, Self::name, name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for panel in TrainingPanel::ALL {
            assert_eq!(panel.name().parse::<TrainingPanel>().unwrap(), panel);
        }
        assert_eq!(
            "total".parse::<TrainingPanel>().unwrap_err().to_string(),
            "panel \"total\" is unknown; the panels are loss, diffusion, decoder_position, \
             velocity_coherence, acceleration_coherence, jerk, decoder_quaternion, \
             quaternion_delta, phase_monotonic, position_smoothness, markers, contrast, commitment, \
             perplexity, gradient_norm, learning_rate"
        );
    }

    #[test]
    fn usual_panels_are_panels_of_the_stage() {
        for stage in TrainingStage::ALL {
            let all = stage.panels();
            assert!(stage.usual_panels().iter().all(|panel| all.contains(panel)), "{stage:?}");
            let order = |panel: &TrainingPanel| TrainingPanel::ALL.iter().position(|p| p == panel);
            assert!(all.is_sorted_by_key(order), "{stage:?}");
        }
    }
}
