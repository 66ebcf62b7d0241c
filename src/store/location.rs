//! Locations: one place in one kind of storage, opened from what the user typed.
//!
//! Local paths go through `std::fs`, because only there can a write be fsynced and an odd file
//! name be read; everything else goes through `object_store`.

use std::fmt;
use std::io::Write as _;
use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path as ObjectPath;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _};
use url::Url;

use super::StoreError;
use super::client::{self, ClientOptions, block_on};
use super::redaction::redacted_location;
use super::{local, output, remote};

/// Folder of the manifests, without which a folder is no store.
const COMMITS: &str = "commits";
/// Small objects that are read at once.
const READS_IN_FLIGHT: usize = 32;

/// A folder in local or remote storage.
#[derive(Clone, Debug)]
pub struct Location {
    /// The location as a URL without a trailing slash; a local path is made absolute.
    url: String,
    kind: LocationKind,
}

#[derive(Clone, Debug)]
pub(crate) enum LocationKind {
    Local(PathBuf),
    Remote { store: Arc<dyn ObjectStore>, prefix: ObjectPath },
}

/// An object of a listing, or a file below a local folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedObject {
    /// Path below the location, `/`-separated.
    pub path: String,
    pub size_bytes: u64,
}

/// Whether a put wrote the object or found it there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PutOutcome {
    Written,
    AlreadyThere,
}

impl Location {
    /// Opens a location from a path or URL (`file://`, `gs://`, `s3://`, `az://`, `memory://NAME`).
    ///
    /// Nothing is read or created. Credentials and endpoints come from the standard variables
    /// (`GOOGLE_APPLICATION_CREDENTIALS`, `AWS_*`, `AZURE_*`).
    ///
    /// # Errors
    /// [`StoreError::BadLocation`] for an unknown scheme, a missing bucket or incomplete
    /// credentials.
    pub fn open(text: &str, options: &ClientOptions) -> Result<Self, StoreError> {
        let bad =
            |reason: String| StoreError::BadLocation { text: redacted_location(text), reason };
        if text.is_empty() {
            return Err(bad("is empty".into()));
        }
        let Some((scheme, _)) = text.split_once("://") else {
            return Self::local(FsPath::new(text));
        };
        let url = Url::parse(text).map_err(|e| bad(format!("is not a URL ({e})")))?;
        if scheme == "file" {
            let path = url.to_file_path().map_err(|()| bad("is not a local path".into()))?;
            return Self::local(&path);
        }
        let store = client::build(&url, options).map_err(bad)?;
        let prefix = ObjectPath::from_url_path(url.path())
            .map_err(|e| bad(format!("has a path that object stores refuse ({e})")))?;
        let bucket = url.host_str().unwrap_or_default();
        let mut full = format!("{scheme}://{bucket}");
        if !prefix.as_ref().is_empty() {
            full.push('/');
            full.push_str(prefix.as_ref());
        }
        Ok(Self { url: full, kind: LocationKind::Remote { store, prefix } })
    }

    /// Returns a location behind a client that the caller holds already, for embedders; `url` is
    /// what messages and tables call it, `prefix` the key below which its objects are.
    pub fn with_client(url: &str, store: Arc<dyn ObjectStore>, prefix: &str) -> Self {
        let prefix = remote::join(&ObjectPath::default(), prefix);
        let url = url.trim_end_matches('/').to_owned();
        Self { url, kind: LocationKind::Remote { store, prefix } }
    }

    /// Opens a local folder, which need not exist.
    ///
    /// # Errors
    /// [`StoreError::Io`] when the working directory of a relative path cannot be found.
    pub fn local(path: &FsPath) -> Result<Self, StoreError> {
        // An existing folder has one name, whichever way it was reached; tables record it.
        let absolute = path
            .canonicalize()
            .or_else(|_| std::path::absolute(path))
            .map_err(|e| StoreError::io("find", &path.display().to_string(), e))?;
        let url = Url::from_file_path(&absolute).map(String::from).unwrap_or_default();
        let url = url.trim_end_matches('/').to_owned();
        Ok(Self { url, kind: LocationKind::Local(absolute) })
    }

    /// Returns the location as a URL, without a trailing slash.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Returns the URL of the object at `path` below this location.
    ///
    /// A local URL is percent-encoded as RFC 8089 asks; an object's URL carries its key as it is,
    /// as `gsutil` and `aws s3` print it.
    pub fn url_of(&self, path: &str) -> String {
        match &self.kind {
            LocationKind::Local(root) => {
                Url::from_file_path(root.join(path)).map(String::from).unwrap_or_default()
            }
            LocationKind::Remote { .. } => format!("{}/{path}", self.url),
        }
    }

