//! Post-processing of the root alone, against that of a body with the same numbers.

use super::*;
use crate::motion::layout::tests::ROOT;
use crate::motion::quaternion::{dot, from_axis_angle, mul};
use crate::units::FPS;
use ndarray::Axis;

/// The columns of the body that the root alone has.
fn root_of(frames: &Array2<f32>) -> Array2<f32> {
    let columns: Vec<usize> = (0..6).chain(9..16).collect();
    frames.select(Axis(1), &columns)
}

/// A turning walk whose channels are off by a few hundredths, as if they had been decoded.
fn decoded(n: usize) -> Array2<f32> {
    let pose = |t: usize| {
        let s = t as f64 / FPS;
        let yaw = from_axis_angle([0.0, 1.0, 0.0], 0.9 * s);
        let lean = from_axis_angle([1.0, 0.0, 0.0], 0.2 * (3.0 * s).sin());
        ([(1.3 * s).sin(), 0.9 + 0.03 * (8.0 * s).cos(), 0.6 * s], mul(yaw, lean))
    };
    let (position_m, orientation) = (0..n + 2).map(pose).unzip();
    let mut frames = frames_in(BODY, &Poses { position_m, orientation }, n);
    for ((t, i), x) in frames.indexed_iter_mut() {
        *x += 0.03 * (((t * 31 + i * 17) % 19) as f32 / 9.0 - 1.0);
    }
    frames
}

fn processed(layout: Layout, config: &PostProcessConfig, frames: &Array2<f32>) -> Array2<f32> {
    let mut frames = frames.clone();
    process_in(layout, config, &mut frames, None, &HeldPoses::default());
    frames
}

#[test]
fn the_root_alone_is_processed_as_within_a_body() {
    let body = decoded(61);
    let configs = [
        PostProcessConfig::default(),
        PostProcessConfig {
            savitzky_golay: Some(SavitzkyGolay::default()),
            apply_smoothing: true,
            ..PostProcessConfig::default()
        },
        PostProcessConfig { coherence: Coherence::Blend, ..PostProcessConfig::default() },
    ];
    for config in configs {
        let found = processed(ROOT, &config, &root_of(&body));
        assert_eq!(found, root_of(&processed(BODY, &config, &body)), "{:?}", config.coherence);
    }
}

#[test]
fn what_is_derived_are_the_differences_of_its_poses() {
    let found = processed(ROOT, &PostProcessConfig::default(), &root_of(&decoded(31)));
    for t in 0..29 {
        for i in 0..3 {
            let rate = 30.0 * (f64::from(found[[t + 1, i]]) - f64::from(found[[t, i]]));
            // Single precision of positions of 1 m, times 30.
            assert!((f64::from(found[[t, 3 + i]]) - rate).abs() < 1e-5, "{t}, {i}");
        }
        let q: Quaternion = std::array::from_fn(|i| f64::from(found[[t, 6 + i]]));
        assert!((dot(q, q) - 1.0).abs() < 1e-6);
    }
}

#[test]
fn fusion_without_accelerations_weighs_what_is_there() {
    let variances = FusionVariances::default();
    let config = PostProcessConfig {
        coherence: Coherence::Fuse,
        fusion_variances: Some(variances),
        ..PostProcessConfig::default()
    };
    let body = decoded(61);
    let found = processed(ROOT, &config, &root_of(&body));
    // A body whose accelerations are not numbers says as much.
    let mut silent = body.clone();
    let acceleration = BODY.body().acceleration.expect("a body has it");
    silent.slice_mut(s![.., acceleration.range()]).fill(f32::NAN);
    let wanted = processed(BODY, &config, &silent);
    assert_eq!(found.slice(s![.., ..3]), wanted.slice(s![.., ..3]));
    assert_eq!(found.slice(s![.., 6..]), wanted.slice(s![.., 9..16]));
    assert_ne!(found.slice(s![.., ..3]), body.slice(s![.., ..3]));
}
