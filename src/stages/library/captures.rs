//! The motion that dances are made of: captures of a folder, or those that a store has.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read as _;

use anyhow::bail;
use ndarray::Array3;

use super::StoreContents;
use crate::motion::choreography::{PrimitiveError, Repertoire};
use crate::motion::{Axis, ChannelLimits, Dancers, Trajectory};
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::ingest::{CAPTURE_EXTENSIONS, ReadMotion, notes_of, read_motion};
use crate::store::{
    Content, Listing, Source, SourceFile, SourceProblemKind, StoreError, StoreSnapshot, digest,
    tables,
};

/// Archives that lie beside motion and hold none: AMASS's shapes and first stages, and features of songs.
const NOT_MOTION: [&str; 3] = ["shape.npz", "stagei.npz", "features.npz"];
/// Largest motion file that is read, in bytes.
const MAX_FILE_BYTES: u64 = 1 << 30;
/// Raised when a capture is read in another way.
const READING_VERSION: u32 = 2;

/// Captures that were found, not yet read.
pub struct Captures {
    /// Where they come from, as commits name it.
    pub origin: String,
    /// What the storage says of all of them, without reading them.
    pub fingerprint: String,
    place: CaptureSource,
}

enum CaptureSource {
    /// Phrases of the store, with the digests of their files.
    Store { place: StoreSnapshot, ids: BTreeMap<String, String> },
    Folder {
        source: Source,
        files: Vec<SourceFile>,
        problems: Vec<(String, Failure)>,
        up: Option<Axis>,
    },
}

/// Captures that were read.
#[derive(Default)]
pub struct LoadedCaptures {
    pub repertoire: Repertoire,
    /// Digest of their content.
    pub content_hash: String,
    /// Those that failed, with their URLs.
    pub failed: Vec<(String, String, Failure)>,
    /// What a reader should know of captures, with their names.
    pub noted: Vec<(String, String)>,
}

impl Captures {
    /// Finds the captures of a store: phrases with motion and without audio that library has not
    /// constructed.
    pub fn of_store(store: &StoreSnapshot, known: &StoreContents) -> Self {
        let ids = known.captures.clone();
        let lines: String = ids.iter().map(|(id, hash)| format!("{hash} {id}\n")).collect();
        Self {
            origin: super::FROM_STORE.to_owned(),
            fingerprint: digest(lines.as_bytes()),
            place: CaptureSource::Store { place: store.clone(), ids },
        }
    }

    /// Finds every file that is named like a motion below a folder. `up` is the axis that is up in captures, none to
    /// find it.
    ///
    /// # Errors
    /// [`StoreError`] when the folder cannot be listed.
    pub fn of_folder(source: Source, up: Option<Axis>) -> Result<Self, StoreError> {
        let Listing { files, problems, .. } = source.list()?;
        let is_motion = |path: &str| {
            let name = path.rsplit('/').next().unwrap_or(path);
            let extension = name.rsplit_once('.').map_or("", |(_, extension)| extension);
            !name.starts_with('.')
                && CAPTURE_EXTENSIONS.iter().any(|e| e.eq_ignore_ascii_case(extension))
                && !NOT_MOTION.iter().any(|e| name.ends_with(e))
        };
        let files: Vec<_> = files.into_iter().filter(|file| is_motion(&file.path)).collect();
        let problems = problems.into_iter();
        let problems = problems.filter(|p| {
            // What lies behind a link that is not followed is unknown.
            is_motion(&p.path) || p.kind == SourceProblemKind::Symlink
        });
        let problems = problems.map(|p| {
            let kind = match p.kind {
                SourceProblemKind::Name => FailureKind::Name,
                SourceProblemKind::NotAFile => FailureKind::NotAFile,
                SourceProblemKind::Symlink => FailureKind::Symlink,
                SourceProblemKind::Unreadable => FailureKind::Unreadable,
            };
            let message = format!("{} {}", p.path, p.message);
            (p.path.clone(), Failure::new(kind, &p.path, message))
        });
        let mut lines: String =
            files.iter().map(|f| format!("{} {}\n", f.fingerprint, f.path)).collect();
        lines += &reading_line(&files, up);
        Ok(Self {
            origin: source.location().url().to_owned(),
            fingerprint: digest(lines.as_bytes()),
            place: CaptureSource::Folder { problems: problems.collect(), files, source, up },
        })
    }

    /// Returns the names of all captures.
    pub fn names(&self) -> BTreeSet<String> {
        match &self.place {
            CaptureSource::Store { ids, .. } => ids.keys().cloned().collect(),
            CaptureSource::Folder { files, problems, .. } => {
                let problems = problems.iter().map(|(name, _)| name.clone());
                files.iter().map(|file| file.path.clone()).chain(problems).collect()
            }
        }
    }

