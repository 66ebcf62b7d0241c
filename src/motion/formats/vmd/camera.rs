//! The camera: an eye at a distance from what it looks at, one rigid body.

use std::f64::consts::PI;

use super::curve::{Curve, Keyed, Keys};
use super::{CAMERA_KEY_BYTES, RATE_HZ, UNIT_M, VmdError, f32_at, n_frames, position_m, u32_at};
use crate::motion::capture::{Axis, RigidTrack};
use crate::motion::quaternion::{Quaternion, from_axis_angle, mul, rotate};

const X: [f64; 3] = [1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];
const Z: [f64; 3] = [0.0, 0.0, 1.0];
/// Numbers of a key: distance, target x, y, z, angles about x, y, z.
const N_NUMBERS: usize = 7;
/// Where the curves begin: four bytes each (both times, both progresses) for x, y, z, turn and distance.
const CURVES_AT: usize = 4 + 4 * N_NUMBERS;
/// Curve of each number, by its place among the curves.
const CURVE_OF: [usize; N_NUMBERS] = [4, 0, 1, 2, 3, 3, 3];

#[derive(Clone, Debug)]
struct CameraKey {
    frame: u32,
    numbers: [f64; N_NUMBERS],
    curves: [Curve; 5],
}

impl Keyed for CameraKey {
    fn frame(&self) -> u32 {
        self.frame
    }
}

impl CameraKey {
    fn read(key: &[u8; CAMERA_KEY_BYTES]) -> Result<Self, VmdError> {
        let frame = u32_at(key, 0);
        let numbers: [f64; N_NUMBERS] = std::array::from_fn(|i| f32_at(key, 4 + 4 * i));
        if numbers.iter().any(|x| !x.is_finite()) {
            return Err(VmdError::NotFinite { what: "camera", frame });
        }
        let byte = |curve: usize, i: usize| key[CURVES_AT + 4 * curve + i];
        let curve = |i| Curve::new([byte(i, 0), byte(i, 2)], [byte(i, 1), byte(i, 3)]);
        Ok(Self { frame, numbers, curves: std::array::from_fn(curve) })
    }
}

/// Reads the track of the camera: its eye, looking along the body's +Z.
///
/// `R = R_y(β) R_z(-γ) R_x(α)`, eye `= target - R ẑ d`, with the angles as they are and the target reflected in
/// z; the distance `d` is negative in front of the target.
pub fn track(keys: &[[u8; CAMERA_KEY_BYTES]]) -> Result<RigidTrack, VmdError> {
    let keys: Result<Vec<_>, _> = keys.iter().map(CameraKey::read).collect();
    let keys = Keys::sorted(keys?);
    let last = keys.last_frame().unwrap_or(0);
    let n_frames = n_frames(last)?;
    let mut position = Vec::with_capacity(n_frames);
    let mut orientation = Vec::with_capacity(n_frames);
    for [distance, x, y, z, alpha, beta, gamma] in (0..=last).filter_map(|t| numbers_at(&keys, t)) {
        let turn: Quaternion = mul(
            mul(from_axis_angle(Y, beta), from_axis_angle(Z, -gamma)),
            from_axis_angle(X, alpha),
        );
        let (target, back) = (position_m([x, y, z]), rotate(turn, Z));
        position.push(std::array::from_fn(|c| target[c] - back[c] * distance * UNIT_M));
        // A camera looks along its own -z.
        orientation.push(mul(turn, from_axis_angle(Y, PI)));
    }
    Ok(RigidTrack {
        format: "vmd_camera",
        root: "camera".to_owned(),
        rate_hz: RATE_HZ,
        up: Some(Axis::Y),
        unit_m: UNIT_M,
        position_m: position,
        orientation,
        points_m: Vec::new(),
        height_m: None,
        is_keyframed: true,
        notes: vec!["the track is the camera's".to_owned()],
    })
}

fn numbers_at(keys: &Keys<CameraKey>, frame: u32) -> Option<[f64; N_NUMBERS]> {
    let (a, after) = keys.around(frame)?;
    let Some((b, time)) = after else { return Some(a.numbers) };
    let share: [f64; 5] = std::array::from_fn(|i| b.curves[i].at(time));
    Some(std::array::from_fn(|i| a.numbers[i] + share[CURVE_OF[i]] * (b.numbers[i] - a.numbers[i])))
}
