//! Measures of groups against `tests/golden/groups/make.py` and against closed forms.

use ndarray::{Array3, s};
use serde::Deserialize;

use super::contact::contacts;
use super::formation::coverage;
use super::unison::unison;
use super::*;
use crate::chance::Draws;
use crate::evaluation::frechet::{Gaussian, frechet_distance};
use crate::evaluation::geometric::{GEOMETRIC_NAMES, GeometricThresholds, geometric_features};
use crate::motion::npy::read_f32;
use crate::motion::quaternion::{Quaternion, from_axis_angle, mul, rotate};
use crate::units::FPS;

/// Relative to a measure; both sides compute in double precision.
const TOLERANCE: f64 = 1e-9;

#[derive(Deserialize)]
struct Golden {
    bar_frames: f64,
    radius_m: f64,
    kinetic_features: Vec<Vec<f64>>,
    gmc_published: f64,
    gmc_correlation: f64,
    unison: f64,
    tif: f64,
    touching_pairs_per_frame: f64,
    least_separation_m: f64,
    coverage_m2: f64,
    spread_m: f64,
    dancer_diversity: f64,
    dancer_velocity_difference_m_s: f64,
}

fn golden() -> (Array3<f32>, Golden) {
    let array = read_f32(include_bytes!("../../../tests/golden/groups/group.npy")).expect("array");
    let shape: [usize; 3] = array.shape.try_into().expect("three axes");
    let group = Array3::from_shape_vec(shape, array.values).expect("values of the shape");
    let measures = include_str!("../../../tests/golden/groups/measures.json");
    (group, serde_json::from_str(measures).expect("measures"))
}

/// Steps of a dancer in its own frame: sums of sines of its own.
fn dance(n: usize, seed: u64) -> Poses {
    let mut draws = Draws::new(seed);
    let waves: Vec<[f64; 2]> =
        (0..16).map(|_| [0.2 + 1.5 * draws.uniform(), 6.3 * draws.uniform()]).collect();
    let wave = |i: usize, t: usize| {
        (0..4)
            .map(|k| {
                (std::f64::consts::TAU * waves[4 * i + k][0] * t as f64 / FPS + waves[4 * i + k][1])
                    .sin()
            })
            .sum::<f64>()
    };
    let up = [0.0, 1.0, 0.0];
    Poses {
        position_m: (0..n)
            .map(|t| [0.2 * wave(0, t), 1.0 + 0.05 * wave(1, t), 0.2 * wave(2, t)])
            .collect(),
        orientation: (0..n).map(|t| from_axis_angle(up, 0.4 * wave(3, t))).collect(),
    }
}

/// The same steps elsewhere, facing another way.
fn moved(dancer: &Poses, place: [f64; 3], yaw_rad: f64) -> Poses {
    let turn: Quaternion = from_axis_angle([0.0, 1.0, 0.0], yaw_rad);
    let at = |&p: &[f64; 3]| {
        let p = rotate(turn, p);
        std::array::from_fn(|i| p[i] + place[i])
    };
    Poses {
        position_m: dancer.position_m.iter().map(at).collect(),
        orientation: dancer.orientation.iter().map(|&q| mul(turn, q)).collect(),
    }
}

fn later(dancer: &Poses, n: usize) -> Poses {
    Poses {
        position_m: dancer.position_m[n..].to_vec(),
        orientation: dancer.orientation[n..].to_vec(),
    }
}

#[test]
fn measures_are_those_of_the_formulas() {
    let (group, golden) = golden();
    let found = measure(group.view(), golden.bar_frames, golden.radius_m);
    let pairs = [
        (found.gmc_published, golden.gmc_published, "gmc_published"),
        (found.gmc_correlation, golden.gmc_correlation, "gmc_correlation"),
        (found.unison, golden.unison, "unison"),
        (found.tif, golden.tif, "tif"),
        (found.touching_pairs_per_frame, golden.touching_pairs_per_frame, "pairs per frame"),
        (found.least_separation_m, golden.least_separation_m, "least_separation_m"),
        (found.coverage_m2, golden.coverage_m2, "coverage_m2"),
        (found.spread_m, golden.spread_m, "spread_m"),
        (found.dancer_diversity, golden.dancer_diversity, "dancer_diversity"),
        (
            found.dancer_velocity_difference_m_s,
            golden.dancer_velocity_difference_m_s,
            "dancer_velocity_difference_m_s",
        ),
    ];
    for (found, wanted, name) in pairs {
        let found = found.unwrap_or(f64::NAN);
        assert!((found - wanted).abs() <= TOLERANCE * wanted.abs(), "{name}: {found} {wanted}");
    }
    let features = realism::kinetic_features(&dancers(group.view()).expect("poses"));
    assert_eq!(features.dim(), (golden.kinetic_features.len(), 12));
    for ((i, k), found) in features.indexed_iter() {
        let wanted = golden.kinetic_features[i][k];
        assert!((found - wanted).abs() <= TOLERANCE * wanted.abs(), "{i} {k}: {found} {wanted}");
    }
}

