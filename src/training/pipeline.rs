//! The UNet and the decoder as one: motion sampled in a few steps that gradients flow through.

use std::sync::Arc;

use crate::autodiff::op::binary::{Binary, Pair};
use crate::autodiff::op::elementwise::{Function, Map};
use crate::autodiff::{Interpreter, Tensor};
use crate::diffusion::{Schedule, Spacing, ddim_linear, steps};
use crate::model::{Graph, MotionDecoder, ParameterList, Scope, UNet1D, UNetInputs};
use crate::motion::MOTION_DIM;
use crate::motion::style::STYLE_DIM;

use super::batch::Batch;
use super::config::NetworkConfig;
use super::decoder::DECODER;
use super::diffusion::UNET;
use super::error::TrainingError;
use super::sampling::is_partial;

/// Both networks, over one list of parameters.
#[derive(Clone, Debug)]
pub struct Pipeline {
    pub unet: Arc<UNet1D>,
    pub decoder: MotionDecoder,
    pub(super) takes_style: bool,
}

impl Pipeline {
    /// Makes both networks; names begin with `unet.` and `decoder.`.
    pub fn new(network: &NetworkConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let mut root = Scope::root(&mut list);
        let unet = UNet1D::within(&mut root.at(UNET.trim_end_matches('.')), &network.unet);
        let decoder =
            MotionDecoder::within(&mut root.at(DECODER.trim_end_matches('.')), &network.decoder);
        let takes_style = network.unet.style_dim > 0;
        (Self { unet: Arc::new(unet), decoder, takes_style }, list)
    }

    /// Samples by DDIM from step `from` − 1 on, every step of which gradients can flow through.
    ///
    /// x̂0 = A x + B p, kept within the clip range; x' = c x + d x̂0 with c = √((1 − ᾱ')/(1 − ᾱ)) and
    /// d = √ᾱ' − c √ᾱ, which is DDIM with the ε̂ that fits x̂0; the last step leads to x̂0 itself.
    /// Steps are evenly spaced from `from` − 1 to 0; from all T of them in the reference (7.3), where `x`
    /// is noise. Each call of the network is run again for its gradient, so that memory is that of one call.
    ///
    /// # Shapes
    /// - `x`, the sample at step `from` − 1, and returned: \[batch, frames, 25\]
    ///
    /// # Errors
    /// Shapes that do not fit; a number of steps that there is not.
    pub fn sample<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        schedule: &Schedule,
        (from, n_steps): (usize, usize),
        x: &[f32],
        batch: &Batch,
    ) -> Result<Tensor<f32>, TrainingError> {
        let (n, frames) = (batch.n_windows, batch.n_frames);
        let n_features = batch.audio.len() / (n * frames);
        let mut x = g.constant(&[n, frames, MOTION_DIM], x);
        let audio = g.constant(&[n, frames, n_features], &batch.audio);
        let mask = is_partial(&batch.mask).then(|| g.constant(&[n, frames], &batch.mask));
        let style = self.takes_style.then(|| g.constant(&[n, STYLE_DIM], &batch.style));
        for step in steps(from, n_steps, Spacing::Linspace)? {
            let t = g.constant(&[n], &vec![step.t as f32; n]);
            let mut inputs = vec![&x, &t, &audio];
            inputs.extend(&mask);
            inputs.extend(&style);
            let (unet, has_mask, has_style) =
                (Arc::clone(&self.unet), mask.is_some(), style.is_some());
            let prediction = g.checkpoint(&inputs, move |g, inputs| {
                let given = UNetInputs {
                    x: &inputs[0],
                    t: &inputs[1],
                    audio: &inputs[2],
                    drop_audio: None,
                    mask: has_mask.then(|| &inputs[3]),
                    style: has_style.then(|| &inputs[3 + usize::from(has_mask)]),
                };
                unet.forward(g, given)
            })?;
            let (a, b) = ddim_linear(schedule, step.t, None);
            let estimate = weighted_sum(g, &[(&x, a), (&prediction, b)])?;
            let estimate = match schedule.clip_range() {
                Some(range) => {
                    let clamp = Function::Clamp { low: -range, high: range };
                    g.apply(Map::new(clamp), &[&estimate])?
                }
                None => estimate,
            };
            let (here, there) = (schedule.level(Some(step.t)), schedule.level(step.next));
            let c = there.noise / here.noise;
            let d = there.signal - c * here.signal;
            x = if step.next.is_none() {
                estimate
            } else {
                weighted_sum(g, &[(&x, c), (&estimate, d)])?
            };
        }
        Ok(x)
    }
}

/// Σ w x.
pub(super) fn weighted_sum<I: Interpreter<Element = f32>>(
    g: &mut I,
    terms: &[(&Tensor<f32>, f64)],
) -> Result<Tensor<f32>, TrainingError> {
    let mut sum: Option<Tensor<f32>> = None;
    for &(x, w) in terms {
        let term = g.scale(x, w)?;
        sum = Some(match sum {
            None => term,
            Some(sum) => g.apply(Binary::new(Pair::Add), &[&sum, &term])?,
        });
    }
    Ok(sum.expect("a sum has terms"))
}
