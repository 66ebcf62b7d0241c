//! The flags of training, and the configuration that they make.

mod tokens;

use std::num::NonZeroUsize;

use crate::diffusion::{BetaSchedule, DiffusionConfig, LossType, Prediction};
use crate::model::{DecoderConfig, Family, GroupConfig, Preset, UNetConfig};
use crate::motion::ChannelLimits;
use crate::motion::style::STYLE_DIM;
use crate::stages::RARE;
use crate::training::{
    Augmentation, ChannelWeights, DecoderTraining, DiffusionTraining, EmaConfig, EstimateLosses,
    GroupLosses, GroupNetworkConfig, GroupTrainConfig, GroupTraining, LearningRate,
    LearningRateSchedule, NetworkConfig, Objective, OptimizerConfig, TrainConfig,
};
pub use tokens::TokensParams;

/// Sizes of the networks; each wins over the preset.
#[derive(Clone, Debug, clap::Args)]
pub struct NetworkParams {
    /// Kind of the networks: a UNet and a decoder for one dancer; a transformer and a score for groups of dancers,
    /// which learns from phrases of two dancers and more (docs/groups.md); or a tokenizer of motion and, with
    /// --tokenizer, a planner of its tokens (docs/tokens.md).
    #[arg(long, value_enum, default_value_t = Family::Unet, help_heading = "Networks")]
    pub family: Family,
    /// Size of the networks.
    #[arg(long, value_enum, default_value_t = Preset::Small, help_heading = "Networks")]
    pub preset: Preset,
    /// Channels of each level, 256,512,… [default: the preset's]
    #[arg(long, value_name = "N", value_delimiter = ',', help_heading = "Networks",
          hide_short_help = RARE)]
    pub widths: Vec<usize>,
    /// Residual blocks of a level [default: 2]
    #[arg(long, value_name = "N", help_heading = "Networks", hide_short_help = RARE)]
    pub num_res_blocks: Option<usize>,
    /// Levels that attend [default: all but the first]
    #[arg(long, value_name = "LEVEL", value_delimiter = ',', help_heading = "Networks",
          hide_short_help = RARE)]
    pub attention_levels: Option<Vec<usize>>,
    /// Heads of attention [default: the preset's]
    #[arg(long, value_name = "N", help_heading = "Networks", hide_short_help = RARE)]
    pub num_heads: Option<usize>,
    /// Channels of a head, instead of --num-heads
    #[arg(long, value_name = "N", help_heading = "Networks", hide_short_help = RARE)]
    pub num_head_channels: Option<usize>,
    /// Numbers of the time embedding [default: the preset's]
    #[arg(long, value_name = "N", help_heading = "Networks", hide_short_help = RARE)]
    pub time_embed_dim: Option<usize>,
    /// Channels of the music as attention sees it [default: the preset's]
    #[arg(long, value_name = "N", help_heading = "Networks", hide_short_help = RARE)]
    pub context_dim: Option<usize>,
    /// Share of the UNet's numbers that training drops [default: 0.1]
    #[arg(long, value_name = "P", help_heading = "Networks", hide_short_help = RARE)]
    pub dropout: Option<f64>,
    /// Compute inner values of the UNet again for their gradient: less memory, a third more time.
    #[arg(long, help_heading = "Networks", hide_short_help = RARE)]
    pub use_checkpoint: bool,
    /// Let the music in by attention alone, as the reference draws it; such a network cannot tell when a
    /// beat falls.
    #[arg(long, help_heading = "Networks", hide_short_help = RARE)]
    pub attention_only: bool,
    /// Let the UNet hear the features alone, as the reference does, without the clock: where in its bar and how
    /// fast the music is.
    #[arg(long, help_heading = "Networks", hide_short_help = RARE)]
    pub no_clock: bool,
    /// Let the UNet take a style (the mean of the style channels) beside the music.
    #[arg(long, help_heading = "Networks", hide_short_help = RARE)]
    pub style: bool,
    /// Width of the decoder.
    #[arg(long, value_name = "N", default_value_t = DecoderConfig::default().hidden_dim,
          help_heading = "Networks", hide_short_help = RARE)]
    pub decoder_hidden_dim: usize,
    /// Blocks of the decoder.
    #[arg(long, value_name = "N", default_value_t = DecoderConfig::default().n_blocks,
          help_heading = "Networks", hide_short_help = RARE)]
    pub decoder_blocks: usize,
    /// Width of a decoder block's inner layer, in units of --decoder-hidden-dim.
    #[arg(long, value_name = "N", default_value_t = DecoderConfig::default().expansion,
          help_heading = "Networks", hide_short_help = RARE)]
    pub decoder_expansion: usize,
    /// Share of the decoder's numbers that training drops.
    #[arg(long, value_name = "P", default_value_t = 0.0, help_heading = "Networks",
          hide_short_help = RARE)]
    pub decoder_dropout: f64,
    /// Limits within which the decoder keeps velocities and accelerations.
    #[arg(long, value_enum, default_value_t = ChannelLimits::Wide, help_heading = "Networks",
          hide_short_help = RARE)]
    pub limits: ChannelLimits,
    /// Frames of a window, 30 a second.
    #[arg(long, value_name = "N", default_value_t = 120, help_heading = "Networks",
          hide_short_help = RARE)]
    pub window_frames: usize,
}