#[test]
fn copies_are_in_unison_wherever_they_stand_and_face() {
    let one = dance(331, 1);
    let copies =
        [one.clone(), moved(&one, [2.0, 0.0, -1.0], 1.3), moved(&one, [-4.0, 0.0, 7.0], -2.9)];
    assert!((unison(&copies, 61.0).expect("unison") - 1.0).abs() < 1e-12);
    let difference = difference::difference(&copies).expect("dancers");
    assert!(difference.of_velocities_m_s < 1e-12);
    // Turned by angles that are not whole quarters: horizontal energies stay.
    assert!(correlation::correlation(&copies).expect("gmc") > 1.0 - 1e-12);
    assert!(difference.of_features.expect("frames") < 1e-9);
}

#[test]
fn a_canon_within_a_bar_is_unison_and_one_beyond_is_not() {
    let one = dance(500, 2);
    let canon = |lag: usize| [one.clone(), later(&moved(&one, [3.0, 0.0, 0.0], 0.7), lag)];
    for lag in [1, 37, 60] {
        assert!((unison(&canon(lag), 60.0).expect("unison") - 1.0).abs() < 1e-9, "{lag}");
    }
    assert!(unison(&canon(83), 60.0).expect("unison") < 0.9);
    assert!(difference::difference(&canon(37)).expect("dancers").of_velocities_m_s > 0.1);
}

#[test]
fn independent_dancers_are_in_no_unison() {
    // On the mean of many pairs 0; a lag that is chosen where r is taken would give 0.2.
    let all: Vec<Poses> = (0..12).map(|i| dance(1500, 100 + i)).collect();
    let found = unison(&all, 60.0).expect("unison");
    assert!(found.abs() < 0.05, "{found}");
    let gmc = correlation::correlation(&all).expect("gmc");
    assert!(gmc.abs() < 0.2, "{gmc}");
}

#[test]
fn mirrored_steps_are_opposite() {
    let one = dance(400, 3);
    // Only sideways, so that the mirror has nothing but the sign.
    let sideways = |sign: f64| Poses {
        position_m: one.position_m.iter().map(|p| [sign * p[0], 1.0, 0.0]).collect(),
        orientation: vec![crate::motion::quaternion::IDENTITY; one.len()],
    };
    let found = unison(&[sideways(1.0), sideways(-1.0)], 1.0).expect("unison");
    assert!(found < -0.9, "{found}");
}

#[test]
fn bodies_touch_below_two_radii() {
    let stands = |x: f64| Poses {
        position_m: (0..20).map(|t| [x, 1.0 + 0.3 * f64::from(t), 0.0]).collect(),
        orientation: vec![crate::motion::quaternion::IDENTITY; 20],
    };
    let at = |x: f64| contacts(&[stands(0.0), stands(x)], 0.35).expect("a pair");
    assert_eq!((at(0.69).share, at(0.69).per_frame), (1.0, 1.0));
    assert_eq!((at(0.71).share, at(0.71).least_m), (0.0, 0.71));
    // Of three pairs one touches.
    let three = contacts(&[stands(0.0), stands(0.5), stands(5.0)], 0.35).expect("pairs");
    assert!((three.share - 1.0 / 3.0).abs() < 1e-15 && three.per_frame == 1.0);
    assert_eq!(three.least_m, 0.5);
}

