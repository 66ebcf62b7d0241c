//! HumanML3D features in `.npy`: `[T, 263]` at 20 fps, of one skeleton of 22 joints.
//!
//! A row holds the root's turn about +Y to the next frame (half the angle: it is the angle of a quaternion's
//! exponent), its velocity in the plane in its own frame, its height, 21 joint positions in the root's frame,
//! 21 rotations of 6 numbers, 22 velocities and 4 contacts. Of the root's orientation the heading alone is
//! there. Source: Guo et al., Generating diverse and natural 3D human motions from text, CVPR 2022, and
//! `recover_root_rot_pos` of its published code.

#[cfg(test)]
mod tests;

use thiserror::Error;

use crate::motion::capture::{Axis, RigidTrack};
use crate::motion::npy::{self, NpyError};
use crate::motion::quantile::median;
use crate::motion::quaternion::{Quaternion, rotate};

/// Numbers of a frame.
pub const FEATURE_DIM: usize = 263;
/// Frames per second.
pub const RATE_HZ: f64 = 20.0;

const TURN: usize = 0;
const VELOCITY: [usize; 2] = [1, 2];
const HEIGHT: usize = 3;
const JOINTS: usize = 4;
/// Joints beside the root.
const N_JOINTS: usize = 21;
/// Joints from the head down to the root, and from it down to either ankle.
const HEAD_TO_ROOT: [usize; 6] = [15, 12, 9, 6, 3, 0];
const ROOT_TO_ANKLES: [[usize; 4]; 2] = [[0, 1, 4, 7], [0, 2, 5, 8]];
/// Heights along bones, from head joint to ankles, that a person has, m.
const PERSON_HEIGHT_M: std::ops::RangeInclusive<f64> = 0.8..=2.2;
/// Frames that are looked at for lengths.
const MAX_SAMPLED_FRAMES: usize = 256;

/// Why features were refused.
#[derive(Debug, Error)]
pub enum HumanMl3dError {
    #[error(transparent)]
    Npy(#[from] NpyError),
    /// Another number of features.
    #[error(
        "npy has shape {shape:?}, expected [frames, {FEATURE_DIM}] of HumanML3D or [frames, 25] of \
         trajectories; save one of them"
    )]
    Shape { shape: Vec<usize> },
    /// A NaN or an infinity, which would spread to all that follows.
    #[error(
        "npy has no finite number as feature {feature} of frame {frame}, both counted from 0; repair or cut \
         the motion there"
    )]
    NotFinite { frame: usize, feature: usize },
    /// The joints make no person.
    #[error(
        "npy has joints that make a body of {height_m:.3} m from ankles to head, expected {low} to {high} m; \
         where the features are standardised, multiply by Std.npy and add Mean.npy before saving"
    )]
    NoPerson { height_m: f64, low: f64, high: f64 },
}

impl HumanMl3dError {
    /// The error's class in reports.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Npy(error) => error.kind(),
            Self::Shape { .. } => "shape",
            Self::NotFinite { .. } => "non_finite",
            Self::NoPerson { .. } => "motion_format",
        }
    }
}

/// Reads the root's track and the joints beside it.
///
/// The heading before frame t is `θ[t] = Σ r[s]` over s < t, half the angle; the root's orientation is the
/// inverse of `exp(θ ĵ)`, its position in the plane `Σ q[s] v[s-1]` over s ≤ t.
///
/// # Errors
/// [`HumanMl3dError`].
pub fn read(bytes: &[u8]) -> Result<RigidTrack, HumanMl3dError> {
    let array = npy::read_f64(bytes)?;
    let [n_frames @ (1..), FEATURE_DIM] = array.shape[..] else {
        return Err(HumanMl3dError::Shape { shape: array.shape });
    };
    if let Some(at) = array.values.iter().position(|x| !x.is_finite()) {
        return Err(HumanMl3dError::NotFinite {
            frame: at / FEATURE_DIM,
            feature: at % FEATURE_DIM,
        });
    }
    let mut position_m = Vec::with_capacity(n_frames);
    let mut orientation: Vec<Quaternion> = Vec::with_capacity(n_frames);
    let mut points_m: Vec<_> = (0..N_JOINTS).map(|_| Vec::with_capacity(n_frames)).collect();
    let (mut half_turn, mut x, mut z) = (0.0f64, 0.0, 0.0);
    let mut before: Option<&[f64]> = None;
    for row in array.values.chunks_exact(FEATURE_DIM) {
        half_turn += before.map_or(0.0, |before| before[TURN]);
        let q = [half_turn.cos(), 0.0, -half_turn.sin(), 0.0];
        if let Some(before) = before {
            let step = rotate(q, [before[VELOCITY[0]], 0.0, before[VELOCITY[1]]]);
            x += step[0];
            z += step[2];
        }
        position_m.push([x, row[HEIGHT], z]);
        orientation.push(q);
        for (point, joint) in points_m.iter_mut().zip(row[JOINTS..].chunks_exact(3)) {
            let [dx, y, dz] = rotate(q, [joint[0], joint[1], joint[2]]);
            point.push([x + dx, y, z + dz]);
        }
        before = Some(row);
    }
    let height_m = height_of(&position_m, &points_m);
    if !PERSON_HEIGHT_M.contains(&height_m) {
        let (low, high) = (*PERSON_HEIGHT_M.start(), *PERSON_HEIGHT_M.end());
        return Err(HumanMl3dError::NoPerson { height_m, low, high });
    }
    Ok(RigidTrack {
        format: "humanml3d",
        root: "pelvis".to_owned(),
        rate_hz: RATE_HZ,
        up: Some(Axis::Y),
        unit_m: 1.0,
        position_m,
        orientation,
        points_m,
        height_m: Some(height_m),
        is_keyframed: false,
        notes: vec!["of the root's orientation the features have the heading alone".to_owned()],
    })
}

/// Way along bones from the head to the ankles, m: medians over the take.
fn height_of(root: &[[f64; 3]], points: &[Vec<[f64; 3]>]) -> f64 {
    let n = root.len().min(MAX_SAMPLED_FRAMES);
    let frames: Vec<usize> = (0..n).map(|i| i * root.len() / n).collect();
    let at = |joint: usize, t: usize| match joint {
        0 => root[t],
        joint => points[joint - 1][t],
    };
    let bone = |a: usize, b: usize| {
        let apart = |&t: &usize| {
            let (a, b) = (at(a, t), at(b, t));
            (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
        };
        median(&mut frames.iter().map(apart).collect::<Vec<_>>()).unwrap_or(0.0)
    };
    let way = |joints: &[usize]| joints.windows(2).map(|pair| bone(pair[0], pair[1])).sum::<f64>();
    let legs = ROOT_TO_ANKLES.iter().map(|leg| way(leg)).sum::<f64>() / ROOT_TO_ANKLES.len() as f64;
    way(&HEAD_TO_ROOT) + legs
}
