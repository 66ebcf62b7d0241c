//! The reference's feature files: `features.npz` with one array per block.

use std::io::{self, Seek, Write};

use ndarray::{ArrayView2, s};

use crate::audio::{BLOCKS, Block};
use crate::motion::npz::{Npz, NpzError, NpzWriter};
use crate::stages::failure::{Failure, FailureKind};

/// Largest array of a feature file: over four hours of mel bands. A small archive can hold any
/// amount of zeros, so this and not the file's size bounds the memory that it takes.
const MAX_ARRAY_BYTES: u64 = 256 << 20;

/// The content of a feature file beside its arrays.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureFile {
    pub n_frames: usize,
    pub tempo_bpm: Option<f64>,
    pub beat_times_s: Vec<f64>,
}

/// Reads and checks a feature file, and calls `visit` with each block, its values (`[len, frames]`
/// row by row) and the number of frames.
///
/// # Errors
/// A [`Failure`] that names the file, the array, and what was expected of it.
pub fn read_features(
    path: &str,
    bytes: &[u8],
    mut visit: impl FnMut(Block, &[f32], usize),
) -> Result<FeatureFile, Failure> {
    let from_npz = |e: NpzError| Failure::of(path, e.kind(), &e);
    let mut npz = Npz::open_limited(bytes, MAX_ARRAY_BYTES).map_err(from_npz)?;
    let mut n_frames = None;
    for block in BLOCKS {
        let key = block.name;
        let array = npz.read_f32(key).map_err(from_npz)?;
        let expected = match block.len {
            1 => "[frames]".to_owned(),
            n => format!("[{n}, frames]"),
        };
        let frames = match (array.shape.as_slice(), block.len) {
            (&[frames], 1) => Some(frames),
            (&[rows, frames], len) if rows == len => Some(frames),
            _ => None,
        };
        let Some(frames) = frames.filter(|&frames| frames > 0) else {
            let message = format!("{path}: {key} has shape {:?}, expected {expected}", array.shape);
            return Err(Failure::new(FailureKind::Shape, path, message));
        };
        let n = *n_frames.get_or_insert(frames);
        if n != frames {
            let message =
                format!("{path}: {key} has {frames} frames but mel has {n}; extract them again");
            return Err(Failure::new(FailureKind::Shape, path, message));
        }
        if let Some(i) = array.values.iter().position(|x| !x.is_finite()) {
            let count = array.values.iter().filter(|x| !x.is_finite()).count();
            let (value, frame) = (array.values[i], i % frames);
            let message = format!(
                "{path}: {key} is {value} at frame {frame} ({count} non-finite values in all); \
                 extract the features again"
            );
            return Err(Failure::new(FailureKind::NonFinite, path, message));
        }
        visit(block, &array.values, frames);
    }
    let has = |npz: &Npz<'_>, key: &str| npz.keys().iter().any(|k| k == key);
    let n_frames = n_frames.unwrap_or(0);
    let mut file = FeatureFile { n_frames, tempo_bpm: None, beat_times_s: Vec::new() };
    if has(&npz, "tempo") {
        let tempo = npz.read_f64("tempo").map_err(from_npz)?;
        // librosa reports 0 for a song without a pulse; that is "no tempo", not a broken file.
        file.tempo_bpm = tempo.values.first().copied().filter(|bpm| bpm.is_finite() && *bpm > 0.0);
    }
    if has(&npz, "beat_times") {
        let beats = npz.read_f64("beat_times").map_err(from_npz)?;
        if let Some(time_s) = beats.values.iter().find(|t| !t.is_finite() || **t < 0.0) {
            let message =
                format!("{path}: beat_times holds {time_s} s; times are finite and not negative");
            return Err(Failure::new(FailureKind::NonFinite, path, message));
        }
        file.beat_times_s = beats.values;
    }
    Ok(file)
}

/// Adds the blocks of features to a feature file; frames of shape `[T, 163]`.
///
/// # Errors
/// The error of the output.
pub fn write_blocks<W: Write + Seek>(
    npz: &mut NpzWriter<W>,
    frames: ArrayView2<'_, f32>,
) -> io::Result<()> {
    let n_frames = frames.nrows();
    let mut first = 0;
    for block in BLOCKS {
        // Columns of the frames are rows of the reference's arrays.
        let values = frames.slice_move(s![.., first..first + block.len]).reversed_axes();
        let shape = [block.len, n_frames];
        let shape = if block.len == 1 { &shape[1..] } else { &shape[..] };
        npz.add(block.name, shape, values.iter().copied())?;
        first += block.len;
    }
    Ok(())
}
