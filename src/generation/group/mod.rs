//! Motion of groups: the card of a model of the family `group`, the engine that runs it, and windows over long tracks.

mod card;
mod engine;
mod track;

pub use card::{GroupCard, GroupProvenance};
pub use engine::{ConsistencyForm, GroupEngine, GroupEngineInputs, GroupEstimator};
pub use track::{GroupGenerator, GroupTrack};
