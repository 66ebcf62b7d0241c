//! Motion by tokens: the card of a model of the family `tokens`, the engines that run its networks, and motion for a
//! track of any length.

mod card;
mod constraints;
mod control;
mod eager;
mod engine;
mod group;
mod networks;
mod planner;
mod reconstruct;
mod runtime;
mod track;
mod weights;

pub use card::{TokensCard, TokensNetworks, TokensProvenance};
pub use constraints::Control;
pub use control::{Steering, steer};
pub use engine::TokenEngine;
pub use group::kept_of;
pub use networks::{
    PlanWindow, PlannerNetworks, TokenizerNetworks, WindowPlan, WithheldConditions,
};
pub use planner::{PlanRequest, PlannerEngine, shuffle};
pub use reconstruct::{Decoding, Reconstruction};
pub use runtime::{OnnxPlanner, OnnxTokenizer};
pub use track::{TokenGenerator, TokenTrack};
pub use weights::tokens_parameters;

#[cfg(test)]
mod tests;
