//! The models of an export, with their inputs and outputs: the UNet and the decoder, or the denoiser and the score
//! of a group.

use crate::audio::FeatureScale;
use crate::model::{
    DecoderConfig, GroupConfig, GroupDenoiser, GroupInputs, GroupScore, GroupScoreInputs,
    MotionDecoder, ParameterId, Result, UNet1D, UNetConfig, UNetInputs,
};
use crate::motion::MOTION_DIM;

use super::builder::{Axes, Builder, Form};
use super::music::{ConditionValues, MusicNames};
use super::proto::Graph;
use super::storage::Storage;

/// The inputs and the output of `unet.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct UNetNames;

impl UNetNames {
    pub const X: &'static str = "x_t";
    pub const T: &'static str = "t";
    pub const AUDIO: &'static str = MusicNames::AUDIO;
    pub const CLOCK: &'static str = MusicNames::CLOCK;
    pub const DROP_AUDIO: &'static str = MusicNames::DROP_AUDIO;
    pub const STYLE: &'static str = MusicNames::STYLE;
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
    let ConditionValues { audio, drop_audio, style } =
        ConditionValues::inputs(&mut g, c.into(), c.style_dim, "samples", scale)?;
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

/// The inputs and outputs of `denoiser.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct GroupNames;

impl GroupNames {
    pub const X: &'static str = "x_t";
    pub const T: &'static str = "t";
    pub const AUDIO: &'static str = MusicNames::AUDIO;
    pub const CLOCK: &'static str = MusicNames::CLOCK;
    pub const DROP_AUDIO: &'static str = MusicNames::DROP_AUDIO;
    pub const NUMBER: &'static str = "number";
    pub const Z: &'static str = "z";
    pub const X0: &'static str = "x0";
    pub const W: &'static str = "w";
}

/// The inputs and the output of `score.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct GroupScoreNames;

impl GroupScoreNames {
    pub const X0: &'static str = "x0";
    pub const T: &'static str = "t";
    pub const W: &'static str = "w";
    pub const NUMBER: &'static str = "number";
    pub const LOG_RATIO: &'static str = "log_ratio";
    pub const AGREEMENT: &'static str = "agreement";
}

/// What the row of the number of dancers means.
const NUMBER: &str = "dancers of each group less 1, at most the largest number in training less 1";

/// Writes the denoiser of a group: x_t, t, the music and the noise of the group → clean motion and the embedding of
/// the group.
///
/// All groups of a batch have as many dancers as the batches of x_t and t say. Features come as the `features` table
/// has them and are scaled within.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn group_denoiser(
    config: &GroupConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    scale: &FeatureScale,
    storage: Storage,
) -> Result<Graph> {
    let (denoiser, list) = GroupDenoiser::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let x = g.batched_input(
        GroupNames::X,
        Axes::Frames,
        "dancers",
        config.motion_dim,
        "noisy motion, normalised, group by group and dancer by dancer, 30 frames a second",
    );
    let t = g.integer_input(GroupNames::T, Axes::Batch, "step of the diffusion, 0 the least noisy");
    let ConditionValues { audio, drop_audio, .. } =
        ConditionValues::inputs(&mut g, config.condition(), 0, "groups", scale)?;
    let number = g.integer_input(GroupNames::NUMBER, Axes::Batch, NUMBER);
    let z = g.input(
        GroupNames::Z,
        Axes::Samples,
        config.width,
        "noise of the group embedding, standard normal; the same for all windows of a track",
    );
    let inputs = GroupInputs {
        x: &x,
        t: &t,
        audio: &audio,
        drop_audio: Some(&drop_audio),
        number: &number,
        z: &z,
        mask: None,
    };
    let found = denoiser.forward(&mut g, &inputs)?;
    g.output(GroupNames::X0, found.x0, "clean motion, normalised")?;
    g.output(GroupNames::W, found.w, "embedding of the group, for score.onnx")?;
    Ok(g.finish("denoiser"))
}

/// Writes the score of a group: an estimate of clean motion and the embedding of a group → log f.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn group_score(
    config: &GroupConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    storage: Storage,
) -> Result<Graph> {
    let (score, list) = GroupScore::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let x0 = g.batched_input(
        GroupScoreNames::X0,
        Axes::Frames,
        "dancers",
        config.motion_dim,
        "clean motion, normalised, group by group and dancer by dancer",
    );
    let t = g.integer_input(GroupScoreNames::T, Axes::Batch, "step that each dancer is of");
    g.name_axis(0, "dancers");
    let w = g.input(GroupScoreNames::W, Axes::Samples, config.width, "embedding of the group");
    let number = g.integer_input(GroupScoreNames::NUMBER, Axes::Batch, NUMBER);
    let inputs =
        GroupScoreInputs { x0: &x0, t: &t, w: &w, number: &number, mask: None, there: None };
    let y = score.forward(&mut g, &inputs)?;
    g.output(
        GroupScoreNames::LOG_RATIO,
        y.log_ratio,
        "log of p(motion | group) / p(motion), up to a constant",
    )?;
    g.output(
        GroupScoreNames::AGREEMENT,
        y.agreement,
        "the part of it that is the agreement of the dancers",
    )?;
    Ok(g.finish("score"))
}
