//! Files on this machine: published by link, durable, listed without the unfinished ones.

use std::path::Path as FsPath;

use super::StoreError;
use super::location::{ListedObject, PutOutcome};

/// Start of the names of files being written. The dot keeps an abandoned one out of `*.parquet` globs
/// and of listings.
pub const PARTIAL: &str = ".partial-";
/// Start of the names that libraries give to files that they write beside the one they were asked for;
/// below `runs` alone, where weights are written so.
const LIBRARY_PARTIAL: &str = ".tmp";
/// Letters and digits that make such a name its own.
const N_RANDOM: usize = 6;
/// Age at which a file being written is taken for abandoned.
const PARTIAL_LIFETIME: std::time::Duration = std::time::Duration::from_secs(24 * 3600);

/// Folders of a store beside its tables, and how many levels of folders each has.
const FOLDERS: [(&str, usize); 5] =
    [("commits", 1), ("runs", 2), ("models", 1), ("reference", 0), ("baselines", 0)];

/// Creates a temporary file in a folder, which is made if it is missing, with the permissions that new files
/// get.
pub fn temporary_in(folder: &FsPath) -> std::io::Result<tempfile::NamedTempFile> {
    make_folder(folder)?;
    let mut builder = tempfile::Builder::new();
    builder.prefix(PARTIAL).rand_bytes(N_RANDOM);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        // The system takes away what the user's mask forbids.
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(folder)
}

/// Makes a folder and those above it, each known to the disk before anything is put into it.
fn make_folder(folder: &FsPath) -> std::io::Result<()> {
    let missing: Vec<_> = folder.ancestors().take_while(|above| !above.exists()).collect();
    std::fs::create_dir_all(folder)?;
    for made in missing.iter().rev() {
        match made.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => sync_folder(parent)?,
            _ => {}
        }
    }
    Ok(())
}

/// Writes a folder's entries to the disk.
fn sync_folder(folder: &FsPath) -> std::io::Result<()> {
    match std::fs::File::open(folder).and_then(|folder| folder.sync_all()) {
        // A folder that may be passed through but not read is somebody else's to keep.
        Err(e) if e.kind() == std::io::ErrorKind::PermissionDenied => Ok(()),
        synced => synced,
    }
}

/// Links a temporary file to its final name after fsync of the data, then fsyncs the folder.
pub fn persist_new(file: tempfile::NamedTempFile, path: &FsPath) -> std::io::Result<PutOutcome> {
    file.as_file().sync_all()?;
    match file.persist_noclobber(path) {
        Ok(_) => {}
        Err(e) if e.error.kind() == std::io::ErrorKind::AlreadyExists => {
            return Ok(PutOutcome::AlreadyThere);
        }
        Err(e) => return Err(e.error),
    }
    if let Some(folder) = path.parent() {
        sync_folder(folder)?;
    }
    Ok(PutOutcome::Written)
}

pub fn list(root: &FsPath, folder: &str) -> Result<Vec<ListedObject>, StoreError> {
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
        found.push(ListedObject { path: path.to_owned(), size_bytes });
    }
    Ok(found)
}

/// Removes temporary files that killed writers left in the folders of the store at `root` more than a day ago.
///
/// Nothing else is looked at, and what cannot be read or removed is left as it is.
pub fn sweep(root: &FsPath) {
    for (folder, n_levels) in own_folders() {
        let below = walkdir::WalkDir::new(root.join(folder)).min_depth(1).max_depth(n_levels + 1);
        for entry in below.into_iter().filter_map(Result::ok) {
            let is_of_library = folder == "runs" && is_partial(entry.file_name(), LIBRARY_PARTIAL);
            let is_ours = is_of_library || is_partial(entry.file_name(), PARTIAL);
            if entry.file_type().is_file() && is_ours && is_left_behind(&entry) {
                // Another process may sweep too; then it is just as gone.
                std::fs::remove_file(entry.path()).ok();
            }
        }
    }
}

fn own_folders() -> impl Iterator<Item = (&'static str, usize)> {
    super::tables::all().into_iter().map(|table| (table.name, 0)).chain(FOLDERS)
}

/// Returns whether a name is one that this program or a library of it gives to files being written.
fn is_partial(name: &std::ffi::OsStr, start: &str) -> bool {
    let random = name.to_str().and_then(|name| name.strip_prefix(start));
    random.is_some_and(|random| {
        random.len() == N_RANDOM && random.bytes().all(|byte| byte.is_ascii_alphanumeric())
    })
}

fn is_left_behind(entry: &walkdir::DirEntry) -> bool {
    let age = entry.metadata().ok().and_then(|meta| meta.modified().ok()?.elapsed().ok());
    age.is_some_and(|age| age > PARTIAL_LIFETIME)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn a_sweep_takes_our_own_old_partial_files_and_no_others() {
        let root = tempfile::tempdir().unwrap();
        let write = |path: &str, days: u64| {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            let file = std::fs::File::create(path).unwrap();
            let age = std::time::Duration::from_secs(days * 24 * 3600 + 60);
            file.set_modified(std::time::SystemTime::now() - age).unwrap();
        };
        let ours = [
            "motion/.partial-a1B2c3",
            "commits/ingest/.partial-zzzzzz",
            "runs/a/diffusion/.tmpQ7w8E9",
            "runs/a/.partial-000000",
            "models/m/.partial-ABCDEF",
            "baselines/.partial-123abc",
        ];
        let foreign_paths = [
            ".tmp_important_notes",
            ".partial-a1B2c3",
            "projects/a/.tmpl.html",
            "projects/.partial-a1B2c3",
            "motion/.tmpQ7w8E9",
            "motion/deeper/.partial-a1B2c3",
            "motion/.partial-a1B2c3.bak",
            "motion/.partial-notes!",
            "motion/a.parquet",
            "runs/a/diffusion/.tmp_notes",
            "runs/a/diffusion/deeper/.partial-a1B2c3",
        ];
        ours.iter().chain(&foreign_paths).for_each(|path| write(path, 2));
        write("motion/.partial-y0unG5", 0);
        sweep(root.path());
        let left: BTreeSet<String> = walkdir::WalkDir::new(root.path())
            .into_iter()
            .map(|entry| entry.unwrap())
            .filter(|entry| entry.file_type().is_file())
            .map(|entry| entry.path().strip_prefix(root.path()).unwrap().display().to_string())
            .collect();
        let expected = foreign_paths.iter().chain(&["motion/.partial-y0unG5"]);
        assert_eq!(left, expected.map(|path| (*path).to_owned()).collect());
    }
}