    /// Returns the folder on this machine, or `None` for a remote location.
    pub fn local_path(&self) -> Option<&FsPath> {
        match &self.kind {
            LocationKind::Local(path) => Some(path),
            LocationKind::Remote { .. } => None,
        }
    }

    pub(crate) fn kind(&self) -> &LocationKind {
        &self.kind
    }

    /// Removes temporary files that killed writers left in a local store's own folders more than a day ago.
    pub fn sweep(&self) {
        if let LocationKind::Local(root) = &self.kind {
            local::sweep(root);
        }
    }

    /// Lists every object below `folder`, sorted by path; a missing folder is empty.
    ///
    /// # Errors
    /// [`StoreError`] when the storage cannot be listed.
    pub fn list(&self, folder: &str) -> Result<Vec<ListedObject>, StoreError> {
        let mut found = match &self.kind {
            LocationKind::Local(root) => local::list(root, folder)?,
            LocationKind::Remote { store, prefix } => self
                .metas(store, prefix, folder)?
                .into_iter()
                .filter_map(|meta| {
                    let path = remote::relative(prefix, &meta.location)?;
                    Some(ListedObject { path, size_bytes: meta.size })
                })
                .collect(),
        };
        found.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(found)
    }

    /// Lists the objects of remote storage below `folder`.
    fn metas(
        &self,
        store: &dyn ObjectStore,
        prefix: &ObjectPath,
        folder: &str,
    ) -> Result<Vec<ObjectMeta>, StoreError> {
        let below = remote::join(prefix, folder);
        block_on(store.list(Some(&below)).try_collect())
            .map_err(|e| StoreError::remote("list", &self.url_of(folder), e))
    }

    /// Lists every object below `folder` as [`Location::list`] does, with the times at which they were written.
    ///
    /// # Errors
    /// [`StoreError`] when the storage cannot be listed.
    pub(crate) fn list_with_times(
        &self,
        folder: &str,
    ) -> Result<Vec<(ListedObject, SystemTime)>, StoreError> {
        let mut found: Vec<(ListedObject, SystemTime)> = match &self.kind {
            LocationKind::Local(root) => {
                let time_of = |listed: &ListedObject| {
                    let modified = std::fs::metadata(root.join(&listed.path))?.modified()?;
                    Ok::<_, std::io::Error>(modified)
                };
                let listed = local::list(root, folder)?.into_iter();
                // One that somebody else removed meanwhile is not there.
                listed
                    .filter_map(|listed| time_of(&listed).ok().map(|time| (listed, time)))
                    .collect()
            }
            LocationKind::Remote { store, prefix } => self
                .metas(store, prefix, folder)?
                .into_iter()
                .filter_map(|meta| {
                    let path = remote::relative(prefix, &meta.location)?;
                    let listed = ListedObject { path, size_bytes: meta.size };
                    Some((listed, meta.last_modified.into()))
                })
                .collect(),
        };
        found.sort_by(|a, b| a.0.path.cmp(&b.0.path));
        Ok(found)
    }

    /// Returns the size of an object, which locally must be a regular file.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::NotAFile`] or errors of the storage.
    pub(crate) fn size_bytes(&self, path: &str) -> Result<u64, StoreError> {
        let place = || self.url_of(path);
        match &self.kind {
            LocationKind::Local(root) => {
                let found = std::fs::metadata(root.join(path))
                    .map_err(|e| StoreError::io("measure", &place(), e))?;
                if found.is_file() {
                    Ok(found.len())
                } else {
                    Err(StoreError::NotAFile { place: place() })
                }
            }
            LocationKind::Remote { store, prefix } => {
                block_on(store.head(&remote::join(prefix, path)))
                    .map(|meta| meta.size)
                    .map_err(|e| StoreError::remote("measure", &place(), e))
            }
        }
    }

    /// Reads a whole object; a large remote one in ranges, so that a stalled request costs one range.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] or errors of the storage.
    pub fn read(&self, path: &str) -> Result<Bytes, StoreError> {
        let place = || self.url_of(path);
        match &self.kind {
            LocationKind::Local(root) => std::fs::read(root.join(path))
                .map(Bytes::from)
                .map_err(|e| StoreError::io("read", &place(), e)),
            LocationKind::Remote { store, prefix } => {
                block_on(remote::read_object(store, &remote::join(prefix, path)))
                    .map_err(|e| StoreError::remote("read", &place(), e))
            }
        }
    }

