//! The files of a tokenizer: the encoder with its codebook, the decoder of signals, and the denoiser.

use crate::model::{Graph as _, ParameterId, Result, Tokenizer, TokensConfig};

use super::builder::{Axes, Builder, Form};
use super::proto::Graph;
use super::storage::Storage;

/// The input and the output of `encoder.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct TokenEncoderNames;

impl TokenEncoderNames {
    pub const MOTION: &'static str = "motion";
    pub const TOKENS: &'static str = "tokens";
}

/// The input and the output of `signal.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct SignalNames;

impl SignalNames {
    pub const TOKENS: &'static str = "tokens";
    pub const SIGNAL: &'static str = "signal";
}

/// The inputs and the output of `denoiser.onnx` of a model of tokens.
#[derive(Clone, Copy, Debug)]
pub struct SignalDenoiserNames;

impl SignalDenoiserNames {
    pub const X: &'static str = "x_t";
    pub const T: &'static str = "t";
    pub const SIGNAL: &'static str = "signal";
    pub const X0: &'static str = "x0";
}

/// The axis of tokens, and that of the frames of a signal.
pub(super) const TOKENS_AXIS: &str = "tokens";
const SIGNAL_AXIS: &str = "signal frames";

/// Writes the encoder and the nearest row of the codebook: motion → tokens.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn token_encoder(
    config: &TokensConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    storage: Storage,
) -> Result<Graph> {
    let (tokenizer, list) = Tokenizer::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let motion = g.input(
        TokenEncoderNames::MOTION,
        Axes::Frames,
        config.motion_dim,
        "motion over the origin, facing +Z, normalised, 30 frames a second",
    );
    let tokens = tokenizer.tokens(&mut g, &motion)?;
    g.output(TokenEncoderNames::TOKENS, tokens, "rows of the codebook, one for each few frames")?;
    g.name_output_axis(1, TOKENS_AXIS);
    Ok(g.finish("encoder"))
}

/// Writes the codebook and the decoder of signals: tokens → a signal for each frame that they stand for.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn token_signal(
    config: &TokensConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    storage: Storage,
) -> Result<Graph> {
    let (tokenizer, list) = Tokenizer::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let meaning = "rows of the codebook, whole numbers below their number";
    let tokens = g.integer_input(SignalNames::TOKENS, Axes::Mask, meaning);
    g.name_axis(1, TOKENS_AXIS);
    let q = tokenizer.codes(&mut g, &tokens)?;
    let signal = tokenizer.whole_signal(&mut g, &q)?;
    g.output(SignalNames::SIGNAL, signal, "for each frame of each token, for denoiser.onnx")?;
    g.name_output_axis(1, SIGNAL_AXIS);
    Ok(g.finish("signal"))
}

/// Writes the diffusion decoder: x_t, t and the signal → clean motion.
///
/// A signal of more frames than x_t is cropped within.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn token_denoiser(
    config: &TokensConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    storage: Storage,
) -> Result<Graph> {
    let (tokenizer, list) = Tokenizer::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let x = g.input(
        SignalDenoiserNames::X,
        Axes::Frames,
        config.motion_dim,
        "noisy motion, normalised, 30 frames a second",
    );
    let meaning = "step of the diffusion, 0 the least noisy";
    let t = g.integer_input(SignalDenoiserNames::T, Axes::Batch, meaning);
    let signal = g.framed_input(
        SignalDenoiserNames::SIGNAL,
        SIGNAL_AXIS,
        config.width,
        "that of signal.onnx, of as many frames or more",
    );
    let signal = g.crop_frames(&signal, &x)?;
    let x0 = tokenizer.denoise(&mut g, &x, &t, &signal)?;
    g.output(SignalDenoiserNames::X0, x0, "clean motion, normalised")?;
    Ok(g.finish("denoiser"))
}
