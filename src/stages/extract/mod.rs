//! `extract`: audio becomes the tables `features`, `extractions` and `beats`, or feature files.

mod files;
mod one;
mod phrases;

use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use super::failure::{Failure, N_SHOWN, failures_json, write_failures};
use super::{ClientParams, Contract, Progress, RARE, Stage, Summary, all_threads};
use crate::audio::Tuning;
use crate::store::{Location, Shard, digest};

pub use one::{ExtractRules, ExtractedFeatures};
pub(in crate::stages) use one::{Origin, extract, needed_bytes};
pub(in crate::stages) use phrases::survey;

/// Raised when extract writes something else for the same input and parameters.
const OUTPUT_VERSION: u32 = 2;

/// The stage.
pub struct Extract;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables: extracts every phrase that has audio (or a feature file) and
    /// no current features. Not used with --audio.
    #[arg(long, value_name = "URL", required_unless_present = "audio")]
    pub store: Option<String>,
    /// Audio files to extract without a store (WAV, AIFF, AU, CAF, FLAC, MP3, Ogg Vorbis, Opus, M4A or AAC).
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "output")]
    pub audio: Vec<PathBuf>,
    /// With --audio: FILE.npz for one file, FILE.parquet for any number in one table, or a folder for
    /// one NAME.npz each.
    #[arg(long, value_name = "FILE|DIR", requires = "audio")]
    pub output: Option<PathBuf>,
    /// Deviation from A440 in bins of 1/36 octave, from -0.5 to below 0.5, instead of the estimate.
    #[arg(long, value_name = "BINS", allow_hyphen_values = true, hide_short_help = RARE)]
    pub tuning: Option<Tuning>,
    /// Part of the job that this process does: i/n, or auto inside an array job.
    #[arg(long, value_name = "I/N", default_value_t = Shard::WHOLE.to_string())]
    pub shard: String,
    /// Files under way at once.
    #[arg(long, value_name = "N", default_value_t = all_threads())]
    pub workers: NonZeroUsize,
    /// Memory that the files under way may take, in GB (10^9 bytes); a file that needs more is done
    /// alone.
    #[arg(long, value_name = "GB", default_value_t = 2.0)]
    pub memory: f64,
    /// Longest time for one file, in seconds; then it counts as failed.
    #[arg(long, value_name = "S", default_value_t = 900.0, hide_short_help = RARE)]
    pub timeout: f64,
    /// Longest audio of one file, in seconds; a longer one counts as failed.
    #[arg(long, value_name = "S", default_value_t = 24.0 * 3600.0, hide_short_help = RARE)]
    pub max_duration: f64,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Do every phrase again, done or not.
    #[arg(long)]
    pub force: bool,
}

/// Settings that extraction from a store and from files share.
struct ExtractJob<'a> {
    rules: ExtractRules,
    n_workers: NonZeroUsize,
    memory_bytes: u64,
    dry_run: bool,
    progress: &'a dyn Progress,
}

impl Stage for Extract {
    const NAME: &'static str = "extract";
    const ABOUT: &'static str = "extract the 163 audio features and the beats";
    const CONTRACT: Contract = Contract {
        reads: "phrases and their audio, or audio files",
        writes: "features, extractions, beats, failures, or feature files",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        let positive = |flag: &str, value: f64| {
            if value > 0.0 {
                return Ok(value);
            }
            Err(anyhow::anyhow!("{flag} {value} is not above 0; give a positive number"))
        };
        let timeout_s = positive("--timeout", params.timeout)?;
        let job = ExtractJob {
            rules: ExtractRules {
                tuning: params.tuning,
                max_duration_s: positive("--max-duration", params.max_duration)?,
                timeout: Duration::try_from_secs_f64(timeout_s).unwrap_or(Duration::MAX),
            },
            n_workers: params.workers,
            memory_bytes: (positive("--memory", params.memory)? * 1e9) as u64,
            dry_run: params.dry_run,
            progress,
        };
        let output = params.output.as_ref().filter(|_| !params.audio.is_empty());
        let (place, done) = match (&params.store, output) {
            (_, Some(output)) => {
                let done = files::run(&job, &params.audio, output)?;
                (ExtractPlace::Files(output.display().to_string()), done)
            }
            (Some(store), None) => {
                let options = params.client.options();
                let store = Location::open(store, &options)?;
                let target = phrases::StoreTarget {
                    store: &store,
                    options,
                    shard: Shard::parse(&params.shard, |name| std::env::var(name).ok())?,
                    params_hash: &params_hash(params.tuning),
                    force: params.force,
                };
                (ExtractPlace::Store(store.to_string()), phrases::run(&job, &target)?)
            }
            (None, None) => anyhow::bail!("nothing to do: give --store, or --audio with --output"),
        };
        let took_s = started.elapsed().as_secs_f64();
        Ok(Box::new(ExtractSummary { place, done, dry_run: params.dry_run, took_s }))
    }
}

/// Returns the digest of everything but the input that determines extract's output.
fn params_hash(tuning: Option<Tuning>) -> String {
    let tuning = tuning.map(Tuning::bins);
    let text = serde_json::json!({ "output_version": OUTPUT_VERSION, "tuning": tuning });
    digest(text.to_string().as_bytes())
}

