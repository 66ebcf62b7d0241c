//! Reads arrays out of NumPy `.npz` archives, and writes them: zip files whose members are `.npy` files.
//!
//! Sources: `numpy.savez` and `numpy.savez_compressed`; PKWARE APPNOTE sections 4.3 (layout) and
//! 4.5.3 (zip64). The declared sizes of a member are never trusted: reading stops at a limit.

#[cfg(test)]
mod tests;

use std::io::{self, Cursor, Read, Seek, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter};

use super::npy::{self, MAX_ARRAY_BYTES, NpyArray, NpyError, Writable};
use crate::excerpt::preview;

/// Room for a member's header over the limit on its array.
const HEADER_ROOM_BYTES: u64 = 128 * 1024;

/// Most keys named in a message.
const MAX_LISTED_KEYS: usize = 20;

/// Why an archive or one of its arrays could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NpzError {
    /// No bytes at all.
    #[error(
        "npz file is empty (0 bytes); the download or copy that made it failed, fetch it again"
    )]
    Empty,
    /// The bytes are no zip archive.
    #[error("not an npz file: it starts with {found}; {way_out}")]
    NotNpz { found: String, way_out: &'static str },
    /// A zip archive without its end.
    #[error(
        "npz file is truncated: it starts as a zip archive, but no table of members ends its \
         {found_bytes} bytes; the file was cut short, copy or download it again"
    )]
    Truncated { found_bytes: u64 },
    /// The table of members contradicts itself or the file.
    #[error("npz table of members is damaged: {reason}; copy or download the file again")]
    Damaged { reason: String },
    /// Two members have one key, and readers would disagree on which of them counts.
    #[error("npz key {key:?} names two members; write the file again with each key once")]
    DuplicateKey { key: String },
    /// No such member.
    #[error("npz has no key {key:?}; it holds {}", list(.keys))]
    MissingKey { key: String, keys: Vec<String> },
    /// A member that needs a password.
    #[error("npz member {key:?} is encrypted; write it without a password")]
    Encrypted { key: String },
    /// A member compressed otherwise than NumPy does.
    #[error(
        "npz member {key:?} is compressed with zip method {method}, and only stored (0) and \
         deflated (8) members are read; write the file with numpy.savez_compressed"
    )]
    Compression { key: String, method: String },
    /// A member whose bytes do not decompress or do not match their checksum.
    #[error("npz member {key:?} is damaged: {reason}; copy or download the file again")]
    DamagedMember { key: String, reason: String },
    /// A member that goes on past the limit.
    #[error(
        "npz member {key:?} decompresses to {found_bytes} bytes or more, over the limit of \
         {limit_bytes}; split the array into smaller files"
    )]
    TooLarge { key: String, found_bytes: u64, limit_bytes: u64 },
    /// A member that is no readable array.
    #[error("npz member {key:?}: {source}")]
    Member { key: String, source: NpyError },
}

impl NpzError {
    /// The error's class in reports: `npz_format`, `missing_key`, or one of [`NpyError::kind`].
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Empty => "empty_file",
            Self::Truncated { .. } => "truncated",
            Self::MissingKey { .. } => "missing_key",
            Self::TooLarge { .. } => "too_large",
            Self::Member { source, .. } => source.kind(),
            Self::NotNpz { .. }
            | Self::Damaged { .. }
            | Self::DuplicateKey { .. }
            | Self::Encrypted { .. }
            | Self::Compression { .. }
            | Self::DamagedMember { .. } => "npz_format",
        }
    }
}

fn list(keys: &[String]) -> String {
    if keys.is_empty() {
        return "no members at all".to_owned();
    }
    let named: Vec<&str> = keys.iter().take(MAX_LISTED_KEYS).map(String::as_str).collect();
    let more = match keys.len().saturating_sub(MAX_LISTED_KEYS) {
        0 => String::new(),
        count => format!(" and {count} more"),
    };
    format!("{}{more}", named.join(", "))
}

/// Writes an archive of `.npy` members, stored as they are (`numpy.savez`), one after the other.
///
/// The same members give the same bytes: no member carries a time.
pub struct NpzWriter<W: Write + Seek> {
    archive: ZipWriter<W>,
    values: Vec<u8>,
}

