//! One person in all the ways that people have their files: the same motion comes out.

use super::person::{Person, PersonAction};
use super::*;
use crate::motion::exchange;
use crate::motion::quaternion::from_axis_angle;
use ndarray::Array2;
use proptest::prelude::*;

const Y: [f64; 3] = [0.0, 1.0, 0.0];

fn converted(person: &Person) -> Capture {
    let bvh = Bvh::parse(person.bvh().as_bytes()).expect("a take");
    convert_capture(&bvh, None, None).unwrap_or_else(|e| panic!("{person:?}: {e}"))
}

fn told(capture: &Capture) -> Vec<String> {
    capture.account.notes.iter().map(ToString::to_string).collect()
}

/// Asserts that all 25 channels are the same, to what the digits of the files leave.
fn assert_same(person: &Person, got: &Capture, want: &Capture) {
    let (got, want) = (got.trajectory.view(), want.trajectory.view());
    assert_eq!(got.dim(), want.dim(), "{person:?}");
    for ((t, i), want) in want.indexed_iter() {
        // Six places of the coarsest unit, a metre, twice differenced (900 per s²) in accelerations.
        let tolerance = if (6..9).contains(&i) { 0.02 } else { 1e-3 };
        let off = (got[[t, i]] - want).abs();
        assert!(
            off < tolerance,
            "frame {t}, channel {i}: {} against {want}; {person:?}",
            got[[t, i]]
        );
    }
}

#[test]
fn the_person_is_as_drawn() {
    let capture = converted(&Person::default());
    let x = capture.trajectory.view();
    assert_eq!(x.nrows(), 59);
    for t in 12..45 {
        let s = t as f64 / 30.0;
        let wave = |hz: f64, phase: f64| (std::f64::consts::TAU * hz * s + phase).sin();
        // Feet are 0.94 m below the hips.
        let want = [0.3 * wave(0.4, 0.0), 0.94 + 0.02 * wave(0.9, 0.3), 0.45 * s];
        for (axis, want) in want.into_iter().enumerate() {
            let off = f64::from(x[[t, axis]]) - want;
            // The floor is that of swung legs, a little higher.
            let tolerance = if axis == 1 { 0.06 } else { 0.001 };
            assert!(off.abs() < tolerance, "frame {t} axis {axis}: off by {off}");
        }
    }
    assert_eq!(told(&capture), [""; 0]);
    assert_eq!((capture.account.unit_m, capture.account.cut_s), (0.01, 0.0));
}

#[test]
fn a_root_that_never_moves_is_not_the_body() {
    let base = Person { n_frames: 137, ..Person::default() };
    let want = converted(&base);
    let flat = from_axis_angle([1.0, 0.0, 0.0], -std::f64::consts::FRAC_PI_2);
    let unturned = [1.0, 0.0, 0.0, 0.0];
    for (above, prop) in [
        (vec![([0.0; 3], unturned)], false),
        (vec![([1.0, 0.5, -3.0], unturned)], false),
        (vec![([0.0; 3], unturned), ([0.0, 0.9, 0.1], unturned)], false),
        // It holds something else.
        (vec![([0.0; 3], unturned)], true),
        // It turns the axes of the file, as programs with Z up write it.
        (vec![([0.0; 3], flat)], false),
        (vec![([2.0, 0.0, 1.0], flat), ([0.0; 3], unturned)], true),
    ] {
        let person = Person { above, prop, ..base.clone() };
        let got = converted(&person);
        assert_same(&person, &got, &want);
        assert_eq!(got.account.root, "Hips");
        assert_eq!(told(&got), ["root above_0 never moves, the body's root is Hips"]);
    }
}

#[test]
fn any_axis_may_be_up_and_any_unit_written() {
    for does in
        [PersonAction::Walks, PersonAction::Sits, PersonAction::Crouches, PersonAction::Lies]
    {
        let base = Person { does, n_frames: 121, ..Person::default() };
        let want = converted(&base);
        assert_eq!(told(&want), [""; 0], "{does:?}");
        for up in [Axis::Y, Axis::Z, Axis::X, Axis::MinusY, Axis::MinusZ, Axis::MinusX] {
            for (units_per_m, unit) in [
                (100.0, 0.01),
                (1.0, 1.0),
                (1000.0, 0.001),
                (1.0 / 0.0254, 0.0254),
                (1.0 / 0.3048, 0.3048),
            ] {
                let person = Person { up, units_per_m, ..base.clone() };
                let got = converted(&person);
                assert_eq!((got.account.up, got.account.unit_m), (up, unit), "{does:?}");
                assert_same(&person, &got, &want);
            }
        }
    }
}

#[test]
fn no_names_own_axes_and_six_channels_do_not_matter() {
    for does in [PersonAction::Walks, PersonAction::Sits] {
        let base = Person { does, ..Person::default() };
        let want = converted(&base);
        for up in [Axis::Y, Axis::Z] {
            for (named, own_axes, six_channels) in
                [(false, false, false), (true, true, false), (true, false, true)]
            {
                let person = Person { up, named, own_axes, six_channels, ..base.clone() };
                let got = converted(&person);
                assert_eq!(got.account.up, up, "{person:?}");
                assert_same(&person, &got, &want);
            }
        }
    }
}

