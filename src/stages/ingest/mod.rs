//! `ingest`: phrases or a music library become the tables `phrases`, `motion` and `beats`.

mod batch;
mod layout;
mod motion;
mod phrase;
mod survey;

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Instant;

use super::{ClientParams, Contract, LinkParams, Progress, RARE, Stage, Summary, all_threads};
use crate::store::tables::PhraseRow;
use crate::store::{
    Cache, Ledger, Location, Row as _, Shard, Source, StoreError, StoreSnapshot, checkpoint, digest,
};

use super::batch::BatchJob;
use super::failure::{Failure, failures_json, write_failures, write_notes};
use super::item_state::ItemState;
use super::touched::TouchedContent;
pub(in crate::stages) use crate::audio::formats::is_audio_extension as is_audio;
pub use layout::{IngestPlan, Layout, PlannedPhrase, Role, plan};
pub(in crate::stages) use motion::{
    CAPTURE_EXTENSIONS, ReadMotion, notes_of, read_bvh, read_dancers, read_motion, read_trajectory,
};
pub(in crate::stages) use phrase::read_beats;
pub use phrase::{IngestRules, content_hash_of_audio};
pub(in crate::stages) use survey::{origins, survey};

/// Raised when ingest writes something else for the same input and rules.
const OUTPUT_VERSION: u32 = 1;
/// Raised when ingest writes something else for a phrase with a beat list, and for no other.
const BEATS_VERSION: u32 = 2;
/// The name under which phrases are committed that were seen again with nothing new.
const SEEN: &str = "ingest-seen";
/// Raised when ingest writes something else for a motion capture, and for no other phrase.
const CAPTURE_VERSION: u32 = 2;

/// The stage.
pub struct Ingest;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket with phrases, or any tree of audio files.
    #[arg(long, value_name = "URL")]
    pub source: String,
    /// Folder or bucket for the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// How the source is organised.
    #[arg(long, value_enum, value_name = "LAYOUT", default_value_t = Layout::Auto)]
    pub layout: Layout,
    #[command(flatten)]
    pub rules: IngestRules,
    /// Part of the job that this process does: i/n, or auto inside an array job.
    #[arg(long, value_name = "I/N", default_value_t = Shard::WHOLE.to_string())]
    pub shard: String,
    /// Batches under way at once.
    #[arg(long, value_name = "N", default_value_t = all_threads())]
    pub workers: NonZeroUsize,
    /// Phrases committed together, about; also how many a kill can cost each worker.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::new(512).expect("512 is not 0"),
          hide_short_help = RARE)]
    pub batch_phrases: NonZeroUsize,
    /// Keep copies of remote files in this folder and read them from there next time.
    #[arg(long, value_name = "DIR", help_heading = "Remote storage")]
    pub cache: Option<PathBuf>,
    /// Size of the cache in GB (10^9 bytes); the least recently used files leave first.
    #[arg(long, value_name = "GB", default_value_t = 20.0, help_heading = "Remote storage",
          hide_short_help = RARE)]
    pub cache_size_gb: f64,
    #[command(flatten)]
    pub links: LinkParams,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Do every phrase again, done or not.
    #[arg(long)]
    pub force: bool,
    /// Read every file again instead of trusting its size and time (or entity tag).
    #[arg(long)]
    pub verify: bool,
}

impl Stage for Ingest {
    const NAME: &'static str = "ingest";
    const ABOUT: &'static str = "bring phrases or a music library into tables";
    const CONTRACT: Contract =
        Contract { reads: "a source of files", writes: "phrases, motion, beats, failures" };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        let options = params.client.options();
        let shard = Shard::parse(&params.shard, |name| std::env::var(name).ok())?;
        let source = Source::open(&params.source, &options, open_cache(&params)?)?
            .following_links(params.links.follow_links);
        let store = Location::open(&params.store, &options)?;
        let plan = plan(source.list()?, params.layout);
        if plan.phrases.is_empty() {
            anyhow::bail!(
                "source {}: no phrases found among {} files; expected motion/ID/trajectory.npy (or \
                 motion.bvh, .npz, .npy, .vmd), audio_features/ID/features.npz, or audio files anywhere",
                source.location(),
                plan.ignored.len()
            );
        }
        if !params.dry_run {
            store.sweep();
        }
        let snapshot = StoreSnapshot::take(&store)?;
        let ledger = snapshot.ledger(Self::NAME)?;
        let seen = TouchedContent::read(&store, SEEN)?;
        let params_hash = params_hash(&params.rules);

