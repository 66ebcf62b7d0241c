//! Quaternion algebra, Hamilton `(w, x, y, z)`, in double precision.
//!
//! Source for the products and the exponential map: Solà, Quaternion kinematics for the
//! error-state Kalman filter, arXiv:1711.02508, sections 1 and 2.

use super::vector::cross;

/// A quaternion `w + xi + yj + zk`.
pub type Quaternion = [f64; 4];

/// The rotation by nothing.
pub const IDENTITY: Quaternion = [1.0, 0.0, 0.0, 0.0];

/// Norms below this are not divided by, so that a zero quaternion stays finite.
const MIN_NORM: f64 = 1e-12;

/// Half-angle sines below this take the small-angle limit `θ / sin(θ/2) -> 2`.
const SMALL_SINE: f64 = 1e-9;

/// Hamilton product `a ⊗ b`: the rotation `b` followed by the rotation `a`.
pub fn mul(a: Quaternion, b: Quaternion) -> Quaternion {
    let [w1, x1, y1, z1] = a;
    let [w2, x2, y2, z2] = b;
    [
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
    ]
}

/// Conjugate `q*`, the inverse of a unit quaternion.
pub fn conj(q: Quaternion) -> Quaternion {
    [q[0], -q[1], -q[2], -q[3]]
}

/// Inner product of two quaternions as vectors of four numbers.
pub fn dot(a: Quaternion, b: Quaternion) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
}

/// `q / max(|q|, 1e-12)`; a zero quaternion stays zero.
pub fn normalize(q: Quaternion) -> Quaternion {
    let norm = dot(q, q).sqrt().max(MIN_NORM);
    q.map(|c| c / norm)
}

/// The vector `v` rotated by the unit quaternion `q`: `v + 2 u × (u × v + w v)`, `q = (w, u)`.
pub fn rotate(q: Quaternion, v: [f64; 3]) -> [f64; 3] {
    let (w, u) = (q[0], [q[1], q[2], q[3]]);
    let inner = cross(u, v);
    let outer = cross(u, [inner[0] + w * v[0], inner[1] + w * v[1], inner[2] + w * v[2]]);
    [v[0] + 2.0 * outer[0], v[1] + 2.0 * outer[1], v[2] + 2.0 * outer[2]]
}

/// Rotation by `angle_rad` about a unit `axis`: `(cos θ/2, axis sin θ/2)`.
pub fn from_axis_angle(axis: [f64; 3], angle_rad: f64) -> Quaternion {
    let (sine, cosine) = (angle_rad / 2.0).sin_cos();
    [cosine, axis[0] * sine, axis[1] * sine, axis[2] * sine]
}

/// Rotation by a vector, its axis times its angle: `exp(v / 2)`, the inverse of
/// [`angular_velocity`]`(`[`IDENTITY`]`, q, 1)` up to half a turn.
pub fn from_rotation_vector(v: [f64; 3]) -> Quaternion {
    let angle = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let factor = if angle < 1e-12 { 0.5 } else { (angle / 2.0).sin() / angle };
    [(angle / 2.0).cos(), v[0] * factor, v[1] * factor, v[2] * factor]
}

/// Flips signs so that `q[t] · q[t+1] >= 0` and the first `w >= 0`; the rotations stay the same.
pub fn make_sign_continuous(q: &mut [Quaternion]) {
    for t in 1..q.len() {
        if dot(q[t], q[t - 1]) < 0.0 {
            q[t] = q[t].map(|c| -c);
        }
    }
    if q.first().is_some_and(|first| first[0] < 0.0) {
        for c in q.as_flattened_mut() {
            *c = -*c;
        }
    }
}

/// World-frame angular velocity, rad/s, that turns `from` into `to` in `1 / rate_hz` seconds.
///
/// `ω = 2 log(to ⊗ from*) rate`, the logarithm along the shorter arc; both must be unit.
pub fn angular_velocity(from: Quaternion, to: Quaternion, rate_hz: f64) -> [f64; 3] {
    let d = mul(to, conj(from));
    let d = if d[0] < 0.0 { d.map(|c| -c) } else { d };
    let sine = (d[1] * d[1] + d[2] * d[2] + d[3] * d[3]).sqrt();
    let angle_per_sine = if sine > SMALL_SINE { 2.0 * sine.atan2(d[0]) / sine } else { 2.0 };
    [d[1], d[2], d[3]].map(|c| c * angle_per_sine * rate_hz)
}

/// Spherical linear interpolation along the shorter arc, `sin((1-s)θ) q_a + sin(sθ) q_b` over `sin θ`.
///
/// Source: Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
pub fn slerp(a: Quaternion, b: Quaternion, s: f64) -> Quaternion {
    slerp_as_signed(a, nearer(a, b), s)
}

/// Spherical linear interpolation along the arc that the signs of `a` and `b` say, which may be the longer one.
///
/// Between two orientations that turn, each with continuous signs, the arc stays on one side though they pass half a
/// turn of each other; the shorter arc would change sides there. Where `b` is nearly `-a` no arc is told, and the
/// shorter one is taken.
pub fn slerp_as_signed(a: Quaternion, b: Quaternion, s: f64) -> Quaternion {
    let cosine = dot(a, b);
    let b = if cosine < -1.0 + 1e-6 { b.map(|c| -c) } else { b };
    let angle = dot(a, b).clamp(-1.0, 1.0).acos();
    // Nearly equal orientations: the limit of both weights.
    let (wa, wb) = if angle < 1e-6 {
        (1.0 - s, s)
    } else {
        (((1.0 - s) * angle).sin() / angle.sin(), (s * angle).sin() / angle.sin())
    };
    normalize(std::array::from_fn(|c| wa * a[c] + wb * b[c]))
}

