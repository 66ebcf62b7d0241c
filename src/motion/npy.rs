//! Reads and writes NumPy `.npy` arrays of plain numbers (NumPy enhancement proposal 1).
//!
//! Our own rather than a crate's: `npyz` 0.9.1 and `ndarray-npy` 0.10.0 allocate the declared
//! header length, up to 4 GiB, before reading it, and `ndarray-npy` the declared array as well.

mod error;
mod header;
#[cfg(test)]
mod tests;

use std::io::{self, Read};

use crate::excerpt::clip;
pub use error::NpyError;
use header::{Dtype, DtypeKind, Header};

/// Most bytes one array may take in memory, and most that are read for it: 1 GiB.
pub const MAX_ARRAY_BYTES: u64 = 1 << 30;

/// Longest header text that is read; NumPy's own for a plain dtype is 118 bytes.
const MAX_HEADER_BYTES: u64 = 64 * 1024;

const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// Bytes read and converted at a time; a multiple of every item size.
const CHUNK_BYTES: usize = 64 * 1024;

/// An array with its axis lengths; a 0-d scalar has an empty `shape` and one value.
#[derive(Debug, Clone, PartialEq)]
pub struct NpyArray<T> {
    pub shape: Vec<usize>,
    /// In C order: the last axis varies fastest.
    pub values: Vec<T>,
}

/// Reads an array of any shape and plain numeric dtype as `f32`.
///
/// Booleans become 0 and 1, integers and `f8` are rounded to nearest; an `f8` beyond the range of
/// `f32` becomes ±infinity, for the caller's check of non-finite values to find. Bytes after the
/// data are ignored, as `numpy.load` ignores them. Errors: every [`NpyError`] but `Io`.
pub fn read_f32(bytes: &[u8]) -> Result<NpyArray<f32>, NpyError> {
    read_array(bytes, MAX_ARRAY_BYTES, bytes.len())
}

/// Reads an array of any shape and plain numeric dtype as `f64`; 64-bit integers are rounded to
/// nearest, all else is exact. Otherwise as [`read_f32`].
pub fn read_f64(bytes: &[u8]) -> Result<NpyArray<f64>, NpyError> {
    read_array(bytes, MAX_ARRAY_BYTES, bytes.len())
}

/// Reads as [`read_f32`] from a stream and refuses an array over `byte_limit` bytes (or over
/// [`MAX_ARRAY_BYTES`]); takes no more from the stream than header and data.
pub fn read_f32_from(reader: impl Read, byte_limit: u64) -> Result<NpyArray<f32>, NpyError> {
    read_array(reader, byte_limit, 0)
}

/// Reads as [`read_f64`] from a stream and refuses an array over `byte_limit` bytes (or over
/// [`MAX_ARRAY_BYTES`]); takes no more from the stream than header and data.
pub fn read_f64_from(reader: impl Read, byte_limit: u64) -> Result<NpyArray<f64>, NpyError> {
    read_array(reader, byte_limit, 0)
}

/// A number that [`write()`] can store.
pub trait Writable: Copy {
    /// NumPy's name of the type.
    const DESCR: &'static str;
    /// Appends the little-endian bytes.
    fn append_to(self, bytes: &mut Vec<u8>);
}

macro_rules! writable {
    ($type:ty, $descr:literal) => {
        impl Writable for $type {
            const DESCR: &'static str = $descr;
            fn append_to(self, bytes: &mut Vec<u8>) {
                bytes.extend_from_slice(&self.to_le_bytes());
            }
        }
    };
}
writable!(f32, "<f4");
writable!(f64, "<f8");
writable!(i64, "<i8");

/// Writes `values`, in C order, as a version 1.0 file equal byte for byte to `numpy.save`'s for
/// a C-order array of `shape`, of `<f4`, `<f8` or `<i8` as the values are.
///
/// # Panics
/// If the lengths in `shape` do not multiply to the number of values, or there are over 64.
pub fn write<T: Writable>(shape: &[usize], values: &[T]) -> Vec<u8> {
    let count = shape.iter().try_fold(1_usize, |count, &length| count.checked_mul(length));
    assert_eq!(count, Some(values.len()), "shape {shape:?} against {} values", values.len());
    let mut file = header::<T>(shape);
    file.reserve(size_of_val(values));
    for value in values {
        value.append_to(&mut file);
    }
    file
}