/// The diffusion process.
#[derive(Clone, Debug, clap::Args)]
pub struct DiffusionParams {
    /// Steps of the diffusion.
    #[arg(long, value_name = "N", default_value_t = DiffusionConfig::default().n_steps,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub timesteps: usize,
    /// How noise grows from step to step.
    #[arg(long, value_enum, default_value_t = DiffusionConfig::default().beta_schedule,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub beta_schedule: BetaSchedule,
    /// First noise of a linear or sqrt schedule.
    #[arg(long, value_name = "X", default_value_t = DiffusionConfig::default().beta_start,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub beta_start: f64,
    /// Last noise of a linear or sqrt schedule.
    #[arg(long, value_name = "X", default_value_t = DiffusionConfig::default().beta_end,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub beta_end: f64,
    /// What the UNet predicts. From a prediction of noise clean motion follows by a division by nearly 0
    /// at the noisiest steps, which samplers of few steps do not survive.
    #[arg(long, value_enum, default_value_t = Prediction::Sample, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub prediction: Prediction,
    /// Estimates of clean motion are kept within so many standard deviations; 0 for no limit.
    #[arg(long, value_name = "X", default_value_t = 5.0, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub clip_range: f64,
    /// What is made small.
    #[arg(long, value_enum, default_value_t = LossType::Mse, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub loss: LossType,
    /// Where Huber's loss turns from squared to linear.
    #[arg(long, value_name = "X", default_value_t = Objective::default().huber_delta,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub huber_delta: f64,
    /// Weigh steps by min-SNR with this γ (5 is usual) [default: all steps alike]
    #[arg(long, value_name = "GAMMA", help_heading = "Diffusion", hide_short_help = RARE)]
    pub min_snr_gamma: Option<f64>,
    /// Weight of each style channel; all others but the vertical ones have 1.
    #[arg(long, value_name = "X", default_value_t = ChannelWeights::default().style,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub style_weight: f64,
    /// Weight of vertical position, velocity and acceleration.
    #[arg(long, value_name = "X", default_value_t = ChannelWeights::default().vertical,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub vertical_weight: f64,
    /// Weight of position and orientation [default: 8 in a tokenizer, whose tokens must say where a body is, else 1]
    #[arg(long, value_name = "X", help_heading = "Diffusion", hide_short_help = RARE)]
    pub pose_weight: Option<f64>,
    /// Weight of velocities against differences of positions, of the estimate of clean motion.
    #[arg(long, value_name = "X", default_value_t = EstimateLosses::default().velocity,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub velocity_loss: f64,
    /// Weight of accelerations against differences of velocities.
    #[arg(long, value_name = "X", default_value_t = EstimateLosses::default().acceleration,
          help_heading = "Diffusion", hide_short_help = RARE)]
    pub acceleration_loss: f64,
    /// Weights of the first, second and third differences of poses against the truth's.
    #[arg(long, value_name = "X,X,X", value_delimiter = ',', num_args = 1..,
          default_values_t = EstimateLosses::default().differences, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub difference_losses: Vec<f64>,
    /// Probability that a window goes without its music, for guidance.
    #[arg(long, value_name = "P", default_value_t = 0.1, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub condition_dropout: f64,
    /// Probability that a window goes without its clock alone, so that the network hears as well.
    #[arg(long, value_name = "P", default_value_t = 0.1, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub clock_dropout: f64,
    /// Probability that a window goes without its style, with --style.
    #[arg(long, value_name = "P", default_value_t = 0.1, help_heading = "Diffusion",
          hide_short_help = RARE)]
    pub style_dropout: f64,
}

