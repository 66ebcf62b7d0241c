//! Motion as a BVH take of one joint, the root.
//!
//! BVH has no place for a unit or a comment, so this is where they are told: positions are
//! centimetres, the usual unit of the format, angles are degrees, and the axes are those of the
//! motion, +Y up and +Z forward. The End Site lies a person's height above the root, since others know a
//! length unit by the height of a body; [`crate::motion::convert_bvh`] knows such a take by its skeleton.

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::io::{self, Write};

use ndarray::ArrayView2;

use super::poses;
use crate::motion::quaternion::{Quaternion, rotate};
use crate::units::FPS;

const CM_PER_M: f64 = 100.0;
/// Height of the End Site over the root, cm.
pub const END_SITE_CM: f64 = 170.0;
/// Name of the only joint.
pub const ROOT_NAME: &str = "body";
/// Cosines of the middle angle below this leave of the outer two only their sum or difference: both
/// what is left out then and what rounding does above are of this size.
const GIMBAL_COSINE: f64 = 1e-8;

/// Writes position and orientation of motion, `[T, 25]`, `T >= 1`, in centimetres and degrees to six
/// places. A frame lasts `1 / FPS` s to all digits: at 0.0333333 s an hour would be 3.6 ms short.
///
/// # Errors
/// The error of `out`, and [`super::PoseError`] for what BVH cannot hold.
///
/// # Panics
/// When there are other than 25 channels.
pub fn write_bvh(frames: ArrayView2<'_, f32>, out: &mut dyn Write) -> io::Result<()> {
    let poses = poses(frames, "BVH")?;
    write!(
        out,
        "HIERARCHY\n\
         ROOT {ROOT_NAME}\n\
         {{\n\
         \tOFFSET 0.0 0.0 0.0\n\
         \tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n\
         \tEnd Site\n\
         \t{{\n\
         \t\tOFFSET 0.0 {END_SITE_CM:?} 0.0\n\
         \t}}\n\
         }}\n\
         MOTION\n\
         Frames: {}\n\
         Frame Time: {}\n",
        poses.len(),
        1.0 / FPS
    )?;
    let mut angles_rad = [0.0; 3];
    for (p, &q) in poses.position_m.iter().zip(&poses.orientation) {
        let [x, y, z] = p.map(|c| c * CM_PER_M);
        angles_rad = euler_zxy(q, angles_rad);
        let [rz, rx, ry] = angles_rad.map(f64::to_degrees);
        writeln!(out, "{x:.6} {y:.6} {z:.6} {rz:.6} {rx:.6} {ry:.6}")?;
    }
    Ok(())
}

/// Returns angles (γ, β, α), rad, about Z, X and Y with `R(q) = Rz(γ) Rx(β) Ry(α)`, nearest to those of
/// the frame before, so that what is interpolated between frames takes the short way.
///
/// With R = (r_ij): `sin β = r₂₁`, `γ = atan2(-r₀₁, r₁₁)`, `α = atan2(-r₂₀, r₂₂)`. Where cos β = 0 only
/// `γ ± α` is defined, `atan2(r₁₀, r₀₀)`, and α stays as it was.
pub fn euler_zxy(q: Quaternion, before: [f64; 3]) -> [f64; 3] {
    // The columns of R.
    let x = rotate(q, [1.0, 0.0, 0.0]);
    let y = rotate(q, [0.0, 1.0, 0.0]);
    let z = rotate(q, [0.0, 0.0, 1.0]);
    let cosine = x[2].hypot(z[2]);
    if cosine < GIMBAL_COSINE {
        let up_or_down = y[2].signum();
        let gamma = x[1].atan2(x[0]) - up_or_down * before[2];
        return nearest([gamma, up_or_down * FRAC_PI_2, before[2]], before);
    }
    let one = [(-y[0]).atan2(y[1]), y[2].atan2(cosine), (-x[2]).atan2(z[2])];
    // The same rotation with cos β below 0.
    let other = [one[0] + PI, PI - one[1], one[2] + PI];
    let (one, other) = (nearest(one, before), nearest(other, before));
    let way = |angles: &[f64; 3]| -> f64 {
        angles.iter().zip(before).map(|(angle, before)| (angle - before).abs()).sum()
    };
    if way(&other) < way(&one) { other } else { one }
}