    /// Reads the first bytes of an object; all of a shorter one.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] or errors of the storage.
    pub fn read_start(&self, path: &str, n_bytes: u64) -> Result<Bytes, StoreError> {
        use std::io::Read as _;
        let place = || self.url_of(path);
        match &self.kind {
            LocationKind::Local(root) => {
                let read = || {
                    let mut start = Vec::new();
                    std::fs::File::open(root.join(path))?.take(n_bytes).read_to_end(&mut start)?;
                    Ok(Bytes::from(start))
                };
                read().map_err(|e| StoreError::io("read", &place(), e))
            }
            LocationKind::Remote { store, prefix } => {
                block_on(store.get_range(&remote::join(prefix, path), 0..n_bytes))
                    .map_err(|e| StoreError::remote("read", &place(), e))
            }
        }
    }

    /// Reads a whole object that another program wrote, if it is a regular file of at most `max_bytes`.
    ///
    /// # Errors
    /// [`StoreError::NotAFile`], [`StoreError::TooLarge`], and as [`Location::read`].
    pub fn read_regular(&self, path: &str, max_bytes: u64) -> Result<Bytes, StoreError> {
        let n_bytes = self.size_bytes(path)?;
        if n_bytes > max_bytes {
            let place = self.url_of(path);
            return Err(StoreError::TooLarge { place, n_bytes, max_bytes });
        }
        self.read(path)
    }

    /// Returns whether anything was ever committed here.
    ///
    /// # Errors
    /// The error of the storage.
    pub fn is_store(&self) -> Result<bool, StoreError> {
        match &self.kind {
            LocationKind::Local(root) => Ok(root.join(COMMITS).is_dir()),
            LocationKind::Remote { store, prefix } => {
                let below = remote::join(prefix, COMMITS);
                let first = block_on(store.list(Some(&below)).try_next());
                let first = first.map_err(|e| StoreError::remote("list", &self.url, e))?;
                Ok(first.is_some())
            }
        }
    }

    /// Reads a whole object; none where there is no such object.
    ///
    /// # Errors
    /// The error of the storage.
    pub fn read_if_there(&self, path: &str) -> Result<Option<Bytes>, StoreError> {
        match self.read(path) {
            Err(StoreError::NotFound { .. }) => Ok(None),
            read => read.map(Some),
        }
    }

    /// Reads many listed objects, remote ones concurrently, in the order given; for small ones.
    ///
    /// # Errors
    /// The first failure.
    pub fn read_many(&self, listed: &[ListedObject]) -> Result<Vec<Bytes>, StoreError> {
        match &self.kind {
            LocationKind::Local(_) => listed.iter().map(|l| self.read(&l.path)).collect(),
            LocationKind::Remote { store, prefix } => {
                let reads = listed.iter().map(|ListedObject { path, size_bytes }| async move {
                    remote::read_sized(store, &remote::join(prefix, path), *size_bytes)
                        .await
                        .map_err(|e| StoreError::remote("read", &self.url_of(path), e))
                });
                block_on(futures::stream::iter(reads).buffered(READS_IN_FLIGHT).try_collect())
            }
        }
    }

    /// Writes `bytes` at `path` unless something is there: whole or absent, and durable on return.
    ///
    /// # Errors
    /// Errors of the storage; an existing object is not an error but [`PutOutcome::AlreadyThere`].
    pub fn put_new(&self, path: &str, bytes: Bytes) -> Result<PutOutcome, StoreError> {
        let place = || self.url_of(path);
        match &self.kind {
            LocationKind::Local(root) => {
                let io = |e| StoreError::io("write", &place(), e);
                let mut file = local::temporary_in(&folder_of(root, path)).map_err(io)?;
                file.write_all(&bytes).map_err(io)?;
                local::persist_new(file, &root.join(path)).map_err(io)
            }
            LocationKind::Remote { store, prefix } => {
                let object = remote::join(prefix, path);
                block_on(remote::create(store, &object, &bytes))
                    .map_err(|e| StoreError::remote("write", &place(), e))
            }
        }
    }

