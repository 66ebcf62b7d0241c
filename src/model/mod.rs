//! Networks, each written once over the operations that a network may use.
//!
//! [`Graph`] is what an interpreter offers; [`UNet1D`] predicts noise from noisy motion, step and
//! music; [`MotionDecoder`] turns what was sampled into the 25 channels; [`GroupDenoiser`] predicts the motion of a
//! group, and [`GroupScore`] how well motion fits its group; [`Tokenizer`] turns motion into tokens and back, and a
//! [`Planner`] music into tokens. This room knows shapes and names, not numbers: values are the interpreter's.

mod condition;
mod decoder;
mod family;
mod graph;
mod group;
mod layers;
mod outline;
mod parameter;
mod tokens;
mod unet;

pub use condition::{ConditionConfig, condition, condition_scale};
pub use decoder::{DecoderConfig, MotionDecoder};
pub use family::Family;
pub use graph::{
    Activation, Attention, Channels, Convolution, Graph, GraphError, GroupNormalization, Mirror,
    Result,
};
pub use group::{
    GroupConfig, GroupDenoiser, GroupInputs, GroupNetworks, GroupPrediction, GroupScore,
    GroupScoreInputs, GroupScores, ScoredDancers, ScoredGroups,
};
pub use layers::{AttentionBlock, Conv1d, GroupNorm, LayerNorm, Linear, ResBlock};
pub use outline::{ActivationCounts, Layer, Outline};
pub use parameter::{Init, Parameter, ParameterId, ParameterList, Role, Scope};
pub use tokens::{
    CONSTRAINT_DIM, ConditionInputs, KeysAndValues, PlanConditions, Planner, PlannerConfig,
    PlannerInputs, PlannerKind, PlannerStep, PlannerStepInputs, PoseConstraint, Quantized,
    Tokenizer, TokensConfig,
};
pub use unet::{ConfigError, Preset, UNet1D, UNetConfig, UNetInputs};