    /// Reads all captures and cuts them into primitives.
    ///
    /// # Errors
    /// When there is no capture at all, or the store cannot be read.
    pub fn load(self) -> anyhow::Result<LoadedCaptures> {
        match self.place {
            CaptureSource::Store { place, ids } => {
                if ids.is_empty() {
                    bail!(
                        "store {} has no captures: no phrase has motion without audio; ingest \
                         some, or name a folder of motion files with --captures",
                        place.store()
                    );
                }
                let mut frames: BTreeMap<String, Array3<f32>> = BTreeMap::new();
                let wanted = ids.keys().cloned().collect();
                place.table(tables::motion())?.visit_groups(&wanted, |id, found| {
                    frames.insert(id.to_owned(), found);
                    Ok::<_, StoreError>(())
                })?;
                let mut reading = CaptureReading::default();
                for (id, frames) in frames {
                    let added = guarded(&id, || {
                        let dancers = Dancers::of_frames(frames);
                        let dancers = dancers.map_err(|e| Failure::of(&id, e.kind(), &e))?;
                        reading.add_all(&id, dancers)
                    });
                    reading.settle(&id, &place.store().url_of(&id), added);
                }
                Ok(reading.finish(self.fingerprint))
            }
            CaptureSource::Folder { source, files, problems, up } => {
                if files.is_empty() && problems.is_empty() {
                    bail!(
                        "captures folder {}: no .bvh, .npz, .npy or .vmd file anywhere below it; \
                         name the folder of your motion captures",
                        source.location()
                    );
                }
                let mut reading = CaptureReading::default();
                let mut hashes = reading_line(&files, up);
                let contents = source.read_in_order(files.clone());
                for (file, (content, _permit)) in files.iter().zip(contents) {
                    let path = file.path.as_str();
                    let added = bytes_of(file, content).and_then(|bytes| {
                        hashes += &format!("{} {path}\n", digest(&bytes));
                        guarded(path, || {
                            let (dancers, notes) = read(path, &bytes, up)?;
                            reading.add_all(path, dancers)?;
                            reading.noted.extend(notes.map(|notes| (path.to_owned(), notes)));
                            Ok(())
                        })
                    });
                    reading.settle(path, &source.location().url_of(path), added);
                }
                for (path, failure) in problems {
                    reading.settle(&path, &source.location().url_of(&path), Err(failure));
                }
                Ok(reading.finish(digest(hashes.as_bytes())))
            }
        }
    }
}

/// The repertoire as it grows.
#[derive(Default)]
struct CaptureReading {
    repertoire: Repertoire,
    failed: Vec<(String, String, Failure)>,
    noted: Vec<(String, String)>,
}

impl CaptureReading {
    /// Adds the motion of a capture; of a group that of each dancer, whose steps are as good as a soloist's.
    fn add_all(&mut self, path: &str, dancers: Dancers) -> Result<(), Failure> {
        let is_group = dancers.n_dancers() > 1;
        for (dancer, motion) in dancers.into_trajectories().into_iter().enumerate() {
            let of_dancer = format!("{path}, dancer {dancer}");
            self.add(if is_group { &of_dancer } else { path }, motion)?;
        }
        Ok(())
    }

    fn add(&mut self, path: &str, motion: Trajectory) -> Result<(), Failure> {
        motion.check(&ChannelLimits::Wide).map_err(|e| Failure::of(path, e.kind(), &e))?;
        let refused = |e: PrimitiveError| {
            let kind = match e {
                PrimitiveError::TooShort { .. } => FailureKind::TooShort,
                _ => FailureKind::NoPrimitive,
            };
            Failure::new(kind, path, format!("{path}: {e}"))
        };
        self.repertoire.add(&motion).map(|_| ()).map_err(refused)
    }

    fn settle(&mut self, name: &str, url: &str, added: Result<(), Failure>) {
        if let Err(failure) = added {
            self.failed.push((name.to_owned(), url.to_owned(), failure));
        }
    }

    fn finish(self, content_hash: String) -> LoadedCaptures {
        let Self { repertoire, failed, noted } = self;
        LoadedCaptures { repertoire, content_hash, failed, noted }
    }
}

fn bytes_of(
    file: &SourceFile,
    content: Result<Content, StoreError>,
) -> Result<bytes::Bytes, Failure> {
    let path = file.path.as_str();
    if file.size_bytes > MAX_FILE_BYTES {
        let message = format!(
            "{path} has {} bytes, more than the {MAX_FILE_BYTES} that are read; split the take",
            file.size_bytes
        );
        return Err(Failure::new(FailureKind::TooLarge, path, message));
    }
    match content.map_err(|e| super::unreadable(path, &e))? {
        Content::Bytes(bytes) => Ok(bytes),
        Content::File(mut open) => {
            let mut bytes = Vec::new();
            open.read_to_end(&mut bytes)
                .map_err(|e| Failure::new(FailureKind::Unreadable, path, e))?;
            Ok(bytes.into())
        }
    }
}

/// One line of what the digest of captures is made from; none where all are trajectories.
fn reading_line(files: &[SourceFile], up: Option<Axis>) -> String {
    if files.iter().all(|file| is_npy(&file.path)) {
        return String::new();
    }
    format!("reading version {READING_VERSION}, up {}\n", up.map_or("found", Axis::name))
}

fn is_npy(path: &str) -> bool {
    path.rsplit_once('.').is_some_and(|(_, extension)| extension.eq_ignore_ascii_case("npy"))
}

/// Reads a motion, and what a reader should know of it.
fn read(path: &str, bytes: &[u8], up: Option<Axis>) -> Result<(Dancers, Option<String>), Failure> {
    let ReadMotion { dancers, account, .. } = read_motion(path, bytes, None, up)?;
    Ok((dancers, account.as_ref().and_then(notes_of)))
}
