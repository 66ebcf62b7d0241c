//! The files of a planner of tokens: the whole network, and for one that plans position by position what it hears and
//! a step of it, with a cache of keys and values.

use crate::audio::FeatureScale;
use crate::model::{
    ConditionInputs, Graph as _, KeysAndValues, ParameterId, PlanConditions, Planner,
    PlannerConfig, PlannerStepInputs, Result,
};

use super::builder::{Axes, Builder, Form, Value};
use super::music::{ConditionValues, MusicNames};
use super::proto::Graph;
use super::storage::Storage;
use super::tokens::TOKENS_AXIS;

/// The inputs and the output of `planner.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct PlannerNames;

impl PlannerNames {
    pub const TOKENS: &'static str = "tokens";
    pub const AUDIO: &'static str = MusicNames::AUDIO;
    pub const CLOCK: &'static str = MusicNames::CLOCK;
    pub const DROP_AUDIO: &'static str = MusicNames::DROP_AUDIO;
    pub const STYLE: &'static str = MusicNames::STYLE;
    /// Only in networks that take constraints.
    pub const CONSTRAINTS: &'static str = "constraints";
    /// May be left out; only in networks that take constraints.
    pub const DROP_CONSTRAINTS: &'static str = "drop_constraints";
    pub const LOGITS: &'static str = "logits";
}

/// The outputs of `planner_music.onnx`, whose inputs are those of the music.
#[derive(Clone, Copy, Debug)]
pub struct PlannerMusicNames;

impl PlannerMusicNames {
    pub const LOCAL: &'static str = "local";
    pub const GLOBAL: &'static str = "global";
}

/// The inputs and the outputs of `planner_step.onnx`.
#[derive(Clone, Copy, Debug)]
pub struct PlannerStepNames;

impl PlannerStepNames {
    pub const TOKENS: &'static str = PlannerNames::TOKENS;
    pub const LOCAL: &'static str = PlannerMusicNames::LOCAL;
    pub const GLOBAL: &'static str = PlannerMusicNames::GLOBAL;
    pub const PAST: &'static str = "past";
    pub const LOGITS: &'static str = PlannerNames::LOGITS;
    pub const PRESENT: &'static str = "present";
}

/// Positions that are done, those of a step, and all of them.
const PAST_AXIS: &str = "past";
const STEP_AXIS: &str = "tokens - past";
/// Tokens of the whole window.
const WINDOW_AXIS: &str = "tokens of the window";

/// The inputs of constraints, of a network that takes them.
struct ConstraintValues {
    constraints: Value,
    drop_constraints: Value,
}

impl ConstraintValues {
    fn inputs(g: &mut Builder<'_>, config: &PlannerConfig) -> Option<Self> {
        if config.constraint_dim == 0 {
            return None;
        }
        let constraints = g.input(
            PlannerNames::CONSTRAINTS,
            Axes::Frames,
            config.constraint_dim,
            "what is asked of each frame: x, z, y normalised, the directions of the body's +Z and +Y, and 1 for each of \
             floor, height and orientation that is asked for; zeros for what is not",
        );
        let meaning = "1 for windows that go without constraints, 0 where left out";
        let drop_constraints =
            g.optional_input(PlannerNames::DROP_CONSTRAINTS, Axes::Batch, 0, meaning);
        // It may be given where drop_audio is left out: onnxruntime takes axes of one name to be of one size.
        g.name_axis(0, "batch or 1 of constraints");
        Some(Self { constraints, drop_constraints })
    }
}