        // With --force everything is done again anyway, also where old parts cannot be read.
        let unidentified = if params.force { BTreeSet::new() } else { unidentified(&snapshot)? };

        let mine: Vec<_> = plan.phrases.iter().filter(|p| shard.takes(&p.id)).collect();
        let origin = source.location().url();
        let batches = BatchJob {
            store: &store,
            stage: Self::NAME,
            params_hash: &params_hash,
            origin,
            ledger: &ledger,
        };
        let is_done = |p: &PlannedPhrase| {
            !params.force
                && !params.verify
                && !unidentified.contains(&p.id)
                && state(p, &ledger, &seen, &params_hash, origin).is_done()
        };
        let (done, todo): (Vec<_>, Vec<_>) = mine.into_iter().partition(|p| is_done(p));
        tracing::info!(
            source = source.location().url(),
            store = store.url(),
            %shard,
            found = plan.phrases.len(),
            done = done.len(),
            todo = todo.len(),
            ignored = plan.ignored.len(),
            "planned"
        );
        let mut report = IngestSummary {
            source: source.location().to_string(),
            store: store.to_string(),
            dry_run: params.dry_run,
            tally: IngestTally { n_unchanged: done.len() as u64, ..IngestTally::default() },
            n_todo: todo.len() as u64,
            ignored: plan.ignored,
            took_s: 0.0,
        };
        if params.dry_run {
            let problems = todo.iter().filter_map(|p| {
                let failure = *p.problem.clone()?;
                Some(FailedPhrase { id: p.id.clone(), failure })
            });
            report.tally.failed = problems.collect();
        } else {
            snapshot.checkpoint();
            progress.start("ingest", "phrases", todo.len() as u64);
            let todo = batch::batches(&plan.phrases, todo, params.batch_phrases.get());
            let job = batch::IngestJob {
                source: &source,
                batches,
                seen: &seen,
                rules: &params.rules,
                progress,
                unidentified: &unidentified,
                force: params.force,
            };
            report.tally.add(job.run(&todo, params.workers)?);
            if !report.tally.is_stopped {
                job.forget_failures(&plan.phrases, shard)?;
            }
            // The plan and the catalogue of a million phrases are not needed at once.
            drop(todo);
            drop((plan.phrases, ledger, seen));
            checkpoint(&store, &[Self::NAME]);
            progress.finish();
        }
        report.tally.failed.sort_by(|a, b| a.id.cmp(&b.id));
        report.tally.noted.sort();
        report.took_s = started.elapsed().as_secs_f64();
        Ok(Box::new(report))
    }
}

fn open_cache(params: &Params) -> Result<Option<Cache>, StoreError> {
    // A cache is made when it is opened.
    let Some(folder) = params.cache.as_ref().filter(|_| !params.dry_run) else { return Ok(None) };
    Cache::open(folder, (params.cache_size_gb * 1e9) as u64).map(Some)
}

/// Returns the digest of everything but the input that determines ingest's output.
fn params_hash(rules: &IngestRules) -> String {
    let text = serde_json::json!({ "output_version": OUTPUT_VERSION, "rules": rules }).to_string();
    digest(text.as_bytes())
}

/// Returns what the store has of a phrase for these files and rules.
///
/// Size and time tell a file's versions apart, not the files of two sources.
fn state(
    planned: &PlannedPhrase,
    ledger: &Ledger,
    seen: &TouchedContent,
    params_hash: &str,
    origin: &str,
) -> ItemState {
    let fingerprint = batch::fingerprint(planned);
    let refused = ledger.get(&batch::contested(&planned.id, origin));
    if refused.is_some_and(|known| known.item.failure.is_some()) {
        return ItemState::Failed;
    }
    ItemState::of(ledger.get(&planned.id), |known| {
        let is_same = known.origin == origin && known.item.fingerprint == fingerprint;
        known.params_hash == params_hash && (is_same || seen.has(known, origin, &fingerprint))
    })
}

/// Returns the phrases with audio or a feature file whose rows do not tell the identity of the music: release 0.1
/// did not write it.
///
/// # Errors
/// [`StoreError`] when the commits cannot be read.
fn unidentified(store: &StoreSnapshot) -> Result<BTreeSet<String>, StoreError> {
    // Rows that cannot be read cannot be mended, and do not keep others from being ingested.
    let (table, _) = store.known_table(PhraseRow::schema())?;
    let lacks = |row: &PhraseRow| {
        let has_music = row.audio_url.is_some() || row.features_url.is_some();
        row.song_hash.is_none() && has_music
    };
    let mut found = BTreeSet::new();
    for i in 0..table.parts().len() {
        if table.parts()[i].part.schema_version < table.version() {
            match table.part(i).rows_where(lacks) {
                Ok(rows) => found.extend(rows.into_iter().map(|row| row.phrase_id)),
                Err(e) => tracing::warn!("{e}; the songs of its phrases stay unknown"),
            }
        }
    }
    Ok(found)
}

