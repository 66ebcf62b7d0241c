//! The files of a model of tokens: the encoder with its codebook, the decoder of signals, the denoiser and the planner.

use crate::audio::FeatureScale;
use crate::model::{
    Graph as _, ParameterId, Planner, PlannerConfig, PlannerInputs, Result, Tokenizer, TokensConfig,
};
use crate::motion::CLOCK_DIM;

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

/// The inputs and the output of `planner.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct PlannerNames;

impl PlannerNames {
    pub const TOKENS: &'static str = "tokens";
    pub const AUDIO: &'static str = "audio";
    /// Only in networks that hear the clock.
    pub const CLOCK: &'static str = "clock";
    /// May be left out.
    pub const DROP_AUDIO: &'static str = "drop_audio";
    /// May be left out; only in networks that take a style.
    pub const STYLE: &'static str = "style";
    /// Only in networks that take constraints.
    pub const CONSTRAINTS: &'static str = "constraints";
    /// May be left out; only in networks that take constraints.
    pub const DROP_CONSTRAINTS: &'static str = "drop_constraints";
    pub const LOGITS: &'static str = "logits";
}

/// The axis of tokens, and that of the frames of a signal.
const TOKENS_AXIS: &str = "tokens";
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

/// Writes a planner: tokens and the music → what is said of each token.
///
/// Features come as the `features` table has them and are scaled within.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn planner(
    config: &PlannerConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    scale: &FeatureScale,
    storage: Storage,
) -> Result<Graph> {
    let (planner, list) = Planner::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let tokens = g.integer_input(
        PlannerNames::TOKENS,
        Axes::Mask,
        "tokens of a window, as many as encoder.onnx makes of its frames; of the masked kind the number of codes stands \
         for a token that is not known, of the autoregressive kind a position sees none from its own on",
    );
    g.name_axis(1, TOKENS_AXIS);
    let audio = g.input(
        PlannerNames::AUDIO,
        Axes::Frames,
        config.audio_cond_dim,
        "features of the music as motiongen extract writes them",
    );
    let clock = config.clock.then(|| {
        g.input(
            PlannerNames::CLOCK,
            Axes::Frames,
            CLOCK_DIM,
            "cos and sin of 2 pi n bars for n = 1, 2, 3 and the beats of a bar, ln(tempo / 120), 1 where known; \
             zeros where unknown",
        )
    });
    let drop_audio = g.optional_input(
        PlannerNames::DROP_AUDIO,
        Axes::Batch,
        0,
        "1 for windows that go without music, 0 where left out",
    );
    let style = (config.style_dim > 0).then(|| {
        let meaning = "style, normalised, 0 for none";
        g.optional_input(PlannerNames::STYLE, Axes::Samples, config.style_dim, meaning)
    });
    let constraints = (config.constraint_dim > 0).then(|| {
        let constraints = g.input(
            PlannerNames::CONSTRAINTS,
            Axes::Frames,
            config.constraint_dim,
            "what is asked of each frame: x, z, y normalised, the directions of the body's +Z and +Y, and 1 for each of \
             floor, height and orientation that is asked for; zeros for what is not",
        );
        let meaning = "1 for windows that go without constraints, 0 where left out";
        let drop = g.optional_input(PlannerNames::DROP_CONSTRAINTS, Axes::Batch, 0, meaning);
        // It may be given where drop_audio is left out: onnxruntime takes axes of one name to be of one size.
        g.name_axis(0, "batch or 1 of constraints");
        (constraints, drop)
    });
    let features = g.standardized(audio, &scale.centre, &scale.scale)?;
    let audio = match &clock {
        Some(clock) => g.concat(&[&features, clock])?,
        None => features,
    };
    let inputs = PlannerInputs {
        tokens: &tokens,
        audio: &audio,
        drop_audio: Some(&drop_audio),
        style: style.as_ref(),
        constraints: constraints.as_ref().map(|(asked, _)| asked),
        drop_constraints: constraints.as_ref().map(|(_, drop)| drop),
        mask: None,
    };
    let logits = planner.forward(&mut g, &inputs)?;
    g.output(PlannerNames::LOGITS, logits, "ln p of each code at each position, up to a constant")?;
    g.name_output_axis(1, TOKENS_AXIS);
    Ok(g.finish("planner"))
}
