//! SMPL parameters in `.npz`: AIST++, AMASS, AIOZ-GDANCE, and what other programs write with the same keys.
//!
//! Pose vectors begin with the root's axis-angle. The root joint stands at its place in the rest shape plus
//! the translation, `p = J₀ + t`, since the whole body turns about `J₀`; `J₀` depends on the shape, which a
//! body model is needed for, so that of the mean shape is taken. Only the members below are read, so that
//! strings and Python objects beside them (`gender`) do no harm. Sources: Loper et al., SMPL, TOG 2015;
//! Mahmood et al., AMASS, ICCV 2019; Li et al., AI Choreographer (AIST++), ICCV 2021;
//! Le et al., Music-Driven Group Choreography (AIOZ-GDANCE), CVPR 2023.

#[cfg(test)]
mod tests;

use thiserror::Error;

use crate::motion::capture::{Axis, RigidTrack};
use crate::motion::group::MAX_DANCERS;
use crate::motion::npy::NpyArray;
use crate::motion::npz::{Npz, NpzError};
use crate::motion::quaternion::from_rotation_vector;

/// Rest position of the root joint of SMPL's neutral mean shape, m, +Y up.
pub const MEAN_PELVIS_M: [f64; 3] = [-0.001_795_06, -0.223_333_82, 0.028_219_18];
/// Frames per second of AIST++, which its files do not say.
pub const AIST_RATE_HZ: f64 = 60.0;
/// Frames per second of AIOZ-GDANCE, which its files do not say.
pub const GDANCE_RATE_HZ: f64 = 30.0;
/// Lengths of a pose vector: the root alone, SMPL without and with hands' joints, SMPL-H, SMPL-X.
const POSE_DIMS: [usize; 5] = [3, 66, 72, 156, 165];

// Where AIOZ-GDANCE keeps the root apart, its poses begin with another joint.
const POSE_KEYS: [&str; 5] =
    ["smpl_orients", "smpl_poses", "poses", "root_orient", "global_orient"];
const TRANSLATION_KEYS: [&str; 4] = ["smpl_trans", "trans", "transl", "root_trans"];
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
    /// The pose of a group is no list of axis-angles by dancer and frame.
    #[error(
        "npz member {key:?} has shape {shape:?}, expected [{n_dancers}, {n_frames}, 72] (SMPL), or another length \
         of poses, for the positions of {n_dancers} dancers in {n_frames} frames; save both of the same dancers \
         and frames"
    )]
    GroupPose { key: String, shape: Vec<usize>, n_dancers: usize, n_frames: usize },
    /// No dancer, or more than a group has.
    #[error(
        "npz has {n_dancers} dancers, expected 1 to {MAX_DANCERS}; split it into several phrases"
    )]
    Count { n_dancers: usize },
    /// A group where a soloist is read.
    #[error("npz has {n_dancers} dancers where one is read; save each of them alone")]
    Group { n_dancers: usize },
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
            Self::Pose { .. }
            | Self::Translation { .. }
            | Self::GroupPose { .. }
            | Self::Count { .. }
            | Self::Group { .. } => "shape",
            Self::Number { .. } => "motion_format",
        }
    }
}

/// Reads the root's track out of an archive of SMPL parameters of one body, as [`read_dancers`] does.
///
/// Errors: [`SmplError`].
pub fn read(bytes: &[u8]) -> Result<RigidTrack, SmplError> {
    let mut tracks = read_dancers(bytes)?;
    match (tracks.len(), tracks.pop()) {
        (1, Some(track)) => Ok(track),
        (n_dancers, _) => Err(SmplError::Group { n_dancers }),
    }
}

