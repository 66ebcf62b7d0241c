//! Motion that any program made for the music of a store: files in a folder, named after its phrases.
//!
//! A file belongs to a phrase by its path below the folder without its extension, called its name here. These
//! rules are tried in turn, and the first that fits counts:
//!
//! 1. the name is the phrase's, with or without the extension of its audio (`gunroar/gr2.npy` for
//!    `gunroar/gr2.ogg`);
//! 2. the name is that followed by a number: `NAME.K.npy`, or `K.npy` in a folder `NAME`, is sample K. `NAME_K`
//!    is none, since phrases of captures end so themselves;
//! 3. the file's own name, without folders, is that of one phrase alone (its last part, or else the name of its
//!    audio file);
//! 4. the same with a number as in rule 2.
//!
//! Files are read one at a time, when they are asked for.

mod content;
mod names;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use ndarray::Array2;

use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::plot::nearest::nearest;
use crate::store::digest;
use names::Names;

/// Failures up to which a file that matches nothing is told the nearest names: each costs a look at every
/// phrase.
const MAX_NEAREST: usize = 100;
/// Share of its music's length by which a motion may be longer or shorter without a note.
const LENGTH_TOLERANCE: f64 = 0.1;

/// A phrase that motion can be for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ForeignPhrase<'a> {
    pub id: &'a str,
    /// The file with its music.
    pub url: &'a str,
    /// Frames of its music, where they are known.
    pub n_frames: Option<usize>,
}

/// The motions of a folder that can be read, and why others cannot.
#[derive(Debug, Default)]
pub struct ForeignMotions {
    /// By phrase and sample.
    pub files: Vec<ForeignFile>,
    pub failures: Vec<(PathBuf, Failure)>,
    /// Number of files whose names are not those of motions; they are not read.
    pub n_others: usize,
}

/// A file and the phrase that its motion is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ForeignFile {
    pub phrase_id: String,
    pub sample: usize,
    pub path: PathBuf,
    /// Frames of the phrase's music, where they are known.
    pub n_music_frames: Option<usize>,
}

/// The content of a file from which its 25 channels came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileContent {
    /// All of them.
    Channels,
    /// Positions and orientations: the rest is derived.
    Poses,
    /// A motion capture.
    Capture,
}

impl FileContent {
    /// Whether the motion has a phase of its own.
    pub const fn has_phase(self) -> bool {
        matches!(self, Self::Channels)
    }

    /// Returns which channels were derived, in a sentence without its begin; none where all were there.
    pub const fn derived(self) -> Option<&'static str> {
        match self {
            Self::Channels => None,
            Self::Poses => Some(
                "velocity, acceleration and angular velocity are derived from its poses, phase and style \
                 are 0",
            ),
            Self::Capture => Some(
                "it is a motion capture: resampled to 30 fps, with velocity, acceleration, angular velocity \
                 and style derived from its poses, and phase 0",
            ),
        }
    }
}

/// A motion that was read; its values may be anything.
#[derive(Clone, Debug, PartialEq)]
pub struct ForeignMotion {
    pub phrase_id: String,
    pub sample: usize,
    pub path: PathBuf,
    /// Of the soloist, or of the first dancer of a group, \[T, 25\], T ≥ 1.
    pub frames: Array2<f32>,
    /// Of the other dancers of a group, as many frames each.
    pub others: Vec<Array2<f32>>,
    pub content: FileContent,
    pub has_phase: bool,
    /// Notes on what is unusual about the file, but no reason to refuse it.
    pub note: Option<String>,
}

impl ForeignMotion {
    /// Returns how many dancers there are.
    pub fn n_dancers(&self) -> usize {
        1 + self.others.len()
    }

    /// Returns the frames of each dancer.
    pub fn into_dancers(self) -> impl Iterator<Item = Array2<f32>> {
        std::iter::once(self.frames).chain(self.others)
    }
}

