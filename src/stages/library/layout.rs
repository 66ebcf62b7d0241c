//! Constructed phrases as files, in the layout that ingest and the field's scripts read.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use super::one::{ConstructedPhrase, SongMusic};
use super::songs::Song;
use crate::motion::npy;
use crate::motion::npz::NpzWriter;
use crate::stages::feature_file::write_blocks;
use crate::store::write_file;

const README: &str = "\
These phrases are constructed, not captured: `motiongen library` made them from songs and from motion
captures of other occasions.

  motion/ID/trajectory.npy          [frames, 25] at 30 fps; of a group [dancers, frames, 25]
  audio_features/ID/features.npz    mel, chroma, mfcc, rms, spectral_centroid, onset_strength (relative
                                    to the whole song), tempo, beat_times (s, from the begin)
  beats/ID.beats.txt                seconds and number in the bar, on to the downbeat after the phrase
  splits.tsv                        phrase, split and song: keep the phrases of a song together

An ID is SONG.tTAKE.NUMBER. What motion owes to music here is known: steps begin and end on beats, their
energy follows the rank of the song's loudness and onsets, the body rises and falls with the bar, and it
turns with phrases of whole bars. docs/architecture.md of motiongen has the formulas. `motiongen ingest`
reads this folder (into another store than the one it was made for); it splits by phrase, so use splits.tsv
or the store of `motiongen library` itself where that matters.
";

/// A folder of phrases in the making.
pub struct PhraseFolder {
    folder: PathBuf,
    /// Lines of the table of splits.
    splits: Mutex<Vec<String>>,
}

impl PhraseFolder {
    /// Starts a folder.
    ///
    /// # Errors
    /// When it cannot be made.
    pub fn new(folder: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        Ok(Self { folder: folder.to_owned(), splits: Mutex::new(Vec::new()) })
    }

    /// Writes a phrase, each file whole or not at all.
    ///
    /// # Errors
    /// The error of the file system.
    pub fn write(
        &self,
        song: &Song,
        music: &SongMusic,
        phrase: &ConstructedPhrase,
    ) -> io::Result<()> {
        let ConstructedPhrase { id, motion, features, beats, later_beats, .. } = phrase;
        let values: Vec<f32> = motion.iter().copied().collect();
        let shape = match motion.shape() {
            // A soloist's has no axis of dancers.
            [1, of_one @ ..] => of_one,
            shape => shape,
        };
        let trajectory = npy::write(shape, &values);
        write_file(&self.folder.join(format!("motion/{id}/trajectory.npy")), |out| {
            out.write_all(&trajectory)
        })?;
        let mut npz = NpzWriter::new(io::Cursor::new(Vec::new()));
        write_blocks(&mut npz, features.view())?;
        npz.add("tempo", &[], [music.beats.tempo_bpm()])?;
        npz.add("beat_times", &[beats.len()], beats.iter().map(|beat| beat.0))?;
        let archive = npz.finish()?.into_inner();
        write_file(&self.folder.join(format!("audio_features/{id}/features.npz")), |out| {
            out.write_all(&archive)
        })?;
        let listed = || beats.iter().chain(later_beats);
        // A beat list is two beats or more, one of them a downbeat.
        if listed().count() >= 2 && listed().any(|beat| beat.1 == 1) {
            // Nanoseconds: the rest is rounding of differences.
            let rounded = |time_s: &f64| (time_s * 1e9).round() / 1e9;
            let lines: String =
                listed().map(|(t, number)| format!("{} {number}\n", rounded(t))).collect();
            write_file(&self.folder.join(format!("beats/{id}.beats.txt")), |out| {
                out.write_all(lines.as_bytes())
            })?;
        }
        let line = format!("{id}\t{}\t{}\n", song.split, song.id);
        self.splits.lock().unwrap_or_else(PoisonError::into_inner).push(line);
        Ok(())
    }

    /// Writes what is about the whole folder.
    ///
    /// # Errors
    /// The error of the file system.
    pub fn finish(self) -> io::Result<()> {
        write_file(&self.folder.join("README.txt"), |out| out.write_all(README.as_bytes()))?;
        let mut lines = self.splits.into_inner().unwrap_or_else(PoisonError::into_inner);
        lines.sort();
        write_file(&self.folder.join("splits.tsv"), |out| {
            out.write_all(b"phrase\tsplit\tsong\n")?;
            lines.iter().try_for_each(|line| out.write_all(line.as_bytes()))
        })
    }
}
