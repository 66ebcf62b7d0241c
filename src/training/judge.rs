//! Motion that a network in training samples, judged: a loss tells how well noise is told from motion, not how the motion
//! moves that comes of it.

use ndarray::{Array3, ArrayView3};

use crate::autodiff::Stream;
use crate::diffusion::{SamplerConfig, Schedule};
use crate::motion::style::STYLE_DIM;
use crate::motion::{MOTION_DIM, Normalizer};

use super::error::TrainingError;
use super::sampling::{Condition, Denoiser};

/// Seed of the noise: the same for every validation, so that validations differ by the network alone.
const SEED: u64 = 23;

/// Judges sampled motion beside real motion.
pub trait SampleJudge: Send + Sync {
    /// Returns how motion is sampled.
    fn sampler(&self) -> &SamplerConfig;

    /// Returns what the network hears of each window, scaled, \[n, frames, condition_dim\].
    fn heard(&self) -> ArrayView3<'_, f32>;

    /// Returns the distance of motion, \[n, frames, 25\] in metres, from real motion to the same music: 0 for motion that
    /// moves alike. None where motion is not finite.
    fn distance(&self, motion: ArrayView3<f32>) -> Option<f64>;
}

/// Samples motion for the windows of a judge and returns its distance; none without windows, or where motion is not
/// finite.
///
/// # Errors
/// What the network refuses.
pub fn sampled_distance(
    judge: &dyn SampleJudge,
    denoiser: &Denoiser,
    schedule: &Schedule,
    normalizer: &Normalizer,
) -> Result<Option<f64>, TrainingError> {
    let heard = judge.heard();
    let (n, frames, _) = heard.dim();
    if n == 0 {
        return Ok(None);
    }
    let audio = heard.as_standard_layout();
    let condition = Condition {
        audio: audio.as_slice().expect("in order"),
        mask: &vec![1.0; n * frames],
        style: &vec![0.0; n * STYLE_DIM],
        drop_audio: &[],
    };
    let random = |draw: u64, z: &mut [f32]| Stream::new(SEED, draw).normal(0, z);
    let mut x = Array3::zeros((n, frames, MOTION_DIM));
    random(0, x.as_slice_mut().expect("an array made in order"));
    let noise = |draw: usize, z: &mut [f32]| random(draw as u64 + 1, z);
    let mut motion = denoiser.sample(judge.sampler(), schedule, x, &condition, 1.0, noise)?;
    motion.outer_iter_mut().for_each(|window| normalizer.denormalize(window));
    Ok(judge.distance(motion.view()))
}