/// Lists the motions in a folder and below it, without reading them, in order of phrase and sample.
///
/// Files whose names end in something other than `.npy`, `.csv`, `.bvh` or `.parquet`, and those that begin
/// with a dot, are left alone. A file that matches no phrase, or comes second for a phrase and sample, is a
/// failure.
///
/// # Errors
/// When there is no such folder, or no motion in it.
pub fn read(dir: &Path, phrases: &[ForeignPhrase]) -> anyhow::Result<ForeignMotions> {
    let place = dir.display();
    ensure!(
        dir.is_dir(),
        "--motions {place} is no folder; name the folder with a motion file for each song"
    );
    let mut found = ForeignMotions::default();
    let mut paths = walk(dir, &mut found).with_context(|| format!("while reading {place}"))?;
    ensure!(
        !paths.is_empty() || !found.failures.is_empty(),
        "--motions {place} has no motion files; put .npy, .csv, .bvh or .parquet files in it, named after \
         the store's phrases"
    );
    paths.sort();
    let names = Names::new(phrases);
    let mut taken: BTreeMap<(usize, usize), PathBuf> = BTreeMap::new();
    for path in paths {
        let name = names::name_below(dir, &path);
        let Some((phrase, sample)) = names.find(&name) else {
            let near = if found.failures.len() < MAX_NEAREST {
                let all = phrases.iter().map(|phrase| phrase.id.to_owned());
                format!("; nearest: {}", nearest(&name, all))
            } else {
                String::new()
            };
            let message = format!(
                "{}: is named after no phrase of the store{near}; name it PHRASE.npy, or PHRASE.0.npy, \
                 PHRASE.1.npy and so on for several motions of one phrase",
                path.display()
            );
            found.failures.push(refused(FailureKind::Name, path, message));
            continue;
        };
        match taken.entry((phrase, sample)) {
            Entry::Vacant(place) => {
                place.insert(path);
            }
            Entry::Occupied(place) => {
                let message = format!(
                    "{}: is a second motion for sample {sample} of phrase {}, beside {}; remove one of \
                     them, or number them {}.0, {}.1 and so on",
                    path.display(),
                    phrases[phrase].id,
                    place.get().display(),
                    phrases[phrase].id,
                    phrases[phrase].id,
                );
                found.failures.push(refused(FailureKind::DuplicateId, path, message));
            }
        }
    }
    found.files = taken
        .into_iter()
        .map(|((phrase, sample), path)| ForeignFile {
            phrase_id: phrases[phrase].id.to_owned(),
            sample,
            path,
            n_music_frames: phrases[phrase].n_frames,
        })
        .collect();
    found.files.sort_by(|a, b| (&a.phrase_id, a.sample).cmp(&(&b.phrase_id, b.sample)));
    Ok(found)
}

impl ForeignMotions {
    /// Keeps the `n` files whose names have the smallest digests, which is no order that names have.
    pub fn keep(&mut self, n: usize) {
        let name = |file: &ForeignFile| format!("{}/{}", file.phrase_id, file.sample);
        self.files.sort_by_cached_key(|file| digest(name(file).as_bytes()));
        self.files.truncate(n);
        self.files.sort_by(|a, b| (&a.phrase_id, a.sample).cmp(&(&b.phrase_id, b.sample)));
    }
}

/// A file that holds no motion, or none for a phrase.
#[derive(Debug)]
pub struct RefusedFile {
    /// Its path below the folder.
    pub name: String,
    pub failure: Failure,
}

impl RefusedFile {
    /// Names files by their paths below a folder.
    pub fn all(folder: &Path, files: impl IntoIterator<Item = (PathBuf, Failure)>) -> Vec<Self> {
        let name =
            |path: &Path| path.strip_prefix(folder).unwrap_or(path).to_string_lossy().into_owned();
        files.into_iter().map(|(path, failure)| Self { name: name(&path), failure }).collect()
    }
}

impl ForeignFile {
    /// Reads the motion; values that are not finite stay, for the checks to judge.
    ///
    /// # Errors
    /// One sentence that names the file, whatever its bytes are.
    pub fn read(&self) -> Result<ForeignMotion, Failure> {
        let place = self.path.display().to_string();
        let (mut dancers, content) = guarded(&place, || content::read(&self.path))?;
        let others = dancers.split_off(1);
        let frames = dancers.pop().unwrap_or_default();
        let note = self.length_note(frames.nrows());
        Ok(ForeignMotion {
            phrase_id: self.phrase_id.clone(),
            sample: self.sample,
            path: self.path.clone(),
            frames,
            others,
            content,
            has_phase: content.has_phase(),
            note,
        })
    }

    fn length_note(&self, n_frames: usize) -> Option<String> {
        let n_music = self.n_music_frames?;
        let off = n_frames.abs_diff(n_music) as f64 / n_music.max(1) as f64;
        (off > LENGTH_TOLERANCE).then(|| {
            format!(
                "{}: has {n_frames} frames, and the music of {} has {n_music}",
                self.path.display(),
                self.phrase_id
            )
        })
    }
}

fn refused(kind: FailureKind, path: PathBuf, message: String) -> (PathBuf, Failure) {
    let failure = Failure::new(kind, &path.display().to_string(), message);
    (path, failure)
}

/// Returns the files in a folder and below it that are named like motions; links to folders are not followed,
/// so that none leads back.
fn walk(dir: &Path, found: &mut ForeignMotions) -> std::io::Result<Vec<PathBuf>> {
    let (mut folders, mut files) = (Vec::new(), Vec::new());
    let mut list = |folder: &Path, folders: &mut Vec<PathBuf>| -> std::io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let path = entry.path();
            if entry.file_name().to_string_lossy().starts_with('.') {
                continue;
            }
            if entry.file_type()?.is_dir() {
                folders.push(path);
            } else if content::ForeignFormat::of(&path).is_some() {
                files.push(path);
            } else {
                found.n_others += 1;
            }
        }
        Ok(())
    };
    list(dir, &mut folders)?;
    let mut unreadable = Vec::new();
    while let Some(folder) = folders.pop() {
        if let Err(e) = list(&folder, &mut folders) {
            let message = format!("{}: cannot be listed ({e})", folder.display());
            unreadable.push(refused(FailureKind::Unreadable, folder, message));
        }
    }
    found.failures.extend(unreadable);
    Ok(files)
}
