//! Sources: trees of files somebody else wrote, listed and read without trusting any of it.

use std::collections::VecDeque;
use std::fs::File;
use std::path::Path as FsPath;
use std::sync::Arc;

use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt as _};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use xxhash_rust::xxh3::xxh3_128;

use super::cache::Cache;
use super::client::{block_on, runtime};
use super::location::{Location, LocationKind};
use super::remote::{join, read_sized, relative};
use super::{ClientOptions, StoreError};

/// Files up to this size are read into memory; larger ones are handed over as open files.
const IN_MEMORY_BYTES: u64 = 16 << 20;
/// Unit in which fetched bytes are counted against the read-ahead budget.
const BUDGET_UNIT_BYTES: u64 = 64 << 10;

/// One regular file (or object) of a source.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceFile {
    /// Path below the source, `/`-separated.
    pub path: String,
    pub size_bytes: u64,
    /// Digest of what the storage says of the file without reading it: size and modification time
    /// locally, entity tag remotely.
    pub fingerprint: String,
}

/// Something below a source that is no readable regular file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceProblem {
    /// Path below the source; bytes that are not UTF-8 are shown as U+FFFD.
    pub path: String,
    pub kind: SourceProblemKind,
    /// The problem, as the predicate of a sentence about the path.
    pub message: String,
}

/// Why a path below a source cannot be a file of a phrase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceProblemKind {
    /// The name is not UTF-8.
    Name,
    /// A folder, pipe, socket or device stands where a file is expected.
    NotAFile,
    /// A symbolic link leads back to one of its own folders, out of the source, or nowhere.
    Symlink,
    /// The operating system refused.
    Unreadable,
}

/// Everything below a source, sorted by path.
#[derive(Clone, Debug, Default)]
pub struct Listing {
    pub files: Vec<SourceFile>,
    /// Folders without anything in them, and folders whose name ends like a file's.
    pub folders: Vec<String>,
    pub problems: Vec<SourceProblem>,
}

/// The content of a source file.
#[derive(Debug)]
pub enum Content {
    Bytes(Bytes),
    /// A file too large for memory, open at its start.
    File(File),
}

/// A source opened for reading.
#[derive(Clone, Debug)]
pub struct Source {
    location: Location,
    cache: Option<Arc<Cache>>,
    /// Files fetched ahead of the reader.
    read_ahead: usize,
    /// Bytes fetched ahead of the reader.
    read_ahead_bytes: u64,
    /// Whether symbolic links may lead out of the source.
    follows_links: bool,
}

impl Source {
    /// Opens a source; `cache` keeps copies of remote files on this machine.
    ///
    /// # Errors
    /// [`StoreError::BadLocation`].
    pub fn open(
        text: &str,
        options: &ClientOptions,
        cache: Option<Cache>,
    ) -> Result<Self, StoreError> {
        Ok(Self::at(Location::open(text, options)?, options, cache))
    }

    /// Returns the source at a location that the caller holds already.
    pub fn at(location: Location, options: &ClientOptions, cache: Option<Cache>) -> Self {
        Self {
            location,
            cache: cache.map(Arc::new),
            read_ahead: options.n_requests.max(1),
            read_ahead_bytes: 64 << 20,
            follows_links: false,
        }
    }

    /// Returns the source with symbolic links followed out of it, or refused.
    #[must_use]
    pub fn following_links(self, follows_links: bool) -> Self {
        Self { follows_links, ..self }
    }

    pub fn location(&self) -> &Location {
        &self.location
    }

    /// Lists the whole source.
    ///
    /// # Errors
    /// [`StoreError`] when the source itself is missing or cannot be listed; trouble below it is
    /// in [`Listing::problems`].
    pub fn list(&self) -> Result<Listing, StoreError> {
        match self.location.kind() {
            LocationKind::Local(root) => list_tree(root, self.follows_links),
            LocationKind::Remote { store, prefix } => {
                let metas: Vec<_> = block_on(store.list(Some(prefix)).try_collect())
                    .map_err(|e| StoreError::remote("list", self.location.url(), e))?;
                let mut listing = Listing::default();
                for meta in metas {
                    let Some(path) = relative(prefix, &meta.location) else { continue };
                    let tag = meta.e_tag.unwrap_or_else(|| meta.last_modified.to_rfc3339());
                    let fingerprint = fingerprint_of(&format!("{} {tag}", meta.size));
                    listing.files.push(SourceFile { path, size_bytes: meta.size, fingerprint });
                }
                listing.files.sort_by(|a, b| a.path.cmp(&b.path));
                Ok(listing)
            }
        }
    }

    /// Returns the file that a table recorded by its URL, or `None` when it lies elsewhere.
    pub fn recorded(&self, url: &str, size_bytes: u64, fingerprint: &str) -> Option<SourceFile> {
        let path = match self.location.kind() {
            LocationKind::Local(root) => {
                let path = url::Url::parse(url).ok()?.to_file_path().ok()?;
                path.strip_prefix(root).ok()?.to_str()?.to_owned()
            }
            LocationKind::Remote { .. } => {
                url.strip_prefix(self.location.url())?.strip_prefix('/')?.to_owned()
            }
        };
        Some(SourceFile { path, size_bytes, fingerprint: fingerprint.to_owned() })
    }

