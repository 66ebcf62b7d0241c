//! Folders on this machine that are costly to make, made once and kept.

use std::path::{Path as FsPath, PathBuf};
use std::time::SystemTime;

use super::StoreError;
use super::local::PARTIAL;

/// Folders that are kept; the least recently used beyond are removed.
const N_KEPT: usize = 12;

/// Returns the folder `key` below `root`, which `make` fills if it is not there yet.
///
/// The folder appears by rename: it is there whole or not at all, and of two processes that make it at the
/// same time one wins.
///
/// # Errors
/// [`StoreError::Cache`] when the disk refuses, and errors of `make`.
pub fn prepared<E: From<StoreError>>(
    root: &FsPath,
    key: &str,
    make: impl FnOnce(&FsPath) -> Result<(), E>,
) -> Result<PathBuf, E> {
    let failed = |e: std::io::Error| StoreError::Cache {
        place: root.display().to_string(),
        reason: format!("cannot be used ({e}); name a folder that may be written by --model-cache"),
    };
    let folder = root.join(key);
    if folder.is_dir() {
        touch(&folder);
        return Ok(folder);
    }
    std::fs::create_dir_all(root).map_err(failed)?;
    let partial = tempfile::Builder::new().prefix(PARTIAL).tempdir_in(root).map_err(failed)?;
    make(partial.path())?;
    match std::fs::rename(partial.path(), &folder) {
        // What was renamed is not to be removed as a temporary folder.
        Ok(()) => drop(partial.keep()),
        Err(_) if folder.is_dir() => {}
        Err(e) => return Err(failed(e).into()),
    }
    forget_old(root, &folder);
    Ok(folder)
}

fn touch(folder: &FsPath) {
    // Best effort: the order in which folders are removed depends on it, nothing else.
    if let Ok(handle) = std::fs::File::open(folder) {
        handle.set_modified(SystemTime::now()).ok();
    }
}

/// Returns whether a name is one that this program gives to what it prepares: a word, `-` and 32 hexadecimal
/// digits. A cache may lie in a folder that has others.
fn is_key(name: &str) -> bool {
    let (kind, digest) = name.split_once('-').unwrap_or_default();
    ["model", "optimized"].contains(&kind)
        && digest.len() == 32
        && digest.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Removes folders that were not used for longest.
fn forget_old(root: &FsPath, newest: &FsPath) {
    let Ok(entries) = std::fs::read_dir(root) else { return };
    let mut folders: Vec<(SystemTime, PathBuf)> = entries
        .flatten()
        .filter(|entry| is_key(&entry.file_name().to_string_lossy()))
        .filter_map(|entry| {
            let metadata = entry.metadata().ok()?;
            metadata.is_dir().then_some((metadata.modified().ok()?, entry.path()))
        })
        .filter(|(_, path)| path != newest)
        .collect();
    folders.sort();
    let n_over = (folders.len() + 1).saturating_sub(N_KEPT);
    for (_, path) in folders.into_iter().take(n_over) {
        std::fs::remove_dir_all(path).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn make(root: &FsPath, key: &str, text: &str) -> Result<PathBuf, StoreError> {
        prepared(root, key, |folder| {
            std::fs::write(folder.join("a"), text).expect("written");
            Ok(())
        })
    }

    #[test]
    fn a_folder_is_made_once() {
        let root = tempfile::tempdir().unwrap();
        let folder = make(root.path(), "k", "first").unwrap();
        assert_eq!(make(root.path(), "k", "second").unwrap(), folder);
        assert_eq!(std::fs::read_to_string(folder.join("a")).unwrap(), "first");
    }

    #[test]
    fn what_could_not_be_made_leaves_nothing() {
        let root = tempfile::tempdir().unwrap();
        let broken: Result<PathBuf, StoreError> = prepared(root.path(), "k", |folder| {
            std::fs::write(folder.join("a"), "half").expect("written");
            Err(StoreError::Cache { place: "x".into(), reason: "broken".into() })
        });
        assert_eq!(broken.unwrap_err().to_string(), "cache x: broken");
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 0);
    }

    #[test]
    fn the_oldest_go_first() {
        let root = tempfile::tempdir().unwrap();
        let hour = std::time::Duration::from_secs(3600);
        let key = |i: usize| format!("model-{i:032x}");
        let foreign_names =
            ["documents", "model-of-mine", "optimized-00000000000000000000000000000000.bak"];
        for name in foreign_names {
            std::fs::create_dir(root.path().join(name)).unwrap();
            let then = SystemTime::now() - hour * 1000;
            std::fs::File::open(root.path().join(name)).unwrap().set_modified(then).unwrap();
        }
        for i in 0..N_KEPT {
            let folder = make(root.path(), &key(i), "x").unwrap();
            let then = SystemTime::now() - hour * (100 - i as u32);
            std::fs::File::open(folder).unwrap().set_modified(then).unwrap();
        }
        // The oldest is used, so the second oldest is the one to go.
        make(root.path(), &key(0), "x").unwrap();
        make(root.path(), &key(99), "x").unwrap();
        assert!(root.path().join(key(0)).is_dir());
        assert!(!root.path().join(key(1)).exists());
        assert!(foreign_names.iter().all(|name| root.path().join(name).is_dir()));
        let n_folders = std::fs::read_dir(root.path()).unwrap().count();
        assert_eq!(n_folders, N_KEPT + foreign_names.len());
    }
}
