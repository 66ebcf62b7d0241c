//! Why an item was refused: one kind, one sentence.

use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::store::digest;

/// Classes of failure, as the `kind` column of `failures` spells them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FailureKind {
    AudioCodec,
    AudioData,
    AudioHeader,
    AudioNoSamples,
    AudioNotFinite,
    AudioSampleRate,
    BeatsFormat,
    BvhFormat,
    /// The file was written to while it was read, or since it was ingested.
    Changed,
    ChannelLimit,
    /// A constraint that the track cannot keep.
    Constraint,
    DuplicateId,
    EmptyFile,
    /// What runs a model stopped.
    Engine,
    Layout,
    LengthMismatch,
    MissingKey,
    Name,
    /// A song without enough beats to dance to.
    NoBeats,
    /// A phrase with nothing to dance to.
    NoMusic,
    /// A capture that nothing can be danced of.
    NoPrimitive,
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
    /// A tempo that nobody dances to.
    Tempo,
    Timeout,
    TooLarge,
    TooLong,
    TooShort,
    Truncated,
    Unreadable,
    Unwritable,
    /// What is in the store was written by another version of the program.
    Version,
}

impl FailureKind {
    /// Returns the kind as tables spell it.
    pub fn name(self) -> &'static str {
        match self {
            FailureKind::AudioCodec => "audio_codec",
            FailureKind::AudioData => "audio_data",
            FailureKind::AudioHeader => "audio_header",
            FailureKind::AudioNoSamples => "audio_no_samples",
            FailureKind::AudioNotFinite => "audio_not_finite",
            FailureKind::AudioSampleRate => "audio_sample_rate",
            FailureKind::BeatsFormat => "beats_format",
            FailureKind::BvhFormat => "bvh_format",
            FailureKind::Changed => "changed",
            FailureKind::ChannelLimit => "channel_limit",
            FailureKind::Constraint => "constraint",
            FailureKind::DuplicateId => "duplicate_id",
            FailureKind::EmptyFile => "empty_file",
            FailureKind::Engine => "engine",
            FailureKind::Layout => "layout",
            FailureKind::LengthMismatch => "length_mismatch",
            FailureKind::MissingKey => "missing_key",
            FailureKind::Name => "name",
            FailureKind::NoBeats => "no_beats",
            FailureKind::NoMusic => "no_music",
            FailureKind::NoPrimitive => "no_primitive",
            FailureKind::NonFinite => "non_finite",
            FailureKind::NotAFile => "not_a_file",
            FailureKind::NpyFormat => "npy_format",
            FailureKind::NpzFormat => "npz_format",
            FailureKind::Panic => "panic",
            FailureKind::Pickle => "pickle",
            FailureKind::QuaternionNorm => "quaternion_norm",
            FailureKind::Shape => "shape",
            FailureKind::Symlink => "symlink",
            FailureKind::Tempo => "tempo",
            FailureKind::Timeout => "timeout",
            FailureKind::TooLarge => "too_large",
            FailureKind::TooLong => "too_long",
            FailureKind::TooShort => "too_short",
            FailureKind::Truncated => "truncated",
            FailureKind::Unreadable => "unreadable",
            FailureKind::Unwritable => "unwritable",
            FailureKind::Version => "version",
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

    /// Builds a failure from a reader's own kind and sentence, naming the file.
    pub fn of(path: &str, kind: &str, error: &dyn fmt::Display) -> Self {
        Self::new(FailureKind::of_reader(kind), path, format!("{path}: {error}"))
    }

    /// Returns a digest of kind and message, by which a failure is known again.
    pub fn digest(&self) -> String {
        digest(format!("{}\n{}", self.kind.name(), self.message).as_bytes())[..32].to_owned()
    }
}

/// Does the work on one item; a defect of ours costs the item, not the job.
///
/// # Errors
/// What `work` says, or [`FailureKind::Panic`] for the file at `path`.
pub fn guarded<T>(path: &str, work: impl FnOnce() -> Result<T, Failure>) -> Result<T, Failure> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let said = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied())
            .unwrap_or("no message");
        let message =
            format!("the program broke on this phrase ({said}); please report it with the file");
        Err(Failure::new(FailureKind::Panic, path, message))
    })
}

impl FailureKind {
    /// Every kind, for looking one up by the name that a reader gives.
    const ALL: [FailureKind; 39] = [
        FailureKind::AudioCodec,
        FailureKind::AudioData,
        FailureKind::AudioHeader,
        FailureKind::AudioNoSamples,
        FailureKind::AudioNotFinite,
        FailureKind::AudioSampleRate,
        FailureKind::BeatsFormat,
        FailureKind::BvhFormat,
        FailureKind::Changed,
        FailureKind::ChannelLimit,
        FailureKind::Constraint,
        FailureKind::DuplicateId,
        FailureKind::EmptyFile,
        FailureKind::Engine,
        FailureKind::Layout,
        FailureKind::LengthMismatch,
        FailureKind::MissingKey,
        FailureKind::Name,
        FailureKind::NoBeats,
        FailureKind::NoMusic,
        FailureKind::NoPrimitive,
        FailureKind::NonFinite,
        FailureKind::NotAFile,
        FailureKind::NpyFormat,
        FailureKind::NpzFormat,
        FailureKind::Panic,
        FailureKind::Pickle,
        FailureKind::QuaternionNorm,
        FailureKind::Shape,
        FailureKind::Symlink,
        FailureKind::Tempo,
        FailureKind::Timeout,
        FailureKind::TooLarge,
        FailureKind::TooLong,
        FailureKind::TooShort,
        FailureKind::Truncated,
        FailureKind::Unreadable,
        FailureKind::Unwritable,
        FailureKind::Version,
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
