//! Without tables: audio files become motions in a folder.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use ndarray::ArrayView2;

use super::GenerateTally;
use super::maker::{GeneratedMotion, MotionMaker};
use super::music::PhraseMusic;
use super::outputs::{self, MotionFormat, MotionOutput, StreamFormat};
use super::receipt::{Receipt, digest_of_song};
use crate::motion::exchange::{csv_header, write_csv_rows, write_ndjson_rows};
use crate::motion::{Beats, BeatsError};
use crate::stages::Progress;
use crate::stages::extract::{ExtractRules, ExtractedFeatures, Origin, extract};
use crate::stages::failure::{Failure, FailureKind};
use crate::store::{SourceFile, StoreError, content_of};

/// Longest audio.
const MAX_DURATION_S: f64 = 24.0 * 3600.0;

/// The files to generate motion for, and the folder to write to.
pub struct FolderTarget<'a> {
    pub audio: &'a [PathBuf],
    pub folder: &'a Path,
    pub formats: &'a [MotionFormat],
    pub stream: Option<&'a str>,
    pub stream_format: StreamFormat,
    pub n_samples: usize,
    pub dry_run: bool,
    pub force: bool,
}

/// A motion to generate for a file.
struct FileMotionTask<'a> {
    path: &'a PathBuf,
    stem: String,
    /// Digest of the song.
    song: String,
    name: String,
    sample: usize,
    receipt: Receipt,
}

/// A file's features and beats.
type FeaturesAndBeats = Result<(ExtractedFeatures, Option<Beats>), Failure>;

/// Makes motions for files, one file after another.
///
/// # Errors
/// When the folder cannot be written; files that cannot be danced to are part of what was done.
pub fn run(
    maker: &dyn MotionMaker,
    target: &FolderTarget,
    progress: &dyn Progress,
) -> anyhow::Result<GenerateTally> {
    let mut done = GenerateTally::default();
    let mut names = std::collections::BTreeMap::new();
    let mut tasks = Vec::new();
    // The first motion is streamed whenever that is asked for, made or not.
    let mut is_streamed = target.stream.is_some();
    for path in target.audio {
        let stem = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        if let Some(other) = names.insert(stem.clone(), path) {
            bail!(
                "{} and {} would both be called {stem}; generate them into two folders",
                other.display(),
                path.display()
            );
        }
        let song = digest_of_song(path, &beat_list_of(path));
        for sample in 0..target.n_samples {
            let name =
                if target.n_samples == 1 { stem.clone() } else { format!("{stem}.{sample}") };
            // A song that cannot be read fails when it is its turn.
            let receipt = Receipt::new(maker, &stem, song.as_deref().unwrap_or_default(), sample);
            let is_kept =
                || song.is_some() && receipt.is_kept(target.folder, &name, target.formats);
            if !target.force && !std::mem::take(&mut is_streamed) && is_kept() {
                done.n_unchanged += 1;
            } else {
                let song = song.clone().unwrap_or_default();
                tasks.push(FileMotionTask {
                    path,
                    stem: stem.clone(),
                    song,
                    name,
                    sample,
                    receipt,
                });
            }
        }
    }
    done.n_todo = tasks.len() as u64;
    if target.dry_run {
        return Ok(done);
    }
    let open = |place| FrameStream::open(place, target.stream_format);
    let mut stream = target.stream.map(open).transpose()?;
    std::fs::create_dir_all(target.folder)
        .with_context(|| format!("while making {}", target.folder.display()))?;
    progress.start("generate", "motions", tasks.len() as u64);
    let mut heard: Option<(&PathBuf, FeaturesAndBeats)> = None;
    for FileMotionTask { path, stem, song, name, sample, receipt } in tasks {
        if progress.is_interrupted() {
            done.is_interrupted = true;
            break;
        }
        if heard.as_ref().is_none_or(|(known, _)| *known != path) {
            progress.say(&format!("features of {stem}"));
            heard = Some((path, listen(path)));
        }
        let Some((_, music)) = &heard else { continue };
        let mut first_after = None;
        let outcome = music.as_ref().map_err(Clone::clone).and_then(|(extracted, beats)| {
            let source = path.display().to_string();
            let music = PhraseMusic {
                phrase_id: &stem,
                content_hash: &song,
                source: &source,
                features: extracted.frames.view(),
                beats: beats.clone(),
                has_downbeats: true,
            };
            progress.say(&format!("motion for {stem}"));
            let mut watch = |frames: ArrayView2<f32>| match &mut stream {
                Some(stream) => stream.write(frames),
                None => Ok(()),
            };
            let started = Instant::now();
            let made = maker.make(&music, sample, &mut watch)?;
            // Only the first motion is streamed.
            let first = stream.take().and_then(|stream| stream.first);
            first_after = first.map(|first| first.duration_since(started));
            Ok(made)
        });
        match outcome {
            Ok(made) => {
                let beats_s: &[f64] = match music {
                    Ok((_, Some(beats))) => beats.times_s(),
                    _ => &[],
                };
                let output = MotionOutput {
                    name: &name,
                    frames: made.frames.view(),
                    beats_s,
                    audio: path,
                    facts: facts(&made),
                };
                let written =
                    outputs::write(&output, target.formats, target.folder).and_then(|written| {
                        receipt.keep(target.folder, &name, target.formats)?;
                        Ok(written)
                    });
                match written {
                    Ok(written) => {
                        done.add_made(&made);
                        done.told.push((told(&name, &made, first_after), written));
                    }
                    Err(e) => {
                        let source = path.display().to_string();
                        let message = format!("{e:#}");
                        let failure = Failure::new(FailureKind::Unwritable, &source, message);
                        done.failed.push((name, failure));
                    }
                }
            }
            Err(failure) => done.failed.push((name, failure)),
        }
        progress.advance(1);
    }
    progress.finish();
    Ok(done)
}

