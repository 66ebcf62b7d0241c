use proptest::prelude::*;

use super::*;
use crate::motion::convert_track;

/// Joint positions of somebody who stands, in the root's frame: head, neck, spine and legs are enough.
fn standing() -> Vec<f64> {
    let mut row = vec![0.0; FEATURE_DIM];
    row[HEIGHT] = 0.9;
    for (joint, y) in [
        (3, 1.0),
        (6, 1.15),
        (9, 1.2),
        (12, 1.4),
        (15, 1.5),
        (1, 0.8),
        (2, 0.8),
        (4, 0.45),
        (5, 0.45),
    ] {
        row[JOINTS + 3 * (joint - 1) + 1] = y;
    }
    row
}

fn npy_of(rows: &[Vec<f64>]) -> Vec<u8> {
    npy::write(&[rows.len(), FEATURE_DIM], &rows.concat())
}

#[test]
fn a_circle_of_steps_closes() {
    // Forward by 0.1 m and a turn of 30° in each of twelve frames: a regular polygon.
    let mut row = standing();
    row[TURN] = -std::f64::consts::PI / 12.0;
    row[VELOCITY[1]] = 0.1;
    let track = read(&npy_of(&vec![row; 25])).unwrap();
    assert_eq!((track.rate_hz, track.position_m[0]), (20.0, [0.0, 0.9, 0.0]));
    let at = |t: usize| track.position_m[t];
    for c in [0, 2] {
        assert!((at(12)[c] - at(0)[c]).abs() < 1e-12 && (at(24)[c]).abs() < 1e-12);
    }
    // The circumradius of twelve sides of 0.1 m is 0.1 / (2 sin 15°); half way round is across.
    let across = ((at(6)[0]).powi(2) + (at(6)[2]).powi(2)).sqrt();
    assert!((across - 0.1 / (std::f64::consts::PI / 12.0).sin()).abs() < 1e-12, "{across}");
    // The first step is made with the heading after the first turn: 30° to +X.
    let step = [0.1 * (std::f64::consts::PI / 6.0).sin(), 0.1 * (std::f64::consts::PI / 6.0).cos()];
    assert!(
        (at(1)[0] - step[0]).abs() < 1e-12 && (at(1)[2] - step[1]).abs() < 1e-12,
        "{:?}",
        at(1)
    );
    let forward = rotate(track.orientation[1], [0.0, 0.0, 0.1]);
    assert!((forward[0] - step[0]).abs() < 1e-12 && (forward[2] - step[1]).abs() < 1e-12);
}

#[test]
fn other_arrays_are_refused_with_the_way_out() {
    let told = |bytes: &[u8]| {
        let error = read(bytes).unwrap_err();
        (error.to_string(), error.kind())
    };
    assert_eq!(
        told(&npy::write(&[2, 251], &vec![0.0f32; 502])),
        (
            "npy has shape [2, 251], expected [frames, 263] of HumanML3D or [frames, 25] of trajectories; \
             save one of them"
                .to_owned(),
            "shape"
        )
    );
    let standardised: Vec<f64> = standing().iter().map(|x| x / 20.0).collect();
    assert_eq!(
        told(&npy_of(&vec![standardised; 9])),
        (
            // (1.5 - 0.9 + 0.9) / 20.
            "npy has joints that make a body of 0.075 m from ankles to head, expected 0.8 to 2.2 m; where the \
             features are standardised, multiply by Std.npy and add Mean.npy before saving"
                .to_owned(),
            "motion_format"
        )
    );
    let mut rows = vec![standing(); 9];
    rows[5][2] = f64::INFINITY;
    assert_eq!(
        told(&npy_of(&rows)),
        (
            "npy has no finite number as feature 2 of frame 5, both counted from 0; repair or cut the motion \
             there"
                .to_owned(),
            "non_finite"
        )
    );
}

proptest! {
    #[test]
    fn no_features_make_the_reader_panic(
        n in 0..60usize, scale in prop::num::f64::ANY, bytes in prop::collection::vec(any::<u8>(), 0..200)
    ) {
        let row: Vec<f64> = standing().iter().map(|x| x * scale).collect();
        if let Ok(track) = read(&npy_of(&vec![row; n])) {
            drop(convert_track(&track, None, None));
        }
        prop_assert!(read(&bytes).is_err());
    }
}
