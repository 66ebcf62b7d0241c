//! What can be wrong with a `.npy` file, each as one sentence with its values and the way out.

use std::io;

use crate::excerpt::preview;

/// Why bytes could not be read as a numeric NumPy array.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NpyError {
    /// No bytes at all.
    #[error(
        "npy file is empty (0 bytes); the download or copy that made it failed, fetch it again"
    )]
    Empty,
    /// The six magic bytes are missing.
    #[error("not an npy file: it starts with {found}; {way_out}")]
    NotNpy { found: String, way_out: &'static str },
    /// A format version other than 1.0, 2.0 and 3.0.
    #[error(
        "npy format version {major}.{minor} is unknown; versions 1.0, 2.0 and 3.0 are read, \
         save the array again with numpy.save"
    )]
    Version { major: u8, minor: u8 },
    /// The header length field exceeds what any numeric array needs.
    #[error(
        "npy header declares {declared_bytes} bytes of text, over the limit of {limit_bytes}; \
         the file is damaged or no plain numeric array, save it again with numpy.save"
    )]
    HeaderTooLong { declared_bytes: u64, limit_bytes: u64 },
    /// The header text is not the dictionary the format asks for.
    #[error(
        "npy header is malformed at byte {at_byte}: {reason}; save the array again with numpy.save"
    )]
    Header { at_byte: usize, reason: String },
    /// A data type that is not a plain number.
    #[error("npy dtype {descr:?} holds {what}, which are not read; {way_out}")]
    Dtype { descr: String, what: &'static str, way_out: &'static str },
    /// A structured (record) data type.
    #[error(
        "npy dtype is structured with {n_fields} fields, which are not read; save each field as \
         an array of its own, for example numpy.savez(path, **{{n: a[n] for n in a.dtype.names}})"
    )]
    Structured { n_fields: usize },
    /// Python objects, stored as a pickle.
    #[error(
        "npy holds Python objects (pickle), which are never executed; save it with \
         numpy.save(..., allow_pickle=False) from a numeric array"
    )]
    Pickle,
    /// The declared array is larger than the limit.
    #[error(
        "npy header declares shape ({shape}) of {descr:?}, at least {declared_bytes} bytes in \
         memory, over the limit of {limit_bytes}; split the array into smaller files"
    )]
    TooLarge { shape: String, descr: String, declared_bytes: u64, limit_bytes: u64 },
    /// Fewer bytes than declared.
    #[error(
        "npy {part} is truncated: {declared_bytes} bytes are declared and {found_bytes} found; \
         the file was cut short, copy or download it again"
    )]
    Truncated { part: &'static str, declared_bytes: u64, found_bytes: u64 },
    /// The reader below failed.
    #[error("npy bytes could not be read: {0}; check the disk or the archive they come from")]
    Io(#[source] io::Error),
}

impl NpyError {
    /// The error's class in reports: `npy_format`, `empty_file`, `too_large`, `pickle` or
    /// `truncated`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Empty => "empty_file",
            Self::HeaderTooLong { .. } | Self::TooLarge { .. } => "too_large",
            Self::Pickle => "pickle",
            Self::Truncated { .. } => "truncated",
            Self::NotNpy { .. }
            | Self::Version { .. }
            | Self::Header { .. }
            | Self::Dtype { .. }
            | Self::Structured { .. }
            | Self::Io(_) => "npy_format",
        }
    }

    /// The error for bytes that begin otherwise than an npy file.
    pub(super) fn not_npy(start: &[u8]) -> Self {
        // Protocol 2 to 5 pickles open with the PROTO opcode, 0x80, and the protocol number.
        if matches!(start, [0x80, 2..=5, ..]) {
            return Self::Pickle;
        }
        let way_out = if start.starts_with(b"PK") {
            "it is a zip archive, name it .npz to have its members read"
        } else if start.trim_ascii_start().starts_with(b"<") {
            "was an error page saved in place of the array?"
        } else {
            "save the array with numpy.save"
        };
        Self::NotNpy { found: preview(start), way_out }
    }
}
