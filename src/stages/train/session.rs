//! What training and fine-tuning share: the run's name and claim, its phrases, and progress.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context as _, bail, ensure};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::autodiff::Threads;
use crate::model::Family;
use crate::motion::group::MAX_DANCERS;
use crate::stages::model_folder::is_model_name;
use crate::stages::{Progress, RARE, all_threads, lease};
use crate::store::tables::FailureRow;
use crate::store::{
    Commit, Item, Lease, Ledger, Location, Patience, PutOutcome, Row as _, StoreError, TimestampUs,
    digest,
};
use crate::training::{
    Dataset, DatasetOptions, Ensemble, ExcludedPhrase, Scales, TrainingError, Watch, differences,
    fit_scales,
};

/// Where failures of phrases come from.
const ITEMS_FROM: &str = "phrases";

/// How training runs, whatever it learns.
#[derive(Clone, Debug, clap::Args)]
pub struct MachineParams {
    /// Threads that a step runs on; the result is the same for any number.
    #[arg(long, value_name = "N", default_value_t = all_threads(), help_heading = "Machine")]
    pub threads: NonZeroUsize,
    /// Threads that make batches ahead of time; the batches are the same for any number.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN, help_heading = "Machine",
          hide_short_help = RARE)]
    pub loader_threads: NonZeroUsize,
    /// Keep all frames in memory rather than in a temporary file (see TMPDIR).
    #[arg(long, help_heading = "Machine", hide_short_help = RARE)]
    pub in_memory: bool,
    /// Seconds that a store which does not answer is waited for.
    #[arg(long, value_name = "S", default_value_t = 600.0, help_heading = "Machine",
          hide_short_help = RARE)]
    pub store_patience: f64,
    /// Share of the phrases that may be unfit to learn from; training refuses to start beyond.
    #[arg(long, value_name = "SHARE", default_value_t = 0.05, help_heading = "Machine",
          hide_short_help = RARE)]
    pub max_failed: f64,
}

impl MachineParams {
    /// Returns how long a store is waited for.
    pub fn patience(&self) -> Patience {
        let limit = Duration::try_from_secs_f64(self.store_patience).unwrap_or(Duration::ZERO);
        Patience { limit, ..Patience::default() }
    }

    /// Starts the threads that steps run on.
    ///
    /// # Errors
    /// When the system gives none.
    pub fn start_threads(&self) -> anyhow::Result<Threads> {
        Threads::start(self.threads).context("while starting threads")
    }
}

/// Refuses a name that could not be a folder everywhere.
pub fn check_run_name(run: &str) -> anyhow::Result<()> {
    ensure!(
        is_model_name(run),
        "--run {run:?} is no name for a run; use 1 to 100 letters, digits, -, _ and ., and no . \
         at the beginning"
    );
    Ok(())
}

/// Takes the lease to write a run; other processes that ask for it meanwhile wait or are refused.
///
/// # Errors
/// [`StoreError::Held`] when another process writes it.
pub fn lease_of(store: &Location, run: &str, watch: &ProgressWatch) -> Result<Lease, StoreError> {
    let note = |text: &str| watch.note(text);
    lease::take(store, &format!("runs/{run}"), &format!("run {run}"), &note).map(|(lease, _)| lease)
}

/// Returns where a command's claim on a run lies below the store.
pub fn claim_path(run: &str, command: &str) -> String {
    format!("runs/{run}/{command}.json")
}

/// Claims a run's name for a configuration.
///
/// # Errors
/// [`TrainingError::OtherConfig`] when the run has another one.
pub fn claim<C: Serialize + DeserializeOwned>(
    store: &Location,
    run: &str,
    command: &str,
    config: &C,
    patience: Patience,
    watch: &ProgressWatch,
) -> anyhow::Result<()> {
    let path = claim_path(run, command);
    let text = serde_json::to_vec_pretty(config)?;
    let notice = |error: &StoreError, pause| watch.notice(error, pause);
    let put = patience.wait_out(notice, || store.put_new(&path, text.clone().into()))?;
    if put == PutOutcome::AlreadyThere {
        let known = patience.wait_out(notice, || store.read(&path))?;
        let known: C = serde_json::from_slice(&known).map_err(|e| TrainingError::Checkpoint {
            place: store.url_of(&path),
            reason: format!(
                "is the configuration of another version of motiongen, or damaged ({e}); give the run \
                 another name, or start it anew with --force"
            ),
        })?;
        let differences = differences(config, &known);
        if !differences.is_empty() {
            bail!(TrainingError::OtherConfig { run: run.to_owned(), differences });
        }
    }
    Ok(())
}

/// Phrases that are ready to learn from.
pub struct TrainingPhrases {
    pub dataset: Arc<Dataset>,
    pub left_out: Vec<ExcludedPhrase>,
}