    /// Writes `bytes` at `path` in place of what is there: the old or the new is there at any moment, whole.
    ///
    /// # Errors
    /// The error of the storage.
    pub fn replace(&self, path: &str, bytes: Bytes) -> Result<(), StoreError> {
        let place = || self.url_of(path);
        match &self.kind {
            LocationKind::Local(root) => {
                let io = |e| StoreError::io("write", &place(), e);
                let mut file = output::temporary_beside(&root.join(path)).map_err(io)?;
                file.write_all(&bytes).map_err(io)?;
                output::replace_file(&root.join(path), file).map_err(io)
            }
            LocationKind::Remote { store, prefix } => {
                block_on(store.put(&remote::join(prefix, path), bytes.into()))
                    .map(|_| ())
                    .map_err(|e| StoreError::remote("write", &place(), e))
            }
        }
    }

    /// Creates a temporary file for an object that [`Location::put_file_new`] will publish: on the
    /// same file system for a local location, so that publishing is one link.
    ///
    /// # Errors
    /// [`StoreError::Io`] when no file can be made.
    pub fn temporary(&self, path: &str) -> Result<tempfile::NamedTempFile, StoreError> {
        match &self.kind {
            LocationKind::Local(root) => local::temporary_in(&folder_of(root, path)),
            LocationKind::Remote { .. } => tempfile::NamedTempFile::new(),
        }
        .map_err(|e| StoreError::io("make a temporary file beside it", &self.url_of(path), e))
    }

    /// Sets the time of a local file to now, so that it is not taken for abandoned; best effort.
    pub(crate) fn touch(&self, path: &str) {
        if let LocationKind::Local(root) = &self.kind
            && let Ok(file) = std::fs::File::options().write(true).open(root.join(path))
        {
            file.set_modified(SystemTime::now()).ok();
        }
    }

    /// Removes an object; one that is gone already is no error.
    ///
    /// # Errors
    /// The error of the storage.
    pub fn remove(&self, path: &str) -> Result<(), StoreError> {
        let place = || self.url_of(path);
        let removed = match &self.kind {
            LocationKind::Local(root) => std::fs::remove_file(root.join(path))
                .map_err(|e| StoreError::io("remove", &place(), e)),
            LocationKind::Remote { store, prefix } => {
                block_on(store.delete(&remote::join(prefix, path)))
                    .map_err(|e| StoreError::remote("remove", &place(), e))
            }
        };
        match removed {
            Err(StoreError::NotFound { .. }) => Ok(()),
            removed => removed,
        }
    }

    /// Publishes a finished temporary file at `path`: whole or absent, and durable on return.
    ///
    /// Object stores cannot refuse to overwrite at the end of a multipart upload; there a racing
    /// writer of the same path writes the same bytes, because paths are content keys.
    ///
    /// # Errors
    /// Errors of the storage; an existing object is not an error but [`PutOutcome::AlreadyThere`].
    pub fn put_file_new(
        &self,
        path: &str,
        file: tempfile::NamedTempFile,
    ) -> Result<PutOutcome, StoreError> {
        let place = || self.url_of(path);
        let io = |e| StoreError::io("write", &place(), e);
        match &self.kind {
            LocationKind::Local(root) => local::persist_new(file, &root.join(path)).map_err(io),
            LocationKind::Remote { store, prefix } => {
                let size = file.as_file().metadata().map_err(io)?.len();
                if size <= remote::SINGLE_PUT_BYTES as u64 {
                    let bytes = std::fs::read(file.path()).map_err(io)?;
                    return self.put_new(path, Bytes::from(bytes));
                }
                let path = remote::join(prefix, path);
                let put = async {
                    match store.head(&path).await {
                        Ok(_) => return Ok(PutOutcome::AlreadyThere),
                        Err(object_store::Error::NotFound { .. }) => {}
                        Err(e) => return Err(e),
                    }
                    match remote::upload(store, &path, file.path()).await {
                        Ok(()) => Ok(PutOutcome::Written),
                        // As in `create`: the last answer may have been lost.
                        Err(e) => match store.head(&path).await {
                            Ok(there) if there.size == size => Ok(PutOutcome::Written),
                            _ => Err(e),
                        },
                    }
                };
                block_on(put).map_err(|e| StoreError::remote("write", &place(), e))
            }
        }
    }
}

/// Returns the folder of an object below a local root.
fn folder_of(root: &FsPath, path: &str) -> PathBuf {
    let path = root.join(path);
    path.parent().map_or_else(|| root.to_owned(), FsPath::to_owned)
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.kind {
            LocationKind::Local(path) => write!(f, "{}", path.display()),
            LocationKind::Remote { .. } => f.write_str(&self.url),
        }
    }
}
