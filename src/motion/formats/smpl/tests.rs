use std::io::Cursor;

use proptest::prelude::*;

use super::*;
use crate::motion::npz::NpzWriter;
use crate::motion::quaternion::{from_axis_angle, normalize};
use crate::motion::{Capture, CaptureError, convert_track};

type Member<'a> = (&'a str, &'a [usize], Vec<f64>);

fn npz(members: &[Member]) -> Vec<u8> {
    let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
    for (key, shape, values) in members {
        npz.add(key, shape, values.iter().copied()).unwrap();
    }
    npz.finish().unwrap().into_inner()
}

/// Poses of 24 joints whose root turns about +Y by 0.1 rad a frame, after a turn about x.
fn poses(n: usize, tilt_rad: f64) -> Vec<f64> {
    let tilt = from_axis_angle([1.0, 0.0, 0.0], tilt_rad);
    let row = |t: usize| {
        let q =
            crate::motion::quaternion::mul(tilt, from_axis_angle([0.0, 1.0, 0.0], 0.1 * t as f64));
        let vector =
            crate::motion::quaternion::angular_velocity([1.0, 0.0, 0.0, 0.0], normalize(q), 1.0);
        vector.into_iter().chain(std::iter::repeat_n(0.25, 69))
    };
    (0..n).flat_map(row).collect()
}

fn places(n: usize) -> Vec<f64> {
    (0..n).flat_map(|t| [0.01 * t as f64, 1.0, -0.02 * t as f64]).collect()
}

fn refusal(members: &[Member]) -> (String, &'static str) {
    let error = read(&npz(members)).unwrap_err();
    (error.to_string(), error.kind())
}

fn converted(members: &[Member]) -> Result<Capture, CaptureError> {
    convert_track(&read(&npz(members)).unwrap(), None, None)
}

#[test]
fn the_pelvis_is_that_of_the_mean_shape_and_translations_are_scaled_back() {
    let n = 9;
    let scaled: Vec<f64> = places(n).iter().map(|x| x * 90.0).collect();
    let track = read(&npz(&[
        ("smpl_poses", &[n, 72], poses(n, 0.0)),
        ("smpl_trans", &[n, 3], scaled),
        ("smpl_scaling", &[1], vec![90.0]),
    ]))
    .unwrap();
    assert_eq!((track.format, track.rate_hz, track.up), ("aist", 60.0, Some(Axis::Y)));
    for t in 0..n {
        for (c, want) in [0.01 * t as f64, 1.0, -0.02 * t as f64].into_iter().enumerate() {
            let got = track.position_m[t][c] - MEAN_PELVIS_M[c];
            assert!((got - want).abs() < 1e-12, "{t}: {got}");
        }
        let want = from_axis_angle([0.0, 1.0, 0.0], 0.1 * t as f64);
        for (got, want) in track.orientation[t].iter().zip(want) {
            assert!((got - want).abs() < 1e-12, "{t}");
        }
    }
}

#[test]
fn up_is_the_formats_and_else_the_bodys() {
    let n = 31;
    let quarter = std::f64::consts::FRAC_PI_2;
    let standing =
        |tilt| vec![("poses", &[31, 72][..], poses(n, tilt)), ("trans", &[31, 3][..], places(n))];
    let up = |tilt: f64, rate: Option<&'static str>| {
        let mut members = standing(tilt);
        members.extend(rate.map(|key| (key, &[][..], vec![30.0])));
        converted(&members)
    };
    // The body's +Y is turned to +Z by a quarter turn about x.
    assert_eq!(up(quarter, Some("mocap_framerate")).unwrap().account.up, Axis::Z);
    assert_eq!(up(quarter, Some("fps")).unwrap().account.up, Axis::Z);
    assert_eq!(up(0.0, Some("fps")).unwrap().account.up, Axis::Y);
    let assumed = up(0.25 * std::f64::consts::PI, Some("fps")).unwrap().account;
    assert_eq!(assumed.up, Axis::Y);
    assert_eq!(
        assumed.notes.last().unwrap().to_string(),
        "nothing tells which axis is up, y is assumed (--up names another)"
    );
    assert_eq!(
        up(0.0, Some("mocap_frame_rate")).unwrap_err().to_string(),
        "capture holds its body along y, while its format has z up; name the axis that is up with --up y or \
         --up z"
    );
    let track = read(&npz(&standing(0.0))).unwrap();
    assert_eq!(track.rate_hz, 60.0);
    assert_eq!(
        track.notes.last().unwrap(),
        "no frame rate in the file, 60 fps are taken (fps says another)"
    );
}

#[test]
fn what_is_no_motion_of_smpl_is_refused_with_both_values() {
    let n = 5;
    let pose: Member = ("poses", &[5, 72], poses(n, 0.0));
    let trans: Member = ("trans", &[5, 3], places(n));
    assert_eq!(
        refusal(std::slice::from_ref(&pose)),
        (
            "npz has no translation: it holds poses, expected smpl_trans, trans, transl or root_trans; save them with \
             numpy.savez(path, poses=…, trans=…, mocap_framerate=…)"
                .to_owned(),
            "missing_key"
        )
    );
    assert_eq!(
        refusal(&[("poses", &[5, 71], vec![0.0; 355]), trans.clone()]),
        (
            "npz member \"poses\" has shape [5, 71], expected [frames, 72] (SMPL), [frames, 156] (SMPL-H), \
             [frames, 165] (SMPL-X) or [frames, joints, 3]; save the pose as axis-angles, the root first"
                .to_owned(),
            "shape"
        )
    );
    assert_eq!(
        refusal(&[pose.clone(), ("trans", &[4, 3], places(4))]),
        (
            "npz member \"trans\" has shape [4, 3], expected [5, 3], a position for each of the 5 poses; save \
             both of the same frames"
                .to_owned(),
            "shape"
        )
    );
    assert_eq!(
        refusal(&[pose.clone(), trans.clone(), ("smpl_scaling", &[1], vec![0.0])]),
        (
            "npz member \"smpl_scaling\" has shape [1] and first value 0, expected one positive number; save \
             it as one"
                .to_owned(),
            "motion_format"
        )
    );
    assert_eq!(
        converted(&[pose, trans, ("fps", &[], vec![0.5])]).unwrap_err().to_string(),
        "capture has 0.5 frames per second, expected 1 to 10000; write the rate of the take"
    );
    let mut broken = places(31);
    broken[3 * 7 + 1] = f64::NAN;
    assert_eq!(
        converted(&[("poses", &[31, 72], poses(31, 0.0)), ("trans", &[31, 3], broken)])
            .unwrap_err()
            .to_string(),
        "capture has a value that is not finite in frame 7, counted from 0; repair or cut the take there"
    );
}

proptest! {
    #[test]
    fn no_archive_makes_the_reader_panic(
        n in 0..40usize, dim in prop_oneof![Just(72), Just(0), 0..170usize], other in 0..40usize,
        is_whole in any::<bool>(), value in prop::num::f64::ANY,
        key in 0..5usize, flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4)
    ) {
        let rows = if is_whole { n } else { other };
        let rate = ["mocap_framerate", "fps", "smpl_scaling", "poses2", "betas"][key];
        let mut bytes = npz(&[
            ("poses", &[n, dim], vec![value; n * dim]),
            ("trans", &[rows, 3], vec![value; 3 * rows]),
            (rate, &[], vec![value]),
        ]);
        for (at, byte) in flips {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        match read(&bytes) {
            Ok(track) => drop(convert_track(&track, None, None)),
            Err(error) => prop_assert!(error.to_string().len() < 1000),
        }
    }
}
