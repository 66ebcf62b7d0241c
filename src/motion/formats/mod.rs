//! Formats of the field that have no hierarchy of joints: each is read into the track of one rigid body.
//!
//! The bytes are untrusted. Nothing is allocated from a number that a file claims, and no byte makes a reader
//! panic. [`super::convert_track`] turns a track into the 25 channels.

pub mod humanml3d;
mod keys;
pub mod rigid;
pub mod smpl;
pub mod vmd;

pub use humanml3d::HumanMl3dError;
pub use rigid::RigidError;
pub use smpl::SmplError;
pub use vmd::VmdError;