/// Reads the roots' tracks out of an archive of SMPL parameters: of one body, or of a group where translations are
/// `[N, T, 3]` and poses `[N, T, 72]` (or another length of poses), all in the file's one frame of reference.
///
/// Positions are `J₀ + t / s` in metres with the scaling `s` of AIST++, else 1. Without a rate 60 fps are
/// taken, of a group 30 fps. Z is up where AMASS's rate says so, Y where AIST++'s scaling does, else as the body is carried.
/// Errors: [`SmplError`].
pub fn read_dancers(bytes: &[u8]) -> Result<Vec<RigidTrack>, SmplError> {
    let mut archive = Npz::open(bytes)?;
    let pose_key = first_of(&archive, "pose", &POSE_KEYS)?;
    let translation_key = first_of(&archive, "translation", &TRANSLATION_KEYS)?;
    let poses = archive.read_f64(pose_key)?;
    let translation = archive.read_f64(translation_key)?;
    let is_group = translation.shape.len() == 3;
    let (n_frames, pose_dim) = if is_group {
        group_shape(pose_key, &poses, translation_key, &translation)?
    } else {
        let (n_frames, pose_dim) = pose_shape(pose_key, &poses)?;
        if translation.shape != [n_frames, 3] {
            let (key, shape) = (translation_key.to_owned(), translation.shape);
            return Err(SmplError::Translation { key, shape, n_frames });
        }
        (n_frames, pose_dim)
    };

    let has = |key: &&str| archive.keys().iter().any(|found| found == key);
    let is_scaled = has(&SCALING_KEY);
    let rate_key = RATE_KEYS.into_iter().find(|key| has(key));
    let is_amass = rate_key.is_some_and(|key| RATE_KEYS[..N_AMASS_RATE_KEYS].contains(&key));
    let scaling = if is_scaled { number(&mut archive, SCALING_KEY)? } else { 1.0 };
    let rate_hz = match rate_key {
        Some(key) => number(&mut archive, key)?,
        None if is_group => GDANCE_RATE_HZ,
        None => AIST_RATE_HZ,
    };

    let mut notes = vec![format!(
        "root is the pelvis of the mean shape, {:.3} m below the translation along the file's y; that of the \
         body's own shape is not in the file",
        -MEAN_PELVIS_M[1]
    )];
    if rate_key.is_none() && !is_scaled {
        notes
            .push(format!("no frame rate in the file, {rate_hz} fps are taken (fps says another)"));
    }
    let (format, up) = match (is_amass, is_scaled) {
        (true, _) => ("amass", Some(Axis::Z)),
        (false, true) => ("aist", Some(Axis::Y)),
        (false, false) if is_group => ("gdance", None),
        (false, false) => ("smpl", None),
    };
    let position = |t: &[f64]| std::array::from_fn(|c| MEAN_PELVIS_M[c] + t[c] / scaling);
    let orientation = |pose: &[f64]| from_rotation_vector([pose[0], pose[1], pose[2]]);
    let track = |translation: &[f64], poses: &[f64]| RigidTrack {
        format,
        root: "pelvis".to_owned(),
        rate_hz,
        up,
        unit_m: 1.0 / scaling,
        position_m: translation.chunks_exact(3).map(position).collect(),
        orientation: poses.chunks_exact(pose_dim).map(orientation).collect(),
        points_m: Vec::new(),
        height_m: None,
        is_keyframed: false,
        notes: notes.clone(),
    };
    if n_frames == 0 {
        // Without frames there are no pieces to cut the values into.
        return Ok(vec![track(&[], &[])]);
    }
    let of_dancers = translation.values.chunks_exact(3 * n_frames);
    Ok(of_dancers
        .zip(poses.values.chunks_exact(pose_dim * n_frames))
        .map(|(t, p)| track(t, p))
        .collect())
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

/// Frames and numbers per frame of the poses of a group, `[N, T, n]` or `[N, T, joints, 3]`.
fn group_shape(
    pose_key: &str,
    poses: &NpyArray<f64>,
    translation_key: &str,
    translation: &NpyArray<f64>,
) -> Result<(usize, usize), SmplError> {
    let &[n_dancers, n_frames, 3] = translation.shape.as_slice() else {
        let (key, shape) = (translation_key.to_owned(), translation.shape.clone());
        let n_frames = poses.shape.get(1).copied().unwrap_or(0);
        return Err(SmplError::Translation { key, shape, n_frames });
    };
    if !(1..=MAX_DANCERS).contains(&n_dancers) {
        return Err(SmplError::Count { n_dancers });
    }
    match poses.shape[..] {
        [n, t, dim] if [n, t] == [n_dancers, n_frames] && POSE_DIMS.contains(&dim) => {
            Ok((n_frames, dim))
        }
        [n, t, joints, 3] if [n, t] == [n_dancers, n_frames] && joints > 0 => {
            Ok((n_frames, 3 * joints))
        }
        _ => {
            let (key, shape) = (pose_key.to_owned(), poses.shape.clone());
            Err(SmplError::GroupPose { key, shape, n_dancers, n_frames })
        }
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