/// Returns what comes before the values, in C order, of an array of `shape`: see [`write()`].
///
/// # Panics
/// If there are over 64 axes.
pub fn header<T: Writable>(shape: &[usize]) -> Vec<u8> {
    assert!(shape.len() <= 64, "shape has {} axes and NumPy allows 64", shape.len());
    let lengths: Vec<String> = shape.iter().map(usize::to_string).collect();
    let comma = if shape.len() == 1 { "," } else { "" };
    let mut header = format!(
        "{{'descr': '{}', 'fortran_order': False, 'shape': ({}{comma}), }}",
        T::DESCR,
        lengths.join(", ")
    );
    // `numpy.lib.format` leaves room for the first axis to grow to 21 digits in place, then pads
    // with 1 to 64 spaces and a newline so that the data start at a multiple of 64 bytes.
    let growth = lengths.first().map_or(0, |first| 21_usize.saturating_sub(first.len()));
    let fixed = MAGIC.len() + 4 + header.len() + growth + 1;
    header.extend(std::iter::repeat_n(' ', growth + 64 - fixed % 64));
    header.push('\n');

    let mut bytes = Vec::with_capacity(MAGIC.len() + 4 + header.len());
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&[1, 0]);
    // 64 lengths of at most 20 digits stay far below the 65,535 bytes that version 1.0 can say.
    bytes.extend_from_slice(&(header.len() as u16).to_le_bytes());
    bytes.extend_from_slice(header.as_bytes());
    bytes
}

/// `at_hand_bytes` is how many bytes the reader surely holds, and so how much may be reserved
/// before reading; 0 lets the vector grow with what comes.
fn read_array<T: Element>(
    mut reader: impl Read,
    byte_limit: u64,
    at_hand_bytes: usize,
) -> Result<NpyArray<T>, NpyError> {
    let Header { dtype, fortran_order, shape } = read_header(&mut reader)?;
    let count = checked_count::<T>(&dtype, &shape, byte_limit.min(MAX_ARRAY_BYTES))?;
    let declared_bytes = count * dtype.size_bytes;

    let mut values = Vec::with_capacity(count.min(at_hand_bytes / dtype.size_bytes));
    let mut chunk = vec![0; declared_bytes.min(CHUNK_BYTES)];
    let mut found_bytes = 0;
    while found_bytes < declared_bytes {
        let wanted = chunk.len().min(declared_bytes - found_bytes);
        let found = read_up_to(&mut reader, &mut chunk[..wanted])?;
        found_bytes += found;
        if found < wanted {
            return Err(truncated("data", declared_bytes, found_bytes));
        }
        append(&dtype, &chunk[..wanted], &mut values);
    }
    if fortran_order {
        values = to_c_order(values, &shape);
    }
    Ok(NpyArray { shape, values })
}

fn read_header(reader: &mut impl Read) -> Result<Header, NpyError> {
    let mut start = [0; 8];
    let found = read_up_to(reader, &mut start)?;
    if found == 0 {
        return Err(NpyError::Empty);
    }
    let magic = &start[..found.min(MAGIC.len())];
    if !MAGIC.starts_with(magic) {
        // A few more bytes make the message tell what the file is.
        let mut more = [0; 16];
        let found_more = read_up_to(reader, &mut more)?;
        return Err(NpyError::not_npy(&[&start[..found], &more[..found_more]].concat()));
    }
    if found < start.len() {
        return Err(truncated("magic", start.len(), found));
    }
    let [.., major, minor] = start;
    let length_size = match (major, minor) {
        (1, 0) => 2,
        (2 | 3, 0) => 4,
        _ => return Err(NpyError::Version { major, minor }),
    };
    let mut length = [0; 4];
    let found = read_up_to(reader, &mut length[..length_size])?;
    if found < length_size {
        return Err(truncated("header length", length_size, found));
    }
    let declared_bytes = u64::from(u32::from_le_bytes(length));
    if declared_bytes > MAX_HEADER_BYTES {
        return Err(NpyError::HeaderTooLong { declared_bytes, limit_bytes: MAX_HEADER_BYTES });
    }
    let mut text = Vec::new();
    reader.take(declared_bytes).read_to_end(&mut text).map_err(NpyError::Io)?;
    if (text.len() as u64) < declared_bytes {
        return Err(truncated("header", declared_bytes as usize, text.len()));
    }
    header::parse(&text)
}

/// The number of values, once it is sure that they fit the limit as stored and as `T`.
fn checked_count<T>(dtype: &Dtype, shape: &[usize], limit_bytes: u64) -> Result<usize, NpyError> {
    let item_bytes = dtype.size_bytes.max(size_of::<T>()) as u64;
    // An axis of length 0 counts as 1 here, so that (0, 2^63) is refused, as NumPy does.
    let declared_bytes =
        shape.iter().fold(item_bytes, |bytes, &length| bytes.saturating_mul(length.max(1) as u64));
    if declared_bytes > limit_bytes {
        let lengths: Vec<String> = shape.iter().map(usize::to_string).collect();
        let shape = clip(&lengths.join(", "));
        let descr = dtype.descr.clone();
        return Err(NpyError::TooLarge { shape, descr, declared_bytes, limit_bytes });
    }
    Ok(shape.iter().product())
}