/// Returns the place of the beat list beside a song.
fn beat_list_of(audio: &Path) -> PathBuf {
    audio.with_extension("beats.txt")
}

/// Extracts the features of a file, and its beats: those of a beats file beside it, else the tracked ones.
pub(in crate::stages) fn listen(path: &Path) -> FeaturesAndBeats {
    let name = path.display().to_string();
    let io = |e: io::Error| StoreError::Io { action: "read", place: name.clone(), source: e };
    if path.is_dir() {
        let message = format!("{name}: is a folder; name the files in it");
        return Err(Failure::new(FailureKind::NotAFile, &name, message));
    }
    let size_bytes = std::fs::metadata(path).map_or(0, |meta| meta.len());
    let content = content_of(path, size_bytes).map_err(io);
    let rules =
        ExtractRules { tuning: None, max_duration_s: MAX_DURATION_S, timeout: Duration::MAX };
    let file = SourceFile { path: name.clone(), size_bytes, fingerprint: String::new() };
    let extracted = extract(Origin::Audio, &file, content, |_| true, &rules)?;
    let beside = beat_list_of(path);
    let beats = if beside.exists() {
        let read = |e: &dyn std::fmt::Display| {
            let message = format!("{}: {e}", beside.display());
            Failure::new(FailureKind::BeatsFormat, &beside.display().to_string(), message)
        };
        let text = std::fs::read_to_string(&beside).map_err(|e| read(&e))?;
        Some(Beats::parse(&text).map_err(|e: BeatsError| read(&e))?)
    } else {
        extracted.counted_beats()
    };
    Ok((extracted, beats))
}

/// Says what was made, and where it was streamed how soon its first frames were there.
fn told(name: &str, made: &GeneratedMotion, first_after: Option<Duration>) -> String {
    let row = made.rows.iter().find(|row| row.selected);
    let score = row.and_then(|row| row.score).map_or("none".to_owned(), |x| format!("{x:.3}"));
    let checks = row
        .map_or(String::new(), |row| format!("{} of {} checks", row.checks_passed, row.n_checks));
    let duration_s = crate::units::frames_to_s(made.n_frames());
    let factor = made.seconds / duration_s.max(f64::MIN_POSITIVE);
    let streamed = first_after
        .map_or(String::new(), |t| format!("; first frames after {:.2} s", t.as_secs_f64()));
    format!(
        "{name}: {duration_s:.1} s of motion in {:.1} s ({factor:.2} × real time), score {score}, {checks}{streamed}",
        made.seconds
    )
}

/// The facts on a motion that a page shows.
fn facts(made: &GeneratedMotion) -> Vec<(String, String)> {
    let Some(row) = made.rows.iter().find(|row| row.selected) else { return Vec::new() };
    let mut facts = vec![
        ("model", row.model.clone()),
        ("engine", row.engine.clone()),
        ("sampler", format!("{}, {} steps", row.sampler, row.n_steps)),
        ("guidance", format!("{}", row.guidance)),
        ("seed", format!("{}", row.seed as u64)),
        ("candidates", format!("{}", made.rows.len())),
        ("checks", format!("{} of {} passed", row.checks_passed, row.n_checks)),
        ("real-time factor", format!("{:.2}", row.real_time_factor)),
    ];
    facts.extend(row.score.map(|x| ("score", format!("{x:.3}"))));
    facts.extend(row.locking.map(|x| ("bar locking R²", format!("{x:.3}"))));
    facts.extend(
        made.displacement.map(|x| ("moved by fusion", format!("{:.1} mm", x.position_rms_mm))),
    );
    facts.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

/// Frames on their way to a player.
struct FrameStream {
    out: Box<dyn Write>,
    format: StreamFormat,
    n_frames: usize,
    /// When the first frames were there.
    first: Option<Instant>,
}

impl FrameStream {
    fn open(place: &str, format: StreamFormat) -> anyhow::Result<Self> {
        let mut out: Box<dyn Write> = match place {
            "-" => Box::new(io::stdout()),
            path => Box::new(File::create(path).with_context(|| format!("while writing {path}"))?),
        };
        if format == StreamFormat::Csv {
            out.write_all(csv_header().as_bytes())?;
        }
        Ok(Self { out, format, n_frames: 0, first: None })
    }

    fn write(&mut self, frames: ArrayView2<f32>) -> io::Result<()> {
        // A write for each number would be a call of the system for each.
        let mut text = Vec::new();
        match self.format {
            StreamFormat::Csv => write_csv_rows(frames, self.n_frames, &mut text)?,
            StreamFormat::Ndjson => write_ndjson_rows(frames, self.n_frames, &mut text)?,
        }
        self.out.write_all(&text)?;
        self.out.flush()?;
        self.n_frames += frames.nrows();
        self.first.get_or_insert_with(Instant::now);
        Ok(())
    }
}
