//! The capture conversion against golden files of an independent NumPy/SciPy statement
//! (`tests/golden/motion/make.py`), and against the identities every trajectory must obey.

use std::fs;
use std::path::PathBuf;

use motiongen::motion::lowpass::lowpass;
use motiongen::motion::npy::read_f64;
use motiongen::motion::quaternion::{Quaternion, dot, from_axis_angle, mul, normalize};
use motiongen::motion::spline::CubicSpline;
use motiongen::motion::style::{BodyMotion, style_channels};
use motiongen::motion::{
    Beats, Bvh, CHANNEL_NAMES, Channel, ChannelLimits, MOTION_DIM, Trajectory, convert_bvh,
};
use motiongen::units::FPS;

/// Every capture with the beats file it is converted with.
const CASES: [(&str, Option<&str>); 5] = [
    ("cmu_01_01", None),
    ("mocapbank", Some("waltz")),
    ("mocapbank_15fps", None),
    ("six_channels", Some("plain")),
    ("short", None),
];

fn golden(name: &str) -> Vec<u8> {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "tests/golden/motion", name].iter().collect();
    fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn golden_array(name: &str) -> (Vec<usize>, Vec<f64>) {
    let array = read_f64(&golden(name)).unwrap();
    (array.shape, array.values)
}

fn convert(case: &str, beats: Option<&str>) -> Trajectory {
    let bvh = Bvh::parse(&golden(&format!("{case}.bvh"))).unwrap();
    let beats = beats.map(|name| {
        let text = String::from_utf8(golden(&format!("{name}.beats.txt"))).unwrap();
        Beats::parse(&text).unwrap()
    });
    convert_bvh(&bvh, beats.as_ref()).unwrap()
}

fn quaternion(frame: &[f64]) -> Quaternion {
    let mut q = [0.0; 4];
    q.copy_from_slice(&frame[Channel::Quaternion.range()]);
    normalize(q)
}

/// Rows of a trajectory in double precision.
fn rows(trajectory: &Trajectory) -> Vec<Vec<f64>> {
    let view = trajectory.view();
    view.rows().into_iter().map(|row| row.iter().map(|&x| f64::from(x)).collect()).collect()
}

#[test]
fn every_channel_agrees_with_the_independent_conversion() {
    for (case, beats) in CASES {
        let (shape, expected) = golden_array(&format!("{case}.expected.npy"));
        let trajectory = convert(case, beats);
        assert_eq!(shape, [trajectory.n_frames(), MOTION_DIM], "{case}");
        let mut largest = [0.0f64; MOTION_DIM];
        for (got, want) in rows(&trajectory).iter().zip(expected.chunks_exact(MOTION_DIM)) {
            for i in 0..MOTION_DIM {
                // Half a unit in the last place of an f32, and 1e-9 for two orders of summation
                // in doubles: rounding near 1e-13 m grows by 900 in the acceleration.
                let tolerance = 0.5 * f64::from(f32::EPSILON) * want[i].abs() + 1e-9;
                let error = (got[i] - want[i]).abs();
                largest[i] = largest[i].max(error);
                assert!(
                    error <= tolerance,
                    "{case}: {} is {} instead of {}",
                    CHANNEL_NAMES[i],
                    got[i],
                    want[i]
                );
            }
        }
        // The largest numbers here are accelerations of about 140 m/s²: 8e-6 in single precision.
        assert!(largest.iter().all(|e| *e < 1e-5), "{case}: {largest:?}");
    }
}

#[test]
fn captures_of_people_pass_the_checks() {
    for case in ["cmu_01_01", "mocapbank", "mocapbank_15fps"] {
        assert_eq!(convert(case, None).check(&ChannelLimits::Reference), Ok(()), "{case}");
    }
    // Drawn with sines of 1 m at up to 4 Hz: no body accelerates at 133 m/s².
    let error = convert("six_channels", None).check(&ChannelLimits::Wide).unwrap_err();
    assert_eq!(error.kind(), "channel_limit");
}

#[test]
fn velocity_and_acceleration_are_forward_differences() {
    for (case, beats) in CASES {
        let x = rows(&convert(case, beats));
        for pair in x.windows(2) {
            for i in 0..6 {
                let derived = (pair[1][i] - pair[0][i]) * FPS;
                // Each side of the difference and its result were rounded to f32 once.
                let size = (pair[0][i].abs() + pair[1][i].abs()) * FPS + derived.abs();
                let tolerance = 0.5 * f64::from(f32::EPSILON) * size + 1e-9;
                assert!((pair[0][i + 3] - derived).abs() <= tolerance, "{case} {}", i + 3);
            }
        }
    }
}