    /// Reads files in the order given, remote ones ahead of the caller within the budget.
    pub fn read_in_order(&self, files: Vec<SourceFile>) -> OrderedContents {
        match self.location.kind() {
            LocationKind::Local(root) => {
                let (root, follows_links) = (root.clone(), self.follows_links);
                OrderedContents::Local { root, follows_links, files: files.into() }
            }
            LocationKind::Remote { store, prefix } => {
                let (sender, receiver) = mpsc::channel(1);
                let fetcher = Fetcher {
                    store: Arc::clone(store),
                    prefix: prefix.clone(),
                    url: self.location.url().to_owned(),
                    cache: self.cache.clone(),
                    budget: Arc::new(Semaphore::new(units(self.read_ahead_bytes) as usize)),
                    budget_units: units(self.read_ahead_bytes),
                };
                let window = self.read_ahead;
                runtime().spawn(async move {
                    let fetched = futures::stream::iter(files)
                        .map(|file| fetcher.fetch(file))
                        .buffered(window);
                    let mut fetched = std::pin::pin!(fetched);
                    while let Some(content) = fetched.next().await {
                        // The receiver is dropped: the rest is not wanted.
                        if sender.send(content).await.is_err() {
                            break;
                        }
                    }
                });
                OrderedContents::Remote { receiver }
            }
        }
    }
}

/// The contents of files, one after the other in the order asked for.
pub enum OrderedContents {
    Local { root: std::path::PathBuf, follows_links: bool, files: VecDeque<SourceFile> },
    Remote { receiver: mpsc::Receiver<FetchedFile> },
}

/// A fetched file with its share of the read-ahead budget, which goes back when it is dropped.
type FetchedFile = (Result<Content, StoreError>, Option<OwnedSemaphorePermit>);

impl Iterator for OrderedContents {
    type Item = FetchedFile;

    fn next(&mut self) -> Option<Self::Item> {
        match self {
            OrderedContents::Local { root, follows_links, files } => {
                let file = files.pop_front()?;
                let path = root.join(&file.path);
                // A file may have become a link since it was listed.
                let read = if *follows_links || !leads_out(root, &path) {
                    read_local(&path, file.size_bytes)
                } else {
                    Err(StoreError::OutsideSource { place: path.display().to_string() })
                };
                Some((read, None))
            }
            OrderedContents::Remote { receiver } => receiver.blocking_recv(),
        }
    }
}

#[derive(Clone)]
struct Fetcher {
    store: Arc<dyn ObjectStore>,
    prefix: ObjectPath,
    url: String,
    cache: Option<Arc<Cache>>,
    budget: Arc<Semaphore>,
    budget_units: u32,
}

impl Fetcher {
    fn fetch(&self, file: SourceFile) -> impl Future<Output = FetchedFile> + Send + 'static {
        let this = self.clone();
        async move {
            // A file larger than the whole budget takes all of it and goes through alone. The
            // semaphore is fair, so the head of the line is served first and cannot starve.
            let share = units(file.size_bytes).min(this.budget_units);
            let permit = Arc::clone(&this.budget).acquire_many_owned(share).await.ok();
            (this.content(&file).await, permit)
        }
    }

    async fn content(&self, file: &SourceFile) -> Result<Content, StoreError> {
        let place = format!("{}/{}", self.url, file.path);
        let cached = |c: &Arc<Cache>| c.get(&place, &file.fingerprint, file.size_bytes);
        if let Some(content) = self.cache.as_ref().and_then(cached) {
            return Ok(content);
        }
        let path = join(&self.prefix, &file.path);
        let remote = |e| StoreError::remote("read", &place, e);
        let content = if file.size_bytes <= IN_MEMORY_BYTES {
            let bytes = read_sized(&self.store, &path, file.size_bytes).await.map_err(remote)?;
            Content::Bytes(bytes)
        } else {
            Content::File(self.spool(&path, &place).await?)
        };
        match &self.cache {
            Some(cache) => cache.put(&place, &file.fingerprint, content),
            None => Ok(content),
        }
    }

    /// Streams an object into an unnamed temporary file, one range at a time.
    async fn spool(&self, path: &ObjectPath, place: &str) -> Result<File, StoreError> {
        use std::io::{Seek as _, Write as _};
        let io = |e| StoreError::io("spool", place, e);
        let remote = |e| StoreError::remote("read", place, e);
        let mut file = tempfile::tempfile().map_err(io)?;
        let size = self.store.head(path).await.map_err(remote)?.size;
        let mut start = 0;
        while start < size {
            let end = (start + IN_MEMORY_BYTES).min(size);
            let piece = self.store.get_range(path, start..end).await.map_err(remote)?;
            file.write_all(&piece).map_err(io)?;
            start = end;
        }
        file.rewind().map_err(io)?;
        Ok(file)
    }
}

