//! Arbitrary bytes through the reader of constraints, as TOML, JSON, CSV and array: no panic, memory in proportion to the
//! track, and constraints within it.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/chance.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod chance;
#[path = "../../src/excerpt.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod excerpt;
#[path = "../../src/motion/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod motion;
#[path = "../../src/units.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod units;
#[path = "../../src/generation"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod generation {
    mod control;
    pub use control::*;
}
#[path = "../../src/stages/generate/constraints_file.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod constraints_file;

#[path = "../../src/stages/generate/path_file.rs"]
mod path_file;

use constraints_file::ConstraintsRequest;
use motion::ChannelLimits;

/// Frames of the track, few enough that a constraint behind the end is usual.
const N_FRAMES: usize = 31;

fuzz_target!(|bytes: &[u8]| {
    for extension in ["toml", "json", "csv", "npy"] {
        let Ok(asked) = ConstraintsRequest::of_bytes(bytes.to_vec(), extension) else { continue };
        match asked.of_track(N_FRAMES, ChannelLimits::Wide) {
            Ok(constraints) => {
                let mut frames = ndarray::Array2::zeros((N_FRAMES, motion::MOTION_DIM));
                frames.column_mut(9).fill(1.0);
                constraints.bend(&mut frames, 0, 1.0);
            }
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
});