#[test]
fn a_formation_has_an_area_and_a_spread() {
    let at = |places: &[[f64; 2]]| {
        let stands = |&[x, z]: &[f64; 2]| Poses {
            position_m: vec![[x, 1.0, z]; 3],
            orientation: vec![crate::motion::quaternion::IDENTITY; 3],
        };
        coverage(&places.iter().map(stands).collect::<Vec<_>>()).expect("dancers")
    };
    // A square of 2 m, whatever is within it and on its sides.
    let square = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [1.0, 0.0], [0.5, 1.2]];
    assert!((at(&square).hull_m2 - 4.0).abs() < 1e-12);
    assert!((at(&square[..4]).spread_m - 2.0_f64.sqrt()).abs() < 1e-12);
    let line = at(&[[0.0, 0.0], [1.0, 1.0], [3.0, 3.0]]);
    assert_eq!(line.hull_m2, 0.0);
    assert_eq!((at(&[[1.0, 2.0]; 2]).hull_m2, at(&[[1.0, 2.0]; 2]).spread_m), (0.0, 0.0));
}

#[test]
fn realism_is_the_distance_from_real_groups() {
    let group = |first: u64, slower: usize| -> Vec<Poses> {
        let dancer = |seed: u64| {
            let fast = dance(75 * 140, seed);
            let held = |t: usize| t / slower;
            Poses {
                position_m: (0..fast.len()).map(|t| fast.position_m[held(t)]).collect(),
                orientation: (0..fast.len()).map(|t| fast.orientation[held(t)]).collect(),
            }
        };
        (first..first + 3).map(dancer).collect()
    };
    let fit =
        |group: &[Poses]| Gaussian::fit(realism::kinetic_features(group).view()).expect("fit");
    let real = fit(&group(1, 1));
    let same = frechet_distance(&real, &fit(&group(1, 1))).expect("known");
    let other = frechet_distance(&real, &fit(&group(1, 2))).expect("known");
    assert!(same < 1e-9 && other > 0.1, "{same} {other}");

    // Pooled shares are means over the dancers.
    let group = group(7, 1);
    let chunk: Vec<Poses> = group.iter().map(|d| crate::evaluation::body::part(d, 0..75)).collect();
    let thresholds = GeometricThresholds::fit(&chunk).expect("frames");
    let found = realism::geometric_group_features(&group, &thresholds);
    assert_eq!(found.dim(), (140, GEOMETRIC_NAMES.len()));
    for i in 0..GEOMETRIC_NAMES.len() {
        let share = |d: &Poses| geometric_features(d, &thresholds).expect("frames")[i];
        let wanted = chunk.iter().map(share).sum::<f64>() / 3.0;
        assert!((found[[0, i]] - wanted).abs() < 1e-12, "{i}");
    }
}

#[test]
fn what_is_not_defined_is_none() {
    let (group, _) = golden();
    let alone = measure(group.slice(s![..1, .., ..]), 60.0, 0.35);
    assert_eq!(
        (alone.unison, alone.tif, alone.gmc_published, alone.dancer_diversity),
        (None, None, None, None)
    );
    assert!(alone.spread_m == Some(0.0) && alone.coverage_m2 == Some(0.0));
    let nobody = Array3::zeros((0, 9, 25));
    assert_eq!(measure(nobody.view(), 60.0, 0.35), GroupMeasures::default());
    let mut broken = group.clone();
    broken[[1, 7, 0]] = f32::NAN;
    assert_eq!(measure(broken.view(), 60.0, 0.35), GroupMeasures::default());
    let there = present(broken.view(), &[true, false, true]);
    let pair = present(group.view(), &[true, false, true]);
    assert_eq!(measure(there.view(), 60.0, 0.35), measure(pair.view(), 60.0, 0.35));
    assert!(measure(there.view(), 60.0, 0.35).unison.is_some());
    let poses = dancers(group.view()).expect("poses");
    for bar_frames in [0.3, f64::NAN, 159.0, -5.0, f64::INFINITY] {
        assert_eq!(unison(&poses, bar_frames), None, "{bar_frames}");
    }
    // A dancer that does not move is in no unison.
    let still = Array3::from_shape_fn((2, 200, 25), |(_, _, i)| f32::from(u8::from(i == 9)));
    let still = measure(still.view(), 60.0, 0.35);
    assert_eq!((still.unison, still.gmc_correlation, still.tif), (None, None, Some(1.0)));
}