/// Opens or reads a local file, whichever its size asks for.
pub(super) fn read_local(path: &FsPath, size_bytes: u64) -> Result<Content, StoreError> {
    content_of(path, size_bytes).map_err(|e| StoreError::io("read", &path.display().to_string(), e))
}

/// Opens or reads a file of this machine, whichever its size asks for.
///
/// # Errors
/// Errors of the disk.
pub fn content_of(path: &FsPath, size_bytes: u64) -> std::io::Result<Content> {
    if size_bytes <= IN_MEMORY_BYTES {
        std::fs::read(path).map(|bytes| Content::Bytes(bytes.into()))
    } else {
        File::open(path).map(Content::File)
    }
}

fn units(bytes: u64) -> u32 {
    u32::try_from(bytes.div_ceil(BUDGET_UNIT_BYTES)).unwrap_or(u32::MAX).max(1)
}

fn fingerprint_of(text: &str) -> String {
    format!("{:032x}", xxh3_128(text.as_bytes()))
}

/// Returns whether a path below a source ends elsewhere; a root that exists is spelled without links.
fn leads_out(root: &FsPath, path: &FsPath) -> bool {
    path.canonicalize().is_ok_and(|target| !target.starts_with(root))
}

fn list_tree(root: &FsPath, follows_links: bool) -> Result<Listing, StoreError> {
    let place = root.display().to_string();
    let meta = std::fs::metadata(root).map_err(|e| StoreError::io("list", &place, e))?;
    if !meta.is_dir() {
        let source = std::io::Error::from(std::io::ErrorKind::NotADirectory);
        return Err(StoreError::Io { action: "list", place, source });
    }
    let mut listing = Listing::default();
    let mut walk = walkdir::WalkDir::new(root).follow_links(true).min_depth(1).into_iter();
    while let Some(entry) = walk.next() {
        let entry = match entry {
            Ok(entry) => entry,
            Err(e) => {
                listing.problems.push(walk_problem(root, &e));
                continue;
            }
        };
        if !follows_links && entry.path_is_symlink() && leads_out(root, entry.path()) {
            if entry.file_type().is_dir() {
                walk.skip_current_dir();
            }
            let path = entry.path().strip_prefix(root).unwrap_or(entry.path());
            listing.problems.push(SourceProblem {
                path: path.to_string_lossy().into_owned(),
                kind: SourceProblemKind::Symlink,
                message:
                    "is a symbolic link that leads out of the source; copy what it names into \
                          the source, or pass --follow-links"
                        .into(),
            });
            continue;
        }
        let below = entry.path().strip_prefix(root).unwrap_or(entry.path());
        let (Some(path), file_type) = (below.to_str(), entry.file_type()) else {
            listing.problems.push(SourceProblem {
                path: below.to_string_lossy().into_owned(),
                kind: SourceProblemKind::Name,
                message: "has a name that is not UTF-8; rename it".into(),
            });
            continue;
        };
        let path = path.to_owned();
        if file_type.is_dir() {
            listing.folders.push(path);
        } else if file_type.is_file() {
            match entry.metadata() {
                Ok(meta) => listing.files.push(local_file(path, &meta)),
                Err(e) => listing.problems.push(walk_problem(root, &e)),
            }
        } else {
            listing.problems.push(SourceProblem {
                path,
                kind: SourceProblemKind::NotAFile,
                message: "is a pipe, socket or device, not a file; remove it".into(),
            });
        }
    }
    listing.files.sort_by(|a, b| a.path.cmp(&b.path));
    listing.folders.sort();
    listing.problems.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(listing)
}

fn local_file(path: String, meta: &std::fs::Metadata) -> SourceFile {
    let modified_ns = meta
        .modified()
        .ok()
        .and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok())
        .map_or(0, |d| d.as_nanos());
    let fingerprint = fingerprint_of(&format!("{} {modified_ns}", meta.len()));
    SourceFile { path, size_bytes: meta.len(), fingerprint }
}

fn walk_problem(root: &FsPath, error: &walkdir::Error) -> SourceProblem {
    let path = error.path().unwrap_or(root);
    let path = path.strip_prefix(root).unwrap_or(path).to_string_lossy().into_owned();
    if let Some(ancestor) = error.loop_ancestor() {
        let ancestor = ancestor.strip_prefix(root).unwrap_or(ancestor).display();
        let ancestor = match ancestor.to_string().as_str() {
            "" => "the source itself".to_owned(),
            folder => format!("its own folder \"{folder}\""),
        };
        let message = format!("is a symbolic link back to {ancestor}; remove it");
        return SourceProblem { path, kind: SourceProblemKind::Symlink, message };
    }
    let kind = error.io_error().map(std::io::Error::kind);
    let (kind, message) = match kind {
        Some(std::io::ErrorKind::NotFound) => (
            SourceProblemKind::Symlink,
            "is a symbolic link to something that does not exist; remove or repair it".to_owned(),
        ),
        Some(std::io::ErrorKind::PermissionDenied) => (
            SourceProblemKind::Unreadable,
            "may not be read (permission denied); grant read access".to_owned(),
        ),
        _ => (SourceProblemKind::Unreadable, format!("could not be listed ({error})")),
    };
    SourceProblem { path, kind, message }
}
