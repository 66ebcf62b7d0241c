//! How a model of tokens is best sampled, measured as for models of other families.

use std::num::NonZeroUsize;

use ndarray::{Array2, Axis, concatenate};

use super::{TrainedTokens, engines};
use crate::diffusion::{SamplerConfig, Schedule, TokenSampling};
use crate::generation::{EngineError, SamplingDefaults, TokenGenerator, TokenTrack};
use crate::model::condition;
use crate::stages::Progress;
use crate::stages::export::tuning::{SEED, tuned};
use crate::stages::validation_motion::{Window, song_of};
use crate::training::{Dataset, Phrase, Split};

/// Most windows that are planned and made for each guidance.
const N_WINDOWS: usize = 16;

/// Measures the guidance of the plan with which motion is locked to the bar as real motion is, and the errors that the
/// decoder leaves; none without validation phrases as long as a window.
///
/// # Errors
/// When the frames cannot be read, or errors of the engines.
pub fn sampling_defaults(
    trained: &TrainedTokens,
    threads: NonZeroUsize,
    dataset: &Dataset,
    progress: &dyn Progress,
) -> anyhow::Result<Option<SamplingDefaults>> {
    let network = &trained.tokenizer.state.config.network;
    let n_frames = network.window_frames;
    let (tokens, planner) = engines(trained, threads)?;
    let is_fit = |p: &&Phrase| p.split == Split::Validation && p.n_frames >= n_frames;
    let phrases: Vec<&Phrase> = dataset.phrases().iter().filter(is_fit).collect();
    let n = phrases.len().min(N_WINDOWS);
    let mut windows: Vec<Window> = Vec::new();
    for i in 0..n {
        let phrase = phrases[i * phrases.len() / n];
        let features = dataset.features(phrase, 0, n_frames)?;
        let motion = dataset.motion(phrase, 0, n_frames)?;
        let clock = phrase.clock_of(motion.view());
        let heard = condition(planner.config().condition(), features.view(), Some(clock.view()));
        let (song, beats_per_bar) = (song_of(phrase), phrase.beats_per_bar);
        windows.push(Window { song, beats_per_bar, motion, heard });
    }
    let schedule = Schedule::new(&network.diffusion)?;
    let (sampler, plan) = (SamplerConfig::fast27(), TokenSampling::default());
    sampler.check(schedule.len())?;
    tuned(&windows, dataset, progress, |guidance| {
        let generator = TokenGenerator {
            tokens: &tokens,
            planner: &planner,
            plan: &plan,
            sampler: &sampler,
            schedule: &schedule,
            guidance,
            overlap_tokens: 0,
        };
        let made = windows.iter().enumerate().map(|(i, window)| {
            let (condition, seed) = (window.heard.view(), SEED + i as u64);
            let track = TokenTrack::new(condition, seed);
            let mut parts: Vec<Array2<f32>> = Vec::new();
            let _plans = generator.run(&track, |frames| -> Result<(), EngineError> {
                parts.push(frames);
                Ok(())
            })?;
            let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
            Ok(concatenate(Axis(0), &views).expect("invariant: parts of one motion"))
        });
        made.collect()
    })
}
