//! What can go wrong between the program and its storage.

use parquet::errors::ParquetError;
use thiserror::Error;

/// A failure of the store: it names the place as the user typed it; causes are in `source`.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoreError {
    #[error(
        "location \"{text}\" {reason}; use a path, file://, gs://, s3://, az:// or memory://NAME"
    )]
    BadLocation { text: String, reason: String },

    #[error("{place}: not found{hint}")]
    NotFound { place: String, hint: &'static str },

    #[error("{place}: is no regular file; remove it or put the file in its place")]
    NotAFile { place: String },

    #[error(
        "{place}: is a symbolic link that leads out of the source; copy what it names into the source, or pass \
         --follow-links"
    )]
    OutsideSource { place: String },

    #[error(
        "{place}: has {n_bytes} bytes, at most {max_bytes} are read; it is not what it should be"
    )]
    TooLarge { place: String, n_bytes: u64, max_bytes: u64 },

    #[error(
        "{place}: holds no store (it has no commits); check --store, or fill it with motiongen ingest"
    )]
    NoStore { place: String },

    #[error("{place}: could not {action}")]
    Io {
        action: &'static str,
        place: String,
        #[source]
        source: std::io::Error,
    },

    #[error("{place}: could not {action}{hint}")]
    Remote {
        action: &'static str,
        place: String,
        hint: &'static str,
        #[source]
        source: Box<RemoteError>,
    },

    #[error(
        "{place}: commit manifest has format {found}, this program reads formats up to {supported}; install \
         a newer motiongen"
    )]
    ManifestFormat { place: String, found: u32, supported: u32 },

    #[error("{place}: commit manifest is damaged ({reason}); move it away and run the stage again")]
    Manifest { place: String, reason: String },

    #[error(
        "table {table}: {place} has schema version {found}, this program reads {supported}; {remedy}"
    )]
    SchemaVersion {
        table: String,
        place: String,
        found: u32,
        /// The versions that are read, such as `version 2`.
        supported: String,
        remedy: &'static str,
    },

    #[error("table {table}: {place} is not a readable Parquet part")]
    Parquet {
        table: String,
        place: String,
        #[source]
        source: Box<parquet::errors::ParquetError>,
    },

    #[error("table {table}: {place} lacks columns {missing:?}; it has {found:?}")]
    Columns { table: String, place: String, missing: Vec<String>, found: Vec<String> },

    #[error("table {table}: Delta Lake log {place} {reason}")]
    DeltaLog { table: String, place: String, reason: String },

    #[error("{what} is being written by {holder}; wait for its end, or give another name")]
    Held { what: String, holder: String },

    #[error("shard \"{text}\" {reason}; write it as i/n with 0 <= i < n, or \"auto\"")]
    BadShard { text: String, reason: String },

    #[error("cache {place}: {reason}")]
    Cache { place: String, reason: String },

    #[error("{0}")]
    Query(String),
}

impl StoreError {
    /// Wraps an object-store error with the action and the place; a missing object becomes
    /// [`StoreError::NotFound`], and a refused one gets the variables that grant access.
    pub(crate) fn remote(action: &'static str, place: &str, source: object_store::Error) -> Self {
        let hint = match &source {
            object_store::Error::NotFound { .. } => {
                return StoreError::NotFound { place: place.to_owned(), hint: "" };
            }
            source if is_refusal(source) => credentials_hint(place),
            _ => "",
        };
        let source = Box::new(RemoteError(source));
        StoreError::Remote { action, place: place.to_owned(), hint, source }
    }

    /// Returns whether the same may succeed later: the place is out of reach, not wrong, full or closed
    /// to us.
    pub fn may_pass(&self) -> bool {
        use std::io::ErrorKind::{
            PermissionDenied, QuotaExceeded, ReadOnlyFilesystem, StorageFull,
        };
        let is_passing = |e: &std::io::Error| {
            ![PermissionDenied, StorageFull, QuotaExceeded, ReadOnlyFilesystem].contains(&e.kind())
        };
        match self {
            // Parts are never removed: one that is not there lies on a disk that is not there.
            StoreError::NotFound { .. } => true,
            StoreError::Io { source, .. } => is_passing(source),
            StoreError::Remote { source, .. } => !is_refusal(&source.0),
            StoreError::Parquet { source, .. } => match source.as_ref() {
                ParquetError::External(cause) => {
                    let remote = cause.downcast_ref::<object_store::Error>();
                    let local = cause.downcast_ref::<std::io::Error>();
                    remote.is_some_and(|e| !is_refusal(e)) || local.is_some_and(is_passing)
                }
                _ => false,
            },
            _ => false,
        }
    }

    pub(crate) fn io(action: &'static str, place: &str, source: std::io::Error) -> Self {
        if source.kind() == std::io::ErrorKind::NotFound {
            return StoreError::NotFound { place: place.to_owned(), hint: "" };
        }
        StoreError::Io { action, place: place.to_owned(), source }
    }
}

/// An error of a client of remote storage, told on one line.
#[derive(Debug)]
pub struct RemoteError(object_store::Error);

impl std::fmt::Display for RemoteError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&without_markup(&self.0.to_string()))
    }
}

impl std::error::Error for RemoteError {}

/// Returns the text of a client's error with the code and the message of the XML that a server sent in its
/// place, and its lines joined.
fn without_markup(text: &str) -> String {
    let start = ["<?xml", "<Error"].iter().filter_map(|tag| text.find(tag)).min();
    let (before, markup) = text.split_at(start.unwrap_or(text.len()));
    let element = |name: &str| {
        let (_, rest) = markup.split_once(&format!("<{name}>"))?;
        rest.split_once(&format!("</{name}>")).map(|(content, _)| content)
    };
    let said = ["Code", "Message"].into_iter().filter_map(element).collect::<Vec<_>>().join(": ");
    let said = if said.is_empty() { markup } else { &said };
    let words = before.split_whitespace().chain(said.split_whitespace());
    words.collect::<Vec<_>>().join(" ")
}

/// Returns whether the storage knew who asked and said no, or asked for credentials.
fn is_refusal(error: &object_store::Error) -> bool {
    use object_store::Error::{PermissionDenied, Unauthenticated};
    // A refused listing is a generic error of the client's, whose status can only be read.
    let text = || error.to_string();
    matches!(error, PermissionDenied { .. } | Unauthenticated { .. })
        || ["status code: 401", "status code: 403"].iter().any(|code| text().contains(code))
}

fn credentials_hint(place: &str) -> &'static str {
    if place.starts_with("gs://") {
        "; access was refused: set GOOGLE_APPLICATION_CREDENTIALS to a key file that may do this"
    } else if place.starts_with("s3://") {
        "; access was refused: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY to a key that may do \
         this"
    } else if place.starts_with("az://") {
        "; access was refused: set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY"
    } else {
        "; access was refused"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_server_says_in_markup_is_told_on_one_line() {
        let text = "Generic S3 error: status code: 403 Forbidden: <?xml version=\"1.0\"?>\n<Error>\n  \
                    <Code>AccessDenied</Code><Message>Access\nDenied.</Message>\n</Error>";
        let expected = "Generic S3 error: status code: 403 Forbidden: AccessDenied: Access Denied.";
        assert_eq!(without_markup(text), expected);
        assert_eq!(without_markup("one\n  two"), "one two");
        assert_eq!(without_markup("bad: <Error>\nodd"), "bad: <Error> odd");
    }
}