#[test]
fn integrating_velocity_and_angular_velocity_returns_the_path() {
    for (case, beats) in CASES {
        let x = rows(&convert(case, beats));
        let mut p = [x[0][0], x[0][1], x[0][2]];
        let mut q = quaternion(&x[0]);
        for frame in &x {
            for axis in 0..3 {
                // Up to 239 velocities of some m/s, each off by 3e-7 m/s over 1/30 s.
                assert!((p[axis] - frame[axis]).abs() < 2e-6, "{case}");
            }
            // A rotation by at most 239 angles each off by 3e-7 / 30 rad; |dot| is second order.
            assert!(1.0 - dot(q, quaternion(frame)).abs() < 1e-11, "{case}");
            for axis in 0..3 {
                p[axis] += frame[Channel::Velocity.range()][axis] / FPS;
            }
            let omega = &frame[Channel::AngularVelocity.range()];
            let rate = omega.iter().map(|w| w * w).sum::<f64>().sqrt();
            let axis = [0, 1, 2].map(|i| omega[i] / rate.max(1e-300));
            q = mul(from_axis_angle(axis, rate / FPS), q);
        }
    }
}

#[test]
fn quaternions_keep_their_sign_from_frame_to_frame() {
    for (case, beats) in CASES {
        let x = rows(&convert(case, beats));
        assert!(x[0][Channel::Quaternion.range().start] >= 0.0, "{case}");
        assert!(x.windows(2).all(|w| dot(quaternion(&w[0]), quaternion(&w[1])) > 0.9), "{case}");
    }
}

#[test]
fn phase_is_zero_without_beats_and_advances_by_thirds_in_a_waltz() {
    let silent = convert("mocapbank", None);
    assert!(silent.channel(Channel::Phase).iter().all(|&p| p == 0.0));
    let waltz = convert("mocapbank", Some("waltz"));
    let phase: Vec<f32> = waltz.channel(Channel::Phase).iter().copied().collect();
    let bars = phase.windows(2).filter(|w| w[1] < w[0]).count();
    // 239 frames are 7.9 s, a bar lasts about 1.83 s, and the first beat in the file is number 2.
    assert_eq!(bars, 4);
    // Beat 2 of the bar at 1.7 s, that is phase 1/3, within the drawn jitter of some 15 ms.
    assert!((phase[51] - 1.0 / 3.0).abs() < 0.03, "{}", phase[51]);
}

#[test]
fn the_low_pass_agrees_with_sosfiltfilt() {
    let (shape, values) = golden_array("lowpass.npy");
    let rates = [(120.0, 8.0), (30.0, 8.0), (30.0, 3.0), (15.0, 6.0), (97.3, 1.7)];
    let [2, n_cases, n] = shape[..] else { panic!("{shape:?}") };
    assert_eq!(n_cases, rates.len());
    let (inputs, outputs) = values.split_at(n_cases * n);
    for (case, (rate_hz, cutoff_hz)) in rates.into_iter().enumerate() {
        let mut x = inputs[case * n..(case + 1) * n].to_vec();
        lowpass(&mut x, cutoff_hz, rate_hz);
        for (got, want) in x.iter().zip(&outputs[case * n..]) {
            // Values near 10; the sections differ in their order and their gains, not in product.
            assert!((got - want).abs() < 1e-11, "{rate_hz} Hz: {got} instead of {want}");
        }
    }
}

#[test]
fn the_spline_agrees_with_scipy() {
    let (shape, values) = golden_array("spline.npy");
    assert_eq!(shape[0], 4);
    let n = shape[1];
    let spline = CubicSpline::fit(&values[..n], &values[n..2 * n]).unwrap();
    let got = spline.evaluate(&values[2 * n..3 * n]);
    for (got, want) in got.iter().zip(&values[3 * n..]) {
        // Knots 0.05 to 1 apart: the extrapolated ends reach some tens.
        assert!((got - want).abs() < 1e-11, "{got} instead of {want}");
    }
}

#[test]
fn the_style_of_a_root_alone_agrees_to_the_precision_of_its_input() {
    let (shape, expected) = golden_array("style_root_only.npy");
    let (_, frames) = golden_array("mocapbank.expected.npy");
    let frames: Vec<&[f64]> = frames.chunks_exact(MOTION_DIM).collect();
    let vectors = |channel: Channel| -> Vec<[f64; 3]> {
        let first = channel.range().start;
        frames.iter().map(|f| [f[first], f[first + 1], f[first + 2]]).collect()
    };
    let style = style_channels(&BodyMotion {
        position_m: &vectors(Channel::Position),
        velocity_m_s: &vectors(Channel::Velocity),
        acceleration_m_s2: &vectors(Channel::Acceleration),
        orientation: &frames.iter().map(|f| quaternion(f)).collect::<Vec<_>>(),
        nodes_m: &[],
    });
    assert_eq!(shape, [style.len(), 8]);
    for (got, want) in style.iter().flatten().zip(&expected) {
        // Variances of positions cancel to about 1e-16 m², whose root is 1e-8 m.
        assert!((got - want).abs() < 1e-7, "{got} instead of {want}");
    }
}

#[test]
fn conversion_is_repeatable_bit_for_bit() {
    assert_eq!(convert("six_channels", Some("plain")), convert("six_channels", Some("plain")));
}
