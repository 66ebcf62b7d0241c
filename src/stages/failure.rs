//! Why an item was refused: one kind, one sentence.

use std::fmt;
use std::io::{self, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::store::{digest, one_line};

/// Spells each kind once: its name here, its name in tables, and its place among all.
macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident = $name:literal,)*) => {
        /// Classes of failure, as the `kind` column of `failures` spells them.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum FailureKind {
            $($(#[$doc])* $kind,)*
        }

        impl FailureKind {
            /// Every kind, for looking one up by the name that a reader gives.
            const ALL: &'static [Self] = &[$(Self::$kind,)*];

            /// Returns the kind as tables spell it.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => $name,)*
                }
            }
        }
    };
}

kinds! {
    AbcFormat = "abc_format",
    AudioCodec = "audio_codec",
    AudioData = "audio_data",
    AudioHeader = "audio_header",
    AudioNoSamples = "audio_no_samples",
    AudioNotFinite = "audio_not_finite",
    AudioSampleRate = "audio_sample_rate",
    BeatsFormat = "beats_format",
    BvhFormat = "bvh_format",
    /// The file was written to while it was read, or since it was ingested.
    Changed = "changed",
    ChannelLimit = "channel_limit",
    /// A constraint that the track cannot keep.
    Constraint = "constraint",
    CsvFormat = "csv_format",
    DuplicateId = "duplicate_id",
    EmptyFile = "empty_file",
    /// The engine of a model failed.
    Engine = "engine",
    Layout = "layout",
    LengthMismatch = "length_mismatch",
    MissingKey = "missing_key",
    /// A motion file that is not as its format has it.
    MotionFormat = "motion_format",
    Name = "name",
    /// A song without enough beats to dance to.
    NoBeats = "no_beats",
    /// A phrase whose motion is not in the table.
    NoMotion = "no_motion",
    /// A phrase with nothing to dance to.
    NoMusic = "no_music",
    /// A capture that nothing can be danced of.
    NoPrimitive = "no_primitive",
    NonFinite = "non_finite",
    NotAFile = "not_a_file",
    NpyFormat = "npy_format",
    NpzFormat = "npz_format",
    ParquetFormat = "parquet_format",
    /// The program itself broke on the phrase: a defect of ours, kept from stopping the job.
    Panic = "panic",
    Pickle = "pickle",
    QuaternionNorm = "quaternion_norm",
    Shape = "shape",
    SoundFont = "soundfont",
    /// Features of other content than the phrase has now.
    StaleFeatures = "stale_features",
    Symlink = "symlink",
    /// A tempo outside of those that are danced to.
    Tempo = "tempo",
    Timeout = "timeout",
    TooLarge = "too_large",
    TooLong = "too_long",
    TooShort = "too_short",
    Truncated = "truncated",
    /// A score that could not be played.
    Unplayable = "unplayable",
    Unreadable = "unreadable",
    Unwritable = "unwritable",
    /// What is in the store was written by another version of the program.
    Version = "version",
}

impl FailureKind {
    /// Returns the kind that a reader names.
    ///
    /// # Panics
    /// When a reader names a kind that does not exist.
    pub fn of_reader(name: &str) -> Self {
        let named = Self::ALL.iter().find(|kind| kind.name() == name);
        *named
            .unwrap_or_else(|| panic!("invariant: readers know their failure kinds, not {name:?}"))
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
/// Errors of `work`, or [`FailureKind::Panic`] for the file at `path`.
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

/// Failures that a summary spells out; the rest are in the table.
pub(in crate::stages) const N_SHOWN: usize = 10;

/// Writes the first failures of a job, each with its name and sentence, and where to find all of them.
pub(in crate::stages) fn write_failures<'a, N: fmt::Display>(
    out: &mut dyn Write,
    failed: impl ExactSizeIterator<Item = (N, &'a Failure)>,
    store: Option<&str>,
) -> io::Result<()> {
    let n_failed = failed.len();
    for (name, failure) in failed.take(N_SHOWN) {
        // Names come from files, whose owners may have called them anything.
        let sentence = one_line(&format!("{name}: {}", failure.message));
        writeln!(out, "  failed [{}] {sentence}", failure.kind.name())?;
    }
    if n_failed > N_SHOWN {
        writeln!(out, "  … and {} more", n_failed - N_SHOWN)?;
    }
    match store {
        Some(store) if n_failed > 0 => writeln!(out, "  all of them: {}", query_of_failures(store)),
        _ => Ok(()),
    }
}

/// Returns the first failures of a job as JSON, each with its name, kind and sentence.
pub(in crate::stages) fn failures_json<'a, N: fmt::Display>(
    failed: impl Iterator<Item = (N, &'a Failure)>,
) -> serde_json::Value {
    let told = failed.take(N_SHOWN).map(|(name, failure)| {
        serde_json::json!({
            "item": name.to_string(),
            "kind": failure.kind.name(),
            "message": failure.message,
        })
    });
    told.collect()
}

/// Writes what readers should know of items that were done, the first of them, and the command that shows all.
pub(in crate::stages) fn write_notes<'a, N: fmt::Display>(
    out: &mut dyn Write,
    noted: impl ExactSizeIterator<Item = (N, &'a str)>,
    query: Option<&str>,
) -> io::Result<()> {
    let n_noted = noted.len();
    for (name, note) in noted.take(N_SHOWN) {
        writeln!(out, "  note {name}: {note}")?;
    }
    if n_noted <= N_SHOWN {
        return Ok(());
    }
    writeln!(out, "  … and {} more", n_noted - N_SHOWN)?;
    match query {
        Some(query) => writeln!(out, "  all of them: {query}"),
        None => Ok(()),
    }
}

/// Returns the command that shows the failures of a store.
pub(in crate::stages) fn query_of_failures(store: &str) -> String {
    let store = quoted(store);
    format!("motiongen query --store {store} \"select phrase_id, kind, message from failures\"")
}

/// Quotes a word for the shell where it needs it.
pub(in crate::stages) fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,@+%".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}
