//! Bodies that touch, pass, and stand at one place.

use ndarray::{Array3, s};

use super::*;
use crate::chance::Chance;
use crate::motion::MOTION_DIM;
use crate::motion::group::RADIUS_M;

/// A group whose dancers are at places on the floor, m, at 1 m of height.
fn group(n: usize, n_frames: usize, place: impl Fn(usize, usize) -> [f64; 2]) -> Array3<f32> {
    let mut group = Array3::zeros((n, n_frames, MOTION_DIM));
    for i in 0..n {
        // Two frames more, so that every difference is there.
        let position_m = (0..n_frames + 2).map(|t| {
            let [x, z] = place(i, t);
            [x, 1.0, z]
        });
        let poses =
            Poses { position_m: position_m.collect(), orientation: vec![IDENTITY; n_frames + 2] };
        group.slice_mut(s![i, .., ..]).assign(&frames_of(&poses, n_frames));
    }
    group
}

fn least_m(group: &Array3<f32>) -> f64 {
    let (n, n_frames, _) = group.dim();
    let pairs = (0..n).flat_map(|a| (0..a).map(move |b| [a, b]));
    let distances =
        pairs.flat_map(|pair| (0..n_frames).map(move |t| distance_m(group.view(), pair, t)));
    distances.fold(f64::INFINITY, f64::min)
}

/// Largest acceleration and displacement on the floor.
fn largest(before: &Array3<f32>, after: &Array3<f32>) -> (f64, f64) {
    let (n, n_frames, _) = after.dim();
    let mut found = (0.0_f64, 0.0_f64);
    for i in 0..n {
        for t in 0..n_frames {
            let [x, z] = [6, 8].map(|c| f64::from(after[[i, t, c]]));
            found.0 = found.0.max(x.hypot(z));
            let [x, z] = [0, 2].map(|c| f64::from(after[[i, t, c]] - before[[i, t, c]]));
            found.1 = found.1.max(x.hypot(z));
        }
    }
    found
}

/// Velocities and accelerations are differences of positions, wherever there is one.
fn assert_differences(group: &Array3<f32>) {
    let (n, n_frames, _) = group.dim();
    for i in 0..n {
        for t in 0..n_frames - 2 {
            for axis in 0..3_usize {
                let p = |t: usize| f64::from(group[[i, t, axis]]);
                let v = (p(t + 1) - p(t)) * FPS;
                let a = (p(t + 2) - 2.0 * p(t + 1) + p(t)) * FPS * FPS;
                // Single precision of 10 m, 4.8e-7, times 2 · 30 and 4 · 900.
                assert!((f64::from(group[[i, t, 3 + axis]]) - v).abs() < 3e-5, "{i} {t} {axis}");
                assert!((f64::from(group[[i, t, 6 + axis]]) - a).abs() < 2e-3, "{i} {t} {axis}");
            }
        }
    }
}

/// Smooth walks within a square of some metres, from sums of sines.
fn wandering(n: usize, n_frames: usize, half_side_m: f64, seed: u64) -> Array3<f32> {
    let mut chance = Chance::new(seed, 0);
    let waves: Vec<[f64; 3]> = (0..n * 2 * 4)
        .map(|_| [0.05 + 0.25 * chance.uniform(), 6.3 * chance.uniform(), chance.uniform()])
        .collect();
    group(n, n_frames, |i, t| {
        [0, 1].map(|axis| {
            let sum: f64 = (0..4)
                .map(|k| {
                    let [hz, phase, size] = waves[(i * 2 + axis) * 4 + k];
                    size * (std::f64::consts::TAU * hz * t as f64 / FPS + phase).sin()
                })
                .sum();
            half_side_m * sum / 2.0
        })
    })
}

#[test]
fn groups_that_do_not_touch_keep_every_bit() {
    let apart = group(5, 47, |i, t| [0.7 * i as f64, 0.02 * t as f64]);
    // Exactly two radii of 0.35 m in single precision, or more.
    let radius_m = least_m(&apart) / 2.0;
    let found = separate(apart.view(), radius_m).expect("apart");
    assert!(found.iter().zip(&apart).all(|(a, b)| a.to_bits() == b.to_bits()));
    for shape in [(0, 7), (1, 7), (3, 0)] {
        let empty = Array3::zeros((shape.0, shape.1, MOTION_DIM));
        assert_eq!(separate(empty.view(), 0.35).expect("nobody"), empty);
    }
}

