//! Locations: one place in one kind of storage, opened from what the user typed.
//!
//! Local paths go through `std::fs`, because only there can a write be fsynced and an odd file
//! name be read; everything else goes through `object_store`.

use std::fmt;
use std::io::Write as _;
use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, PutPayload};
use url::Url;

use super::StoreError;
use super::client::{self, ClientOptions, block_on};

/// Largest object that is sent with one PUT; larger ones go up in parts of this size.
const SINGLE_PUT_BYTES: usize = 8 << 20;
/// Parts of one multipart upload that may be under way at once.
const MULTIPART_IN_FLIGHT: usize = 4;
/// Small objects that are read at once.
const READS_IN_FLIGHT: usize = 32;
/// Bytes fetched by one ranged GET when a large object is read.
const RANGE_BYTES: u64 = 8 << 20;
/// Times that the creation of an object is repeated when its connection broke, and the pause before
/// the first repetition; the next pauses are longer by as much each.
const BROKEN_PUT_RETRIES: u32 = 4;
const BROKEN_PUT_PAUSE: Duration = Duration::from_millis(100);

/// A folder in local or remote storage.
#[derive(Clone, Debug)]
pub struct Location {
    /// The location as a URL without a trailing slash; a local path is made absolute.
    url: String,
    kind: Kind,
}

#[derive(Clone, Debug)]
pub(crate) enum Kind {
    Local(PathBuf),
    Remote { store: Arc<dyn ObjectStore>, prefix: ObjectPath },
}

/// What a listing tells of one object, or of one file below a local folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Path below the location, `/`-separated.
    pub path: String,
    pub size_bytes: u64,
}

