//! What can be said of motion: checks that it is sound, and how far it follows the music.
//!
//! Everything here is pure: motion of 25 channels and phases in, numbers out.

pub mod sanity;
pub mod score;

pub use sanity::{Check, CheckSet, checks};
pub use score::{Score, score};
