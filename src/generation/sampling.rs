//! Motion sampled step by step with an engine.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, concatenate};

use crate::diffusion::{Refine, SamplerConfig, Schedule, denoise_guided, sample_refined};

use super::engine::{Engine, EngineError, EngineInputs};

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
/// With a guidance other than 0 and 1 each step is one call of a doubled batch. `x` comes with the number of
/// steps that are left, `noise` fills the draw of a number, and `refine` changes every estimate of x0; see
/// [`sample_refined`].
///
/// # Errors
/// What the sampler or the engine refuses.
pub fn sample(
    engine: &dyn Engine,
    sampling: Sampling,
    start: (Array3<f32>, usize),
    audio: ArrayView3<f32>,
    style: Option<ArrayView2<f32>>,
    noise: impl FnMut(usize, &mut [f32]),
    refine: Option<Refine>,
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
            engine.predict(&EngineInputs { x, t: &t, audio, drop_audio: dropped, style })
        })
    };
    sample_refined(sampling.config, sampling.schedule, start, denoise, noise, None, refine)
}
