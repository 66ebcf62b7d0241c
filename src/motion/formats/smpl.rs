//! SMPL parameters in `.npz`: AIST++, AMASS, and what other programs write with the same keys.
//!
//! Pose vectors begin with the root's axis-angle. The root joint stands at its place in the rest shape plus
//! the translation, `p = J₀ + t`, since the whole body turns about `J₀`; `J₀` depends on the shape, which a
//! body model is needed for, so that of the mean shape is taken. Only the members below are read, so that
//! strings and Python objects beside them (`gender`) do no harm. Sources: Loper et al., SMPL, TOG 2015;
//! Mahmood et al., AMASS, ICCV 2019; Li et al., AI Choreographer (AIST++), ICCV 2021.

#[cfg(test)]
mod tests;

use thiserror::Error;

use super::super::capture::{Axis, RigidTrack};
use super::super::npy::NpyArray;
use super::super::npz::{Npz, NpzError};
use super::super::quaternion::from_rotation_vector;

/// Rest position of the root joint of SMPL's neutral mean shape, m, +Y up.
pub const MEAN_PELVIS_M: [f64; 3] = [-0.001_795_06, -0.223_333_82, 0.028_219_18];
/// Frames per second of AIST++, which its files do not say.
pub const AIST_RATE_HZ: f64 = 60.0;
/// Lengths of a pose vector: the root alone, SMPL without and with hands' joints, SMPL-H, SMPL-X.
const POSE_DIMS: [usize; 5] = [3, 66, 72, 156, 165];

const POSE_KEYS: [&str; 4] = ["smpl_poses", "poses", "root_orient", "global_orient"];
const TRANSLATION_KEYS: [&str; 3] = ["smpl_trans", "trans", "transl"];
const SCALING_KEY: &str = "smpl_scaling";
/// Rates as AMASS writes them, and others.
const RATE_KEYS: [&str; 4] = ["mocap_framerate", "mocap_frame_rate", "mocap_fps", "fps"];
/// How many of the rate keys are AMASS's, whose files have Z up.
const N_AMASS_RATE_KEYS: usize = 2;

/// Why SMPL parameters were refused.
#[derive(Debug, Error)]
pub enum SmplError {
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// No pose or no translation.
    #[error(
        "npz has no {what}: it holds {found}, expected {expected}; save them with numpy.savez(path, \
         poses=…, trans=…, mocap_framerate=…)"
    )]
    Missing { what: &'static str, found: String, expected: String },
    /// The pose is no list of axis-angles.
    #[error(
        "npz member {key:?} has shape {shape:?}, expected [frames, 72] (SMPL), [frames, 156] (SMPL-H), \
         [frames, 165] (SMPL-X) or [frames, joints, 3]; save the pose as axis-angles, the root first"
    )]
    Pose { key: String, shape: Vec<usize> },
    /// The translation does not go with the pose.
    #[error(
        "npz member {key:?} has shape {shape:?}, expected [{n_frames}, 3], a position for each of the \
         {n_frames} poses; save both of the same frames"
    )]
    Translation { key: String, shape: Vec<usize>, n_frames: usize },
    /// A number that is none, or no positive one.
    #[error(
        "npz member {key:?} has shape {shape:?} and first value {value}, expected one positive number; \
         save it as one"
    )]
    Number { key: String, shape: Vec<usize>, value: f64 },
}

impl SmplError {
    /// The error's class in reports.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Npz(error) => error.kind(),
            Self::Missing { .. } => "missing_key",
            Self::Pose { .. } | Self::Translation { .. } => "shape",
            Self::Number { .. } => "motion_format",
        }
    }
}

