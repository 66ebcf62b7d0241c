//! Why a phrase was refused: one kind, one sentence.

use std::fmt;

/// Classes of failure, as the `kind` column of `failures` spells them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FailureKind {
    AudioHeader,
    BeatsFormat,
    BvhFormat,
    ChannelLimit,
    DuplicateId,
    EmptyFile,
    Layout,
    LengthMismatch,
    MissingKey,
    Name,
    NonFinite,
    NotAFile,
    NpyFormat,
    NpzFormat,
    /// The program itself broke on the phrase: a defect of ours, kept from stopping the job.
    Panic,
    Pickle,
    QuaternionNorm,
    Shape,
    Symlink,
    TooLarge,
    Truncated,
    Unreadable,
}

impl FailureKind {
    /// Returns the kind as tables spell it.
    pub fn name(self) -> &'static str {
        match self {
            FailureKind::AudioHeader => "audio_header",
            FailureKind::BeatsFormat => "beats_format",
            FailureKind::BvhFormat => "bvh_format",
            FailureKind::ChannelLimit => "channel_limit",
            FailureKind::DuplicateId => "duplicate_id",
            FailureKind::EmptyFile => "empty_file",
            FailureKind::Layout => "layout",
            FailureKind::LengthMismatch => "length_mismatch",
            FailureKind::MissingKey => "missing_key",
            FailureKind::Name => "name",
            FailureKind::NonFinite => "non_finite",
            FailureKind::NotAFile => "not_a_file",
            FailureKind::NpyFormat => "npy_format",
            FailureKind::NpzFormat => "npz_format",
            FailureKind::Panic => "panic",
            FailureKind::Pickle => "pickle",
            FailureKind::QuaternionNorm => "quaternion_norm",
            FailureKind::Shape => "shape",
            FailureKind::Symlink => "symlink",
            FailureKind::TooLarge => "too_large",
            FailureKind::Truncated => "truncated",
            FailureKind::Unreadable => "unreadable",
        }
    }
}

/// A refusal of a phrase.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    pub kind: FailureKind,
    /// The file or folder at fault, below the source.
    pub path: String,
    /// What is wrong and what to do, without the phrase's name.
    pub message: String,
}

impl Failure {
    pub fn new(kind: FailureKind, path: &str, message: impl fmt::Display) -> Self {
        Self { kind, path: path.to_owned(), message: message.to_string() }
    }
}

impl FailureKind {
    /// Every kind, for looking one up by the name that a reader gives.
    const ALL: [FailureKind; 22] = [
        FailureKind::AudioHeader,
        FailureKind::BeatsFormat,
        FailureKind::BvhFormat,
        FailureKind::ChannelLimit,
        FailureKind::DuplicateId,
        FailureKind::EmptyFile,
        FailureKind::Layout,
        FailureKind::LengthMismatch,
        FailureKind::MissingKey,
        FailureKind::Name,
        FailureKind::NonFinite,
        FailureKind::NotAFile,
        FailureKind::NpyFormat,
        FailureKind::NpzFormat,
        FailureKind::Panic,
        FailureKind::Pickle,
        FailureKind::QuaternionNorm,
        FailureKind::Shape,
        FailureKind::Symlink,
        FailureKind::TooLarge,
        FailureKind::Truncated,
        FailureKind::Unreadable,
    ];

    /// Returns the kind that a reader names.
    ///
    /// # Panics
    /// When a reader names a kind that does not exist.
    pub fn of_reader(name: &str) -> Self {
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == name)
            .unwrap_or_else(|| panic!("invariant: readers know their failure kinds, not {name:?}"))
    }
}
