//! `view`: a page on which a motion is played with its music.

use std::io::{self, Read as _, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail, ensure};

use super::generate::listen;
use super::ingest::Ingest;
use super::motion_source::{MotionCapacity, MotionDisplay, MotionParams};
use super::{ClientParams, Contract, Progress, Stage, Summary};
use crate::audio::header::read_header;
use crate::store::tables::PhraseRow;
use crate::store::{self, ClientOptions, Content, Location, Source};
use crate::units::frames_to_s;
use crate::view::{self, Audio, View as Page, ViewSample};

/// Largest audio file that is put into a page: over an hour of MP3, or half an hour of WAV.
const MAX_AUDIO_BYTES: u64 = 256 << 20;
/// The extension of a page.
const EXTENSION: &str = "html";

/// The stage.
pub struct View;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    #[command(flatten)]
    pub source: MotionParams,
    /// Audio file that plays with the motion [default: that of the phrase]; without a store and without
    /// --beats its beats are tracked, or read from the .beats.txt beside it.
    #[arg(long, value_name = "FILE")]
    pub audio: Option<PathBuf>,
    /// Leave out the audio of the phrase.
    #[arg(long, conflicts_with = "audio")]
    pub no_audio: bool,
    /// The page; written whole or not at all, - is standard output [default: FILE.html beside --motion, or RUN.PHRASE.html here]
    #[arg(long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
}

impl Stage for View {
    const NAME: &'static str = "view";
    const ABOUT: &'static str = "make a page that plays a motion with its music";
    const CONTRACT: Contract = Contract {
        reads: "motion files and audio, or phrases, motion, generated, generations and beats",
        writes: "an HTML file that needs no network",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let output = output_of(&params)?;
        let options = params.client.options();
        let subject = params.source.read(MotionCapacity::Many, &options)?;
        let audio = match (&params.audio, &subject.phrase) {
            (Some(path), _) => Some(read_audio(path)?),
            (None, Some(row)) if !params.no_audio => {
                let store = params.source.store.as_deref().unwrap_or_default();
                phrase_audio(store, row, &options, progress)
            }
            _ => None,
        };
        let mut page = page_of(subject, audio);
        if let Some(path) = &params.audio
            && page.beats_s.is_empty()
        {
            page.beats_s = tracked(path, progress);
        }
        let text = view::page(&page);
        if !params.dry_run {
            store::write_file(&output, |out| out.write_all(text.as_bytes()))
                .with_context(|| format!("while writing {}", output.display()))?;
        }
        Ok(Box::new(ViewSummary {
            n_motions: page.samples.len(),
            n_frames: page.samples.first().map_or(0, |sample| sample.frames.nrows()),
            n_beats: page.beats_s.len(),
            has_audio: page.audio.is_some(),
            n_bytes: text.len(),
            dry_run: params.dry_run,
            output,
        }))
    }
}

/// Returns where the page goes.
fn output_of(params: &Params) -> anyhow::Result<PathBuf> {
    let source = &params.source;
    if let Some(output) = &params.output {
        if store::is_standard_output(output) {
            return Ok(output.clone());
        }
        let extension = output.extension().map(|e| e.to_string_lossy()).unwrap_or_default();
        let is_page = extension.eq_ignore_ascii_case(EXTENSION);
        ensure!(
            is_page,
            "--output {} is not named like a page; name it .{EXTENSION}",
            output.display()
        );
        return Ok(output.clone());
    }
    if let Some(file) = source.motion.first() {
        return Ok(file.with_extension(EXTENSION));
    }
    let names = source.run.iter().chain(&source.phrase).map(String::as_str);
    let name = names.collect::<Vec<_>>().join(".");
    // Phrases may be called what no file can be.
    let is_plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    let name: String = name.chars().map(|c| if is_plain(c) { c } else { '_' }).collect();
    Ok(PathBuf::from(format!("{}.{EXTENSION}", name.trim_start_matches('.'))))
}

/// Reads an audio file as it is.
fn read_audio(path: &Path) -> anyhow::Result<Audio> {
    let place = path.display();
    let unreadable =
        |e: io::Error| anyhow!("{place}: cannot be opened ({e}); check that it is still there");
    if path.is_dir() {
        bail!("{place}: is a folder; name a file in it");
    }
    let n_bytes = std::fs::metadata(path).map_err(unreadable)?.len();
    check_size(&place.to_string(), n_bytes)?;
    let bytes = std::fs::read(path).map_err(unreadable)?;
    Ok(audio_of(path, bytes))
}

