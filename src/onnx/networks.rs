//! The two models of an export: the UNet and the decoder, with their inputs and outputs.

use crate::audio::FeatureScale;
use crate::model::{
    DecoderConfig, Graph as _, MotionDecoder, ParameterId, Result, UNet1D, UNetConfig, UNetInputs,
};
use crate::motion::{CLOCK_DIM, MOTION_DIM};

use super::builder::{Axes, Builder, Form};
use super::proto::Graph;
use super::storage::Storage;

/// The inputs and the output of `unet.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct UNetNames;

impl UNetNames {
    pub const X: &'static str = "x_t";
    pub const T: &'static str = "t";
    pub const AUDIO: &'static str = "audio";
    /// Only in networks that hear the clock.
    pub const CLOCK: &'static str = "clock";
    /// May be left out.
    pub const DROP_AUDIO: &'static str = "drop_audio";
    /// May be left out; only in networks that take a style.
    pub const STYLE: &'static str = "style";
    pub const PREDICTION: &'static str = "prediction";
}

/// The input and the output of `decoder.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct DecoderNames;

impl DecoderNames {
    pub const LATENT: &'static str = "latent";
    pub const MOTION: &'static str = "motion";
}

/// Writes a UNet: x_t, t and the music → the prediction, in normalised units.
///
/// Features come as the `features` table has them and are scaled within.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn unet(
    config: &UNetConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    scale: &FeatureScale,
    form: Form,
    storage: Storage,
) -> Result<Graph> {
    let (unet, list) = UNet1D::new(config);
    let mut g = Builder::new(&list, weights, form, storage);
    let c = config;
    let x = g.input(
        UNetNames::X,
        Axes::Frames,
        c.in_channels,
        "noisy motion, normalised, 30 frames a second",
    );
    let t = g.integer_input(UNetNames::T, Axes::Batch, "step of the diffusion, 0 the least noisy");
    let audio = g.input(
        UNetNames::AUDIO,
        Axes::Frames,
        c.audio_cond_dim,
        "features of the music as motiongen extract writes them",
    );
    let clock = c.clock.then(|| {
        g.input(
            UNetNames::CLOCK,
            Axes::Frames,
            CLOCK_DIM,
            "cos and sin of 2 pi n bars for n = 1, 2, 3 and the beats of a bar, ln(tempo / 120), 1 where known; \
             zeros where unknown",
        )
    });
    let drop_audio = g.optional_input(
        UNetNames::DROP_AUDIO,
        Axes::Batch,
        0,
        "1 for samples that go without music, 0 where left out",
    );
    let style = (c.style_dim > 0).then(|| {
        g.optional_input(
            UNetNames::STYLE,
            Axes::Samples,
            c.style_dim,
            "style, normalised, 0 for none",
        )
    });
    let features = g.standardized(audio, &scale.centre, &scale.scale)?;
    let audio = match &clock {
        Some(clock) => g.concat(&[&features, clock])?,
        None => features,
    };
    let inputs = UNetInputs {
        x: &x,
        t: &t,
        audio: &audio,
        drop_audio: Some(&drop_audio),
        mask: None,
        style: style.as_ref(),
    };
    let y = unet.forward(&mut g, inputs)?;
    g.output(UNetNames::PREDICTION, y, "what the network predicts, normalised")?;
    Ok(g.finish("unet"))
}

/// Writes a decoder: latent → motion in metres, seconds and radians, within the limits of its channels.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn decoder(
    config: &DecoderConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    storage: Storage,
) -> Result<Graph> {
    let (decoder, list) = MotionDecoder::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let latent =
        g.input(DecoderNames::LATENT, Axes::Frames, config.input_dim, "sampled motion, normalised");
    let motion = decoder.forward(&mut g, &latent)?;
    debug_assert_eq!(motion.channels, MOTION_DIM);
    g.output(
        DecoderNames::MOTION,
        motion,
        "position m, velocity m/s, acceleration m/s2, quaternion w x y z, angular velocity rad/s, bar phase, style",
    )?;
    Ok(g.finish("decoder"))
}
