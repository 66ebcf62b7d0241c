//! The UNet as a denoiser: what samplers call.

use ndarray::{Array3, ArrayView3};

use crate::autodiff::{Arena, Eager, Parameters, Tensor};
use crate::diffusion::{SamplerConfig, Schedule, denoise_guided, sample};
use crate::model::{UNet1D, UNetInputs};
use crate::motion::MOTION_DIM;
use crate::motion::style::STYLE_DIM;

use super::batch::Batch;
use super::error::TrainingError;

/// A UNet with its weights.
#[derive(Clone, Copy)]
pub struct Denoiser<'a> {
    pub unet: &'a UNet1D,
    pub parameters: &'a Parameters<f32>,
    pub arena: &'a Arena<f32>,
    /// Whether the network takes a style.
    pub takes_style: bool,
}

/// The conditions of a denoiser.
#[derive(Clone, Copy, Debug)]
pub struct Condition<'a> {
    /// Features, `[batch, frames, 163]`.
    pub audio: &'a [f32],
    /// `[batch, frames]`
    pub mask: &'a [f32],
    /// Mean normalised style, `[batch, 8]`.
    pub style: &'a [f32],
    /// 1 for each sample that goes without the music, `[batch]`; empty where all have music.
    pub drop_audio: &'a [f32],
}

impl<'a> Condition<'a> {
    /// Listens to what a batch has.
    pub fn of(batch: &'a Batch) -> Self {
        let Batch { audio, mask, style, .. } = batch;
        Self { audio, mask, style, drop_audio: &[] }
    }
}

impl Denoiser<'_> {
    /// Predicts: what the network says of x_t.
    ///
    /// # Shapes
    /// - `x`: \[batch, frames, 25\], normalised; `t`: below the number of steps
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn predict(
        &self,
        x: ArrayView3<f32>,
        t: &[usize],
        condition: &Condition,
    ) -> Result<Array3<f32>, TrainingError> {
        let (batch, frames, channels) = x.dim();
        let mut g = Eager::new(self.parameters, self.arena);
        let contiguous = x.as_standard_layout();
        let values = contiguous.as_slice().expect("in order");
        let x = g.input(&[batch, frames, channels], values);
        let steps: Vec<f32> = t.iter().map(|&t| t as f32).collect();
        let t = g.input(&[batch], &steps);
        let n_features = condition.audio.len() / (batch * frames).max(1);
        let audio = g.input(&[batch, frames, n_features], condition.audio);
        let mask = is_partial(condition.mask).then(|| g.input(&[batch, frames], condition.mask));
        let drop = condition.drop_audio;
        let drop_audio = (!drop.is_empty()).then(|| g.input(&[batch], drop));
        let style = self.takes_style.then(|| g.input(&[batch, STYLE_DIM], condition.style));
        let inputs = UNetInputs {
            x: &x,
            t: &t,
            audio: &audio,
            drop_audio: drop_audio.as_ref(),
            mask: mask.as_ref(),
            style: style.as_ref(),
        };
        let y = self.unet.forward(&mut g, inputs)?;
        Ok(to_array(&y))
    }

    /// Samples: noise x_T becomes x0, normalised, \[batch, frames, 25\].
    ///
    /// With a `guidance` other than 1 every step looks twice, with the music and without, as one batch of
    /// both; see [`denoise_guided`]. `noise` fills the draw of a number; see [`sample`].
    ///
    /// # Errors
    /// What the sampler or the network refuses.
    pub fn sample(
        &self,
        config: &SamplerConfig,
        schedule: &Schedule,
        x: Array3<f32>,
        condition: &Condition,
        guidance: f64,
        noise: impl FnMut(usize, &mut [f32]),
    ) -> Result<Array3<f32>, TrainingError> {
        let batch = x.dim().0;
        let denoise = |x: ArrayView3<f32>, t: usize| {
            denoise_guided(guidance, x, t, |x, t, dropped: &[bool]| {
                let n = dropped.len();
                let repeat = |values: &[f32]| values.repeat(n / batch.max(1));
                let (audio, mask) = (repeat(condition.audio), repeat(condition.mask));
                let style = repeat(condition.style);
                let drop: Vec<f32> = dropped.iter().map(|&d| f32::from(u8::from(d))).collect();
                let condition =
                    Condition { audio: &audio, mask: &mask, style: &style, drop_audio: &drop };
                self.predict(x, &vec![t; n], &condition)
            })
        };
        sample(config, schedule, x, denoise, noise, None)
    }
}

/// Returns whether some frame does not count.
pub(super) fn is_partial(mask: &[f32]) -> bool {
    mask.iter().any(|&w| w < 1.0)
}

/// Copies a tensor of three axes.
pub(super) fn to_array(x: &Tensor<f32>) -> Array3<f32> {
    let [a, b, c] = x.shape() else { unreachable!("a tensor of three axes") };
    Array3::from_shape_vec((*a, *b, *c), x.data().to_vec()).expect("as many as its shape says")
}

/// Returns values as \[batch, frames, 25\].
pub(super) fn motion_view(values: &[f32], batch: usize, frames: usize) -> ArrayView3<'_, f32> {
    ArrayView3::from_shape((batch, frames, MOTION_DIM), values).expect("as many as its shape says")
}