#[test]
fn a_given_axis_wins() {
    let person = Person { up: Axis::Z, ..Person::default() };
    let bvh = Bvh::parse(person.bvh().as_bytes()).unwrap();
    let want = converted(&Person::default());
    assert_same(&person, &convert_capture(&bvh, None, Some(Axis::Z)).unwrap(), &want);
    let other = convert_capture(&bvh, None, Some(Axis::Y)).unwrap();
    assert_eq!(other.account.up, Axis::Y);
    assert!((other.trajectory.view()[[30, 1]] - want.trajectory.view()[[30, 1]]).abs() > 0.1);
}

#[test]
fn only_a_pose_that_is_jumped_out_of_is_cut() {
    for rate_hz in [24.0, 30.0, 60.0, 120.0] {
        let n_frames = (3.0 * rate_hz) as usize + 1;
        for does in [PersonAction::Walks, PersonAction::HitsAndFreezes, PersonAction::StandsStill] {
            let person = Person { does, rate_hz, n_frames, ..Person::default() };
            let capture = converted(&person);
            assert_eq!(capture.account.cut_s, 0.0, "{does:?} at {rate_hz} Hz");
            assert_eq!(capture.trajectory.n_frames(), 89, "{does:?} at {rate_hz} Hz");
        }
        let person = Person { does: PersonAction::Pops, rate_hz, n_frames, ..Person::default() };
        let capture = converted(&person);
        assert!((capture.account.cut_s - 2.0 / rate_hz).abs() < 1e-12, "{rate_hz} Hz");
        assert!(told(&capture)[0].starts_with("the first 2 frames ("), "{:?}", told(&capture));
    }
}

#[test]
fn what_stands_still_is_told() {
    let capture = converted(&Person { does: PersonAction::StandsStill, ..Person::default() });
    assert_eq!(told(&capture), ["root Hips stands still, it moves within 0.0 mm"]);
    // A body in no unit.
    let capture = converted(&Person { units_per_m: 8.0, ..Person::default() });
    let note = &told(&capture)[0];
    assert!(
        note.starts_with("a body of 14.") && note.ends_with("in any unit, it is scaled to 1.7 m"),
        "{note}"
    );
    let capture = converted(&Person { units_per_m: 1.0 / 0.3048, ..Person::default() });
    assert_eq!(told(&capture), ["lengths are taken for feet, the body for 1.78 m"]);
}

#[test]
fn a_take_of_this_program_comes_back_to_a_millimetre() {
    // A generated motion anywhere: fast, high over the floor, turning.
    let mut frames = Array2::zeros((97, 25));
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        let s = t as f64 / FPS;
        let p = [1.5 + (9.0 * s).sin(), 0.95 + 0.08 * (13.0 * s).cos(), -2.0 + 0.7 * s * s];
        let q = from_axis_angle(Y, 2.5 * s);
        for c in 0..3 {
            row[c] = p[c] as f32;
        }
        for c in 0..4 {
            row[9 + c] = q[c] as f32;
        }
    }
    let mut bytes = Vec::new();
    exchange::write_bvh(frames.view(), &mut bytes).unwrap();
    let bvh = Bvh::parse(&bytes).unwrap();
    let capture = convert_capture(&bvh, None, None).unwrap();
    let got = capture.trajectory.view();
    assert_eq!(got.nrows(), 95);
    for t in 0..95 {
        for c in (0..3).chain(9..13) {
            let off = (got[[t, c]] - frames[[t, c]]).abs();
            assert!(off < 1e-5, "frame {t} channel {c}: off by {off}");
        }
    }
    assert_eq!(told(&capture), [""; 0]);
    assert_eq!(capture.account.unit_m, 0.01);
}

#[test]
fn a_root_alone_keeps_its_height() {
    let rows: String = (0..60).map(|t| format!("{} 95 0 0 0 0\n", f64::from(t) * 2.0)).collect();
    let text = format!(
        "HIERARCHY\nROOT r\n{{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation \
         Xrotation Yrotation\nEnd Site\n{{\nOFFSET 0 165 0\n}}\n}}\nMOTION\nFrames: 60\n\
         Frame Time: 0.0333333\n{rows}"
    );
    let trajectory = convert_bvh(&Bvh::parse(text.as_bytes()).unwrap(), None).unwrap();
    assert_eq!(trajectory.n_frames(), 58);
    assert!((trajectory.view()[[30, 1]] - 0.95).abs() < 1e-4);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn damaged_takes_never_panic(
        at in 0.0..1.0f64, n in 0..40usize, patch in "[{}a-zA-Z0-9 .:\\n\\-]{0,9}",
        named: bool, prop: bool, z_up: bool
    ) {
        let up = if z_up { Axis::Z } else { Axis::Y };
        let above = if prop { vec![([0.0; 3], [1.0, 0.0, 0.0, 0.0])] } else { Vec::new() };
        let person = Person { n_frames: 23, named, prop, up, above, ..Person::default() };
        let mut bytes = person.bvh().into_bytes();
        let start = (at * bytes.len() as f64) as usize;
        let end = (start + n).min(bytes.len());
        bytes.splice(start..end, patch.into_bytes());
        if let Ok(bvh) = Bvh::parse(&bytes) {
            let _ = convert_capture(&bvh, None, None);
        }
    }
}
