//! The engine that is always there: our own interpreter.

use std::num::NonZeroUsize;

use ndarray::{Array3, ArrayView3};

use crate::audio::FeatureScale;
use crate::autodiff::{Eager, Parameters};
use crate::model::{MotionDecoder, UNet1D, UNetConfig, UNetInputs, condition_scale};

use super::engine::{Engine, EngineError, EngineInputs};
use super::interpreter::{EAGER, EagerWorkers, to_array};

/// Runs a model by the interpreter that trains it.
pub struct EagerEngine {
    unet: UNet1D,
    unet_parameters: Parameters<f32>,
    style_dim: usize,
    decoder: MotionDecoder,
    decoder_parameters: Parameters<f32>,
    /// Of the condition.
    scale: FeatureScale,
    workers: EagerWorkers,
}

impl EagerEngine {
    /// Makes an engine of so many workers of so many threads each; `scale` is that of the features.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        (config, unet_parameters): (&UNetConfig, Parameters<f32>),
        (decoder, decoder_parameters): (MotionDecoder, Parameters<f32>),
        scale: &FeatureScale,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        Ok(Self {
            unet: UNet1D::new(config).0,
            unet_parameters,
            style_dim: config.style_dim,
            decoder,
            decoder_parameters,
            scale: condition_scale(config, scale),
            workers: EagerWorkers::start(workers)?,
        })
    }
}

impl Engine for EagerEngine {
    fn name(&self) -> &'static str {
        EAGER
    }

    fn n_workers(&self) -> usize {
        self.workers.n_workers()
    }

    fn predict(&self, inputs: &EngineInputs) -> Result<Array3<f32>, EngineError> {
        inputs.check(self.scale.centre.len())?;
        let (batch, frames, channels) = inputs.x.dim();
        let n_features = self.scale.centre.len();
        let mut audio = inputs.audio.as_standard_layout().into_owned();
        let rows = audio.view_mut().into_shape_with_order((batch * frames, n_features));
        self.scale.apply(rows.expect("in order"));
        let x = inputs.x.as_standard_layout();
        let t: Vec<f32> = inputs.t.iter().map(|&t| t as f32).collect();
        let drop: Vec<f32> = inputs.drop_audio.iter().map(|&d| f32::from(u8::from(d))).collect();
        // As in the exported files, a style that is not given is one of zeros, not a network without a style.
        let style: Option<Vec<f32>> = (self.style_dim > 0).then(|| match inputs.style {
            Some(style) => style.iter().copied().collect(),
            None => vec![0.0; batch * self.style_dim],
        });
        self.workers.run(|arena| {
            let mut g = Eager::new(&self.unet_parameters, arena);
            let x = g.input(&[batch, frames, channels], x.as_slice().expect("in order"));
            let t = g.input(&[batch], &t);
            let audio = g.input(&[batch, frames, n_features], audio.as_slice().expect("in order"));
            let drop = (!drop.is_empty()).then(|| g.input(&[batch], &drop));
            let style = style.map(|style| g.input(&[batch, self.style_dim], &style));
            let inputs = UNetInputs {
                x: &x,
                t: &t,
                audio: &audio,
                drop_audio: drop.as_ref(),
                mask: None,
                style: style.as_ref(),
            };
            Ok(to_array(&self.unet.forward(&mut g, inputs)?))
        })
    }

    fn decode(&self, latent: ArrayView3<f32>) -> Result<Array3<f32>, EngineError> {
        let latent = latent.as_standard_layout();
        self.workers.run(|arena| {
            let mut g = Eager::new(&self.decoder_parameters, arena);
            let x = g.input(latent.shape(), latent.as_slice().expect("in order"));
            Ok(to_array(&self.decoder.forward(&mut g, &x)?))
        })
    }
}