/// Bytes of an array that are written at once.
const PIECE_BYTES: usize = 64 << 10;

impl<W: Write + Seek> NpzWriter<W> {
    /// Starts an archive.
    pub fn new(out: W) -> Self {
        Self { archive: ZipWriter::new(out), values: Vec::new() }
    }

    /// Adds an array of `shape`, whose values come in C order.
    ///
    /// # Errors
    /// The error of the output.
    ///
    /// # Panics
    /// If the values are not as many as the shape says.
    pub fn add<T: Writable>(
        &mut self,
        key: &str,
        shape: &[usize],
        values: impl IntoIterator<Item = T>,
    ) -> io::Result<()> {
        let n_values: usize = shape.iter().product();
        let n_bytes = n_values as u64 * size_of::<T>() as u64;
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .last_modified_time(DateTime::default())
            // Beyond 4 GiB a member needs fields that must be asked for up front.
            .large_file(n_bytes > u64::from(u32::MAX / 2));
        self.archive.start_file(format!("{key}.npy"), options)?;
        self.archive.write_all(&npy::header::<T>(shape))?;
        let mut n_written = 0;
        self.values.clear();
        for value in values {
            value.append_to(&mut self.values);
            n_written += 1;
            if self.values.len() >= PIECE_BYTES {
                self.archive.write_all(&self.values)?;
                self.values.clear();
            }
        }
        assert_eq!(n_written, n_values, "values of {key}, shape {shape:?}");
        self.archive.write_all(&self.values)
    }

    /// Ends the archive and returns the output.
    ///
    /// # Errors
    /// The error of the output.
    pub fn finish(self) -> io::Result<W> {
        Ok(self.archive.finish()?)
    }
}

/// An opened archive over bytes in memory.
#[derive(Debug)]
pub struct Npz<'a> {
    archive: ZipArchive<Cursor<&'a [u8]>>,
    /// One for each member, in the archive's order.
    keys: Vec<String>,
    limit_bytes: u64,
}

impl<'a> Npz<'a> {
    /// Reads the table of members; arrays may take up to [`MAX_ARRAY_BYTES`] each.
    ///
    /// Errors: [`NpzError`] variants that concern the whole archive.
    pub fn open(bytes: &'a [u8]) -> Result<Self, NpzError> {
        Self::open_limited(bytes, MAX_ARRAY_BYTES)
    }

