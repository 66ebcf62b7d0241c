//! What a motion file holds, in any of four formats.

use std::path::Path;

use ndarray::{Array2, Array3, ArrayView2, s};

use super::FileContent;
use crate::motion::group::MAX_DANCERS;
use crate::motion::kinematics::frames_of;
use crate::motion::npy::{self, NpyError};
use crate::motion::quaternion::{Quaternion, make_sign_continuous, normalize};
use crate::motion::{CHANNEL_NAMES, Channel, MOTION_DIM, Poses, exchange};
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::ingest::read_bvh;
use crate::store::{NumberColumnsError, number_columns};

/// Numbers of a pose: position x, y, z and quaternion w, x, y, z.
const POSE_DIM: usize = 7;
/// The columns that count frames and dancers in tables.
const FRAME: &str = "frame";
const DANCER: &str = "dancer";

/// How motion is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ForeignFormat {
    Npy,
    Csv,
    Bvh,
    Parquet,
}

impl ForeignFormat {
    /// Returns the format that a file is named after.
    pub fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_string_lossy().to_ascii_lowercase();
        match extension.as_str() {
            "npy" => Some(Self::Npy),
            "csv" => Some(Self::Csv),
            "bvh" => Some(Self::Bvh),
            "parquet" => Some(Self::Parquet),
            _ => None,
        }
    }
}

/// Reads a motion, `[T, 25]` of each dancer, T ≥ 1, one dancer or more, and what it came from.
///
/// # Errors
/// One sentence that names the file.
pub fn read(path: &Path) -> Result<(Vec<Array2<f32>>, FileContent), Failure> {
    let place = path.display().to_string();
    let bytes = bytes_of(path, &place)?;
    let (frames, content) = match ForeignFormat::of(path) {
        Some(ForeignFormat::Npy) => return of_npy(&place, &bytes),
        Some(ForeignFormat::Csv) => (of_csv(&place, bytes)?, FileContent::Channels),
        Some(ForeignFormat::Bvh) => {
            (read_bvh(&place, &bytes, None, None)?.trajectory.into_array(), FileContent::Capture)
        }
        Some(ForeignFormat::Parquet) => of_parquet(&place, bytes)?,
        None => {
            let message =
                format!("{place}: is named like no motion; name it .npy, .csv, .bvh or .parquet");
            return Err(Failure::new(FailureKind::Name, &place, message));
        }
    };
    if frames.nrows() == 0 {
        let message = format!("{place}: has no frames; write it again");
        return Err(Failure::new(FailureKind::Shape, &place, message));
    }
    Ok((vec![frames], content))
}

fn bytes_of(path: &Path, place: &str) -> Result<Vec<u8>, Failure> {
    let unreadable = |e: std::io::Error| {
        let message = format!("{place}: cannot be opened ({e}); check that it is still there");
        Failure::new(FailureKind::Unreadable, place, message)
    };
    let about = std::fs::metadata(path).map_err(unreadable)?;
    if !about.is_file() {
        let message = format!("{place}: is no file; remove it, or name it otherwise");
        return Err(Failure::new(FailureKind::NotAFile, place, message));
    }
    if about.len() > npy::MAX_ARRAY_BYTES {
        let message = format!(
            "{place}: has {} bytes, more than the {} that are read; split it",
            about.len(),
            npy::MAX_ARRAY_BYTES
        );
        return Err(Failure::new(FailureKind::TooLarge, place, message));
    }
    let bytes = std::fs::read(path).map_err(unreadable)?;
    if bytes.is_empty() {
        let message = format!("{place}: is empty; write the motion again");
        return Err(Failure::new(FailureKind::EmptyFile, place, message));
    }
    Ok(bytes)
}

fn of_npy(place: &str, bytes: &[u8]) -> Result<(Vec<Array2<f32>>, FileContent), Failure> {
    let array = npy::read_f32(bytes).map_err(|e: NpyError| Failure::of(place, e.kind(), &e))?;
    let refused = || {
        let is_turned = matches!(array.shape[..], [MOTION_DIM | POSE_DIM, n] if n > 0);
        let hint = if is_turned { "; transpose it" } else { "" };
        let message = format!(
            "{place}: has shape {:?}, expected [frames, {MOTION_DIM}], or [frames, {POSE_DIM}] of position \
             and quaternion (w, x, y, z), or [dancers, frames, {MOTION_DIM}] of a group of 2 to \
             {MAX_DANCERS}{hint}",
            array.shape
        );
        Failure::new(FailureKind::Shape, place, message)
    };
    if let [n_dancers @ 2..=MAX_DANCERS, n_frames, MOTION_DIM] = array.shape[..]
        && n_frames > 0
    {
        let group = Array3::from_shape_vec((n_dancers, n_frames, MOTION_DIM), array.values)
            .map_err(|e| Failure::new(FailureKind::Shape, place, format!("{place}: {e}")))?;
        let dancers = group.outer_iter().map(|dancer| dancer.to_owned()).collect();
        return Ok((dancers, FileContent::Channels));
    }
    let &[n_frames, n_channels] = array.shape.as_slice() else { return Err(refused()) };
    if n_frames == 0 || ![MOTION_DIM, POSE_DIM].contains(&n_channels) {
        return Err(refused());
    }
    let values = Array2::from_shape_vec((n_frames, n_channels), array.values)
        .map_err(|e| Failure::new(FailureKind::Shape, place, format!("{place}: {e}")))?;
    Ok(match n_channels {
        MOTION_DIM => (vec![values], FileContent::Channels),
        _ => (vec![of_poses(values.view())], FileContent::Poses),
    })
}

