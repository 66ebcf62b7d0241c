//! Without a store: audio files become feature files.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use super::one::{ExtractedFeatures, Origin, extract, needed_bytes};
use super::{ExtractJob, ExtractTally};
use crate::audio::FEATURE_DIM;
use crate::audio::header::read_header_from;
use crate::motion::npz::NpzWriter;
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::feature_file::write_blocks;
use crate::stages::pool::{self, Budget, lock};
use crate::store::{
    PartWriter, SourceFile, StoreError, content_of, is_standard_output, replace_file, tables,
    temporary_beside,
};
use anyhow::{Context as _, bail};

/// Where features go.
#[derive(Debug)]
enum FeaturesOutput {
    /// One `NAME.npz` per file in a folder.
    Folder(PathBuf),
    Npz(PathBuf),
    /// One table of all files.
    Parquet(PathBuf),
}

impl FeaturesOutput {
    fn of(path: &Path, n_files: usize) -> anyhow::Result<Self> {
        // Standard output, pipes and devices have no extension to go by.
        let is_stream =
            std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir());
        if is_standard_output(path) || is_stream && path.extension().is_none() {
            let path = path.to_owned();
            return Ok(if n_files == 1 { Self::Npz(path) } else { Self::Parquet(path) });
        }
        match path.extension().and_then(|e| e.to_str()) {
            Some("npz") if !path.is_dir() => {
                if n_files != 1 {
                    bail!(
                        "--output {} holds the features of one file, but --audio names {n_files}; \
                         name a folder, or a .parquet file, which holds any number",
                        path.display()
                    );
                }
                Ok(Self::Npz(path.to_owned()))
            }
            Some("parquet") if !path.is_dir() => Ok(Self::Parquet(path.to_owned())),
            _ => Ok(Self::Folder(path.to_owned())),
        }
    }
}

struct FileTask {
    index: usize,
    name: String,
    path: PathBuf,
    size_bytes: u64,
    duration_s: f64,
}

/// Extracts the features of `audio` into `output`.
///
/// # Errors
/// When the output cannot be written, or two files would have one name in it.
pub fn run(job: &ExtractJob<'_>, audio: &[PathBuf], output: &Path) -> anyhow::Result<ExtractTally> {
    let output = FeaturesOutput::of(output, audio.len())?;
    let tasks = tasks(audio)?;
    let total_s: f64 = tasks.iter().map(|task| task.duration_s).sum();
    if job.dry_run {
        return Ok(ExtractTally {
            n_todo: tasks.len() as u64,
            todo_s: total_s,
            ..ExtractTally::default()
        });
    }
    let table = match &output {
        FeaturesOutput::Parquet(path) => Some(Mutex::new(FeaturesTable::new(path)?)),
        FeaturesOutput::Folder(folder) => {
            std::fs::create_dir_all(folder)
                .with_context(|| format!("while making the folder {}", folder.display()))?;
            None
        }
        FeaturesOutput::Npz(_) => None,
    };
    job.progress.start_audio("extract", total_s.ceil() as u64);
    let done = Mutex::new(ExtractTally {
        n_todo: tasks.len() as u64,
        todo_s: total_s,
        ..ExtractTally::default()
    });
    let budget = Budget::new(job.memory_bytes);
    let mut queue = tasks.into_iter();
    pool::run(
        job.n_workers,
        || {
            let task = queue.next()?;
            if job.progress.is_interrupted() {
                lock(&done).is_stopped = true;
                return None;
            }
            Some(task)
        },
        |task| -> anyhow::Result<()> {
            let outcome = {
                let _share = budget.take(needed_bytes(task.duration_s, task.size_bytes));
                let outcome = extract_file(&task, job);
                if let Ok(extracted) = &outcome {
                    match &output {
                        FeaturesOutput::Folder(folder) => {
                            write_npz(&folder.join(format!("{}.npz", task.name)), extracted)?;
                        }
                        FeaturesOutput::Npz(path) => write_npz(path, extracted)?,
                        FeaturesOutput::Parquet(_) => {}
                    }
                }
                outcome
            };
            job.progress.advance(task.duration_s.round() as u64);
            lock(&done).add(&task.name, &outcome);
            if let Some(table) = &table {
                lock(table).add(task.index, &task.name, outcome.ok())?;
            }
            Ok(())
        },
    )?;
    job.progress.finish();
    // A table is written whole or not at all.
    if let Some(table) = table.filter(|_| !lock(&done).is_stopped) {
        table.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner).finish()?;
    }
    Ok(done.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
}

