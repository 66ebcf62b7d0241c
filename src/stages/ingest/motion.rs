//! Motion of a phrase: the bytes of its file, or of one for each dancer, become trajectories, or one failure.

use ndarray::{Array2, Array3};

use crate::motion::formats::{
    HumanMl3dError, RigidError, SmplError, VmdError, humanml3d, rigid, smpl, vmd,
};
use crate::motion::npy::{self, NpyArray, NpyError};
use crate::motion::npz::{Npz, NpzError};
use crate::motion::{
    Axis, Beats, Bvh, BvhError, Capture, CaptureAccount, CaptureError, Dancers, DancersError,
    GroupCapture, MOTION_DIM, RigidTrack, Trajectory, TrajectoryError, convert_capture,
    convert_captures, convert_tracks,
};
use crate::stages::failure::{Failure, FailureKind};

/// Reads a `trajectory.npy` of a soloist, `[T, 25]`; its values are not looked at.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_trajectory(path: &str, bytes: &[u8]) -> Result<Trajectory, Failure> {
    let array = npy::read_f32(bytes).map_err(|e: NpyError| Failure::of(path, e.kind(), &e))?;
    trajectory_of(path, array)
}

/// Reads a `trajectory.npy` of a soloist, `[T, 25]`, or of a group, `[N, T, 25]`; its values are not looked at.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_dancers(path: &str, bytes: &[u8]) -> Result<Dancers, Failure> {
    let array = npy::read_f32(bytes).map_err(|e: NpyError| Failure::of(path, e.kind(), &e))?;
    let &[n_dancers, n_frames, MOTION_DIM] = array.shape.as_slice() else {
        return trajectory_of(path, array).map(Dancers::from);
    };
    let shape = (n_dancers, n_frames, MOTION_DIM);
    let frames = Array3::from_shape_vec(shape, array.values)
        .map_err(|e| Failure::new(FailureKind::Shape, path, e))?;
    Dancers::of_frames(frames).map_err(|e: DancersError| Failure::of(path, e.kind(), &e))
}

fn trajectory_of(path: &str, array: NpyArray<f32>) -> Result<Trajectory, Failure> {
    let shape_failure = || {
        let hint = match array.shape[..] {
            [25, _] => "; transpose it",
            [_, _, MOTION_DIM] => "; this is a group of dancers, and one is read here",
            [_, humanml3d::FEATURE_DIM] => {
                "; features of HumanML3D are read where the file is named motion.npy"
            }
            _ => "",
        };
        let message = format!("{path} has shape {:?}, expected [frames, 25]{hint}", array.shape);
        Failure::new(FailureKind::Shape, path, message)
    };
    let &[n_frames, n_channels] = array.shape.as_slice() else { return Err(shape_failure()) };
    if n_frames == 0 || n_channels != MOTION_DIM {
        return Err(shape_failure());
    }
    let frames = Array2::from_shape_vec((n_frames, n_channels), array.values)
        .map_err(|e| Failure::new(FailureKind::Shape, path, e))?;
    Trajectory::new(frames).map_err(|e: TrajectoryError| Failure::of(path, e.kind(), &e))
}

/// Endings of the names of motion captures; what they hold decides further.
pub(in crate::stages) const CAPTURE_EXTENSIONS: [&str; 7] =
    ["bvh", "npz", "npy", "vmd", "c3d", "pkl", "pickle"];

/// A motion with what it was read from.
pub(in crate::stages) struct ReadMotion {
    pub dancers: Dancers,
    /// As the column `motion_format` spells it.
    pub format: &'static str,
    /// Of a capture, what was found out about it.
    pub account: Option<CaptureAccount>,
}

/// Reads a motion of any format: the name's ending decides, of `.npy` the shape.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_motion(
    path: &str,
    bytes: &[u8],
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<ReadMotion, Failure> {
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    let extension = extension.to_ascii_lowercase();
    if bytes.is_empty() {
        let message = format!("{path} is empty; export the capture again");
        return Err(Failure::new(FailureKind::EmptyFile, path, message));
    }
    let tracks = match extension.as_str() {
        "bvh" => return Ok(of_capture(read_bvh(path, bytes, beats, up)?, "bvh")),
        "npz" => read_archive(path, bytes)?,
        "npy" => match humanml3d::read(bytes) {
            Ok(track) => vec![track],
            // Whatever is as wide as no features is a trajectory, or is refused as one.
            Err(HumanMl3dError::Shape { shape })
                if shape.last() != Some(&humanml3d::FEATURE_DIM) =>
            {
                let dancers = read_dancers(path, bytes)?;
                return Ok(ReadMotion { dancers, format: "npy", account: None });
            }
            Err(e) => return Err(Failure::of(path, e.kind(), &e)),
        },
        "vmd" => vec![vmd::read(bytes).map_err(|e: VmdError| Failure::of(path, e.kind(), &e))?],
        "c3d" => return Err(Failure::new(FailureKind::MotionFormat, path, c3d_refusal(path))),
        "pkl" | "pickle" => {
            return Err(Failure::new(FailureKind::Pickle, path, pickle_refusal(path)));
        }
        _ => {
            let message = format!(
                "{path} is named like no motion; name it .{}",
                CAPTURE_EXTENSIONS[..CAPTURE_EXTENSIONS.len() - 2].join(", .")
            );
            return Err(Failure::new(FailureKind::Name, path, message));
        }
    };
    let format = tracks.first().map_or("smpl", |track| track.format);
    convert_tracks(&tracks, beats, up)
        .map(|group| of_group(group, format))
        .map_err(|e: CaptureError| Failure::of(path, capture_kind(&e, "motion_format"), &e))
}

