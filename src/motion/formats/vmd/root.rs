//! The bones that carry a model: 全ての親 (root of all), センター (centre) on it, グルーブ (groove) on that.

use super::curve::{Curve, Keyed, Keys};
use super::{BONE_KEY_BYTES, RATE_HZ, UNIT_M, VmdError, f32_at, n_frames, position_m, u32_at};
use crate::motion::capture::{Axis, RigidTrack};
use crate::motion::quaternion::{IDENTITY, Quaternion, dot, mul, normalize, rotate, slerp};

/// Length of a bone's name, padded with NUL.
const NAME_BYTES: usize = 15;
/// Height at which models usually have the centre at rest, units; the model, not the motion, knows it.
const CENTRE_HEIGHT: f64 = 8.0;
/// Quaternions shorter than this are taken for no turn.
const MIN_NORM: f64 = 1e-6;

/// Bones from the ground up, each with its name in Shift-JIS and its place at rest on the one before, units.
const BONES: [(&[u8], [f64; 3]); 3] = [
    (&[0x91, 0x53, 0x82, 0xc4, 0x82, 0xcc, 0x90, 0x65], [0.0; 3]),
    (&[0x83, 0x5a, 0x83, 0x93, 0x83, 0x5e, 0x81, 0x5b], [0.0, CENTRE_HEIGHT, 0.0]),
    (&[0x83, 0x4f, 0x83, 0x8b, 0x81, 0x5b, 0x83, 0x75], [0.0; 3]),
];

/// A bone's pose relative to its rest.
#[derive(Clone, Debug)]
struct BoneKey {
    frame: u32,
    position: [f64; 3],
    orientation: Quaternion,
    /// Of x, y, z and the turn.
    curves: [Curve; 4],
}

impl Keyed for BoneKey {
    fn frame(&self) -> u32 {
        self.frame
    }
}

impl BoneKey {
    fn read(key: &[u8; BONE_KEY_BYTES]) -> Result<Self, VmdError> {
        let frame = u32_at(key, NAME_BYTES);
        let number = |i: usize| f32_at(key, NAME_BYTES + 4 + 4 * i);
        if (0..7).any(|i| !number(i).is_finite()) {
            return Err(VmdError::NotFinite { what: "bone", frame });
        }
        let q = [number(6), number(3), number(4), number(5)];
        // The first row of the 64 bytes has two overwritten by a flag of physics; the others repeat it,
        // each moved on by a byte, so that every row begins with an axis of its own.
        let byte = |axis: usize, i: usize| key[NAME_BYTES + 32 + 16 * axis + 4 * i];
        let curve =
            |axis| Curve::new([byte(axis, 0), byte(axis, 1)], [byte(axis, 2), byte(axis, 3)]);
        Ok(Self {
            frame,
            position: std::array::from_fn(number),
            orientation: if dot(q, q).sqrt() < MIN_NORM { IDENTITY } else { normalize(q) },
            curves: std::array::from_fn(curve),
        })
    }
}

/// Reads the track of the root bones; none where no key is one's.
pub fn track(keys: &[[u8; BONE_KEY_BYTES]]) -> Result<Option<RigidTrack>, VmdError> {
    let mut bones = Vec::with_capacity(BONES.len());
    for (name, rest) in BONES {
        let is_named = |key: &&[u8; BONE_KEY_BYTES]| {
            key.starts_with(name) && (name.len() == NAME_BYTES || key[name.len()] == 0)
        };
        let bone_keys: Result<Vec<_>, _> =
            keys.iter().filter(is_named).map(BoneKey::read).collect();
        bones.push((rest, Keys::sorted(bone_keys?)));
    }
    if bones.iter().all(|(_, keys)| keys.is_empty()) {
        return Ok(None);
    }
    // Limbs may dance on when the root stands.
    let last = keys.iter().map(|key| u32_at(key, NAME_BYTES)).max().unwrap_or(0);
    let n_frames = n_frames(last)?;
    let mut position = Vec::with_capacity(n_frames);
    let mut orientation = Vec::with_capacity(n_frames);
    for frame in 0..=last {
        let (mut p, mut q) = ([0.0; 3], IDENTITY);
        for (rest, keys) in &bones {
            let (moved, turned) = pose_at(keys, frame);
            let local = rotate(q, std::array::from_fn(|c| rest[c] + moved[c]));
            p = std::array::from_fn(|c| p[c] + local[c]);
            q = mul(q, turned);
        }
        position.push(position_m(p));
        // Reflection in z keeps the turn about z and reverses those about x and y.
        orientation.push([q[0], -q[1], -q[2], q[3]]);
    }
    Ok(Some(RigidTrack {
        format: "vmd",
        root: "センター".to_owned(),
        rate_hz: RATE_HZ,
        up: Some(Axis::Y),
        unit_m: UNIT_M,
        position_m: position,
        orientation,
        points_m: Vec::new(),
        height_m: None,
        is_keyframed: true,
        notes: vec![format!(
            "the centre is taken to rest at {:.2} m, as most models have it; the motion does not say it",
            CENTRE_HEIGHT * UNIT_M
        )],
    }))
}

fn pose_at(keys: &Keys<BoneKey>, frame: u32) -> ([f64; 3], Quaternion) {
    match keys.around(frame) {
        None => ([0.0; 3], IDENTITY),
        Some((key, None)) => (key.position, key.orientation),
        Some((a, Some((b, time)))) => {
            let share = |i: usize| b.curves[i].at(time);
            let p = |c: usize| a.position[c] + share(c) * (b.position[c] - a.position[c]);
            (std::array::from_fn(p), slerp(a.orientation, b.orientation, share(3)))
        }
    }
}