#[test]
fn two_who_run_into_each_other_go_round() {
    // Head on at 1.5 m/s each; they meet at frame 100.
    let heads = group(3, 301, |i, t| match i {
        0 => [1.5 / FPS * (t as f64 - 100.0), 0.0],
        1 => [1.5 / FPS * (100.0 - t as f64), 0.0],
        _ => [0.0, 3.0],
    });
    let found = separate(heads.view(), RADIUS_M).expect("places");
    assert!(least_m(&found) >= 0.7, "{}", least_m(&found));
    assert_differences(&found);
    let (acceleration, displacement) = largest(&heads, &found);
    // Each gives way by half of what is needed, and no faster than a dancer does.
    assert!(displacement < 0.5 && acceleration < 6.0, "{acceleration} m/s², {displacement} m");
    // The third, and what is more than two seconds from the contact, keep their bits.
    assert_eq!(found.slice(s![2, .., ..]), heads.slice(s![2, .., ..]));
    assert_eq!(found.slice(s![.., 180.., ..]), heads.slice(s![.., 180.., ..]));
    assert_eq!(found.slice(s![.., ..20, ..]), heads.slice(s![.., ..20, ..]));
    assert_eq!(found.slice(s![.., .., 9..]), heads.slice(s![.., .., 9..]));
    // Both start and arrive where they would.
    assert_eq!(separate(found.view(), RADIUS_M).expect("places"), found);
}

#[test]
fn a_light_contact_is_the_least_displacement() {
    // Side by side at 0.66 m for ever: each moves by half of 0.05 m.
    let close = group(2, 200, |i, _| [0.66 * i as f64, 0.0]);
    let found = separate(close.view(), RADIUS_M).expect("places");
    for t in 0..200_usize {
        assert!((f64::from(found[[0, t, 0]]) + 0.025).abs() < 1e-4, "{}", found[[0, t, 0]]);
        assert!((f64::from(found[[1, t, 0]]) - 0.685).abs() < 1e-4, "{}", found[[1, t, 0]]);
        assert_eq!(found[[0, t, 2]], 0.0);
    }
}

#[test]
fn dancers_at_one_place_stand_in_a_circle() {
    for n in [2, 3, 5, 16] {
        let heap = group(n, 61, |_, t| [0.01 * t as f64, -2.0]);
        let found = separate(heap.view(), RADIUS_M).expect("places");
        assert!(least_m(&found) >= 0.7, "{n}: {}", least_m(&found));
        assert_differences(&found);
        let (acceleration, displacement) = largest(&heap, &found);
        // A circle of 16 bodies has a radius of 1.8 m.
        assert!(displacement < 2.0 && acceleration < 0.01, "{n}: {acceleration} {displacement}");
    }
}

#[test]
fn crowds_of_any_size_are_parted_with_honest_differences() {
    for (n, n_frames, half_side_m, seed) in
        [(2, 400, 1.0, 1), (5, 611, 2.0, 2), (5, 611, 1.2, 3), (9, 307, 2.5, 4), (16, 450, 3.0, 5)]
    {
        let crowd = wandering(n, n_frames, half_side_m, seed);
        let found = separate(crowd.view(), RADIUS_M).expect("places");
        // More than the last resort would leave, 0.701 m.
        assert!(least_m(&found) >= 0.705, "{n}: {}", least_m(&found));
        // As if they danced faster, not as if they jumped.
        let (acceleration, displacement) = largest(&crowd, &found);
        assert!(acceleration < 30.0 && displacement < 2.0, "{n}: {acceleration} {displacement}");
        assert_differences(&found);
    }
}

#[test]
fn bodies_of_one_frame_are_parted_whatever_their_places() {
    for n in [2, 7, 16] {
        let mut places = ndarray::Array1::from_elem(n, [0.3, -0.2]);
        solve::part(places.view_mut(), 0.701, 0.7);
        for a in 0..n {
            for b in 0..a {
                let distance = (places[a][0] - places[b][0]).hypot(places[a][1] - places[b][1]);
                assert!(distance >= 0.7, "{n}: {distance}");
            }
        }
    }
}

#[test]
fn what_has_no_places_is_refused_in_a_sentence() {
    let mut two = group(2, 5, |i, _| [i as f64, 0.0]);
    let refusal = |group: &Array3<f32>, radius_m: f64| {
        separate(group.view(), radius_m).expect_err("refused").to_string()
    };
    for (radius_m, told) in [(0.0, "0"), (-1.0, "-1"), (f64::NAN, "NaN"), (10.5, "10.5")] {
        assert_eq!(
            refusal(&two, radius_m),
            format!("radius of a body is {told} m, expected a number above 0 and up to 10 m")
        );
    }
    let many = Array3::zeros((17, 3, MOTION_DIM));
    assert_eq!(
        refusal(&many, 0.35),
        "group has 17 dancers, expected at most 16; separate smaller groups"
    );
    two[[1, 3, 2]] = f32::NAN;
    assert_eq!(
        refusal(&two, 0.35),
        "channel position_z of dancer 1 is NaN at frame 3, and bodies are kept apart by their places; \
         repair or remove the dancer"
    );
}
