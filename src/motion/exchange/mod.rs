//! Motion in the formats of others: NumPy, CSV, BVH and glTF.
//!
//! `npy` and `csv` hold all 25 channels as they are; `bvh` and `glb` hold the pose alone, as other
//! programs play it, and refuse what is no pose.

mod body;
mod bvh;
mod csv;
mod glb;
mod ndjson;

use std::io::{self, Write};

use ndarray::{ArrayView, ArrayView2, ArrayView3, Dimension};

#[cfg(test)]
pub(in crate::motion) use bvh::euler_zxy;
pub use bvh::write_bvh;
pub(in crate::motion) use bvh::{END_SITE_CM, ROOT_NAME};
pub use csv::{
    CsvError, csv_header, group_csv_header, read_csv, write_csv, write_csv_rows, write_group_csv,
    write_group_csv_rows,
};
pub use glb::{write_glb, write_group_glb};
pub use ndjson::write_ndjson_rows;

use super::channels::{CHANNEL_NAMES, Channel, MOTION_DIM};
use super::kinematics::Poses;
use super::npy;
use super::quaternion::{Quaternion, dot, make_sign_continuous, normalize};

/// Quaternions with a lower norm say nothing about how a body is turned.
const MIN_QUATERNION_NORM: f64 = 1e-6;

/// Why motion cannot be written as a body that moves.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PoseError {
    /// No frames.
    #[error("motion has no frames, and {format} holds at least one; write it as npy or csv")]
    Empty { format: &'static str },
    /// A NaN or an infinity in position or quaternion; the first in frame order.
    #[error(
        "channel {channel} is {value} at frame {frame}, and {format} holds finite numbers alone; \
         write the motion as npy or csv to look at it"
    )]
    NonFinite { channel: &'static str, frame: usize, value: f32, format: &'static str },
    /// A quaternion that turns nothing; the first in frame order.
    #[error(
        "quaternion norm is {norm:e} at frame {frame}, and {format} needs a rotation; write the \
         motion as npy or csv to look at it"
    )]
    NoRotation { frame: usize, norm: f64, format: &'static str },
}

/// Writes motion, `[T, 25]`, as a NumPy array of `<f4`, equal byte for byte to `numpy.save`'s.
///
/// # Errors
/// The error of `out`.
pub fn write_npy(frames: ArrayView2<'_, f32>, out: &mut dyn Write) -> io::Result<()> {
    write_array(frames, out)
}

/// Writes a group, `[N, T, 25]`, as [`write_npy`] writes motion.
///
/// # Errors
/// The error of `out`.
pub fn write_group_npy(group: ArrayView3<'_, f32>, out: &mut dyn Write) -> io::Result<()> {
    write_array(group, out)
}

fn write_array<D: Dimension>(array: ArrayView<'_, f32, D>, out: &mut dyn Write) -> io::Result<()> {
    out.write_all(&npy::header::<f32>(array.shape()))?;
    let mut bytes = Vec::new();
    for row in array.rows() {
        bytes.clear();
        bytes.extend(row.iter().flat_map(|x| x.to_le_bytes()));
        out.write_all(&bytes)?;
    }
    Ok(())
}

