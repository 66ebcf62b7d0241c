//! The rules that make a phrase acceptable, and what a change of them does.

use std::path::Path;

use crate::support::files::{coherent, trajectory, wav};
use crate::support::{Dir, failures, ingest, phrases};

/// Writes a phrase that turns at `rad_s` in one frame.
fn write_turning(source: &Path, id: &str, rad_s: f32) {
    let mut frames = coherent(13, 4);
    frames[6][14] = rad_s;
    let path = source.join("motion").join(id).join("trajectory.npy");
    crate::support::write(&path, trajectory(&frames));
}

#[test]
fn reference_limits_allow_half_the_angular_velocity_of_wide_ones() {
    let dir = Dir::new();
    let source = dir.at("source");
    for (id, rad_s) in [("slow", 10.0), ("fast", -10.5), ("faster", 20.0), ("fastest", 20.5)] {
        write_turning(&source, id, rad_s);
    }
    let (wide, reference) = (dir.at("wide"), dir.at("reference"));
    assert_eq!(ingest(&source, &wide, &["--limits", "wide"]).code, 1);
    assert_eq!(phrases(&wide).into_keys().collect::<Vec<_>>(), ["fast", "faster", "slow"]);
    assert_eq!(ingest(&source, &reference, &["--limits", "reference"]).code, 1);
    assert_eq!(phrases(&reference).into_keys().collect::<Vec<_>>(), ["slow"]);
    assert_eq!(
        failures(&reference)["fast"].message,
        "motion/fast/trajectory.npy: channel angular_velocity_y is -10.5 rad/s at frame 6, \
         allowed -10 to 10 rad/s (1 values outside their limits in all); correct the unit or \
         remove the phrase"
    );
}

#[test]
fn changed_rules_do_everything_again() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    write_turning(&source, "fast", 15.0);
    write_turning(&source, "slow", 5.0);
    for (limits, code, n_done, ids) in [
        ("wide", 0, 2, &["fast", "slow"][..]),
        ("reference", 1, 1, &["slow"]),
        ("wide", 0, 2, &["fast", "slow"]),
    ] {
        let output = ingest(&source, &store, &["--limits", limits]);
        assert_eq!(output.code, code, "{output:?}");
        let done = format!("\n  {n_done} ingested (");
        assert!(output.stdout.contains(&done), "{}", output.stdout);
        assert!(output.stdout.contains(" 0 up to date, "), "{}", output.stdout);
        assert_eq!(phrases(&store).into_keys().collect::<Vec<_>>(), ids, "{limits}");
        assert_eq!(failures(&store).len(), 2 - ids.len(), "{limits}");
    }
}

#[test]
fn the_tolerance_of_lengths_is_counted_in_frames() {
    let dir = Dir::new();
    // 21 frames are 0.7 s; 0.8 s are three frames more.
    dir.write("source/motion/a/trajectory.npy", trajectory(&coherent(21, 1)));
    dir.write("source/audio/a.wav", wav(0.8));
    let store = dir.at("store");
    for (frames, code) in [("1", 1), ("2", 1), ("3", 0), ("0", 1)] {
        let more = ["--length-tolerance-frames", frames];
        assert_eq!(ingest(&dir.at("source"), &store, &more).code, code, "{frames} frames");
    }
    assert_eq!(
        failures(&store)["a"].message,
        "audio is 0.80 s but motion is 0.70 s; they must agree within 0 frames (0.000 s)"
    );
}