/// Returns the angles, each by whole turns nearest to the one before.
fn nearest(angles: [f64; 3], before: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| angles[i] - TAU * ((angles[i] - before[i]) / TAU).round())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::bvh::{Bvh, JointChannel};
    use crate::motion::channels::{Channel, MOTION_DIM};
    use crate::motion::convert_bvh;
    use crate::motion::quaternion::{IDENTITY, angular_velocity, from_axis_angle, mul, normalize};
    use ndarray::Array2;
    use proptest::prelude::*;

    const AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    fn frames(poses: &[([f64; 3], Quaternion)]) -> Array2<f32> {
        let mut frames = Array2::zeros((poses.len(), MOTION_DIM));
        for (mut row, (p, q)) in frames.rows_mut().into_iter().zip(poses) {
            for (i, &x) in Channel::Position.range().zip(p) {
                row[i] = x as f32;
            }
            for (i, &x) in Channel::Quaternion.range().zip(q) {
                row[i] = x as f32;
            }
        }
        frames
    }

    fn written(frames: &Array2<f32>) -> String {
        let mut bytes = Vec::new();
        write_bvh(frames.view(), &mut bytes).expect("memory");
        String::from_utf8(bytes).expect("text")
    }

    /// Reads a take of one joint back: metres, and rotations in the order of the channels.
    fn read(text: &str) -> Vec<([f64; 3], Quaternion)> {
        let bvh = Bvh::parse(text.as_bytes()).expect("our own take");
        assert_eq!(bvh.frame_time_s(), 1.0 / FPS);
        let joint = &bvh.joints()[0];
        let pose = |values: ndarray::ArrayView1<'_, f64>| {
            let (mut p, mut q) = ([0.0; 3], IDENTITY);
            for (channel, &value) in joint.channels.iter().zip(values) {
                match *channel {
                    JointChannel::Position(axis) => p[axis] = value / 100.0,
                    JointChannel::Rotation(axis) => {
                        q = mul(q, from_axis_angle(AXES[axis], value.to_radians()));
                    }
                }
            }
            (p, q)
        };
        bvh.frames().rows().into_iter().map(pose).collect()
    }

    fn assert_read_back(poses: &[([f64; 3], Quaternion)]) {
        let frames = frames(poses);
        let found = read(&written(&frames));
        assert_eq!(found.len(), poses.len());
        for (t, ((p, q), row)) in found.into_iter().zip(frames.rows()).enumerate() {
            for axis in 0..3 {
                // Six places of a centimetre.
                assert!((p[axis] - f64::from(row[axis])).abs() < 1e-8, "{t}: {p:?}");
            }
            let wanted: Quaternion = std::array::from_fn(|c| f64::from(row[9 + c]));
            let off = angular_velocity(normalize(wanted), q, 1.0);
            // Six places of three angles in degrees.
            assert!(off.iter().all(|c| c.abs() < 1e-7), "{t}: off by {off:?}");
        }
    }

    #[test]
    fn the_text_is_as_documented() {
        let lying = from_axis_angle([0.0, 1.0, 0.0], FRAC_PI_2);
        let text = written(&frames(&[([0.0, 0.5, -0.25], IDENTITY), ([1.5, 0.75, 0.0], lying)]));
        let wanted = "HIERARCHY\nROOT body\n{\n\tOFFSET 0.0 0.0 0.0\n\tCHANNELS 6 Xposition \
            Yposition Zposition Zrotation Xrotation Yrotation\n\tEnd Site\n\t{\n\t\tOFFSET 0.0 \
            170.0 0.0\n\t}\n}\nMOTION\nFrames: 2\nFrame Time: 0.03333333333333333\n";
        let (head, motion) = text.split_at(wanted.len());
        assert_eq!(head, wanted);
        let values: Vec<f64> =
            motion.split_whitespace().map(|x| x.parse().expect("a number")).collect();
        let wanted = [0.0, 50.0, -25.0, 0.0, 0.0, 0.0, 150.0, 75.0, 0.0, 0.0, 0.0, 90.0];
        assert_eq!(values.len(), wanted.len());
        // Single precision of a quaternion of 90°.
        assert!(values.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-5), "{values:?}");
    }

    #[test]
    fn a_body_upside_down_or_flat_on_the_floor_is_read_back() {
        let mut poses = Vec::new();
        for pitch in [-1.0, 1.0] {
            for yaw in 0..7 {
                let turned = from_axis_angle([0.0, 1.0, 0.0], f64::from(yaw));
                let flat = from_axis_angle([1.0, 0.0, 0.0], pitch * FRAC_PI_2);
                let over = from_axis_angle([0.0, 0.0, 1.0], PI);
                poses.push(([1.0, 2.0, 3.0], mul(turned, flat)));
                poses.push(([1.0, 2.0, 3.0], mul(mul(turned, flat), turned)));
                poses.push(([1.0, 2.0, 3.0], mul(turned, over)));
            }
        }
        assert_read_back(&poses);
        // Flat in double precision: only γ ± α is defined, and α stays.
        for sign in [-1.0, 1.0] {
            let flat = from_axis_angle([1.0, 0.0, 0.0], sign * FRAC_PI_2);
            for before in [[0.0; 3], [0.3, sign * 1.5, -2.0]] {
                let [gamma, beta, alpha] = euler_zxy(flat, before);
                let turn = |axis: usize, angle: f64| from_axis_angle(AXES[axis], angle);
                let q = mul(mul(turn(2, gamma), turn(0, beta)), turn(1, alpha));
                let off = angular_velocity(flat, q, 1.0);
                assert!(off.iter().all(|c| c.abs() < 1e-8), "off by {off:?}");
                assert_eq!(alpha, before[2]);
            }
        }
    }

    #[test]
    fn angles_do_not_jump_while_a_body_spins() {
        let lean = from_axis_angle([1.0, 0.0, 0.0], 0.4);
        let poses: Vec<_> = (0..101)
            .map(|t| {
                let spin = from_axis_angle([0.0, 1.0, 0.0], 0.35 * f64::from(t));
                ([0.0; 3], mul(lean, spin))
            })
            .collect();
        let text = written(&frames(&poses));
        let rows = text.lines().skip_while(|line| !line.starts_with("Frame Time:")).skip(1);
        for (t, row) in rows.enumerate() {
            let values: Vec<f64> = row.split(' ').map(|x| x.parse().expect("a number")).collect();
            let wanted = [0.0, 0.4_f64.to_degrees(), (0.35 * t as f64).to_degrees()];
            for (found, wanted) in values[3..].iter().zip(wanted) {
                // Single precision of the quaternion.
                assert!((found - wanted).abs() < 1e-4, "{t}: {found} against {wanted}");
            }
        }
        assert_read_back(&poses);
    }

    #[test]
    fn our_conversion_of_captures_knows_the_unit() {
        let poses: Vec<_> = (0..91)
            .map(|t| {
                let s = f64::from(t) / FPS;
                let p = [(2.0 * s).sin(), 0.95 + 0.03 * (6.0 * s).sin(), 0.4 * s];
                (p, from_axis_angle([0.0, 1.0, 0.0], 0.3 * s))
            })
            .collect();
        let bvh = Bvh::parse(written(&frames(&poses)).as_bytes()).expect("our own take");
        let trajectory = convert_bvh(&bvh, None).expect("a capture");
        assert_eq!(trajectory.n_frames(), 89);
        let found = trajectory.view();
        for t in [20, 45, 70] {
            for axis in [0, 2] {
                let wanted = poses[t].0[axis] - poses[0].0[axis];
                // The start of the filter moves the origin by less than this.
                assert!((f64::from(found[[t, axis]]) - wanted).abs() < 0.01, "{t}");
            }
        }
    }

    proptest! {
        #[test]
        fn any_path_is_read_back(
            poses in prop::collection::vec(
                (prop::array::uniform3(-100.0..100.0f64), prop::array::uniform4(-1.0..1.0f64)),
                1..12
            )
        ) {
            let poses: Vec<_> = poses
                .into_iter()
                .filter(|(_, q)| q.iter().map(|c| c * c).sum::<f64>() > 1e-3)
                .map(|(p, q)| (p, normalize(q)))
                .collect();
            prop_assume!(!poses.is_empty());
            assert_read_back(&poses);
        }
    }
}