/// Returns positions and unit quaternions with continuous signs of motion, `[T, 25]`, `T >= 1`.
///
/// Errors: [`PoseError`] for the format that is named, as an [`io::Error`].
///
/// # Panics
/// When there are other than 25 channels.
fn poses(frames: ArrayView2<'_, f32>, format: &'static str) -> io::Result<Poses> {
    assert_eq!(frames.ncols(), MOTION_DIM, "channels of motion");
    let refused = |e: PoseError| Err(io::Error::new(io::ErrorKind::InvalidInput, e));
    if frames.nrows() == 0 {
        return refused(PoseError::Empty { format });
    }
    let (p, q) = (Channel::Position.range(), Channel::Quaternion.range());
    let mut poses = Poses::default();
    for (frame, row) in frames.rows().into_iter().enumerate() {
        if let Some(i) = p.clone().chain(q.clone()).find(|&i| !row[i].is_finite()) {
            let (channel, value) = (CHANNEL_NAMES[i], row[i]);
            return refused(PoseError::NonFinite { channel, frame, value, format });
        }
        let orientation: Quaternion = std::array::from_fn(|c| f64::from(row[q.start + c]));
        let norm = dot(orientation, orientation).sqrt();
        if norm < MIN_QUATERNION_NORM {
            return refused(PoseError::NoRotation { frame, norm, format });
        }
        poses.position_m.push(std::array::from_fn(|axis| f64::from(row[p.start + axis])));
        poses.orientation.push(normalize(orientation));
    }
    make_sign_continuous(&mut poses.orientation);
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::npy::read_f32;
    use ndarray::{Array2, Array3, s};

    #[test]
    fn an_array_is_written_as_numpy_does_whatever_its_strides() {
        let frames = Array2::from_shape_fn((7, MOTION_DIM), |(t, i)| t as f32 + 0.01 * i as f32);
        let mut bytes = Vec::new();
        write_npy(frames.view(), &mut bytes).expect("memory");
        let values: Vec<f32> = frames.iter().copied().collect();
        assert_eq!(bytes, npy::write(&[7, MOTION_DIM], &values));

        let backwards = frames.slice(s![..;-2, ..]);
        let mut bytes = Vec::new();
        write_npy(backwards, &mut bytes).expect("memory");
        let read = read_f32(&bytes).expect("an array");
        assert_eq!(read.shape, [4, MOTION_DIM]);
        assert_eq!(read.values, backwards.iter().copied().collect::<Vec<f32>>());
    }

    #[test]
    fn a_group_is_written_with_an_axis_of_dancers() {
        let group = Array3::from_shape_fn((3, 5, MOTION_DIM), |(n, t, i)| {
            100.0 * n as f32 + t as f32 + 0.01 * i as f32
        });
        let turned = group.slice(s![..;-1, ..;2, ..]);
        let mut bytes = Vec::new();
        write_group_npy(turned, &mut bytes).expect("memory");
        let read = read_f32(&bytes).expect("an array");
        assert_eq!(read.shape, [3, 3, MOTION_DIM]);
        assert_eq!(read.values, turned.iter().copied().collect::<Vec<f32>>());
    }

    #[test]
    fn what_is_no_pose_is_refused_in_a_sentence() {
        let mut frames = Array2::zeros((3, MOTION_DIM));
        frames.column_mut(Channel::Quaternion.range().start).fill(1.0);
        let refusal = |frames: &Array2<f32>, format| {
            let error = poses(frames.view(), format).expect_err("no pose");
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput);
            error.to_string()
        };
        let none = Array2::zeros((0, MOTION_DIM));
        assert_eq!(
            refusal(&none, "BVH"),
            "motion has no frames, and BVH holds at least one; write it as npy or csv"
        );
        // Other channels may hold what they like.
        frames[[0, 3]] = f32::NAN;
        assert_eq!(poses(frames.view(), "glTF").expect("poses").len(), 3);
        frames[[2, 9]] = 0.0;
        assert_eq!(
            refusal(&frames, "glTF"),
            "quaternion norm is 0e0 at frame 2, and glTF needs a rotation; write the motion as npy \
             or csv to look at it"
        );
        frames[[1, 12]] = f32::INFINITY;
        assert_eq!(
            refusal(&frames, "glTF"),
            "channel quaternion_z is inf at frame 1, and glTF holds finite numbers alone; write the \
             motion as npy or csv to look at it"
        );
        frames[[1, 2]] = f32::NAN;
        assert!(
            refusal(&frames, "BVH").starts_with("channel position_z is NaN at frame 1, and BVH")
        );
    }
}