/// Counts of the files that were extracted, unchanged or failed.
#[derive(Debug, Default)]
struct ExtractTally {
    n_todo: u64,
    todo_s: f64,
    n_unchanged: u64,
    /// Phrases with neither audio nor a feature file.
    n_without: u64,
    n_frames: u64,
    duration_s: f64,
    n_imported: u64,
    /// Name, missing seconds, and whether they are missing at the end, of files that lack some.
    short: Vec<(String, f64, bool)>,
    /// One line on each of the first files that were done.
    told: Vec<String>,
    n_done: u64,
    failed: Vec<(String, Failure)>,
    /// Whether files are left because the user asked for an end.
    is_stopped: bool,
}

impl ExtractTally {
    fn add(&mut self, name: &str, outcome: &Result<ExtractedFeatures, Failure>) {
        match outcome {
            Ok(extracted) => {
                self.n_done += 1;
                self.n_frames += extracted.frames.nrows() as u64;
                self.duration_s += extracted.duration_s();
                self.n_imported += u64::from(extracted.audio.is_none());
                if extracted.lost_s() > 0.0 {
                    let is_truncated = extracted.audio.is_some_and(|h| h.loss.is_truncated);
                    self.short.push((name.to_owned(), extracted.lost_s(), is_truncated));
                }
                if self.told.len() <= N_SHOWN {
                    self.told.push(told(name, extracted));
                }
            }
            Err(failure) => self.failed.push((name.to_owned(), failure.clone())),
        }
    }
}

fn told(name: &str, extracted: &ExtractedFeatures) -> String {
    let tempo = match extracted.tempo_bpm {
        Some(bpm) => format!("{bpm:.1} bpm, {} beats", extracted.beats.len()),
        None => "no tempo".to_owned(),
    };
    let tuning = extracted
        .audio
        .map_or(String::new(), |heard| format!(", tuning {:+.2}/36 octave", heard.tuning.bins()));
    let (n_frames, duration_s) = (extracted.frames.nrows(), extracted.duration_s());
    format!("{name}: {duration_s:.1} s, {n_frames} frames, {tempo}{tuning}")
}

enum ExtractPlace {
    Store(String),
    Files(String),
}

struct ExtractSummary {
    place: ExtractPlace,
    done: ExtractTally,
    dry_run: bool,
    took_s: f64,
}

impl Summary for ExtractSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let ExtractSummary { place, done, took_s, .. } = self;
        let (ExtractPlace::Store(name) | ExtractPlace::Files(name)) = &*place;
        let items = if matches!(place, ExtractPlace::Store(_)) { "phrases" } else { "files" };
        writeln!(out, "extract → {name}")?;
        if self.dry_run {
            let ExtractTally { n_todo, todo_s, n_unchanged, .. } = done;
            writeln!(
                out,
                "  would extract {n_todo} {items} ({todo_s:.1} s of audio), leave {n_unchanged} as \
                 they are"
            )?;
            return Ok(());
        }
        done.failed.sort_by(|a, b| a.0.cmp(&b.0));
        let n_failed = done.failed.len();
        if done.n_todo == 0 {
            writeln!(out, "  nothing to do: {} {items} are up to date", done.n_unchanged)?;
        } else {
            writeln!(
                out,
                "  {} {items} extracted ({:.1} s, {} frames), {} up to date, {n_failed} failed; \
                 {took_s:.1} s, {:.0} × real time",
                done.n_done,
                done.duration_s,
                done.n_frames,
                done.n_unchanged,
                done.duration_s / took_s.max(1e-9)
            )?;
        }
        if done.is_stopped {
            writeln!(out, "  stopped as asked; the same command goes on with what is missing")?;
        }
        if done.n_imported > 0 {
            writeln!(out, "  {} of them brought in from feature files", done.n_imported)?;
        }
        done.short.sort_by(|a, b| a.0.cmp(&b.0));
        for (name, lost_s, is_truncated) in done.short.iter().take(N_SHOWN) {
            let what = if *is_truncated { "ends before its header says" } else { "has gaps" };
            writeln!(out, "  {name} {what}: {lost_s:.2} s are missing")?;
        }
        if done.short.len() > N_SHOWN {
            writeln!(out, "  {} more lack audio", done.short.len() - N_SHOWN)?;
        }
        if done.n_without > 0 {
            writeln!(out, "  {} phrases have neither audio nor features", done.n_without)?;
        }
        if done.told.len() <= N_SHOWN && matches!(place, ExtractPlace::Files(_)) {
            done.told.sort();
            for line in &done.told {
                writeln!(out, "  {line}")?;
            }
        }
        let store = match place {
            ExtractPlace::Store(store) => Some(store.as_str()),
            ExtractPlace::Files(_) => None,
        };
        write_failures(out, done.failed.iter().map(|(name, why)| (name, why)), store)
    }

    fn n_failed(&self) -> u64 {
        self.done.failed.len() as u64
    }

    fn is_stopped(&self) -> bool {
        self.done.is_stopped
    }

    fn figures(&mut self) -> serde_json::Value {
        let ExtractSummary { place, done, .. } = self;
        let (ExtractPlace::Store(name) | ExtractPlace::Files(name)) = &*place;
        serde_json::json!({
            "to": name,
            "dry_run": self.dry_run,
            "n_todo": done.n_todo,
            "todo_s": done.todo_s,
            "n_done": done.n_done,
            "n_unchanged": done.n_unchanged,
            "n_without_audio": done.n_without,
            "n_imported": done.n_imported,
            "n_short": done.short.len(),
            "n_frames": done.n_frames,
            "duration_s": done.duration_s,
            "failures": failures_json(done.failed.iter().map(|(name, why)| (name, why))),
            "took_s": self.took_s,
        })
    }
}