/// Writes what a planner makes of the music, of the style and of constraints, with their inputs.
fn conditions(
    g: &mut Builder<'_>,
    planner: &Planner,
    config: &PlannerConfig,
    scale: &FeatureScale,
) -> Result<PlanConditions<Value>> {
    let ConditionValues { audio, drop_audio, style } =
        ConditionValues::inputs(g, config.condition(), config.style_dim, "windows", scale)?;
    let asked = ConstraintValues::inputs(g, config);
    let inputs = ConditionInputs {
        audio: &audio,
        drop_audio: Some(&drop_audio),
        style: style.as_ref(),
        constraints: asked.as_ref().map(|asked| &asked.constraints),
        drop_constraints: asked.as_ref().map(|asked| &asked.drop_constraints),
        mask: None,
    };
    planner.conditions(g, &inputs)
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
    let conditions = conditions(&mut g, &planner, config, scale)?;
    let logits = planner.forward_under(&mut g, &tokens, &conditions, None)?;
    g.output(PlannerNames::LOGITS, logits, "ln p of each code at each position, up to a constant")?;
    g.name_output_axis(1, TOKENS_AXIS);
    Ok(g.finish("planner"))
}

/// Writes what a planner hears: the music → a vector for each token, and one for the window.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn planner_music(
    config: &PlannerConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    scale: &FeatureScale,
    storage: Storage,
) -> Result<Graph> {
    let (planner, list) = Planner::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let PlanConditions { local, global } = conditions(&mut g, &planner, config, scale)?;
    let meaning = "the music, and what is asked, at each token, for planner_step.onnx";
    g.output(PlannerMusicNames::LOCAL, local, meaning)?;
    g.name_output_axis(1, TOKENS_AXIS);
    let meaning = "the music and the style of the window, for planner_step.onnx";
    g.output(PlannerMusicNames::GLOBAL, global, meaning)?;
    Ok(g.finish("planner_music"))
}

/// Writes a step of an autoregressive planner: tokens so far, what is heard and the cache → what is said of the tokens
/// that are new, and the cache with them.
///
/// The cache has for every position the keys of all layers, one layer behind the other, and then their values.
///
/// # Errors
/// A configuration of which no network can be made.
pub fn planner_step(
    config: &PlannerConfig,
    weights: &dyn Fn(ParameterId) -> Vec<f32>,
    storage: Storage,
) -> Result<Graph> {
    let (planner, list) = Planner::new(config);
    let mut g = Builder::new(&list, weights, Form::default(), storage);
    let (d, layers) = (config.width, config.layers);
    let tokens = g.integer_input(
        PlannerStepNames::TOKENS,
        Axes::Mask,
        "the first tokens of a window, one more than are known; the last is not looked at",
    );
    g.name_axis(1, TOKENS_AXIS);
    let local = g.framed_input(
        PlannerStepNames::LOCAL,
        WINDOW_AXIS,
        d,
        "that of planner_music.onnx, of the whole window",
    );
    let global = g.input(PlannerStepNames::GLOBAL, Axes::Samples, d, "that of planner_music.onnx");
    let past = g.framed_input(
        PlannerStepNames::PAST,
        PAST_AXIS,
        config.cache_dim(),
        "present of the step before; of 0 positions at the first step",
    );
    let part = |g: &mut Builder<'_>, i: usize| g.channels(&past, i * d..(i + 1) * d);
    let known: Vec<KeysAndValues<Value>> = (0..layers)
        .map(|i| {
            let (keys, values) = (part(&mut g, i)?, part(&mut g, layers + i)?);
            Ok(KeysAndValues { keys, values })
        })
        .collect::<Result<_>>()?;
    let conditions = PlanConditions { local, global };
    let inputs = PlannerStepInputs { tokens: &tokens, conditions: &conditions, past: Some(&known) };
    let step = planner.step(&mut g, &inputs)?;
    let meaning = "ln p of each code at each position that is new, up to a constant";
    g.output(PlannerStepNames::LOGITS, step.logits, meaning)?;
    g.name_output_axis(1, STEP_AXIS);
    let keys = step.present.iter().map(|known| &known.keys);
    let all: Vec<&Value> = keys.chain(step.present.iter().map(|known| &known.values)).collect();
    let present = g.concat(&all)?;
    let meaning = "keys and values of all positions so far, past of the next step";
    g.output(PlannerStepNames::PRESENT, present, meaning)?;
    g.name_output_axis(1, TOKENS_AXIS);
    Ok(g.finish("planner_step"))
}
