//! What a run is told: everything that determines what it learns.

use serde::{Deserialize, Serialize};

use crate::autodiff::AdamWConfig;
use crate::diffusion::DiffusionConfig;
use crate::model::{DecoderConfig, UNetConfig};

use super::ema::EmaConfig;
use super::error::TrainingError;
use super::learning_rate::LearningRate;
use super::objective::Objective;
use super::temporal::TemporalConfig;
use super::window::Augmentation;

/// Settings of the optimizer, AdamW with clipping.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OptimizerConfig {
    pub betas: [f64; 2],
    pub epsilon: f64,
    pub weight_decay: f64,
    /// Largest norm of the gradient; `None` for no limit.
    pub gradient_clip: Option<f64>,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        let AdamWConfig { betas, epsilon, weight_decay, max_norm } = AdamWConfig::default();
        Self { betas, epsilon, weight_decay, gradient_clip: max_norm }
    }
}

impl OptimizerConfig {
    pub(super) fn adamw(&self) -> AdamWConfig {
        let Self { betas, epsilon, weight_decay, gradient_clip: max_norm } = *self;
        AdamWConfig { betas, epsilon, weight_decay, max_norm }
    }
}

/// The networks of a run, and how their inputs are made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NetworkConfig {
    pub unet: UNetConfig,
    pub decoder: DecoderConfig,
    pub diffusion: DiffusionConfig,
    /// Frames of a window.
    pub window_frames: usize,
}

impl NetworkConfig {
    /// Refuses networks that cannot be made, or that do not fit each other.
    ///
    /// # Errors
    /// One sentence.
    pub fn check(&self) -> Result<(), TrainingError> {
        self.unet.check()?;
        self.diffusion.check()?;
        if self.unet.n_steps != self.diffusion.n_steps {
            return Err(TrainingError::Config(format!(
                "the network knows {} steps of diffusion, the schedule has {}; give both the same",
                self.unet.n_steps, self.diffusion.n_steps
            )));
        }
        if self.window_frames < 2 {
            return Err(TrainingError::Config(format!(
                "a window has {} frames; it must have at least 2",
                self.window_frames
            )));
        }
        Ok(())
    }
}

/// How the UNet is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DiffusionTraining {
    pub objective: Objective,
    pub augmentation: Augmentation,
    /// Probability that a window goes without its music, for guidance.
    pub condition_dropout: f64,
    /// Probability that a window goes without its clock alone, in a network that hears it.
    #[serde(default)]
    pub clock_dropout: f64,
    /// Probability that a window goes without its style, in a network that takes one.
    pub style_dropout: f64,
    pub batch_size: usize,
    /// Parts of a batch that are done one after the other, to save memory.
    pub accumulate: usize,
    /// Parts of such a part that are done at once, each by its share of the threads.
    pub side_by_side: usize,
    pub learning_rate: LearningRate,
    pub optimizer: OptimizerConfig,
    pub ema: EmaConfig,
}

/// How the decoder is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DecoderTraining {
    pub batch_size: usize,
    pub learning_rate: LearningRate,
    pub optimizer: OptimizerConfig,
    pub ema: EmaConfig,
    /// Latents are made noisy up to this share of the diffusion's steps.
    pub noised_to: f64,
    /// One of every `sampled_every` batches has latents that the UNet sampled; 0 for none.
    pub sampled_every: u64,
    /// The UNet samples from up to this share of the steps, so that the latent is still of its motion.
    pub sampled_from: f64,
    /// Steps of DDIM by which it does.
    pub sampler_steps: usize,
}

/// A training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainConfig {
    pub seed: u64,
    pub network: NetworkConfig,
    pub diffusion: DiffusionTraining,
    pub decoder: DecoderTraining,
}

/// End-to-end fine-tuning of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinetuneConfig {
    pub seed: u64,
    pub batch_size: usize,
    pub lr_diffusion: f64,
    pub lr_decoder: f64,
    pub diffusion_weight: f64,
    pub decoder_weight: f64,
    pub temporal_weight: f64,
    pub temporal: TemporalConfig,
    /// Steps of DDIM that gradients flow through.
    pub num_steps: usize,
    /// Sampling begins with the phrase's motion at this share of the diffusion's steps; with noise at 1.
    pub start: f64,
    pub optimizer: OptimizerConfig,
    pub num_phrases: Option<usize>,
}

impl FinetuneConfig {
    /// Returns the number of steps of the diffusion that sampling goes back over, at least those of DDIM.
    pub fn first_step(&self, n_train: usize) -> usize {
        let share = (self.start * n_train as f64).round() as usize;
        share.clamp(self.num_steps.min(n_train), n_train)
    }
}

/// Returns what differs between two configurations, one phrase for each setting.
pub fn differences<T: Serialize>(asked: &T, known: &T) -> Vec<String> {
    fn walk(path: &str, a: &serde_json::Value, b: &serde_json::Value, found: &mut Vec<String>) {
        match (a, b) {
            (serde_json::Value::Object(a), serde_json::Value::Object(b)) => {
                let keys: std::collections::BTreeSet<_> = a.keys().chain(b.keys()).collect();
                for key in keys {
                    let null = serde_json::Value::Null;
                    let (a, b) = (a.get(key).unwrap_or(&null), b.get(key).unwrap_or(&null));
                    let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                    walk(&path, a, b, found);
                }
            }
            (a, b) if a != b => found.push(format!("{path} is {a}, the run has {b}")),
            _ => {}
        }
    }
    let mut found = Vec::new();
    // A configuration that cannot be written down differs from none.
    if let (Ok(a), Ok(b)) = (serde_json::to_value(asked), serde_json::to_value(known)) {
        walk("", &a, &b, &mut found);
    }
    found
}
