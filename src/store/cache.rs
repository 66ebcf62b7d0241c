//! A read-through cache of remote files on this machine, bounded in size.
//!
//! An entry's name is the digest of its URL and fingerprint, so a changed object misses and an
//! unchanged one is never fetched twice. Entries appear by rename, so a reader sees them whole.

use std::path::{Path as FsPath, PathBuf};
use std::sync::Mutex;
use std::time::SystemTime;

use xxhash_rust::xxh3::xxh3_128;

use super::StoreError;
use super::source::{Content, read_local};

/// A folder of cached files, at most `max_bytes` in all; the least recently used go first.
#[derive(Debug)]
pub struct Cache {
    folder: PathBuf,
    max_bytes: u64,
    /// Bytes in the folder; held while entries are removed.
    used_bytes: Mutex<u64>,
}

impl Cache {
    /// Opens (and creates) a cache folder.
    ///
    /// # Errors
    /// [`StoreError::Cache`] when the folder cannot be made or listed.
    pub fn open(folder: &FsPath, max_bytes: u64) -> Result<Self, StoreError> {
        let failed = |e: std::io::Error| StoreError::Cache {
            place: folder.display().to_string(),
            reason: format!("cannot be used ({e}); name a folder that may be written"),
        };
        std::fs::create_dir_all(folder).map_err(failed)?;
        let used = entries(folder).map_err(failed)?.iter().map(|e| e.size_bytes).sum();
        Ok(Self { folder: folder.to_owned(), max_bytes, used_bytes: Mutex::new(used) })
    }

    /// Returns the cached copy of `url` at `fingerprint`, and marks it as used now.
    ///
    /// An entry of another size was cut by a crash of the machine, and is as good as missing.
    pub fn get(&self, url: &str, fingerprint: &str, size_bytes: u64) -> Option<Content> {
        let path = self.path(url, fingerprint);
        let file = std::fs::File::options().read(true).write(true).open(&path).ok()?;
        if file.metadata().ok()?.len() != size_bytes {
            return None;
        }
        // Access times are often switched off, so the modification time serves for both.
        file.set_modified(SystemTime::now()).ok();
        read_local(&path, size_bytes).ok()
    }

    /// Keeps a copy of `content` and returns it for reading.
    ///
    /// A file that alone exceeds the bound is passed through without being kept.
    ///
    /// # Errors
    /// [`StoreError::Cache`] when the disk refuses.
    pub fn put(
        &self,
        url: &str,
        fingerprint: &str,
        content: Content,
    ) -> Result<Content, StoreError> {
        let failed = |e: std::io::Error| StoreError::Cache {
            place: self.folder.display().to_string(),
            reason: format!("cannot keep {url} ({e}); free some space or leave --cache out"),
        };
        let mut temporary = tempfile::Builder::new()
            .prefix(".partial-")
            .tempfile_in(&self.folder)
            .map_err(failed)?;
        let (size_bytes, content) = copy_into(content, temporary.as_file_mut()).map_err(failed)?;
        if size_bytes > self.max_bytes {
            return Ok(content);
        }
        self.make_room(size_bytes).map_err(failed)?;
        temporary.persist(self.path(url, fingerprint)).map_err(|e| failed(e.error))?;
        Ok(content)
    }

    fn path(&self, url: &str, fingerprint: &str) -> PathBuf {
        self.folder.join(format!("{:032x}", xxh3_128(format!("{url}\n{fingerprint}").as_bytes())))
    }

    /// Removes the least recently used entries until `size_bytes` more fit.
    fn make_room(&self, size_bytes: u64) -> std::io::Result<()> {
        let mut used = self.used_bytes.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if *used + size_bytes > self.max_bytes {
            let mut oldest_first = entries(&self.folder)?;
            oldest_first.sort_by_key(|e| e.used);
            *used = oldest_first.iter().map(|e| e.size_bytes).sum();
            for entry in oldest_first {
                if *used + size_bytes <= self.max_bytes {
                    break;
                }
                // Another process may have removed it first; then it is just as gone.
                std::fs::remove_file(&entry.path).ok();
                *used -= entry.size_bytes;
            }
        }
        *used += size_bytes;
        Ok(())
    }
}