/// Reads the root's track out of an archive of SMPL parameters.
///
/// Positions are `J₀ + t / s` in metres with the scaling `s` of AIST++, else 1. Without a rate 60 fps are
/// taken. Z is up where AMASS's rate says so, Y where AIST++'s scaling does, else as the body is carried.
/// Errors: [`SmplError`].
pub fn read(bytes: &[u8]) -> Result<RigidTrack, SmplError> {
    let mut archive = Npz::open(bytes)?;
    let pose_key = first_of(&archive, "pose", &POSE_KEYS)?;
    let translation_key = first_of(&archive, "translation", &TRANSLATION_KEYS)?;
    let poses = archive.read_f64(pose_key)?;
    let (n_frames, pose_dim) = pose_shape(pose_key, &poses)?;
    let translation = archive.read_f64(translation_key)?;
    if translation.shape != [n_frames, 3] {
        let (key, shape) = (translation_key.to_owned(), translation.shape);
        return Err(SmplError::Translation { key, shape, n_frames });
    }

    let has = |key: &&str| archive.keys().iter().any(|found| found == key);
    let is_scaled = has(&SCALING_KEY);
    let rate_key = RATE_KEYS.into_iter().find(|key| has(key));
    let is_amass = rate_key.is_some_and(|key| RATE_KEYS[..N_AMASS_RATE_KEYS].contains(&key));
    let scaling = if is_scaled { number(&mut archive, SCALING_KEY)? } else { 1.0 };
    let rate_hz = match rate_key {
        Some(key) => number(&mut archive, key)?,
        None => AIST_RATE_HZ,
    };

    let mut notes = vec![format!(
        "root is the pelvis of the mean shape, {:.3} m below the translation along the file's y; that of the \
         body's own shape is not in the file",
        -MEAN_PELVIS_M[1]
    )];
    if rate_key.is_none() && !is_scaled {
        notes.push(format!(
            "no frame rate in the file, {AIST_RATE_HZ} fps are taken (fps says another)"
        ));
    }
    let (format, up) = match (is_amass, is_scaled) {
        (true, _) => ("amass", Some(Axis::Z)),
        (false, true) => ("aist", Some(Axis::Y)),
        (false, false) => ("smpl", None),
    };
    let position = |t: &[f64]| std::array::from_fn(|c| MEAN_PELVIS_M[c] + t[c] / scaling);
    let orientation = |pose: &[f64]| from_rotation_vector([pose[0], pose[1], pose[2]]);
    Ok(RigidTrack {
        format,
        root: "pelvis".to_owned(),
        rate_hz,
        up,
        unit_m: 1.0 / scaling,
        position_m: translation.values.chunks_exact(3).map(position).collect(),
        orientation: poses.values.chunks_exact(pose_dim).map(orientation).collect(),
        points_m: Vec::new(),
        height_m: None,
        is_keyframed: false,
        notes,
    })
}

fn first_of(
    archive: &Npz,
    what: &'static str,
    keys: &[&'static str],
) -> Result<&'static str, SmplError> {
    let found = |key: &&&str| archive.keys().iter().any(|found| found == *key);
    keys.iter().find(found).copied().ok_or_else(|| SmplError::Missing {
        what,
        found: super::keys::listed(archive.keys()),
        expected: super::keys::one_of(keys),
    })
}

/// Frames and numbers per frame of a pose, `[T, n]` or `[T, joints, 3]`.
fn pose_shape(key: &str, poses: &NpyArray<f64>) -> Result<(usize, usize), SmplError> {
    match poses.shape[..] {
        [n_frames, dim] if POSE_DIMS.contains(&dim) => Ok((n_frames, dim)),
        [n_frames, joints, 3] if joints > 0 => Ok((n_frames, 3 * joints)),
        _ => Err(SmplError::Pose { key: key.to_owned(), shape: poses.shape.clone() }),
    }
}

fn number(archive: &mut Npz, key: &str) -> Result<f64, SmplError> {
    let array = archive.read_f64(key)?;
    match array.values[..] {
        [value] if value > 0.0 && value.is_finite() => Ok(value),
        _ => {
            let value = array.values.first().copied().unwrap_or(f64::NAN);
            Err(SmplError::Number { key: key.to_owned(), shape: array.shape, value })
        }
    }
}
