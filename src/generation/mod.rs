//! From an exported model to motion: engines that run it, and what is sampled with them.
//!
//! An [`Engine`] answers what the networks say; [`sample`] asks it step by step. [`ModelCard`] is what a
//! model's folder says of itself.

mod card;
mod control;
mod eager;
mod engine;
mod group;
mod interpreter;
mod learned;
mod pool;
mod retrieval;
mod runtime;
mod sampling;
mod seam;
mod tokens;
mod track;
#[cfg(test)]
mod walk;
mod windows;

pub use card::{
    CardError, FamilyCard, FileEntry, MAX_CARD_BYTES, MODEL_FORMAT, ModelCard, ModelFileName,
    Networks, Provenance, SamplingDefaults, SharedFields, family_of, file_names, is_name,
    own_channels, own_features,
};
pub use control::{Constraints, ControlError, Miss, REACH_FRAMES, WantedValue, continuing, facing};
pub use eager::EagerEngine;
pub use engine::{Engine, EngineError, EngineInputs};
pub use group::{
    ConsistencyForm, GroupCard, GroupEngine, GroupEngineInputs, GroupEstimator, GroupGenerator,
    GroupProvenance, GroupTrack,
};
pub use learned::{LearnedFrom, MusicDigests, MusicSplit, Purpose, ShortDigest};
pub use pool::Pool;
pub use retrieval::Retrieval;
pub use runtime::{OnnxEngine, SessionPlan};
pub use sampling::{Sampling, sample};
pub use tokens::{
    Control, Decoding, OnnxPlanner, OnnxTokenizer, PlanRequest, PlanWindow, PlannerEngine,
    PlannerNetworks, Reconstruction, Steering, TokenEngine, TokenGenerator, TokenTrack,
    TokenizerNetworks, TokensCard, TokensNetworks, TokensProvenance, WindowPlan,
    WithheldConditions, kept_of, shuffle, steer, tokens_parameters,
};
pub use track::{
    Generator, OVERLAP_FRAMES, PrimingMotion, RUN_WINDOWS, Track, WeightedConstraints,
};
pub use windows::Windows;
