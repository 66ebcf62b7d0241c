//! Arbitrary bytes through the readers of SMPL archives, HumanML3D features and VMD: no panic, and a conversion
//! that ends in a trajectory or in a sentence.
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

fuzz_target!(|bytes: &[u8]| {
    let read = [
        motion::formats::smpl::read(bytes).map_err(|e| e.to_string()),
        motion::formats::humanml3d::read(bytes).map_err(|e| e.to_string()),
        motion::formats::vmd::read(bytes).map_err(|e| e.to_string()),
    ];
    for track in read {
        let converted = track
            .and_then(|track| motion::convert_track(&track, None, None).map_err(|e| e.to_string()));
        match converted {
            Ok(capture) => assert!(capture.trajectory.n_frames() >= 3),
            Err(sentence) => assert!(sentence.len() < 1000),
        }
    }
});