/// What a model of groups learns beside clean motion.
#[derive(Clone, Debug, clap::Args)]
pub struct GroupParams {
    /// Weight of points fixed to each body, in 1/m².
    #[arg(long, value_name = "X", default_value_t = GroupLosses::default().markers,
          help_heading = "Groups", hide_short_help = RARE)]
    pub markers_loss: f64,
    /// Weight of telling a group from mixed ones, by which --consistency works.
    #[arg(long, value_name = "X", default_value_t = GroupLosses::default().contrast,
          help_heading = "Groups", hide_short_help = RARE)]
    pub contrast_loss: f64,
    /// Mixed groups beside each group.
    #[arg(long, value_name = "N", default_value_t = GroupLosses::default().n_negatives,
          help_heading = "Groups", hide_short_help = RARE)]
    pub negatives: usize,
}

/// What makes more of each phrase.
#[derive(Clone, Debug, clap::Args)]
pub struct AugmentationParams {
    /// Standard deviation of the noise added to features.
    #[arg(long, value_name = "X", default_value_t = Augmentation::default().condition_noise,
          help_heading = "Augmentation", hide_short_help = RARE)]
    pub condition_noise: f64,
    /// Do not mirror windows in x.
    #[arg(long, help_heading = "Augmentation", hide_short_help = RARE)]
    pub no_mirror: bool,
    /// Turn windows about the vertical by up to so many degrees.
    #[arg(long, value_name = "DEG", default_value_t = Augmentation::default().yaw_deg,
          help_heading = "Augmentation", hide_short_help = RARE)]
    pub yaw_rotation: f64,
    /// Change the speed of windows, music and motion, by up to this share.
    #[arg(long, value_name = "X", default_value_t = Augmentation::default().stretch,
          help_heading = "Augmentation", hide_short_help = RARE)]
    pub time_stretch: f64,
}

/// How weights are moved.
#[derive(Clone, Debug, clap::Args)]
pub struct OptimizerParams {
    /// Windows of a step.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::new(32).expect("not 0"),
          help_heading = "Optimizer")]
    pub batch_size: NonZeroUsize,
    /// Parts of a batch done one after the other, to save memory.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub accumulate: NonZeroUsize,
    /// Parts of a batch done at once, each by its share of the threads: twice as fast for a small network,
    /// whose operations are too short to be shared out; one more gradient in memory each [default: 1; 2
    /// for tiny and small]
    #[arg(long, value_name = "N", help_heading = "Optimizer", hide_short_help = RARE)]
    pub side_by_side: Option<NonZeroUsize>,
    /// Highest learning rate of the UNet [default: 1e-4; 5e-4 for tiny and small; of a tokenizer 2e-4 and 2e-3]
    #[arg(long, value_name = "X", help_heading = "Optimizer", hide_short_help = RARE)]
    pub learning_rate: Option<f64>,
    /// Course of the learning rate after the warm-up.
    #[arg(long, value_enum, default_value_t = LearningRateSchedule::Cosine,
          help_heading = "Optimizer", hide_short_help = RARE)]
    pub lr_schedule: LearningRateSchedule,
    /// Steps of the warm-up; in a short training a tenth of all.
    #[arg(long, value_name = "N", default_value_t = 1000, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub warmup_steps: u64,
    /// Decay of weights.
    #[arg(long, value_name = "X", default_value_t = OptimizerConfig::default().weight_decay,
          help_heading = "Optimizer", hide_short_help = RARE)]
    pub weight_decay: f64,
    /// Largest norm of the gradient; 0 for no limit.
    #[arg(long, value_name = "X", default_value_t = 1.0, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub gradient_clip: f64,
    /// Decay of the average of the weights.
    #[arg(long, value_name = "X", default_value_t = EmaConfig::default().decay,
          help_heading = "Optimizer", hide_short_help = RARE)]
    pub ema_decay: f64,
    /// Steps between two updates of the average.
    #[arg(long, value_name = "N", default_value_t = EmaConfig::default().every,
          value_parser = clap::value_parser!(u64).range(1..), help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub ema_update_every: u64,
    /// Windows of a step of the decoder.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::new(8).expect("not 0"),
          help_heading = "Optimizer", hide_short_help = RARE)]
    pub decoder_batch_size: NonZeroUsize,
    /// Highest learning rate of the decoder.
    #[arg(long, value_name = "X", default_value_t = 1e-3, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub decoder_learning_rate: f64,
}

