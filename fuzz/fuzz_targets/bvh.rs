//! Arbitrary bytes through the reader of captures: no panic, a skeleton whose parents come first, and a
//! conversion that ends in a trajectory or in a sentence.
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
    let bvh = match motion::Bvh::parse(bytes) {
        Ok(bvh) => bvh,
        Err(error) => {
            assert!(error.to_string().len() < 1000);
            return;
        }
    };
    let n_channels: usize = bvh.joints().iter().map(|joint| joint.channels.len()).sum();
    assert_eq!(bvh.frames().ncols(), n_channels);
    assert!(bvh.joints().iter().enumerate().all(|(i, joint)| joint.parent < Some(i)));
    match motion::convert_bvh(&bvh, None) {
        Ok(trajectory) => assert!(trajectory.n_frames() >= 3),
        Err(error) => assert!(error.to_string().len() < 1000),
    }
});