/// Reads the phrases of a store and records those that are left out, unless nothing may be written.
///
/// # Errors
/// When there are none, or too many are left out.
pub fn read_phrases(
    store: &Location,
    command: &'static str,
    (machine, family): (&MachineParams, Family),
    max_train_phrases: Option<usize>,
    progress: &dyn Progress,
    watch: &ProgressWatch,
    is_dry_run: bool,
) -> anyhow::Result<TrainingPhrases> {
    let reading = DatasetOptions {
        in_memory: machine.in_memory,
        n_threads: machine.threads,
        patience: machine.patience(),
        max_train_phrases,
        ensemble: match family {
            Family::Unet | Family::Tokens => Ensemble::Soloists,
            Family::Group => Ensemble::Groups { most: MAX_DANCERS },
        },
    };
    let is_begun = Mutex::new(false);
    let count = |_: usize, n_parts: usize| {
        let mut is_begun = is_begun.lock().unwrap_or_else(PoisonError::into_inner);
        if !std::mem::replace(&mut *is_begun, true) {
            progress.start("read", "parts", n_parts as u64);
        }
        progress.advance(1);
    };
    let notice = |error: &StoreError, pause| watch.notice(error, pause);
    let read = Dataset::read(store, &reading, &notice, &count);
    progress.finish();
    let (dataset, left_out) = read?;
    if !is_dry_run {
        record(store, command, &left_out)?;
    }
    // Phrases for other models are recorded, but nothing is wrong with them.
    let failed: Vec<&ExcludedPhrase> =
        left_out.iter().filter(|one| !one.is_for_other_models()).collect();
    let n_all = dataset.phrases().len() + failed.len();
    let share = failed.len() as f64 / n_all.max(1) as f64;
    if share > machine.max_failed {
        let first = failed.first().map_or("", |one| one.message.as_str());
        bail!(
            "{} of {n_all} phrases ({:.1} %) cannot be learned from, more than --max-failed {:.1} %; they \
             are in the table of failures. The first: {first}",
            failed.len(),
            100.0 * share,
            100.0 * machine.max_failed
        );
    }
    dataset.check_splits(&store.to_string())?;
    Ok(TrainingPhrases { dataset: Arc::new(dataset), left_out })
}

/// Fits the scales of motion and features, and says which channels are constant.
///
/// # Errors
/// When the frames at hand cannot be read.
pub fn scales(
    dataset: &Dataset,
    n_frames: usize,
    watch: &ProgressWatch,
) -> Result<Scales, StoreError> {
    let (scales, constant) = fit_scales(dataset, n_frames)?;
    if !constant.is_empty() {
        watch.note(&format!(
            "constant in all training phrases, kept in their own unit: {}",
            constant.join(", ")
        ));
    }
    Ok(scales)
}

/// Writes phrases that are left out into the table of failures, and withdraws those that are not any more.
fn record(
    store: &Location,
    command: &'static str,
    left_out: &[ExcludedPhrase],
) -> Result<(), StoreError> {
    let ledger = Ledger::read(store, command)?;
    let current: BTreeSet<&str> = left_out.iter().map(|one| one.phrase_id.as_str()).collect();
    let mut commit = Commit::new(store, command, "", ITEMS_FROM);
    let mut rows = Vec::new();
    for one in left_out {
        let failure = digest(format!("{}\n{}", one.kind, one.message).as_bytes())[..32].to_owned();
        let is_known = ledger
            .get(&one.phrase_id)
            .is_some_and(|known| known.item.failure.as_ref() == Some(&failure));
        if is_known {
            continue;
        }
        rows.push(FailureRow {
            stage: command.to_owned(),
            phrase_id: one.phrase_id.clone(),
            source: store.url().to_owned(),
            kind: one.kind.to_owned(),
            message: one.message.clone(),
            time: TimestampUs::now(),
        });
        let (id, input_hash) = (one.phrase_id.clone(), failure.clone());
        let fingerprint = String::new();
        commit.settle(Item { id, fingerprint, input_hash, failure: Some(failure) }, &ledger);
    }
    for id in ledger.failed(ITEMS_FROM).into_iter().filter(|id| !current.contains(id)) {
        commit.settle(Item::forgotten(id), &ledger);
    }
    if !rows.is_empty() {
        rows.sort_by(|a, b| a.phrase_id.cmp(&b.phrase_id));
        commit.part(FailureRow::schema().name, FailureRow::schema)?.write_rows(&rows)?;
    }
    if commit.is_empty() { Ok(()) } else { commit.publish().map(|_| ()) }
}

/// Shows the progress of a training on the command line.
pub struct ProgressWatch<'a>(pub &'a dyn Progress);

impl ProgressWatch<'_> {
    /// Says that the store does not answer.
    pub fn notice(&self, error: &StoreError, pause: Duration) {
        self.note(&format!("{error}; trying again in {:.0} s", pause.as_secs_f64()));
    }
}

impl Watch for ProgressWatch<'_> {
    fn begin(&self, stage: &'static str, step: u64, n_steps: u64) {
        self.0.start(stage, "steps", n_steps);
        self.0.skip(step);
    }

    fn step(&self, said: &str) {
        self.0.say(said);
        self.0.advance(1);
    }

    fn note(&self, line: &str) {
        self.0.note(line);
    }

    fn is_interrupted(&self) -> bool {
        self.0.is_interrupted()
    }

    fn resident_bytes(&self) -> Option<u64> {
        resident_bytes()
    }

    fn end(&self) {
        self.0.finish();
    }
}

/// Returns the memory that the process has in RAM; Linux tells, others do not.
fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes: u64 = line.trim().strip_suffix(" kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}
