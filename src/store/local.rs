//! Files on this machine: published by link, durable, listed without the unfinished ones.

use std::path::Path as FsPath;

use super::StoreError;
use super::location::{Listed, Put};

/// Start of the names of files being written. The dot keeps an abandoned one out of `*.parquet` globs
/// and of listings.
const PARTIAL: &str = ".partial-";
/// Start of the names that libraries give to files that they write beside the one they were asked for.
const LIBRARY_PARTIAL: &str = ".tmp";
/// Age at which a file being written is taken for abandoned.
const PARTIAL_LIFETIME: std::time::Duration = std::time::Duration::from_secs(24 * 3600);

/// Creates a temporary file in the folder of `path`, which is made if it is missing.
pub fn temporary_beside(path: &FsPath) -> std::io::Result<tempfile::NamedTempFile> {
    let folder = path.parent().unwrap_or(FsPath::new("."));
    std::fs::create_dir_all(folder)?;
    tempfile::Builder::new().prefix(PARTIAL).tempfile_in(folder)
}

/// Writes a local file, whole or not at all, replacing what was there.
///
/// # Errors
/// What the file system or `write` says; the old file is untouched then.
pub fn write_file(
    path: &FsPath,
    write: impl FnOnce(&mut dyn std::io::Write) -> std::io::Result<()>,
) -> std::io::Result<()> {
    let mut out = std::io::BufWriter::new(temporary_beside(&std::path::absolute(path)?)?);
    write(&mut out)?;
    let file = out.into_inner().map_err(std::io::IntoInnerError::into_error)?;
    replace_file(path, file)
}

/// Publishes a finished temporary file at `path`, replacing what was there.
///
/// # Errors
/// What the file system says; the old file is untouched then.
pub fn replace_file(path: &FsPath, file: tempfile::NamedTempFile) -> std::io::Result<()> {
    readable_by_all(&file)?;
    file.as_file().sync_all()?;
    file.persist(path).map(|_| ()).map_err(|e| e.error)
}

/// Temporary files are private to their owner; what is written is for whoever may read the folder.
fn readable_by_all(file: &tempfile::NamedTempFile) -> std::io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        file.as_file().set_permissions(std::fs::Permissions::from_mode(0o644))?;
    }
    let _ = file;
    Ok(())
}

/// Links a temporary file to its final name after fsync of the data, then fsyncs the folder.
pub fn persist_new(file: tempfile::NamedTempFile, path: &FsPath) -> std::io::Result<Put> {
    readable_by_all(&file)?;
    file.as_file().sync_all()?;
    match file.persist_noclobber(path) {
        Ok(_) => {}
        Err(e) if e.error.kind() == std::io::ErrorKind::AlreadyExists => {
            return Ok(Put::AlreadyThere);
        }
        Err(e) => return Err(e.error),
    }
    if let Some(folder) = path.parent() {
        std::fs::File::open(folder)?.sync_all()?;
    }
    Ok(Put::Written)
}

pub fn list(root: &FsPath, folder: &str) -> Result<Vec<Listed>, StoreError> {
    let start = root.join(folder);
    if !start.exists() {
        return Ok(Vec::new());
    }
    let mut found = Vec::new();
    for entry in walkdir::WalkDir::new(&start) {
        let entry = entry.map_err(|e| {
            StoreError::io("list", &start.display().to_string(), std::io::Error::other(e))
        })?;
        let hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
        if hidden || !entry.file_type().is_file() {
            continue;
        }
        let Some(path) = entry.path().strip_prefix(root).ok().and_then(FsPath::to_str) else {
            continue;
        };
        let size_bytes = entry.metadata().map(|m| m.len()).unwrap_or_default();
        found.push(Listed { path: path.to_owned(), size_bytes });
    }
    Ok(found)
}

/// Removes temporary files that killed writers left below `root` more than a day ago.
pub fn sweep(root: &FsPath) -> Result<(), StoreError> {
    if !root.exists() {
        return Ok(());
    }
    for entry in walkdir::WalkDir::new(root).max_depth(4) {
        let place = || root.display().to_string();
        let entry = entry.map_err(|e| StoreError::io("list", &place(), e.into()))?;
        let name = entry.file_name().as_encoded_bytes();
        let is_partial =
            [PARTIAL, LIBRARY_PARTIAL].iter().any(|start| name.starts_with(start.as_bytes()));
        let left_behind = is_partial
            && entry
                .metadata()
                .ok()
                .and_then(|meta| meta.modified().ok()?.elapsed().ok())
                .is_some_and(|age| age > PARTIAL_LIFETIME);
        if left_behind {
            // Another process may sweep too; then it is just as gone.
            std::fs::remove_file(entry.path()).ok();
        }
    }
    Ok(())
}
