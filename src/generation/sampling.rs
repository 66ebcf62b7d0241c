//! Motion sampled step by step with an engine.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, concatenate};

use crate::diffusion::{Known, SamplerConfig, Schedule, denoise_guided, sample as run_sampler};

use super::engine::{Engine, EngineError, Inputs};

/// How motion is sampled.
#[derive(Clone, Copy, Debug)]
pub struct Sampling<'a> {
    pub config: &'a SamplerConfig,
    pub schedule: &'a Schedule,
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
}

/// Samples: noise x_T becomes x0, normalised, \[batch, frames, 25\].
///
/// With a guidance other than 0 and 1 each step is one call of a doubled batch. `noise` fills the draw of a
/// number; see [`crate::diffusion::sample`].
///
/// # Errors
/// What the sampler or the engine refuses.
pub fn sample(
    engine: &dyn Engine,
    sampling: Sampling,
    x: Array3<f32>,
    audio: ArrayView3<f32>,
    style: Option<ArrayView2<f32>>,
    noise: impl FnMut(usize, &mut [f32]),
    known: Option<&Known>,
) -> Result<Array3<f32>, EngineError> {
    let is_double = sampling.guidance != 1.0 && sampling.guidance != 0.0;
    // What does not change from step to step is doubled once.
    let both: Option<(Array3<f32>, Option<Array2<f32>>)> = is_double.then(|| {
        let twice = concatenate(Axis(0), &[audio, audio]).expect("two views of one shape");
        let style = style.map(|s| concatenate(Axis(0), &[s, s]).expect("two views of one shape"));
        (twice, style)
    });
    let (audio, style) = match &both {
        Some((audio, style)) => (audio.view(), style.as_ref().map(|style| style.view())),
        None => (audio, style),
    };
    let denoise = |x: ArrayView3<f32>, t: usize| {
        denoise_guided(sampling.guidance, x, t, |x, t, dropped: &[bool]| {
            let t = vec![t; dropped.len()];
            engine.predict(&Inputs { x, t: &t, audio, drop_audio: dropped, style })
        })
    };
    run_sampler(sampling.config, sampling.schedule, x, denoise, noise, known)
}
