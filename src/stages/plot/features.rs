//! `plot features`: the blocks of features of a file or a phrase, one panel each.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{anyhow, bail};
use ndarray::{Array2, s};

use crate::audio::recording::{MAX_HELD_SAMPLES, Options, Recording};
use crate::audio::spectral::MEL_RANGE_HZ;
use crate::audio::{Tuning, mel};
use crate::plot::{self, FeaturesPlot, Panel};
use crate::stages::beats::{self, BeatSource};
use crate::stages::extract::Extract;
use crate::stages::failure::{Failure, guarded};
use crate::stages::{ClientParams, RARE, Stage as _, Summary};
use crate::store::tables::{self, ExtractionRow, FailureRow, PhraseRow};
use crate::store::{ItemTables, Location, Row as _, Snapshot, StoreError};
use crate::units::frames_to_s;

use super::excerpt::ExcerptParams;
use super::nearest::nearest;
use super::output::{WIDTHS_PX, format_of, write_picture};

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Audio file whose features are extracted and drawn (WAV, AIFF, FLAC, MP3, Ogg Vorbis, Opus, M4A or
    /// AAC).
    #[arg(long, value_name = "FILE")]
    pub audio: Option<PathBuf>,
    /// Folder or bucket of the tables, for --phrase.
    #[arg(long, value_name = "URL")]
    pub store: Option<String>,
    /// Instead of --audio: the phrase whose features in the store are drawn.
    #[arg(long, value_name = "ID")]
    pub phrase: Option<String>,
    /// The picture, FILE.png or FILE.svg; written whole or not at all.
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// Panels to draw, from the top: the flag several times, or names with commas between them.
    #[arg(long = "panel", value_name = "PANEL", value_delimiter = ',',
          default_values = Panel::ALL.map(Panel::name))]
    pub panels: Vec<Panel>,
    // Features stay relative to the whole file.
    #[command(flatten)]
    pub excerpt: ExcerptParams,
    /// Width in CSS pixels, 320 to 8192; a PNG has two pixels for each.
    #[arg(long, value_name = "PX", default_value_t = 1000,
          value_parser = clap::value_parser!(u32).range(WIDTHS_PX))]
    pub width: u32,
    /// Deviation from A440 in bins of 1/36 octave, from -0.5 to below 0.5, instead of the estimate.
    #[arg(long, value_name = "BINS", allow_hyphen_values = true, hide_short_help = RARE)]
    pub tuning: Option<Tuning>,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
}

/// Draws the plot.
///
/// # Errors
/// When there is nothing to draw, or the picture cannot be written.
pub fn run(params: &Params) -> anyhow::Result<Box<dyn Summary>> {
    let output = &params.output;
    let format = format_of(output)?;
    params.excerpt.check()?;
    let subject = match (&params.audio, &params.phrase, &params.store) {
        (Some(_), Some(phrase), _) => {
            bail!("--audio and --phrase {phrase} name two things to draw; give one of them")
        }
        (Some(audio), None, _) => from_audio(audio, params.tuning)?,
        (None, Some(phrase), Some(store)) => {
            let store = Location::open(store, &params.client.options())?;
            from_store(&store, phrase, params.tuning)?
        }
        (None, Some(phrase), None) => {
            bail!("--phrase {phrase} is a name in a store; say which with --store")
        }
        (None, None, _) => {
            bail!("nothing to draw: give --audio FILE, or --store URL and --phrase ID")
        }
    };
    let frames = params.excerpt.frames(subject.frames.nrows(), &subject.title)?;
    let features = FeaturesPlot {
        title: &subject.title,
        values: subject.frames.slice(s![frames.clone(), ..]),
        beat_times_s: &subject.beat_times_s,
        tempo_bpm: subject.tempo_bpm,
        mel_hz: &mel::centres_hz(MEL_RANGE_HZ.0, MEL_RANGE_HZ.1),
        start_s: frames_to_s(frames.start),
    };
    let picture = plot::features(&features, &params.panels, params.width, format)?;
    let unit = if frames.len() == 1 { "frame" } else { "frames" };
    let what = format!("{} {unit} ({:.2} s)", frames.len(), frames_to_s(frames.len()));
    write_picture(what, output, &picture, params.dry_run)
}