/// Fills `buffer` as far as the reader has bytes; returns how many.
fn read_up_to(reader: &mut impl Read, buffer: &mut [u8]) -> Result<usize, NpyError> {
    let mut filled = 0;
    while filled < buffer.len() {
        match reader.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(read) => filled += read,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(NpyError::Io(error)),
        }
    }
    Ok(filled)
}

fn truncated(part: &'static str, declared_bytes: usize, found_bytes: usize) -> NpyError {
    let (declared_bytes, found_bytes) = (declared_bytes as u64, found_bytes as u64);
    NpyError::Truncated { part, declared_bytes, found_bytes }
}

/// A type that stored numbers are converted to, each with one rounding.
trait Element: Copy {
    fn from_i64(value: i64) -> Self;
    fn from_u64(value: u64) -> Self;
    fn from_f32(value: f32) -> Self;
    fn from_f64(value: f64) -> Self;
}

macro_rules! element {
    ($type:ty) => {
        impl Element for $type {
            fn from_i64(value: i64) -> Self {
                value as Self
            }
            fn from_u64(value: u64) -> Self {
                value as Self
            }
            fn from_f32(value: f32) -> Self {
                value as Self
            }
            fn from_f64(value: f64) -> Self {
                value as Self
            }
        }
    };
}

element!(f32);
element!(f64);

/// Converts whole items and appends them.
fn append<T: Element>(dtype: &Dtype, bytes: &[u8], values: &mut Vec<T>) {
    let big = dtype.big_endian;
    match (dtype.kind, dtype.size_bytes) {
        (DtypeKind::Float, 4) => extend(values, bytes, big, |b| T::from_f32(f32::from_le_bytes(b))),
        (DtypeKind::Float, 2) => {
            extend(values, bytes, big, |b| T::from_f32(half::f16::from_le_bytes(b).to_f32()));
        }
        (DtypeKind::Float, _) => extend(values, bytes, big, |b| T::from_f64(f64::from_le_bytes(b))),
        (DtypeKind::Bool, _) => extend(values, bytes, big, |[b]| T::from_u64(u64::from(b != 0))),
        (DtypeKind::Int, 1) => {
            extend(values, bytes, big, |b| T::from_i64(i8::from_le_bytes(b).into()))
        }
        (DtypeKind::Int, 2) => {
            extend(values, bytes, big, |b| T::from_i64(i16::from_le_bytes(b).into()))
        }
        (DtypeKind::Int, 4) => {
            extend(values, bytes, big, |b| T::from_i64(i32::from_le_bytes(b).into()))
        }
        (DtypeKind::Int, _) => extend(values, bytes, big, |b| T::from_i64(i64::from_le_bytes(b))),
        (DtypeKind::Uint, 1) => extend(values, bytes, big, |[b]| T::from_u64(b.into())),
        (DtypeKind::Uint, 2) => {
            extend(values, bytes, big, |b| T::from_u64(u16::from_le_bytes(b).into()));
        }
        (DtypeKind::Uint, 4) => {
            extend(values, bytes, big, |b| T::from_u64(u32::from_le_bytes(b).into()));
        }
        (DtypeKind::Uint, _) => extend(values, bytes, big, |b| T::from_u64(u64::from_le_bytes(b))),
    }
}

fn extend<T, const N: usize>(
    values: &mut Vec<T>,
    bytes: &[u8],
    big_endian: bool,
    convert: impl Fn([u8; N]) -> T,
) {
    let (items, _) = bytes.as_chunks::<N>();
    // Two loops, so that little-endian f4 to f32 compiles to a plain copy.
    if big_endian {
        values.extend(items.iter().map(|item| {
            let mut item = *item;
            item.reverse();
            convert(item)
        }));
    } else {
        values.extend(items.iter().map(|item| convert(*item)));
    }
}

/// Reorders values whose first axis varies fastest; `shape` multiplies to their number.
fn to_c_order<T: Copy>(values: Vec<T>, shape: &[usize]) -> Vec<T> {
    let Some((&row_length, outer)) = shape.split_last() else { return values };
    if outer.is_empty() || values.is_empty() {
        return values;
    }
    let mut strides = Vec::with_capacity(shape.len());
    let mut stride = 1;
    for &length in shape {
        strides.push(stride);
        stride *= length;
    }
    let row_stride = strides[outer.len()];
    let mut ordered = Vec::with_capacity(values.len());
    let mut index = vec![0; outer.len()];
    let mut row_start = 0;
    while ordered.len() < values.len() {
        let row = values[row_start..].iter().step_by(row_stride).take(row_length);
        ordered.extend(row.copied());
        for axis in (0..outer.len()).rev() {
            index[axis] += 1;
            row_start += strides[axis];
            if index[axis] < outer[axis] {
                break;
            }
            row_start -= strides[axis] * outer[axis];
            index[axis] = 0;
        }
    }
    ordered
}
