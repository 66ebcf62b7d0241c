//! Motion of a phrase: its file's bytes become a trajectory, or one failure.

use ndarray::Array2;

use crate::motion::formats::{HumanMl3dError, SmplError, VmdError, humanml3d, smpl, vmd};
use crate::motion::npy::{self, NpyError};
use crate::motion::{
    Axis, Beats, Bvh, BvhError, Capture, CaptureAccount, CaptureError, MOTION_DIM, RigidTrack,
    Trajectory, TrajectoryError, convert_capture, convert_track,
};
use crate::stages::failure::{Failure, FailureKind};

/// Reads a `trajectory.npy`; its values are not looked at.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_trajectory(path: &str, bytes: &[u8]) -> Result<Trajectory, Failure> {
    let array = npy::read_f32(bytes).map_err(|e: NpyError| Failure::of(path, e.kind(), &e))?;
    let shape_failure = || {
        let hint = match array.shape[..] {
            [25, _] => "; transpose it",
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
    pub trajectory: Trajectory,
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
    let track = match extension.as_str() {
        "bvh" => return Ok(of_capture(read_bvh(path, bytes, beats, up)?, "bvh")),
        "npz" => smpl::read(bytes).map_err(|e: SmplError| Failure::of(path, e.kind(), &e))?,
        "npy" => match humanml3d::read(bytes) {
            Ok(track) => track,
            // Whatever is as wide as no features is a trajectory, or is refused as one.
            Err(HumanMl3dError::Shape { shape })
                if shape.last() != Some(&humanml3d::FEATURE_DIM) =>
            {
                let trajectory = read_trajectory(path, bytes)?;
                return Ok(ReadMotion { trajectory, format: "npy", account: None });
            }
            Err(e) => return Err(Failure::of(path, e.kind(), &e)),
        },
        "vmd" => vmd::read(bytes).map_err(|e: VmdError| Failure::of(path, e.kind(), &e))?,
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
    read_track(path, &track, beats, up)
}

fn read_track(
    path: &str,
    track: &RigidTrack,
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<ReadMotion, Failure> {
    convert_track(track, beats, up)
        .map(|capture| of_capture(capture, track.format))
        .map_err(|e: CaptureError| Failure::of(path, "motion_format", &e))
}

fn of_capture(capture: Capture, format: &'static str) -> ReadMotion {
    let Capture { trajectory, account } = capture;
    ReadMotion { trajectory, format, account: Some(account) }
}

fn pickle_refusal(path: &str) -> String {
    let name = path.rsplit('/').next().unwrap_or(path);
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    format!(
        "{path} is a Python pickle, which can run any program and is never loaded; convert it where you trust \
         it: python3 -c \"import pickle, numpy as n; d = pickle.load(open('{name}', 'rb'), encoding='latin1'); \
         n.savez('{stem}.npz', **{{k: d[k] for k in ('smpl_poses', 'smpl_trans', 'smpl_scaling')}})\""
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
    if bytes.is_empty() {
        let message = format!("{path} is empty; export the capture again");
        return Err(Failure::new(FailureKind::EmptyFile, path, message));
    }
    let bvh = Bvh::parse(bytes).map_err(|e: BvhError| Failure::of(path, "bvh_format", &e))?;
    convert_capture(&bvh, beats, up).map_err(|e: CaptureError| Failure::of(path, "bvh_format", &e))
}

/// Returns what a reader of a capture should know, in one line; none where there is nothing.
pub(in crate::stages) fn notes_of(account: &CaptureAccount) -> Option<String> {
    let notes: Vec<String> = account.notes.iter().map(ToString::to_string).collect();
    (!notes.is_empty()).then(|| notes.join("; "))
}
