//! What can be said of motion: checks that it is sound, and how far it follows the music.
//!
//! Everything here is pure: motion of 25 channels and phases in, numbers out.

pub mod baseline;
pub mod beats;
pub mod body;
pub mod consistency;
pub mod control;
pub mod coupling;
pub mod distribution;
pub mod diversity;
pub mod frechet;
pub mod geometric;
pub mod group;
pub mod interval;
pub mod keyframe;
pub mod kinetic;
pub mod locking;
pub mod measured;
pub mod metrics;
mod reconstruction;
pub mod reference_statistics;
pub mod sanity;
pub mod score;
pub mod verdict;
pub mod window;
pub mod window_range;

pub use measured::WindowMeasures;
pub use reconstruction::{ReconstructionError, reconstruction_error};
pub use sanity::{
    Check, CheckSet, checks, derivative_error, holds_by_construction, holds_by_derivation,
};
pub use score::{Score, score};