/// Reads the motion of a group from a file for each dancer, in their order: `.npy` of `[T, 25]`, or `.bvh`.
///
/// # Errors
/// A [`Failure`] that names the file or, where the files do not go together, the first of them.
pub(in crate::stages) fn read_group(
    files: &[(String, impl AsRef<[u8]>)],
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<ReadMotion, Failure> {
    let (mut trajectories, mut captures) = (Vec::new(), Vec::new());
    for (path, bytes) in files {
        if path.ends_with(".bvh") {
            captures.push(parse_bvh(path, bytes.as_ref())?);
        } else {
            trajectories.push(read_trajectory(path, bytes.as_ref())?);
        }
    }
    let first = files.first().map_or("", |(path, _)| path.as_str());
    if captures.is_empty() {
        let dancers = Dancers::new(trajectories)
            .map_err(|e: DancersError| Failure::of(folder_of(first), e.kind(), &e))?;
        return Ok(ReadMotion { dancers, format: "npy", account: None });
    }
    if !trajectories.is_empty() {
        let message = format!(
            "{} has {} dancers in .npy and {} in .bvh, which do not share a frame of reference; write all of them \
             in one format",
            folder_of(first),
            trajectories.len(),
            captures.len()
        );
        return Err(Failure::new(FailureKind::MotionFormat, folder_of(first), message));
    }
    convert_captures(&captures, beats, up)
        .map(|group| of_group(group, "bvh"))
        .map_err(|e| Failure::of(folder_of(first), capture_kind(&e, "bvh_format"), &e))
}

fn folder_of(path: &str) -> &str {
    path.rsplit_once('/').map_or(path, |(folder, _)| folder)
}

/// Reads the tracks of an archive: positions and rotations, or SMPL parameters.
fn read_archive(path: &str, bytes: &[u8]) -> Result<Vec<RigidTrack>, Failure> {
    let archive = Npz::open(bytes).map_err(|e: NpzError| Failure::of(path, e.kind(), &e))?;
    if rigid::is_rigid(archive.keys()) {
        return rigid::read(bytes).map_err(|e: RigidError| Failure::of(path, e.kind(), &e));
    }
    smpl::read_dancers(bytes).map_err(|e: SmplError| Failure::of(path, e.kind(), &e))
}

/// Returns the kind of a failed conversion: what is wrong with a group is no matter of its format.
fn capture_kind(error: &CaptureError, format: &'static str) -> &'static str {
    match error {
        CaptureError::Dancers(error) => error.kind(),
        _ => format,
    }
}

fn of_capture(capture: Capture, format: &'static str) -> ReadMotion {
    let Capture { trajectory, account } = capture;
    ReadMotion { dancers: trajectory.into(), format, account: Some(account) }
}

fn of_group(group: GroupCapture, format: &'static str) -> ReadMotion {
    ReadMotion { dancers: group.dancers, format, account: Some(group.account) }
}

fn pickle_refusal(path: &str) -> String {
    let name = path.rsplit('/').next().unwrap_or(path);
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    format!(
        "{path} is a Python pickle, which can run any program and is never loaded; convert it where you trust \
         it: python3 -c \"import pickle, numpy as n; d = pickle.load(open('{name}', 'rb'), encoding='latin1'); \
         n.savez('{stem}.npz', **{{k: d[k] for k in ('smpl_poses', 'smpl_trans', 'root_trans', 'smpl_scaling') if k in \
         d}})\""
    )
}

fn c3d_refusal(path: &str) -> String {
    format!(
        "{path} is a C3D file of markers, which is not read; solve it to a skeleton and export that as BVH (in \
         Blender: import the C3D, retarget it to an armature, export it as motion.bvh)"
    )
}

/// Reads a motion capture in BVH; beat times give the phase. `up` is the axis that is up in the file, none to find it.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_bvh(
    path: &str,
    bytes: &[u8],
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<Capture, Failure> {
    let bvh = parse_bvh(path, bytes)?;
    convert_capture(&bvh, beats, up).map_err(|e: CaptureError| Failure::of(path, "bvh_format", &e))
}

fn parse_bvh(path: &str, bytes: &[u8]) -> Result<Bvh, Failure> {
    if bytes.is_empty() {
        let message = format!("{path} is empty; export the capture again");
        return Err(Failure::new(FailureKind::EmptyFile, path, message));
    }
    Bvh::parse(bytes).map_err(|e: BvhError| Failure::of(path, "bvh_format", &e))
}

/// Returns what a reader of a capture should know, in one line; none where there is nothing.
pub(in crate::stages) fn notes_of(account: &CaptureAccount) -> Option<String> {
    let notes: Vec<String> = account.notes.iter().map(ToString::to_string).collect();
    (!notes.is_empty()).then(|| notes.join("; "))
}