/// What is rarely changed.
#[derive(Clone, Debug, clap::Args)]
pub struct AdvancedParams {
    /// Decays of AdamW's averages of the gradient and its square.
    #[arg(long, value_name = "X", num_args = 2, value_delimiter = ',',
          default_values_t = OptimizerConfig::default().betas, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub betas: Vec<f64>,
    /// What AdamW adds to the root of the average square.
    #[arg(long, value_name = "X", default_value_t = OptimizerConfig::default().epsilon,
          help_heading = "Optimizer", hide_short_help = RARE)]
    pub epsilon: f64,
    /// Latents for the decoder are made noisy up to this share of the diffusion's steps.
    #[arg(long, value_name = "SHARE", default_value_t = 0.05, help_heading = "Decoder",
          hide_short_help = RARE)]
    pub decoder_noised_to: f64,
    /// Of so many batches one has latents that the UNet sampled; 0 for none.
    #[arg(long, value_name = "N", default_value_t = 4, help_heading = "Decoder",
          hide_short_help = RARE)]
    pub decoder_sampled_every: u64,
    /// They are sampled from up to this share of the diffusion's steps.
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, help_heading = "Decoder",
          hide_short_help = RARE)]
    pub decoder_sampled_from: f64,
    /// In so many steps of DDIM.
    #[arg(long, value_name = "N", default_value_t = 5, help_heading = "Decoder",
          hide_short_help = RARE)]
    pub decoder_sampler_steps: usize,
}

/// Everything that determines what a run learns.
#[derive(Clone, Debug, clap::Args)]
pub struct ConfigParams {
    #[command(flatten)]
    pub network: NetworkParams,
    #[command(flatten)]
    pub diffusion: DiffusionParams,
    #[command(flatten)]
    pub group: GroupParams,
    #[command(flatten)]
    pub tokens: TokensParams,
    #[command(flatten)]
    pub augmentation: AugmentationParams,
    #[command(flatten)]
    pub optimizer: OptimizerParams,
    #[command(flatten)]
    pub rare: AdvancedParams,
}

impl NetworkParams {
    fn unet(&self, timesteps: usize) -> UNetConfig {
        let preset = self.preset.config();
        let levels = if self.widths.is_empty() { preset.widths.len() } else { self.widths.len() };
        let attention_levels = match (&self.attention_levels, self.widths.is_empty()) {
            (Some(levels), _) => levels.clone(),
            (None, true) => preset.attention_levels.clone(),
            (None, false) => (1..levels).collect(),
        };
        UNetConfig {
            widths: if self.widths.is_empty() {
                preset.widths.clone()
            } else {
                self.widths.clone()
            },
            num_res_blocks: self.num_res_blocks.unwrap_or(preset.num_res_blocks),
            attention_levels,
            num_heads: self.num_heads.unwrap_or(preset.num_heads),
            num_head_channels: self.num_head_channels.or(preset.num_head_channels),
            time_embed_dim: self.time_embed_dim.unwrap_or(preset.time_embed_dim),
            context_dim: self.context_dim.unwrap_or(preset.context_dim),
            add_audio: !self.attention_only,
            clock: !self.no_clock,
            style_dim: if self.style { STYLE_DIM } else { 0 },
            dropout: self.dropout.unwrap_or(preset.dropout),
            n_steps: timesteps,
            use_checkpoint: self.use_checkpoint,
            ..preset
        }
    }

    fn decoder(&self) -> DecoderConfig {
        DecoderConfig {
            hidden_dim: self.decoder_hidden_dim,
            n_blocks: self.decoder_blocks,
            expansion: self.decoder_expansion,
            dropout: self.decoder_dropout,
            limits: self.limits,
            ..DecoderConfig::default()
        }
    }

    /// Returns how many parts of a batch suit the preset: those of a large network keep all threads busy.
    fn side_by_side(&self) -> usize {
        match self.preset {
            Preset::Tiny | Preset::Small => 2,
            Preset::Base | Preset::Large => 1,
        }
    }

    /// Returns the learning rate that suits the preset: small networks learn faster than large ones.
    fn learning_rate(&self) -> f64 {
        match self.preset {
            Preset::Tiny | Preset::Small => 5e-4,
            Preset::Base | Preset::Large => 1e-4,
        }
    }
}

