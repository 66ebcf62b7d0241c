use super::*;
use crate::motion::postprocess::fusion::Displacement;
use crate::motion::postprocess::noise::{
    NONE, Noise, VARIANCES, exact, farthest, fused, mean_square, noisy, truth,
};
use crate::motion::quaternion::from_axis_angle;

/// About one axis rotations add like numbers, so that the definition for positions, without accelerations,
/// says what angles there must be: through many turns, and whatever the signs.
#[test]
fn turns_about_one_axis_are_fused_as_numbers_are() {
    let n = 80;
    let mut noise = Noise::new(41);
    let angles: Vec<f64> = (0..n).map(|t| 0.7 * t as f64 + 0.3 * noise.normal()).collect();
    let rates: Vec<f64> = (0..n).map(|_| FPS * (0.7 + 0.1 * noise.normal())).collect();
    let variances = FusionVariances {
        acceleration_m2_s4: AxisVariances::even(1e300),
        position_m2: VARIANCES.orientation_rad2,
        velocity_m2_s2: VARIANCES.angular_velocity_rad2_s2,
        ..VARIANCES
    };
    for axis in 0..3 {
        let along = |x: f64| std::array::from_fn(|i| if i == axis { x } else { 0.0 });
        let sign = |t: usize| if t % 5 < 2 { -1.0 } else { 1.0 };
        let measured = FusionMeasurements {
            position: angles.iter().map(|x| along(*x)).collect(),
            velocity: rates.iter().map(|x| along(*x)).collect(),
            acceleration: vec![[0.0; 3]; n],
            orientation: (0..n)
                .map(|t| from_rotation_vector(along(angles[t])).map(|c| sign(t) * c))
                .collect(),
            angular_velocity: rates.iter().map(|x| along(*x)).collect(),
        };
        let wanted = fused(&measured, &variances, &NONE);
        let q = measured.orientations(&variances, &NONE);
        for t in 0..n {
            let angle = Displacement::angle(&from_rotation_vector(wanted[t]), &q[t]);
            assert!(angle < 1e-9, "{axis}, {t}: {angle}");
            assert!(dot(q[t], measured.orientation[t]) > 0.0, "signs stay");
        }
        assert!(wanted[n - 1][axis] > 8.0 * std::f64::consts::TAU);
    }
}

/// No orientation nearby has a smaller sum.
#[test]
fn orientations_are_where_the_sum_is_smallest() {
    let measured = noisy(&truth(25), &VARIANCES, 51);
    let turning = Turning::new(&measured, &NONE);
    let q = measured.orientations(&VARIANCES, &NONE);
    let least = turning.sum(&q, &VARIANCES);
    assert!(least < 0.8 * turning.sum(&turning.q_hat, &VARIANCES));
    assert!(farthest(&q, &turning.q_hat) > 0.02);
    for t in 0..25 {
        for axis in 0..3 {
            let at = |x: f64| {
                let mut nearby = q.clone();
                let v: [f64; 3] = std::array::from_fn(|i| if i == axis { x } else { 0.0 });
                nearby[t] = mul(from_rotation_vector(v), q[t]);
                turning.sum(&nearby, &VARIANCES)
            };
            assert!(at(1e-3) > least && at(-1e-3) > least);
            // No slope, of a sum with a curvature of up to 1e5.
            let slope = (at(1e-5) - at(-1e-5)) / 2e-5;
            assert!(slope.abs() < 1e-3, "{t}, {axis}: {slope}");
        }
    }
}

#[test]
fn a_known_turn_comes_out_of_noise_better_than_it_went_in() {
    let poses = truth(600);
    let measured = noisy(&poses, &VARIANCES, 61);
    let q = measured.orientations(&VARIANCES, &NONE);
    let errors = |q: &[Quaternion]| -> Vec<[f64; 3]> {
        let pairs = poses.orientation.iter().zip(q);
        pairs.map(|(a, b)| angular_velocity(*a, *b, 1.0)).collect()
    };
    let zero = vec![[0.0; 3]; 600];
    for axis in 0..3 {
        let w = VARIANCES.orientation_rad2.of_axis(axis)
            / VARIANCES.angular_velocity_rad2_s2.of_axis(axis);
        let wanted = VARIANCES.orientation_rad2.of_axis(axis) / (1.0 + 4.0 * w * 900.0).sqrt();
        let ratio = mean_square(&errors(&q), &zero, axis) / wanted;
        // Of 600 / 10 independent errors: 18 %, twice; and what is not linear.
        assert!((0.6..1.4).contains(&ratio), "{axis}: {ratio}");
    }
    for q in q {
        assert!((dot(q, q) - 1.0).abs() < 1e-14);
    }
}

#[test]
fn an_orientation_that_is_upside_down_spoils_no_other() {
    let poses = truth(61);
    let truth = &poses.orientation;
    for angle in [1.0, 2.0, 2.9, 3.1, 3.3] {
        for axis in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.6, -0.8]] {
            let mut measured = exact(&poses);
            measured.orientation[30] = mul(from_axis_angle(axis, angle), truth[30]);
            let turning = Turning::new(&measured, &NONE);
            let q = measured.orientations(&VARIANCES, &NONE);
            // It costs no more than to give it up.
            assert!(turning.sum(&q, &VARIANCES) <= turning.sum(truth, &VARIANCES), "{angle}");
            // Its share is 1 / sqrt(1 + 4 w FPS²), a twelfth of its angle about horizontal axes and a
            // thirty-fifth about the vertical, and decays over FPS sqrt w frames, 6 and 17; it turns with
            // the body, so that the two mix.
            let at = |t: usize| Displacement::angle(&truth[t], &q[t]);
            assert!(at(30) < 0.1 * angle, "{angle} about {axis:?}: {}", at(30));
            assert!((0..61).all(|t| at(t) <= at(30) + 1e-12));
            assert!(at(0) < 0.05 && at(60) < 0.05, "{angle} about {axis:?}: {}", at(0));
        }
    }
}

#[test]
fn the_jacobian_is_that_of_differences() {
    for phi in [[0.0; 3], [1e-5, -2e-5, 3e-5], [0.4, -0.3, 0.2], [1.5, 1.9, -1.8]] {
        let j = inverse_jacobian(phi);
        for axis in [0, 1, 2] {
            let log = |x: f64| {
                let d: [f64; 3] = std::array::from_fn(|i| if i == axis { x } else { 0.0 });
                let turned = mul(from_rotation_vector(d), from_rotation_vector(phi));
                angular_velocity([1.0, 0.0, 0.0, 0.0], turned, 1.0)
            };
            let (a, b) = (log(1e-5), log(-1e-5));
            for (i, row) in j.iter().enumerate() {
                let slope = (a[i] - b[i]) / 2e-5;
                assert!((slope - row[axis]).abs() < 1e-8, "{phi:?}: {slope} {}", row[axis]);
            }
        }
    }
}
