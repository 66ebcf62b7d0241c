//! Motion of a phrase: its file's bytes become a trajectory, or one failure.

use ndarray::Array2;

use crate::motion::npy::{self, NpyError};
use crate::motion::{
    Axis, Beats, Bvh, BvhError, Capture, CaptureAccount, CaptureError, Trajectory, TrajectoryError,
    convert_capture,
};
use crate::stages::failure::{Failure, FailureKind};

/// Reads a `trajectory.npy`; its values are not looked at.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_trajectory(path: &str, bytes: &[u8]) -> Result<Trajectory, Failure> {
    let array = npy::read_f32(bytes).map_err(|e: NpyError| Failure::of(path, e.kind(), &e))?;
    let shape_failure = || {
        let hint =
            if array.shape.len() == 2 && array.shape[0] == 25 { "; transpose it" } else { "" };
        let message = format!("{path} has shape {:?}, expected [frames, 25]{hint}", array.shape);
        Failure::new(FailureKind::Shape, path, message)
    };
    let &[n_frames, n_channels] = array.shape.as_slice() else { return Err(shape_failure()) };
    if n_frames == 0 || n_channels != crate::motion::MOTION_DIM {
        return Err(shape_failure());
    }
    let frames = Array2::from_shape_vec((n_frames, n_channels), array.values)
        .map_err(|e| Failure::new(FailureKind::Shape, path, e))?;
    Trajectory::new(frames).map_err(|e: TrajectoryError| Failure::of(path, e.kind(), &e))
}

/// Reads a motion capture; beat times give the phase. `up` is the axis that is up in the file, none to find it.
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