impl ConfigParams {
    /// Returns the configuration that the flags make.
    pub fn config(&self, seed: u64) -> TrainConfig {
        let Self { network, diffusion: d, augmentation: a, optimizer: o, rare, .. } = self;
        let positive = |x: f64| (x > 0.0).then_some(x);
        let ema = EmaConfig { decay: o.ema_decay, every: o.ema_update_every };
        let beta =
            |i: usize| rare.betas.get(i).copied().unwrap_or(OptimizerConfig::default().betas[i]);
        let optimizer = OptimizerConfig {
            betas: [beta(0), beta(1)],
            epsilon: rare.epsilon,
            weight_decay: o.weight_decay,
            gradient_clip: positive(o.gradient_clip),
        };
        let rate =
            |peak: f64| LearningRate { peak, course: o.lr_schedule, warmup_steps: o.warmup_steps };
        TrainConfig {
            seed,
            network: NetworkConfig {
                unet: network.unet(d.timesteps),
                decoder: network.decoder(),
                diffusion: DiffusionConfig {
                    n_steps: d.timesteps,
                    beta_schedule: d.beta_schedule,
                    beta_start: d.beta_start,
                    beta_end: d.beta_end,
                    prediction: d.prediction,
                    clip_range: positive(d.clip_range),
                },
                window_frames: network.window_frames,
            },
            diffusion: DiffusionTraining {
                objective: Objective {
                    loss: d.loss,
                    huber_delta: d.huber_delta,
                    min_snr_gamma: d.min_snr_gamma,
                    channels: ChannelWeights {
                        style: d.style_weight,
                        vertical: d.vertical_weight,
                        pose: d.pose_weight.unwrap_or(ChannelWeights::default().pose),
                    },
                    estimate: EstimateLosses {
                        velocity: d.velocity_loss,
                        acceleration: d.acceleration_loss,
                        differences: d.difference_losses.clone().try_into().unwrap_or_default(),
                    },
                },
                augmentation: Augmentation {
                    condition_noise: a.condition_noise,
                    mirror: !a.no_mirror,
                    yaw_deg: a.yaw_rotation,
                    stretch: a.time_stretch,
                },
                condition_dropout: d.condition_dropout,
                // A network without a clock has none to withhold, so that runs of release 0.1 go on.
                clock_dropout: if network.no_clock { 0.0 } else { d.clock_dropout },
                style_dropout: d.style_dropout,
                batch_size: o.batch_size.get(),
                accumulate: o.accumulate.get(),
                side_by_side: o
                    .side_by_side
                    .map_or_else(|| network.side_by_side(), NonZeroUsize::get),
                learning_rate: rate(o.learning_rate.unwrap_or_else(|| network.learning_rate())),
                optimizer: optimizer.clone(),
                ema,
            },
            decoder: DecoderTraining {
                batch_size: o.decoder_batch_size.get(),
                learning_rate: rate(o.decoder_learning_rate),
                optimizer,
                ema,
                noised_to: rare.decoder_noised_to,
                sampled_every: rare.decoder_sampled_every,
                sampled_from: rare.decoder_sampled_from,
                sampler_steps: rare.decoder_sampler_steps,
            },
        }
    }

    /// Returns the configuration of a model of groups that the flags make; none for a preset that it does not have.
    pub fn group_config(&self, seed: u64) -> Option<GroupTrainConfig> {
        let sizes = GroupConfig::of(self.network.preset)?;
        let TrainConfig { network, diffusion, .. } = self.config(seed);
        let GroupParams { markers_loss, contrast_loss, negatives } = self.group;
        Some(GroupTrainConfig {
            seed,
            network: GroupNetworkConfig {
                group: GroupConfig {
                    clock: !self.network.no_clock,
                    add_audio: !self.network.attention_only,
                    dropout: self.network.dropout.unwrap_or(sizes.dropout),
                    n_steps: network.diffusion.n_steps,
                    ..sizes
                },
                diffusion: network.diffusion,
                window_frames: network.window_frames,
            },
            group: GroupTraining {
                objective: diffusion.objective,
                losses: GroupLosses {
                    markers: markers_loss,
                    contrast: contrast_loss,
                    n_negatives: negatives,
                },
                augmentation: diffusion.augmentation,
                condition_dropout: diffusion.condition_dropout,
                clock_dropout: diffusion.clock_dropout,
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
