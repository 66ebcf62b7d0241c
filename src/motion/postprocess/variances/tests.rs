use ndarray::s;

use super::super::noise::{NONE, VARIANCES, frames, fused, mean_square, noisy, truth};
use super::*;
use crate::motion::kinematics::frames_of;

/// Asserts that every variance is within a factor of the other's.
fn assert_near(found: &FusionVariances, wanted: &FusionVariances, factor: f64) {
    for ((name, a), (_, b)) in found.groups().into_iter().zip(wanted.groups()) {
        for (a, b) in [(a.horizontal, b.horizontal), (a.vertical, b.vertical)] {
            assert!((a / b).ln().abs() < factor.ln(), "{name}: {a:e} against {b:e}");
        }
    }
}

#[test]
fn errors_are_measured_against_the_truth() {
    let pairs: Vec<_> = [(700, 1), (301, 2), (1, 3), (0, 4)]
        .map(|(n, seed)| {
            let poses = truth(n);
            (frames(&noisy(&poses, &VARIANCES, seed)), frames_of(&poses, n))
        })
        .into();
    let views = || pairs.iter().map(|(a, b)| (a.view(), b.view()));
    let found = FusionVariances::measure(views()).expect("errors");
    // 1,000 numbers have their variance to 4.5 %, thrice.
    assert_near(&found, &VARIANCES, 1.15);

    // The last values, which repeat others, count as little as what is not finite.
    let (mut decoded, truth) = pairs[1].clone();
    let wanted = FusionVariances::measure([(decoded.view(), truth.view())]).expect("errors");
    for (t, i) in [(300, 3), (300, 8), (299, 7), (300, 14)] {
        decoded[[t, i]] = 1e6;
    }
    let found = FusionVariances::measure([(decoded.view(), truth.view())]);
    assert_eq!(found, Some(wanted));
    decoded.slice_mut(s![77, ..]).fill(f32::NAN);
    let found = FusionVariances::measure([(decoded.view(), truth.view())]).expect("errors");
    assert_near(&found, &wanted, 1.05);

    assert_eq!(FusionVariances::measure([]), None);
    assert_eq!(FusionVariances::measure([(truth.view(), truth.view())]), None, "no errors");
}

#[test]
fn errors_are_estimated_without_the_truth() {
    // Larger rates, since what lies below the differences of orientations is hardly seen; and none where it
    // starts.
    let angular_velocity_rad2_s2 = AxisVariances { horizontal: 0.8, vertical: 2.5 };
    let variances = FusionVariances { angular_velocity_rad2_s2, ..VARIANCES };
    let motions: Vec<_> =
        (0..6).map(|seed| frames(&noisy(&truth(400), &variances, 100 + seed))).collect();
    let found =
        FusionVariances::of_decoded(motions.iter().map(|m| m.view())).expect("contradictions");
    // Positions and velocities share one contradiction, so that less is known than of numbers alone.
    assert_near(&found, &variances, 1.25);

    let mut holed = motions.clone();
    holed[2].slice_mut(s![100, ..]).fill(f32::NAN);
    let with_hole =
        FusionVariances::of_decoded(holed.iter().map(|m| m.view())).expect("contradictions");
    assert_near(&with_hole, &found, 1.03);
    assert_eq!(FusionVariances::of_decoded([]), None);
    assert_eq!(FusionVariances::of_decoded([motions[0].slice(s![..1, ..])]), None);
}

/// A decoder that wanders off slowly, with velocities that wander along, contradicts itself nowhere: to the
/// truth it is 20 cm off, and fused by that it would be fused worse.
#[test]
fn errors_that_agree_with_each_other_are_none() {
    let n = 900;
    let mut wandering = truth(n);
    for (t, p) in wandering.position_m.iter_mut().enumerate() {
        let t = t as f64;
        *p = [
            p[0] + 0.3 * (0.011 * t).sin(),
            p[1] + 0.2 * (0.017 * t).cos(),
            p[2] + 0.3 * (0.013 * t).cos(),
        ];
    }
    let decoded = noisy(&wandering, &VARIANCES, 7);
    let motion = frames(&decoded);
    let of_truth = FusionVariances::measure([(motion.view(), frames_of(&truth(n), n).view())])
        .expect("errors");
    let of_itself = FusionVariances::of_decoded([motion.view()]).expect("contradictions");
    assert!(of_truth.position_m2.horizontal > 50.0 * VARIANCES.position_m2.horizontal);
    assert_near(&of_itself, &VARIANCES, 1.6);
    for axis in 0..3 {
        let error = |variances: &FusionVariances| {
            mean_square(&fused(&decoded, variances, &NONE), &wandering.position_m, axis)
        };
        assert!(error(&of_itself) < 1.2 * error(&VARIANCES));
        assert!(error(&of_itself) < 0.8 * error(&of_truth), "{axis}");
    }
}

#[test]
fn variances_are_written_by_name_and_must_be_above_nothing() {
    let text = serde_json::to_string(&VARIANCES).expect("numbers");
    assert!(
        text.starts_with(r#"{"position_m2":{"horizontal":0.0004,"vertical":0.0001},"#),
        "{text}"
    );
    assert_eq!(
        serde_json::from_str::<FusionVariances>(&text).expect("what was written"),
        VARIANCES
    );
    assert_eq!(VARIANCES.unsound(), None);
    let mut zero = FusionVariances::default();
    zero.velocity_m2_s2.vertical = 0.0;
    assert_eq!(zero.unsound(), Some(("velocity_m2_s2", 0.0)));
    zero.position_m2.horizontal = f64::INFINITY;
    assert_eq!(zero.unsound(), Some(("position_m2", f64::INFINITY)));
}
