//! Ingest from local folders into local stores, through the executables.

mod again;
mod captures;
mod configuration;
mod library;
mod messages;
mod rules;
mod shards;
mod two_sources;

use std::path::Path;

use crate::support::files::{coherent, trajectory};
use crate::support::write;

/// Writes the motion of a phrase: frames of `coherent(n_frames, seed)`.
fn write_motion(source: &Path, id: &str, n_frames: usize, seed: u32) {
    let path = source.join("motion").join(id).join("trajectory.npy");
    write(&path, trajectory(&coherent(n_frames, seed)));
}
