//! The demo library of `tests/data`: every phrase is sound, and the dance is in time with its music.

use std::collections::BTreeMap;
use std::path::Path;

use motiongen::motion::locking::bar_locking;
use motiongen::motion::quaternion::{angular_velocity, normalize};
use motiongen::motion::{ChannelLimits, Trajectory};
use motiongen::units::FPS;
use ndarray::Array2;

use super::{Output, column, constructed, data, library};
use crate::support::files::Frame;
use crate::support::{Dir, finish, ingest, motion, motiongen};

const TAKES: usize = 2;

/// Ingests and extracts `tests/data`, and constructs a library of it.
fn demo(store: &Path) -> Output {
    for source in ["phrases", "music"] {
        assert_eq!(ingest(&data(source), store, &[]).code, 0);
    }
    assert_eq!(finish(motiongen().args(["extract", "--store"]).arg(store)).code, 0);
    library(store, &["--takes", "2"])
}

#[test]
fn the_demo_library_is_sound_and_in_time() {
    let dir = Dir::new();
    let store = dir.at("store");
    let output = demo(&store);
    assert_eq!(output.code, 0, "{output:?}");
    let found = "  20 songs danced to (430 phrases), 0 up to date, 0 failed; ";
    assert!(output.stdout.contains(found), "{}", output.stdout);
    assert!(output.stdout.contains("14 captures; songs split into 16 train, 2 validation, 2 test"));

    let rows = constructed(&store);
    assert_eq!(rows.len(), 430);
    let frames = motion(&store);
    let mut splits: BTreeMap<&str, &str> = BTreeMap::new();
    let mut jerks = Vec::new();
    for (id, row) in &rows {
        assert_sound(id, &frames[id]);
        jerks.push(mean_jerk(&frames[id]));
        assert_eq!(*splits.entry(&row.source).or_insert(&row.split), row.split, "{id}");
    }
    assert_eq!(splits.len(), 20);
    // The range of 64 real captures.
    assert!(jerks.iter().all(|jerk| (5.0..=404.0).contains(jerk)), "{jerks:?}");

    // Phrases overlap by half: every other one makes a song whole again.
    let mut songs: BTreeMap<(&str, &str), Vec<Frame>> = BTreeMap::new();
    for (id, row) in &rows {
        let (take, number) = id.rsplit_once('.').unwrap();
        if number.parse::<usize>().unwrap().is_multiple_of(2) {
            songs.entry((&row.source, take)).or_default().extend(&frames[id]);
        }
    }
    assert_eq!(songs.len(), 20 * TAKES);
    let (mut locked, mut wrong) = (Vec::new(), Vec::new());
    for ((_, take), frames) in &songs {
        let (velocity_y, phase) = (column(frames, 4), unwrapped(&column(frames, 16)));
        let at = |ratio: f64| {
            let phase: Vec<f64> = phase.iter().map(|p| (p * ratio).fract()).collect();
            bar_locking(&velocity_y, &phase)
        };
        let mut others: Vec<f64> = (0..60)
            .map(|k| 0.617 + 0.0131 * f64::from(k))
            .filter(|ratio| (ratio - 1.0).abs() > 0.04)
            .map(at)
            .collect();
        others.sort_by(f64::total_cmp);
        assert!(at(1.0) > 2.0 * others[others.len() / 2], "{take}: {} {others:?}", at(1.0));
        locked.push(at(1.0));
        wrong.push(others[others.len() / 2]);
    }
    // Measured over 8 takes: mean 0.58, at wrong tempi 0.07, most in songs of a few bars.
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    assert!(locked.iter().all(|r2| *r2 > 0.25) && mean(&locked) > 0.5, "{locked:?}");
    assert!(mean(&wrong) < 0.12, "{wrong:?}");
}

/// Checks what every phrase promises.
fn assert_sound(id: &str, frames: &[Frame]) {
    assert_eq!(frames.len(), 120, "{id}");
    let values: Vec<f32> = frames.as_flattened().to_vec();
    let motion = Trajectory::new(Array2::from_shape_vec((120, 25), values).unwrap()).unwrap();
    motion.check(&ChannelLimits::Wide).unwrap_or_else(|e| panic!("{id}: {e}"));
    let x = |t: usize, i: usize| f64::from(frames[t][i]);
    assert!(x(0, 0).abs() < 1e-6 && x(0, 2).abs() < 1e-6 && x(0, 11).abs() < 1e-6, "{id}");
    assert!(x(0, 9) >= 0.0, "{id}");
    for t in 0..119 {
        for i in 0..6 {
            let derived = (x(t + 1, i) - x(t, i)) * FPS;
            // Positions up to 7 m and velocities up to 5 m/s are rounded twice each.
            assert!((x(t, i + 3) - derived).abs() < 6e-5, "{id}: {i} at {t}");
        }
        let q = |t: usize| normalize(std::array::from_fn(|c| x(t, 9 + c)));
        let omega = angular_velocity(q(t), q(t + 1), FPS);
        for (axis, omega) in omega.into_iter().enumerate() {
            assert!((x(t, 13 + axis) - omega).abs() < 5e-5, "{id}: {axis} at {t}");
        }
        let inner: f64 = (9..13).map(|c| x(t, c) * x(t + 1, c)).sum();
        assert!(inner > 0.9, "{id}: the sign of the quaternion jumps at {t}");
        // A square of 7 m has a diagonal of 9.9 m.
        assert!(x(t, 0).hypot(x(t, 2)) < 9.9, "{id}");
    }
}

fn mean_jerk(frames: &[Frame]) -> f64 {
    let jerk = frames
        .windows(2)
        .map(|f| (6..9).map(|i| (f64::from(f[1][i] - f[0][i]) * FPS).powi(2)).sum::<f64>().sqrt());
    jerk.sum::<f64>() / (frames.len() - 1) as f64
}

/// Phases without their jumps from 1 to 0.
fn unwrapped(phase: &[f64]) -> Vec<f64> {
    let mut bars = 0.0;
    let mut before = phase.first().copied().unwrap_or(0.0);
    let unwrap = |&p: &f64| {
        if p < before - 0.5 {
            bars += 1.0;
        }
        before = p;
        p + bars
    };
    phase.iter().map(unwrap).collect()
}