fn tasks(audio: &[PathBuf]) -> anyhow::Result<Vec<FileTask>> {
    let mut names: BTreeMap<String, &Path> = BTreeMap::new();
    let mut tasks = Vec::with_capacity(audio.len());
    for (index, path) in audio.iter().enumerate() {
        let name = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        if let Some(other) = names.insert(name.clone(), path) {
            bail!(
                "{} and {} would both be called {name}; extract them into two folders",
                other.display(),
                path.display()
            );
        }
        let size_bytes = std::fs::metadata(path).map_or(0, |meta| meta.len());
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        // Only for the order of things; what is wrong with a file is said when it is decoded.
        let header = File::open(path).ok().and_then(|f| read_header_from(f, extension).ok());
        let duration_s = header.map_or(0.0, |header| header.duration_s);
        tasks.push(FileTask { index, name, path: path.clone(), size_bytes, duration_s });
    }
    Ok(tasks)
}

fn extract_file(task: &FileTask, job: &ExtractJob<'_>) -> Result<ExtractedFeatures, Failure> {
    let path = task.path.display().to_string();
    let io = |e| StoreError::Io { action: "read", place: path.clone(), source: e };
    if task.path.is_dir() {
        let message = format!("{path}: is a folder; name the files in it");
        return Err(Failure::new(FailureKind::NotAFile, &path, message));
    }
    let content = content_of(&task.path, task.size_bytes).map_err(io);
    let (size_bytes, fingerprint) = (task.size_bytes, String::new());
    let file = SourceFile { path: path.clone(), size_bytes, fingerprint };
    extract(Origin::Audio, &file, content, |_| true, &job.rules)
}

/// Writes the reference's keys, and what else a reader may want of the file.
fn write_npz(path: &Path, extracted: &ExtractedFeatures) -> anyhow::Result<()> {
    let write = || -> std::io::Result<()> {
        let mut file = temporary_beside(path)?;
        let mut npz = NpzWriter::new(BufWriter::new(file.as_file_mut()));
        let n_frames = extracted.frames.nrows();
        write_blocks(&mut npz, extracted.frames.view())?;
        npz.add("features", &[FEATURE_DIM, n_frames], extracted.frames.t().iter().copied())?;
        let beats = &extracted.beats;
        npz.add("tempo", &[], [extracted.tempo_bpm.unwrap_or(0.0)])?;
        npz.add("beat_times", &[beats.len()], beats.iter().map(|beat| beat.1))?;
        npz.add("beat_frames", &[beats.len()], beats.iter().map(|beat| beat.0 as i64))?;
        if let Some(heard) = extracted.audio {
            npz.add("tuning", &[], [heard.tuning.bins()])?;
            npz.add("n_samples", &[], [heard.n_samples as i64])?;
        }
        npz.finish()?.into_inner().map_err(std::io::IntoInnerError::into_error)?;
        replace_file(path, file)
    };
    write().with_context(|| format!("while writing {}", path.display()))
}

/// A Parquet file of all files' frames, in the order of the command line.
struct FeaturesTable {
    path: PathBuf,
    writer: PartWriter,
    /// Files that were done before one that comes earlier.
    waiting: BTreeMap<usize, (String, Option<ExtractedFeatures>)>,
    n_written: usize,
}

impl FeaturesTable {
    fn new(path: &Path) -> anyhow::Result<Self> {
        let file =
            temporary_beside(path).with_context(|| format!("while writing {}", path.display()))?;
        let writer = PartWriter::new(tables::features(), file)?;
        Ok(Self { path: path.to_owned(), writer, waiting: BTreeMap::new(), n_written: 0 })
    }

    fn add(
        &mut self,
        index: usize,
        name: &str,
        done: Option<ExtractedFeatures>,
    ) -> Result<(), StoreError> {
        self.waiting.insert(index, (name.to_owned(), done));
        while let Some((name, done)) = self.waiting.remove(&self.n_written) {
            if let Some(extracted) = done {
                self.writer.write_frames(&name, extracted.frames.view())?;
            }
            self.n_written += 1;
        }
        Ok(())
    }

    fn finish(self) -> anyhow::Result<()> {
        let finished = self.writer.finish(&[])?;
        replace_file(&self.path, finished.file)
            .with_context(|| format!("while writing {}", self.path.display()))
    }
}