/// The features to draw.
struct PlottedFeatures {
    title: String,
    /// [T, 163].
    frames: Array2<f32>,
    tempo_bpm: Option<f64>,
    beat_times_s: Vec<f64>,
}

/// Extracts the features of an audio file.
fn from_audio(path: &Path, tuning: Option<Tuning>) -> anyhow::Result<PlottedFeatures> {
    let place = path.display().to_string();
    if path.is_dir() {
        bail!("{place}: is a folder; name a file in it");
    }
    // The user who waits for one picture decides how long.
    let options = Options {
        tuning,
        max_duration_s: f64::INFINITY,
        is_late: &|| false,
        max_held_samples: MAX_HELD_SAMPLES,
    };
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let recording = guarded(&place, || {
        Recording::analyse(|| File::open(path), extension, &options)
            .map_err(|e| Failure::of(&place, e.kind(), &e))
    });
    let Recording { raw, meter, .. } = recording.map_err(|failure| anyhow!(failure.message))?;
    let features = raw.normalize();
    Ok(PlottedFeatures {
        title: path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
        frames: features.frames,
        tempo_bpm: meter.tempo_bpm(),
        beat_times_s: meter.beat_times_s,
    })
}

/// Reads the features of a phrase.
fn from_store(
    store: &Location,
    phrase: &str,
    tuning: Option<Tuning>,
) -> anyhow::Result<PlottedFeatures> {
    let rows = ItemTables::take(store, phrase)?;
    let Some(frames) = rows.frames(tables::features())? else {
        return Err(missing(store, phrase, &rows)?);
    };
    let extraction = rows.rows::<ExtractionRow>()?.pop();
    let known = extraction.as_ref().and_then(|e| e.tuning);
    if let Some(wanted) = tuning.filter(|wanted| known != Some(wanted.bins())) {
        let known = known.map_or("from a feature file".to_owned(), |t| format!("with tuning {t}"));
        bail!(
            "store {store} has the features of phrase \"{phrase}\" {known}, not with --tuning \
             {wanted}; leave the flag out, or draw the audio file itself with --audio"
        );
    }
    let beats = beats::of_item(&rows)?;
    // The tempo goes with the beats.
    let tempo_bpm = match beats.source() {
        Some(BeatSource::BeatsFile) => rows.rows::<PhraseRow>()?.pop().and_then(|p| p.tempo_bpm),
        Some(BeatSource::Tracker) => beats.tempo_bpm(),
        _ => extraction.and_then(|e| e.tempo_bpm),
    };
    Ok(PlottedFeatures {
        title: phrase.to_owned(),
        frames,
        tempo_bpm,
        beat_times_s: beats.times_s().to_vec(),
    })
}

/// Returns why a phrase has no features in the store, and the way out.
fn missing(store: &Location, phrase: &str, rows: &ItemTables) -> Result<anyhow::Error, StoreError> {
    let failures: Vec<FailureRow> = rows.rows()?;
    // What extract says is later than what ingest says.
    let last = failures.into_iter().max_by_key(|failure| failure.stage == Extract::NAME);
    if let Some(failure) = last {
        return Ok(anyhow!(
            "store {store} has no features of phrase \"{phrase}\", since {} failed on it: {}",
            failure.stage,
            failure.message
        ));
    }
    let known: Option<PhraseRow> = rows.rows()?.pop();
    if known.as_ref().is_some_and(|row| !row.has_audio && !row.has_features) {
        return Ok(anyhow!(
            "store {store}: phrase \"{phrase}\" has neither audio nor a feature file, so there are \
             no features to draw; ingest it with its audio, then run extract"
        ));
    }
    let mut names: Vec<String> = Vec::new();
    if known.is_none() {
        let extractions: Vec<ExtractionRow> =
            Snapshot::take(store, ExtractionRow::schema())?.rows()?;
        names = extractions.into_iter().map(|row| row.phrase_id).collect();
    }
    if names.is_empty() {
        return Ok(anyhow!(
            "store {store} has no features of phrase \"{phrase}\"; run motiongen extract --store \
             {store} first"
        ));
    }
    let nearest = nearest(phrase, names);
    Ok(anyhow!("store {store} has no phrase \"{phrase}\"; nearest: {nearest}"))
}