fn of_csv(place: &str, bytes: Vec<u8>) -> Result<Array2<f32>, Failure> {
    let refused = |reason: &dyn std::fmt::Display| {
        Failure::new(FailureKind::CsvFormat, place, format!("{place}: {reason}"))
    };
    let text = String::from_utf8(bytes)
        .map_err(|_| refused(&"is not UTF-8 text; write it as CSV again"))?;
    exchange::read_csv(&text).map_err(|e| refused(&e))
}

fn of_parquet(place: &str, bytes: Vec<u8>) -> Result<(Array2<f32>, FileContent), Failure> {
    let refused = |reason: &dyn std::fmt::Display| {
        Failure::new(FailureKind::ParquetFormat, place, format!("{place}: {reason}"))
    };
    let mut wanted = vec![FRAME, DANCER];
    wanted.extend(CHANNEL_NAMES);
    let columns =
        number_columns(bytes.into(), &wanted).map_err(|e: NumberColumnsError| refused(&e))?;
    if let Some(other) = columns.get(DANCER).and_then(|d| d.iter().find(|&&x| x != d[0])) {
        return Err(refused(&format!(
            "has frames of dancer {other} behind those of dancer {}; write the motion of one dancer into a file",
            columns[DANCER][0]
        )));
    }
    if let Some(frame) = columns.get(FRAME) {
        let first = frame.first().copied().unwrap_or(0.0);
        let wrong = frame.iter().zip(0..).find(|&(&x, t)| x != first + f64::from(t));
        if let Some((found, t)) = wrong {
            return Err(refused(&format!(
                "has frame {found} in row {t}, where frame {} should be; write one motion into a file, \
                 sorted by frame",
                first + f64::from(t)
            )));
        }
    }
    let pose = || Channel::Position.range().chain(Channel::Quaternion.range());
    let has = |i: usize| columns.contains_key(CHANNEL_NAMES[i]);
    let is_whole = (0..MOTION_DIM).all(has);
    let is_pose = pose().all(has) && (0..MOTION_DIM).filter(|&i| has(i)).count() == POSE_DIM;
    if !is_whole && !is_pose {
        let missing: Vec<&str> =
            (0..MOTION_DIM).filter(|&i| !has(i)).map(|i| CHANNEL_NAMES[i]).collect();
        return Err(refused(&format!(
            "lacks columns {}; write all {MOTION_DIM} channels, or positions and quaternions alone",
            missing.join(", ")
        )));
    }
    let taken: Vec<usize> = if is_whole { (0..MOTION_DIM).collect() } else { pose().collect() };
    let n_frames = columns.get(CHANNEL_NAMES[0]).map_or(0, Vec::len);
    let values = Array2::from_shape_fn((n_frames, taken.len()), |(t, i)| {
        columns[CHANNEL_NAMES[taken[i]]][t] as f32
    });
    Ok(if is_whole {
        (values, FileContent::Channels)
    } else {
        (of_poses(values.view()), FileContent::Poses)
    })
}

/// Returns all channels of poses, `[T, 7]` → `[T, 25]`: what follows from poses is derived by forward
/// differences, phase and style are 0.
///
/// Turns are taken between unit quaternions of continuous signs; the quaternions themselves stay as they were,
/// for the checks to judge.
fn of_poses(poses: ArrayView2<f32>) -> Array2<f32> {
    let at = |row: &ndarray::ArrayView1<f32>, i: usize| f64::from(row[i]);
    let mut followed = Poses::default();
    for row in poses.rows() {
        followed.position_m.push(std::array::from_fn(|i| at(&row, i)));
        let q: Quaternion = std::array::from_fn(|i| at(&row, 3 + i));
        followed.orientation.push(normalize(q));
    }
    make_sign_continuous(&mut followed.orientation);
    let mut frames = frames_of(&followed, poses.nrows());
    frames.slice_mut(s![.., Channel::Quaternion.range()]).assign(&poses.slice(s![.., 3..]));
    frames
}
