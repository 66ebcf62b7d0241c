use super::take::forward_kinematics;
use super::*;
use crate::motion::quaternion::IDENTITY;
use proptest::prelude::*;
use std::f64::consts::PI;

/// A post of 1.7 m: a root with six channels at 1 m, a head above and a foot below.
pub(super) fn post(rate_hz: f64, rows: &[[f64; 6]]) -> Bvh {
    let mut text = String::from(
        "HIERARCHY\nROOT hips\n{\nOFFSET 50 60 70\nCHANNELS 6 Xposition Yposition Zposition \
         Yrotation Xrotation Zrotation\nJOINT chest\n{\nOFFSET 0 0.3 0\n\
         CHANNELS 3 Zrotation Xrotation Yrotation\nEnd Site\n{\nOFFSET 0 0.4 0\n}\n}\n\
         End Site\n{\nOFFSET 0 -1 0\n}\n}\n",
    );
    text += &format!("MOTION\nFrames: {}\nFrame Time: {}\n", rows.len(), 1.0 / rate_hz);
    for row in rows {
        let words: Vec<String> = row.iter().map(f64::to_string).collect();
        text += &format!("{} 0 0 0\n", words.join(" "));
    }
    Bvh::parse(text.as_bytes()).unwrap()
}

fn told(account: &CaptureAccount) -> Vec<String> {
    account.notes.iter().map(ToString::to_string).collect()
}

#[test]
fn a_gliding_turning_post_has_closed_forms() {
    // 0.6 m/s along x and a turn of 90 degrees per second about the vertical, at 30 Hz.
    let rows: Vec<[f64; 6]> = (0..91)
        .map(|t| [4.0 + 0.02 * f64::from(t), 1.0, -3.0, 3.0 * f64::from(t), 0.0, 0.0])
        .collect();
    let trajectory = convert_bvh(&post(30.0, &rows), None).unwrap();
    assert_eq!(trajectory.n_frames(), 89);
    for (t, row) in trajectory.view().rows().into_iter().enumerate() {
        // The 8 Hz filter passes slow signals, but its ends bend them: stay away from those.
        if !(20..69).contains(&t) {
            continue;
        }
        let angle = t as f64 * PI / 60.0;
        let want = [0.02 * t as f64, 1.0, 0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0]
            .into_iter()
            .chain([(angle / 2.0).cos(), 0.0, (angle / 2.0).sin(), 0.0])
            .chain([0.0, PI / 2.0, 0.0, 0.0]);
        for (i, w) in want.enumerate() {
            // What is left of the bent ends, twice differenced (900 per s²) in acceleration.
            assert!((f64::from(row[i]) - w).abs() < 5e-5, "frame {t} column {i}: {}", row[i]);
        }
    }
}

#[test]
fn position_channels_replace_the_offset_and_rotations_apply_in_file_order() {
    let bvh = post(30.0, &[[1.0, 2.0, 3.0, 90.0, 90.0, 0.0]]);
    let mut pose = vec![([0.0; 3], IDENTITY); 4];
    forward_kinematics(&bvh, bvh.frames().iter().copied(), &mut pose);
    // Turn left to face +X, then bow: the head points along the new forward, +X.
    for (node, want) in [(0, [1.0, 2.0, 3.0]), (1, [1.3, 2.0, 3.0]), (2, [1.7, 2.0, 3.0])] {
        for (axis, w) in want.into_iter().enumerate() {
            assert!((pose[node].0[axis] - w).abs() < 1e-12, "{:?}", pose[node].0);
        }
    }
}

#[test]
fn a_leading_calibration_pose_is_dropped() {
    let mut rows: Vec<[f64; 6]> =
        (0..61).map(|t| [0.01 * f64::from(t), 1.0, 0.0, 0.0, 0.0, 0.0]).collect();
    rows[0] = [5.0, 1.0, 0.0, 0.0, 0.0, 0.0];
    rows[1] = rows[0];
    let (take, account) = Take::of(&post(60.0, &rows), None).unwrap();
    assert_eq!(take.times_s.len(), 59);
    assert_eq!((take.times_s[0], take.nodes[0][0]), (0.0, 0.02));
    assert_eq!(account.cut_s, 2.0 / 60.0);
    assert_eq!(
        told(&account),
        ["the first 2 frames (0.03 s) are cut, a pose that the body jumps out of"]
    );
}

#[test]
fn short_flat_and_oversized_takes_are_refused() {
    let still = [[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]; 4];
    assert_eq!(
        convert_bvh(&post(30.0, &still), None).unwrap_err().to_string(),
        "capture lasts 0.100 s and gives 4 frames at 30 fps, expected at least 5; \
         use a longer take"
    );
    let flat = "HIERARCHY ROOT a\n{ CHANNELS 1 Yposition }\nMOTION Frames: 9 Frame Time: .1\n\
                0 0 0 0 0 0 0 0 0";
    assert_eq!(
        convert_bvh(&Bvh::parse(flat.as_bytes()).unwrap(), None).unwrap_err().to_string(),
        "capture has a body height of 0.0 file units, expected a positive one; \
         check the joint offsets"
    );
    let slow = format!(
        "HIERARCHY ROOT a\n{{ CHANNELS 1 Yposition End Site {{ OFFSET 0 2 0 }} }}\nMOTION Frames: 7300 Frame Time: 1\n{}",
        "0 ".repeat(7300)
    );
    assert_eq!(
        convert_bvh(&Bvh::parse(slow.as_bytes()).unwrap(), None).unwrap_err().to_string(),
        "capture needs 218971 frames, at most 216000 are converted; split the take"
    );
    let mut vast = [[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]; 9];
    vast[4][0] = 1e300;
    let error = convert_bvh(&post(30.0, &vast), None).unwrap_err();
    let CaptureError::Trajectory(error) = error else { panic!("{error}") };
    assert_eq!(error.kind(), "non_finite");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]
    #[test]
    fn every_kept_frame_obeys_the_identities(
        n in 33..77usize, rate_hz in 20.0..130.0f64, speed in 0.1..9.0f64,
        turn in -400.0..400.0f64
    ) {
        let rows: Vec<[f64; 6]> = (0..n)
            .map(|t| {
                let s = t as f64 / rate_hz;
                [(speed * s).sin(), 1.0 + 0.1 * (7.0 * s).cos(), s * s, turn * s, 20.0 * s, 5.0]
            })
            .collect();
        let trajectory = convert_bvh(&post(rate_hz, &rows), None).unwrap();
        let x = trajectory.view().mapv(f64::from);
        for t in 0..x.nrows() - 1 {
            for i in 0..6 {
                let derived = (x[[t + 1, i]] - x[[t, i]]) * FPS;
                // Three roundings to f32, two of them times 30.
                let size = x[[t, i]].abs().max(x[[t + 1, i]].abs()) * FPS + derived.abs();
                let tolerance = 2.0 * f64::from(f32::EPSILON) * size + 1e-9;
                prop_assert!((x[[t, i + 3]] - derived).abs() <= tolerance);
            }
        }
    }
}