/// Returns the one of `q` and `-q` that is nearer to `like`.
pub fn nearer(like: Quaternion, q: Quaternion) -> Quaternion {
    if dot(like, q) < 0.0 { q.map(|c| -c) } else { q }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn unit_quaternion() -> impl Strategy<Value = Quaternion> {
        prop::array::uniform4(-1.0..1.0f64)
            .prop_filter("away from zero", |q| dot(*q, *q) > 1e-3)
            .prop_map(normalize)
    }

    #[test]
    fn an_arc_between_turning_orientations_keeps_its_side() {
        // b turns from 90° to 270° while a stands: the middle goes on from 45° to 135°, and does not fall to -45°.
        let about_y = |degrees: f64| from_axis_angle([0.0, 1.0, 0.0], degrees.to_radians());
        let a = about_y(0.0);
        let mut b = about_y(90.0);
        for k in 0..=30 {
            let degrees = 90.0 + 6.0 * f64::from(k);
            b = nearer(b, about_y(degrees));
            assert_close(&slerp_as_signed(a, b, 0.5), &about_y(degrees / 2.0), 1e-12);
        }
        assert_close(&slerp(a, about_y(270.0), 0.5), &about_y(-45.0), 1e-12);
        assert_close(&slerp_as_signed(a, a.map(|c| -c), 0.3), &a, 1e-12);
    }

    fn assert_close(a: &[f64], b: &[f64], tolerance: f64) {
        for (x, y) in a.iter().zip(b) {
            assert!((x - y).abs() <= tolerance, "{a:?} against {b:?}");
        }
    }

    #[test]
    fn the_units_multiply_as_hamilton_carved_them() {
        let [i, j, k] = [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
        assert_eq!(mul(i, j), k);
        assert_eq!(mul(j, k), i);
        assert_eq!(mul(k, i), j);
        assert_eq!(mul(mul(i, j), k), [-1.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_quarter_turn_about_up_takes_forward_to_right() {
        let q = from_axis_angle([0.0, 1.0, 0.0], FRAC_PI_2);
        // Rounding of one sine and one product.
        assert_close(&rotate(q, [0.0, 0.0, 1.0]), &[1.0, 0.0, 0.0], 1e-15);
    }

    #[test]
    fn signs_follow_the_path_and_start_positive() {
        let path: Vec<_> =
            (0..9).map(|t| from_axis_angle([0.0, 1.0, 0.0], f64::from(t) * 0.4 * PI)).collect();
        let mut q = path.clone();
        for (t, flip) in
            [true, false, true, true, false, true, false, false, true].iter().enumerate()
        {
            if *flip {
                q[t] = q[t].map(|c| -c);
            }
        }
        make_sign_continuous(&mut q);
        assert_eq!(q, path);
    }

    #[test]
    fn angular_velocity_of_no_turn_and_of_a_tiny_turn() {
        assert_eq!(angular_velocity(IDENTITY, IDENTITY, 30.0), [0.0; 3]);
        let tiny = from_axis_angle([0.0, 0.0, 1.0], 1e-10);
        assert_close(&angular_velocity(IDENTITY, tiny, 30.0), &[0.0, 0.0, 3e-9], 1e-22);
    }

    #[test]
    fn a_rotation_vector_is_an_axis_times_an_angle() {
        let q = from_rotation_vector([0.6 * 2.5, 0.0, 0.8 * 2.5]);
        assert_close(&q, &from_axis_angle([0.6, 0.0, 0.8], 2.5), 1e-15);
        assert_eq!(from_rotation_vector([0.0; 3]), IDENTITY);
        assert_close(&from_rotation_vector([2e-13, 0.0, 0.0]), &[1.0, 1e-13, 0.0, 0.0], 1e-25);
    }

    #[test]
    fn slerp_turns_evenly_along_the_shorter_arc() {
        let (a, b) = (
            from_axis_angle([0.0, 1.0, 0.0], 0.2),
            from_axis_angle([0.0, 1.0, 0.0], 1.4).map(|c| -c),
        );
        for i in 0..=6 {
            let s = f64::from(i) / 6.0;
            let q = slerp(a, b, s);
            let turned = angular_velocity(a, q, 1.0)[1];
            assert!((turned - 1.2 * s).abs() < 1e-12, "{s}: {turned}");
        }
        assert_eq!(slerp(a, a, 0.3), a);
    }

    #[test]
    fn a_zero_quaternion_stays_finite() {
        assert_eq!(normalize([0.0; 4]), [0.0; 4]);
    }

    proptest! {
        #[test]
        fn rotation_is_the_sandwich_product(q in unit_quaternion(),
                                            v in prop::array::uniform3(-5.0..5.0f64)) {
            let sandwich = mul(mul(q, [0.0, v[0], v[1], v[2]]), conj(q));
            // A few dozen roundings of numbers up to 10.
            assert_close(&rotate(q, v), &sandwich[1..], 1e-13);
        }

        #[test]
        fn products_compose_rotations(a in unit_quaternion(), b in unit_quaternion(),
                                      v in prop::array::uniform3(-5.0..5.0f64)) {
            assert_close(&rotate(mul(a, b), v), &rotate(a, rotate(b, v)), 1e-13);
        }

        #[test]
        fn angular_velocity_inverts_the_axis_angle_map(q in unit_quaternion(),
                                                       w in prop::array::uniform3(-40.0..40.0f64)) {
            let rate = (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]).sqrt();
            prop_assume!(rate > 1e-3 && rate < 0.99 * 30.0 * PI);
            let to = mul(from_axis_angle(w.map(|c| c / rate), rate / 30.0), q);
            // The quotient loses up to 1/sin(θ/2) of the rounding near a half turn and near none.
            assert_close(&angular_velocity(q, to, 30.0), &w, 1e-10);
        }
    }
}