fn check_size(place: &str, n_bytes: u64) -> anyhow::Result<()> {
    ensure!(
        n_bytes <= MAX_AUDIO_BYTES,
        "{place}: has {n_bytes} bytes, and a page holds audio of up to {MAX_AUDIO_BYTES}; encode it as \
         MP3 or cut it"
    );
    Ok(())
}

fn audio_of(path: &Path, bytes: Vec<u8>) -> Audio {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    Audio { mime: view::mime_of(extension).to_owned(), bytes }
}

/// Reads the audio of a phrase; a page without it is still a page.
fn phrase_audio(
    store: &str,
    row: &PhraseRow,
    options: &ClientOptions,
    progress: &dyn Progress,
) -> Option<Audio> {
    let read = || -> anyhow::Result<Option<Audio>> {
        let Some(url) = &row.audio_url else { return Ok(None) };
        let size_bytes = row.audio_bytes.and_then(|n| u64::try_from(n).ok()).unwrap_or(0);
        check_size(url, size_bytes)?;
        // A page may be passed on, and a table may have been written by anybody: what goes into the page is audio
        // that was ingested from where it lies.
        let store = Location::open(store, options)?;
        let origin = store::origin_of(&store, Ingest::NAME, &row.phrase_id)?;
        let is_ingested = origin.is_some_and(|origin| origin == row.source);
        let source = Source::open(&row.source, options, None)?;
        let file = source.recorded(url, size_bytes, "").filter(|_| is_ingested);
        let file = file.with_context(|| {
            format!("{url} is in none of the sources that the store was ingested from")
        })?;
        let path = file.path.clone();
        let content = source.read_in_order(vec![file]).next().context("nothing was read")?.0?;
        let bytes = match content {
            Content::Bytes(bytes) => bytes.to_vec(),
            Content::File(file) => {
                let mut bytes = Vec::new();
                file.take(MAX_AUDIO_BYTES + 1).read_to_end(&mut bytes)?;
                bytes
            }
        };
        check_size(url, bytes.len() as u64)?;
        let audio = audio_of(Path::new(&path), bytes);
        let extension = Path::new(&path).extension().and_then(|e| e.to_str()).unwrap_or_default();
        read_header(&audio.bytes, extension).with_context(|| format!("{url} is no audio"))?;
        Ok(Some(audio))
    };
    read().unwrap_or_else(|e| {
        progress.note(&format!("the page has no audio: {e:#}; name a file with --audio"));
        None
    })
}

/// Returns the beats of an audio file; none, and a note, where they cannot be found.
fn tracked(path: &Path, progress: &dyn Progress) -> Vec<f64> {
    match listen(path) {
        Ok((_, beats)) => beats.map(|beats| beats.times_s().to_vec()).unwrap_or_default(),
        Err(failure) => {
            let message = failure.message;
            progress.note(&format!("no beats are marked: {message}; name a file with --beats"));
            Vec::new()
        }
    }
}

fn page_of(subject: MotionDisplay, audio: Option<Audio>) -> Page {
    let samples = subject.shown.into_iter().map(|shown| ViewSample {
        name: shown.name,
        frames: shown.motion.into_array(),
        further_dancers: Vec::new(),
        facts: shown.facts,
    });
    Page { title: subject.title, samples: samples.collect(), beats_s: subject.beats_s, audio }
}

/// The summary of a page: its sizes and its file.
struct ViewSummary {
    n_motions: usize,
    n_frames: usize,
    n_beats: usize,
    has_audio: bool,
    n_bytes: usize,
    dry_run: bool,
    output: PathBuf,
}

impl Summary for ViewSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { n_motions, n_frames, n_beats, has_audio, n_bytes, dry_run, output } = self;
        let counted = |n: usize, one: &str| format!("{n} {one}{}", if n == 1 { "" } else { "s" });
        let (motions, beats) = (counted(*n_motions, "motion"), counted(*n_beats, "beat"));
        let duration_s = frames_to_s(*n_frames);
        let audio = if *has_audio { "with audio" } else { "without audio" };
        let mb = *n_bytes as f64 / 1e6;
        let place = output.display();
        let would = if *dry_run { "would write " } else { "" };
        writeln!(
            out,
            "{would}{motions} ({duration_s:.2} s), {beats}, {audio} → {place} ({mb:.2} MB)"
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        serde_json::json!({
            "to": self.output,
            "dry_run": self.dry_run,
            "n_motions": self.n_motions,
            "n_frames": self.n_frames,
            "n_beats": self.n_beats,
            "has_audio": self.has_audio,
            "n_bytes": self.n_bytes,
        })
    }
}