/// Whether a put wrote the object or found it there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Put {
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
        let bad = |reason: String| StoreError::BadLocation { text: text.to_owned(), reason };
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
        Ok(Self { url: full, kind: Kind::Remote { store, prefix } })
    }

    /// Returns a location behind a client that the caller holds already, for embedders; `url` is
    /// what messages and tables call it, `prefix` the key below which its objects are.
    pub fn with_client(url: &str, store: Arc<dyn ObjectStore>, prefix: &str) -> Self {
        let prefix = ObjectPath::from(prefix);
        let url = url.trim_end_matches('/').to_owned();
        Self { url, kind: Kind::Remote { store, prefix } }
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
        Ok(Self { url, kind: Kind::Local(absolute) })
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
            Kind::Local(root) => {
                Url::from_file_path(root.join(path)).map(String::from).unwrap_or_default()
            }
            Kind::Remote { .. } => format!("{}/{path}", self.url),
        }
    }

    /// Returns the folder on this machine, or `None` for a remote location.
    pub fn local_path(&self) -> Option<&FsPath> {
        match &self.kind {
            Kind::Local(path) => Some(path),
            Kind::Remote { .. } => None,
        }
    }

    pub(crate) fn kind(&self) -> &Kind {
        &self.kind
    }

    /// Lists every object below `folder`, sorted by path; a missing folder is empty.
    ///
    /// # Errors
    /// [`StoreError`] when the storage cannot be listed.
    pub fn list(&self, folder: &str) -> Result<Vec<Listed>, StoreError> {
        let mut found = match &self.kind {
            Kind::Local(root) => list_local(root, folder)?,
            Kind::Remote { store, prefix } => {
                let below = join(prefix, folder);
                let metas: Vec<_> = block_on(store.list(Some(&below)).try_collect())
                    .map_err(|e| StoreError::remote("list", &self.url_of(folder), e))?;
                metas
                    .into_iter()
                    .filter_map(|meta| {
                        let path = relative(prefix, &meta.location)?;
                        Some(Listed { path, size_bytes: meta.size })
                    })
                    .collect()
            }
        };
        found.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(found)
    }

    /// Reads a whole object; a large remote one in ranges, so that a stalled request costs one range.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] or what the storage says.
    pub fn read(&self, path: &str) -> Result<Bytes, StoreError> {
        let place = || self.url_of(path);
        match &self.kind {
            Kind::Local(root) => std::fs::read(root.join(path))
                .map(Bytes::from)
                .map_err(|e| StoreError::io("read", &place(), e)),
            Kind::Remote { store, prefix } => block_on(read_object(store, &join(prefix, path)))
                .map_err(|e| StoreError::remote("read", &place(), e)),
        }
    }

    /// Reads many small objects, remote ones concurrently, in the order given.
    ///
    /// # Errors
    /// The first failure.
    pub fn read_many(&self, paths: &[String]) -> Result<Vec<Bytes>, StoreError> {
        match &self.kind {
            Kind::Local(_) => paths.iter().map(|path| self.read(path)).collect(),
            Kind::Remote { store, prefix } => {
                let reads = paths.iter().map(|path| async move {
                    read_object(store, &join(prefix, path))
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
    /// What the storage says; an existing object is not an error but [`Put::AlreadyThere`].
    pub fn put_new(&self, path: &str, bytes: Bytes) -> Result<Put, StoreError> {
        let place = || self.url_of(path);
        match &self.kind {
            Kind::Local(root) => {
                let io = |e| StoreError::io("write", &place(), e);
                let mut file = temporary_beside(&root.join(path)).map_err(io)?;
                file.write_all(&bytes).map_err(io)?;
                persist_new(file, &root.join(path)).map_err(io)
            }
            Kind::Remote { store, prefix } => {
                let object = join(prefix, path);
                block_on(create(store, &object, &bytes))
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
            Kind::Local(root) => temporary_beside(&root.join(path)),
            Kind::Remote { .. } => tempfile::NamedTempFile::new(),
        }
        .map_err(|e| StoreError::io("make a temporary file for", &self.url_of(path), e))
    }

    /// Publishes a finished temporary file at `path`: whole or absent, and durable on return.
    ///
    /// Object stores cannot refuse to overwrite at the end of a multipart upload; there a racing
    /// writer of the same path writes the same bytes, because paths are content keys.
    ///
    /// # Errors
    /// What the storage says; an existing object is not an error but [`Put::AlreadyThere`].
    pub fn put_file_new(
        &self,
        path: &str,
        file: tempfile::NamedTempFile,
    ) -> Result<Put, StoreError> {
        let place = || self.url_of(path);
        let io = |e| StoreError::io("write", &place(), e);
        match &self.kind {
            Kind::Local(root) => persist_new(file, &root.join(path)).map_err(io),
            Kind::Remote { store, prefix } => {
                let size = file.as_file().metadata().map_err(io)?.len();
                if size <= SINGLE_PUT_BYTES as u64 {
                    let bytes = std::fs::read(file.path()).map_err(io)?;
                    return self.put_new(path, Bytes::from(bytes));
                }
                let path = join(prefix, path);
                let put = async {
                    match store.head(&path).await {
                        Ok(_) => return Ok(Put::AlreadyThere),
                        Err(object_store::Error::NotFound { .. }) => {}
                        Err(e) => return Err(e),
                    }
                    match upload(store, &path, file.path()).await {
                        Ok(()) => Ok(Put::Written),
                        // As in `create`: the last answer may have been lost.
                        Err(e) => match store.head(&path).await {
                            Ok(there) if there.size == size => Ok(Put::Written),
                            _ => Err(e),
                        },
                    }
                };
                block_on(put).map_err(|e| StoreError::remote("write", &place(), e))
            }
        }
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.kind {
            Kind::Local(path) => write!(f, "{}", path.display()),
            Kind::Remote { .. } => f.write_str(&self.url),
        }
    }
}

/// Joins a `/`-separated path to a prefix; segments are percent-encoded where object_store asks.
pub(crate) fn join(prefix: &ObjectPath, path: &str) -> ObjectPath {
    // `parse` keeps a key as the store spells it; only a key that could not have come from a store
    // (an empty segment, `..`) needs encoding.
    let below = ObjectPath::parse(path).unwrap_or_else(|_| ObjectPath::from(path));
    prefix.parts().chain(below.parts()).collect()
}

/// Returns `path` below `prefix`, or `None` when it is not below it.
pub(crate) fn relative(prefix: &ObjectPath, path: &ObjectPath) -> Option<String> {
    let rest = path.as_ref().strip_prefix(prefix.as_ref())?;
    Some(rest.trim_start_matches('/').to_owned())
}

pub(crate) async fn read_object(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
) -> object_store::Result<Bytes> {
    let size = store.head(path).await?.size;
    read_sized(store, path, size).await
}

/// Reads an object whose size a listing told, in one GET or in ranges of [`RANGE_BYTES`].
pub(crate) async fn read_sized(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
    size: u64,
) -> object_store::Result<Bytes> {
    if size <= RANGE_BYTES {
        return store.get(path).await?.bytes().await;
    }
    // Not `get_ranges`, which would join the ranges into one again.
    let mut whole = Vec::with_capacity(size as usize);
    for start in (0..size).step_by(RANGE_BYTES as usize) {
        let end = (start + RANGE_BYTES).min(size);
        whole.extend_from_slice(&store.get_range(path, start..end).await?);
    }
    Ok(Bytes::from(whole))
}

/// Creates an object unless it is there, over connections that may break at any moment.
async fn create(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
    bytes: &Bytes,
) -> object_store::Result<Put> {
    let mut n_broken = 0;
    loop {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        let payload = PutPayload::from_bytes(bytes.clone());
        let error = match store.put_opts(path, payload, options).await {
            Ok(_) => return Ok(Put::Written),
            Err(object_store::Error::AlreadyExists { .. }) => return Ok(Put::AlreadyThere),
            Err(error) => error,
        };
        // The store may have acted and its answer been lost; then our bytes are there. The client
        // repeats no request that creates, because only its caller can tell.
        match read_object(store, path).await {
            Ok(there) if there == *bytes => return Ok(Put::Written),
            Err(object_store::Error::NotFound { .. })
                if is_broken_connection(&error) && n_broken < BROKEN_PUT_RETRIES =>
            {
                n_broken += 1;
                tokio::time::sleep(BROKEN_PUT_PAUSE * n_broken).await;
            }
            _ => return Err(error),
        }
    }
}

/// Returns whether a request failed because its connection did, without an answer of the store.
fn is_broken_connection(error: &object_store::Error) -> bool {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if error.is::<object_store::client::HttpError>() {
            return true;
        }
        cause = error.source();
    }
    false
}

async fn upload(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
    file: &FsPath,
) -> object_store::Result<()> {
    use std::io::Read as _;
    let generic = |source: std::io::Error| object_store::Error::Generic {
        store: "local temporary file",
        source: Box::new(source),
    };
    let mut file = std::fs::File::open(file).map_err(generic)?;
    let upload = store.put_multipart(path).await?;
    let mut writer = object_store::WriteMultipart::new_with_chunk_size(upload, SINGLE_PUT_BYTES);
    let sent = async {
        loop {
            let mut chunk = Vec::with_capacity(SINGLE_PUT_BYTES);
            let mut piece = (&mut file).take(SINGLE_PUT_BYTES as u64);
            if piece.read_to_end(&mut chunk).map_err(generic)? == 0 {
                return writer.wait_for_capacity(0).await;
            }
            writer.wait_for_capacity(MULTIPART_IN_FLIGHT).await?;
            writer.put(Bytes::from(chunk));
        }
    };
    if let Err(e) = sent.await {
        // Parts of an unfinished upload are invisible but stored, and paid for.
        writer.abort().await.ok();
        return Err(e);
    }
    writer.finish().await.map(|_| ())
}

fn temporary_beside(path: &FsPath) -> std::io::Result<tempfile::NamedTempFile> {
    let folder = path.parent().unwrap_or(FsPath::new("."));
    std::fs::create_dir_all(folder)?;
    // The leading dot keeps an abandoned temporary out of `*.parquet` globs and of listings.
    tempfile::Builder::new().prefix(".partial-").tempfile_in(folder)
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
fn persist_new(file: tempfile::NamedTempFile, path: &FsPath) -> std::io::Result<Put> {
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

fn list_local(root: &FsPath, folder: &str) -> Result<Vec<Listed>, StoreError> {
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