fn copy_into(content: Content, to: &mut std::fs::File) -> std::io::Result<(u64, Content)> {
    use std::io::{Seek as _, Write as _};
    match content {
        Content::Bytes(bytes) => {
            to.write_all(&bytes)?;
            Ok((bytes.len() as u64, Content::Bytes(bytes)))
        }
        Content::File(mut file) => {
            let size_bytes = std::io::copy(&mut file, to)?;
            file.rewind()?;
            Ok((size_bytes, Content::File(file)))
        }
    }
}

/// Hexadecimal digits of the name of an entry.
const N_DIGITS: usize = 32;

struct CacheEntry {
    path: PathBuf,
    size_bytes: u64,
    used: SystemTime,
}

fn entries(folder: &FsPath) -> std::io::Result<Vec<CacheEntry>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        // Files of others in the folder are none of the cache's.
        let name = entry.file_name();
        let digits = name.as_encoded_bytes();
        let is_ours = digits.len() == N_DIGITS && digits.iter().all(u8::is_ascii_hexdigit);
        let Ok(meta) = entry.metadata() else { continue };
        if !is_ours || !meta.is_file() {
            continue;
        }
        let used = meta.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        found.push(CacheEntry { path: entry.path(), size_bytes: meta.len(), used });
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes_of(content: Content) -> Vec<u8> {
        match content {
            Content::Bytes(bytes) => bytes.to_vec(),
            Content::File(_) => panic!("small entries are read into memory"),
        }
    }

    fn content(n: usize, fill: u8) -> Content {
        Content::Bytes(vec![fill; n].into())
    }

    #[test]
    fn a_changed_fingerprint_misses_and_an_unchanged_one_hits() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let cache = Cache::open(folder.path(), 100).expect("a cache");
        cache.put("gs://b/x", "v1", content(7, 1)).expect("room for 7 bytes");
        assert_eq!(bytes_of(cache.get("gs://b/x", "v1", 7).expect("a hit")), vec![1; 7]);
        assert!(cache.get("gs://b/x", "v2", 7).is_none());
        assert!(cache.get("gs://b/y", "v1", 7).is_none());
        assert!(cache.get("gs://b/x", "v1", 8).is_none(), "an entry that was cut");
    }

    #[test]
    fn the_least_recently_used_entry_leaves_first_and_the_bound_holds() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let cache = Cache::open(folder.path(), 100).expect("a cache");
        let pause = || std::thread::sleep(std::time::Duration::from_millis(20));
        cache.put("a", "1", content(40, 1)).expect("kept");
        pause();
        cache.put("b", "1", content(40, 2)).expect("kept");
        pause();
        cache.get("a", "1", 40).expect("a is used again");
        pause();
        cache.put("c", "1", content(40, 3)).expect("kept");
        assert!(cache.get("b", "1", 40).is_none(), "b was used longest ago");
        assert_eq!(bytes_of(cache.get("a", "1", 40).expect("a stays")), vec![1; 40]);
        assert_eq!(bytes_of(cache.get("c", "1", 40).expect("c stays")), vec![3; 40]);
        let total: u64 = entries(folder.path()).expect("listed").iter().map(|e| e.size_bytes).sum();
        assert_eq!(total, 80);
    }

    #[test]
    fn files_of_others_are_neither_counted_nor_removed() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(folder.path().join("thesis.tex"), [7; 90]).expect("written");
        let cache = Cache::open(folder.path(), 100).expect("a cache");
        for (url, n) in [("a", 60), ("b", 70), ("c", 80)] {
            cache.put(url, "1", content(n, 1)).expect("kept");
        }
        assert!(cache.get("c", "1", 80).is_some() && cache.get("b", "1", 70).is_none());
        assert_eq!(std::fs::read(folder.path().join("thesis.tex")).expect("there"), [7; 90]);
    }

    #[test]
    fn a_file_larger_than_the_bound_passes_through() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let cache = Cache::open(folder.path(), 10).expect("a cache");
        let read = cache.put("a", "1", content(11, 9)).expect("passed through");
        assert_eq!(bytes_of(read), vec![9; 11]);
        assert!(cache.get("a", "1", 11).is_none());
    }
}