    /// Reads the table of members; arrays may take up to `limit_bytes` each.
    ///
    /// Errors: as [`Npz::open`].
    pub fn open_limited(bytes: &'a [u8], limit_bytes: u64) -> Result<Self, NpzError> {
        if bytes.is_empty() {
            return Err(NpzError::Empty);
        }
        // Text or a bare array can hold a whole archive further on; it is still no npz file.
        if !bytes.starts_with(b"PK") {
            return Err(not_npz(bytes));
        }
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|error| {
            // The end record's signature, APPNOTE section 4.3.16.
            if bytes.windows(4).any(|window| window == b"PK\x05\x06") {
                NpzError::Damaged { reason: error.to_string() }
            } else {
                NpzError::Truncated { found_bytes: bytes.len() as u64 }
            }
        })?;
        let mut keys = Vec::with_capacity(archive.len());
        for name in archive.file_names() {
            let name = name.map_err(|error| NpzError::Damaged { reason: error.to_string() })?;
            keys.push(name.strip_suffix(".npy").unwrap_or(&name).to_owned());
        }
        if archive.has_duplicate_names() {
            let key = first_repeated_name(bytes, archive.central_directory_start());
            return Err(NpzError::DuplicateKey { key });
        }
        let mut sorted: Vec<&String> = keys.iter().collect();
        sorted.sort_unstable();
        if let Some(pair) = sorted.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(NpzError::DuplicateKey { key: pair[0].clone() });
        }
        Ok(Self { archive, keys, limit_bytes: limit_bytes.min(MAX_ARRAY_BYTES) })
    }

    /// The members' names without `.npy`, in the archive's order.
    pub fn keys(&self) -> &[String] {
        &self.keys
    }

    /// Reads one array as [`npy::read_f32`] does and verifies the member's CRC-32.
    ///
    /// Errors: [`NpzError`] variants that concern one member.
    pub fn read_f32(&mut self, key: &str) -> Result<NpyArray<f32>, NpzError> {
        self.read(key, |reader, limit_bytes| npy::read_f32_from(reader, limit_bytes))
    }

    /// Reads one array as [`npy::read_f64`] does and verifies the member's CRC-32.
    ///
    /// Errors: [`NpzError`] variants that concern one member.
    pub fn read_f64(&mut self, key: &str) -> Result<NpyArray<f64>, NpzError> {
        self.read(key, |reader, limit_bytes| npy::read_f64_from(reader, limit_bytes))
    }

    fn read<T>(
        &mut self,
        key: &str,
        read_array: impl FnOnce(&mut dyn Read, u64) -> Result<NpyArray<T>, NpyError>,
    ) -> Result<NpyArray<T>, NpzError> {
        let key = key.to_owned();
        let Some(index) = self.keys.iter().position(|other| *other == key) else {
            return Err(NpzError::MissingKey { key, keys: self.keys.clone() });
        };
        let damaged = |reason: String| NpzError::DamagedMember { key: key.clone(), reason };
        let entry = self.archive.by_index_data(index).map_err(|e| damaged(e.to_string()))?;
        if entry.encrypted() {
            return Err(NpzError::Encrypted { key });
        }
        match entry.compression() {
            CompressionMethod::Stored | CompressionMethod::Deflated => {}
            other => {
                let method = match other {
                    #[allow(deprecated)]
                    CompressionMethod::Unsupported(number) => number.to_string(),
                    named => named.to_string(),
                };
                return Err(NpzError::Compression { key, method });
            }
        }
        let mut member = self.archive.by_index(index).map_err(|e| damaged(e.to_string()))?;
        let array = match read_array(&mut member, self.limit_bytes) {
            Ok(array) => array,
            Err(NpyError::Io(error)) => return Err(damaged(io_reason(&error))),
            Err(source) => return Err(NpzError::Member { key, source }),
        };
        // The checksum is only compared at the member's end, so the rest is read and dropped.
        let limit_bytes = self.limit_bytes.saturating_add(HEADER_ROOM_BYTES);
        let mut rest = member.take(limit_bytes);
        let found_bytes = std::io::copy(&mut rest, &mut std::io::sink())
            .map_err(|error| damaged(io_reason(&error)))?;
        if found_bytes == limit_bytes {
            return Err(NpzError::TooLarge { key, found_bytes, limit_bytes: self.limit_bytes });
        }
        Ok(array)
    }
}

/// The `zip` crate's wording for a failed checksum says neither which nor of what.
fn io_reason(error: &std::io::Error) -> String {
    match error.to_string().as_str() {
        "Invalid checksum" => "its bytes do not match its CRC-32".to_owned(),
        other => other.to_owned(),
    }
}

fn not_npz(bytes: &[u8]) -> NpzError {
    let way_out = if bytes.starts_with(b"\x93NUMPY") {
        "it is a single array, name it .npy"
    } else if bytes.trim_ascii_start().starts_with(b"<") {
        "was an error page saved in place of the archive?"
    } else {
        "save the arrays with numpy.savez"
    };
    NpzError::NotNpz { found: preview(bytes), way_out }
}

/// The first name that the table of members holds twice, for the message; the `zip` crate says
/// only that there is one. Layout: APPNOTE section 4.3.12.
fn first_repeated_name(bytes: &[u8], table_start: u64) -> String {
    let mut seen = std::collections::BTreeSet::new();
    let mut rest = usize::try_from(table_start).ok().and_then(|start| bytes.get(start..));
    while let Some([b'P', b'K', 1, 2, ..]) = rest {
        let record = rest.unwrap_or_default();
        let length = |at: usize| match record.get(at..at + 2) {
            Some(&[low, high]) => usize::from(u16::from_le_bytes([low, high])),
            _ => 0,
        };
        let name_end = 46 + length(28);
        let name = record.get(46..name_end).unwrap_or_default();
        if !seen.insert(name) {
            let name = String::from_utf8_lossy(name);
            return name.strip_suffix(".npy").unwrap_or(&name).to_owned();
        }
        rest = record.get(name_end + length(30) + length(32)..);
    }
    String::new()
}
