//! What a motion in a folder was made from: `NAME.motiongen.json`, by which it is known again.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use super::maker::MotionMaker;
use super::outputs::MotionFormat;
use crate::store::{digest_of, digest_texts, write_file};

/// Raised when generate writes other files for the same motion.
const FILES_VERSION: &str = "1";
/// The suffix of the names of receipts.
const SUFFIX: &str = "motiongen.json";

/// The inputs that a motion was made from, and the files that it was written into.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Receipt {
    /// Digest of all that determines the motion.
    key: String,
    model: String,
    /// Digest of the model's weights.
    weights: String,
    seed: u64,
    /// Number of the motion among those of the song.
    sample: usize,
    /// Digest of the song, and of the beat list beside it.
    song: String,
    settings: serde_json::Value,
    /// Digests of the files, by the ends of their names.
    files: BTreeMap<String, String>,
}

impl Receipt {
    /// Returns the receipt of a motion that is not made yet.
    pub fn new(maker: &dyn MotionMaker, stem: &str, song: &str, sample: usize) -> Self {
        let identity = maker.identity();
        let number = sample.to_string();
        let key = [FILES_VERSION, &identity.model, &identity.settings_digest, stem, song, &number];
        Self {
            key: digest_texts(key),
            model: identity.model.clone(),
            weights: identity.weights.clone(),
            seed: identity.seed,
            sample,
            song: song.to_owned(),
            settings: identity.settings.clone(),
            files: BTreeMap::new(),
        }
    }

    /// Returns whether a folder has this motion in some formats, each file as it was written.
    pub fn is_kept(&self, folder: &Path, name: &str, formats: &[MotionFormat]) -> bool {
        let Some(known) = Self::read(folder, name).filter(|known| known.key == self.key) else {
            return false;
        };
        formats.iter().all(|format| {
            let listed = known.files.get(format.extension());
            listed.is_some() && listed == digest_of_file(&file(folder, name, *format)).ok().as_ref()
        })
    }

    /// Writes the receipt of a motion that was written in some formats.
    ///
    /// # Errors
    /// The error of the file system.
    pub fn keep(
        mut self,
        folder: &Path,
        name: &str,
        formats: &[MotionFormat],
    ) -> anyhow::Result<()> {
        if let Some(known) = Self::read(folder, name).filter(|known| known.key == self.key) {
            self.files = known.files;
        }
        for format in formats {
            let path = file(folder, name, *format);
            let found = digest_of_file(&path)
                .with_context(|| format!("while reading {}", path.display()))?;
            self.files.insert(format.extension().to_owned(), found);
        }
        let text = serde_json::to_vec_pretty(&self)?;
        let path = place(folder, name);
        write_file(&path, |out| out.write_all(&text))
            .with_context(|| format!("while writing {}", path.display()))
    }

    fn read(folder: &Path, name: &str) -> Option<Self> {
        serde_json::from_slice(&std::fs::read(place(folder, name)).ok()?).ok()
    }
}

fn place(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.{SUFFIX}"))
}

fn file(folder: &Path, name: &str, format: MotionFormat) -> PathBuf {
    folder.join(format!("{name}.{}", format.extension()))
}

/// Returns the digest of a song: of its audio file, and of the beat list beside it; none of what cannot be read, or
/// only once, as a pipe.
pub fn digest_of_song(audio: &Path, beat_list: &Path) -> Option<String> {
    if !std::fs::metadata(audio).ok()?.is_file() {
        return None;
    }
    let song = digest_of_file(audio).ok()?;
    match digest_of_file(beat_list) {
        Ok(beats) => Some(digest_texts([song.as_str(), &beats])),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Some(song),
        Err(_) => None,
    }
}

fn digest_of_file(path: &Path) -> io::Result<String> {
    digest_of(&mut File::open(path)?)
}