/// Counts of the phrases that were ingested, unchanged or failed.
#[derive(Clone, Debug, Default)]
struct IngestTally {
    n_done: u64,
    n_unchanged: u64,
    n_frames: u64,
    /// Phrases with several dancers.
    n_groups: u64,
    duration_s: f64,
    failed: Vec<FailedPhrase>,
    /// Whether batches are left because the user asked for an end.
    is_stopped: bool,
    /// Captures of which a reader should know something, and what.
    noted: Vec<(String, String)>,
}

/// A phrase that failed, for the summary.
#[derive(Clone, Debug)]
struct FailedPhrase {
    id: String,
    failure: Failure,
}

impl IngestTally {
    fn add(&mut self, other: IngestTally) {
        self.n_done += other.n_done;
        self.n_unchanged += other.n_unchanged;
        self.n_frames += other.n_frames;
        self.n_groups += other.n_groups;
        self.duration_s += other.duration_s;
        self.failed.extend(other.failed);
        self.is_stopped |= other.is_stopped;
        self.noted.extend(other.noted);
    }
}

struct IngestSummary {
    source: String,
    store: String,
    dry_run: bool,
    tally: IngestTally,
    n_todo: u64,
    ignored: Vec<String>,
    took_s: f64,
}

impl Summary for IngestSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let IngestSummary { tally, n_todo, took_s, .. } = self;
        let n_failed = tally.failed.len();
        writeln!(out, "ingest {} → {}", self.source, self.store)?;
        if self.dry_run {
            writeln!(
                out,
                "  would read {n_todo} phrases ({} of them cannot be read), leave {} as they are",
                n_failed, tally.n_unchanged
            )?;
        } else if *n_todo == 0 {
            writeln!(out, "  nothing to do: {} phrases are up to date", tally.n_unchanged)?;
        } else {
            let groups = match tally.n_groups {
                0 => String::new(),
                1 => ", 1 group of dancers".to_owned(),
                n => format!(", {n} groups of dancers"),
            };
            writeln!(
                out,
                "  {} ingested ({:.1} s of music or motion, {} motion frames{groups}), {} up to date, \
                 {n_failed} failed; {took_s:.1} s, {:.0} phrases/s",
                tally.n_done,
                tally.duration_s,
                tally.n_frames,
                tally.n_unchanged,
                *n_todo as f64 / took_s.max(1e-9)
            )?;
        }
        if tally.is_stopped {
            writeln!(out, "  stopped as asked; the same command goes on with what is missing")?;
        }
        if let Some(first) = self.ignored.first() {
            let n = self.ignored.len();
            writeln!(out, "  {n} files belong to no phrase and were left alone, such as {first}")?;
        }
        let all = format!(
            "motiongen query --store {} \"select phrase_id, motion_notes from phrases where motion_notes is \
             not null\"",
            self.store
        );
        let noted = tally.noted.iter().map(|(id, note)| (format!("phrase {id}"), note.as_str()));
        write_notes(out, noted, Some(&all))?;
        let failed =
            tally.failed.iter().map(|refused| (format!("phrase {}", refused.id), &refused.failure));
        write_failures(out, failed, (!self.dry_run).then_some(&self.store))
    }

    fn n_failed(&self) -> u64 {
        if self.dry_run { 0 } else { self.tally.failed.len() as u64 }
    }

    fn is_stopped(&self) -> bool {
        self.tally.is_stopped
    }

    fn figures(&mut self) -> serde_json::Value {
        let IngestSummary { tally, .. } = self;
        serde_json::json!({
            "source": self.source,
            "store": self.store,
            "dry_run": self.dry_run,
            "n_todo": self.n_todo,
            "n_done": tally.n_done,
            "n_unchanged": tally.n_unchanged,
            "n_frames": tally.n_frames,
            "n_groups": tally.n_groups,
            "duration_s": tally.duration_s,
            "n_ignored": self.ignored.len(),
            "failures": failures_json(tally.failed.iter().map(|one| (&one.id, &one.failure))),
            "took_s": self.took_s,
        })
    }
}
