//! With a store: the phrases that have no current features get them, batch by batch.
//!
//! As in ingest, a batch is a range of the phrases' stable hash, cut by the table of phrases alone:
//! every process, at any time, writes the same bytes under the same name. Files of a batch are done
//! side by side, the longest first, and the batch is committed when its last file is done.

mod inputs;
mod writer;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Mutex;

use super::one::{ExtractedFeatures, Origin, extract, needed_bytes};
use super::{Extract, ExtractJob, ExtractTally, params_hash};
use crate::stages::Stage as _;
use crate::stages::batch::{BatchJob, n_batches};
use crate::stages::beats::{self, BeatSource};
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::ingest::content_hash_of_audio;
use crate::stages::item_state::{ItemState, last_params_hash};
use crate::stages::pool::{self, Budget, lock};
use crate::store::tables::PhraseRow;
use crate::store::{
    ClientOptions, Ledger, Location, Row as _, Shard, StoreError, StoreSnapshot, batch_of,
    checkpoint,
};
use crate::units::frames_to_s;
use inputs::{PhraseInput, PhraseInputs};
use writer::BatchWriter;

/// Where the items of this stage come from, as its commits name it.
const ITEMS_FROM: &str = "phrases";
/// Most audio in a batch, about: what a kill can cost, and what waits in memory to be written.
const MAX_BATCH_S: f64 = 1800.0;
/// Most phrases in a batch, about.
const MAX_BATCH_PHRASES: usize = 512;

/// The store and what is asked of it.
pub struct StoreTarget<'a> {
    pub store: &'a Location,
    pub options: ClientOptions,
    pub shard: Shard,
    pub params_hash: &'a str,
    pub force: bool,
}

/// A phrase to extract features of.
struct PhraseTask {
    batch: usize,
    row: PhraseRow,
    origin: Origin,
    url: String,
    size_bytes: u64,
    /// Whether the table has the beats of its beat list, so that no others are written.
    has_listed_beats: bool,
}

impl PhraseTask {
    /// Returns what tells whether the phrase has to be done again beside its content: with release 0.1, beats
    /// were written for all phrases.
    fn fingerprint(&self) -> String {
        let content_hash = &self.row.content_hash;
        if self.has_listed_beats {
            format!("{content_hash} with the beats of its list")
        } else {
            content_hash.clone()
        }
    }
}

type PhraseOutcome = Result<ExtractedFeatures, Failure>;

/// A batch under way.
struct PhraseBatch {
    n_missing: usize,
    outcomes: BTreeMap<String, (PhraseTask, PhraseOutcome)>,
}

/// Extracts the features of every phrase of `target` that lacks them.
///
/// # Errors
/// When the store cannot be read or written; what was committed stays.
pub fn run(job: &ExtractJob<'_>, target: &StoreTarget<'_>) -> anyhow::Result<ExtractTally> {
    let snapshot = StoreSnapshot::take(target.store)?;
    // Rows of other shards are counted and dropped, so that a task's memory is that of its shard.
    let mut table = TableCount::default();
    let rows: Vec<PhraseRow> =
        snapshot.table(PhraseRow::schema())?.rows_where(|row: &PhraseRow| {
            table.add(row);
            target.shard.takes(&row.phrase_id)
        })?;
    if table.n_rows == 0 {
        anyhow::bail!(
            "store {} has no phrases; run first: motiongen ingest --source … --store {}",
            target.store,
            target.store
        );
    }
    let ledger =
        snapshot.ledger_where(Extract::NAME, |id| target.shard.takes(without_suffix(id)))?;
    let names: BTreeSet<String> = rows.iter().map(|row| row.phrase_id.clone()).collect();
    let listed = with_listed_beats(&snapshot, &rows)?;
    let mut tasks = plan(rows, &listed, table.n_batches());
    let n_without = (table.n_recorded - table.n_with_input) as u64;
    let mut done = ExtractTally { n_without, ..ExtractTally::default() };
    let n_mine = tasks.len();
    let batches = BatchJob {
        store: target.store,
        stage: Extract::NAME,
        params_hash: target.params_hash,
        origin: ITEMS_FROM,
        ledger: &ledger,
    };
    tasks.retain(|task| target.force || !state(task, &ledger, target.params_hash).is_done());
    done.n_unchanged = (n_mine - tasks.len()) as u64;
    done.n_todo = tasks.len() as u64;
    // An empty sum of f64 is -0.
    done.todo_s = tasks.iter().fold(0.0, |sum, task| sum + task.row.duration_s);
    if job.dry_run {
        return Ok(done);
    }
    target.store.sweep();
    snapshot.checkpoint();
    job.progress.start_audio("extract", done.todo_s.ceil() as u64);
    let writer = BatchWriter { job: batches, force: target.force };
    let done = Mutex::new(done);
    work_off(job, target, tasks, &writer, &done)?;
    if !lock(&done).is_stopped {
        batches.forget_failures(|id| {
            let phrase = without_suffix(id);
            !names.contains(phrase) && target.shard.takes(phrase)
        })?;
    }
    job.progress.finish();
    checkpoint(target.store, &[Extract::NAME]);
    Ok(done.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
}

/// Returns the phrases of whose beat lists ingest wrote the beats; release 0.1 did not.
fn with_listed_beats(
    store: &StoreSnapshot,
    rows: &[PhraseRow],
) -> Result<BTreeSet<String>, StoreError> {
    let with_list: BTreeSet<&str> = rows
        .iter()
        .filter(|row| row.beats_url.is_some())
        .map(|row| row.phrase_id.as_str())
        .collect();
    if with_list.is_empty() {
        return Ok(BTreeSet::new());
    }
    let known = beats::of_phrases(store, |id| with_list.contains(id))?;
    let listed = known.into_iter().filter(|(_, b)| b.source() == Some(BeatSource::BeatsFile));
    Ok(listed.map(|(id, _)| id).collect())
}

/// What the batches depend on: the whole table, whatever the shard.
#[derive(Default)]
struct TableCount {
    n_rows: usize,
    /// Phrases that were not constructed: those have features of their song, without a file of their own.
    n_recorded: usize,
    /// Phrases with a file that features come from, and their length.
    n_with_input: usize,
    total_s: f64,
}

impl TableCount {
    fn add(&mut self, row: &PhraseRow) {
        self.n_rows += 1;
        self.n_recorded += usize::from(!row.is_constructed());
        if input_of(row).is_some() {
            self.n_with_input += 1;
            self.total_s += row.duration_s;
        }
    }

    fn n_batches(&self) -> u64 {
        let by_length = (self.total_s / MAX_BATCH_S).ceil() as u64;
        n_batches(self.n_with_input.div_ceil(MAX_BATCH_PHRASES), by_length)
    }
}

/// Returns the file that a phrase's features come from, and its size.
fn input_of(row: &PhraseRow) -> Option<(Origin, &String, Option<i64>)> {
    match (&row.audio_url, &row.features_url) {
        (Some(url), _) => Some((Origin::Audio, url, row.audio_bytes)),
        (None, Some(url)) => Some((Origin::FeatureFile, url, row.features_bytes)),
        (None, None) => None,
    }
}

/// Returns the phrases that can have features, with their batches, in the order of work.
fn plan(rows: Vec<PhraseRow>, listed: &BTreeSet<String>, n_batches: u64) -> Vec<PhraseTask> {
    let with_input = |row: PhraseRow| {
        let (origin, url, size_bytes) = input_of(&row)?;
        let url = url.clone();
        let size_bytes = size_bytes.and_then(|n| u64::try_from(n).ok()).unwrap_or(0);
        let has_listed_beats = listed.contains(&row.phrase_id);
        Some(PhraseTask { batch: 0, row, origin, url, size_bytes, has_listed_beats })
    };
    let mut tasks: Vec<PhraseTask> = rows.into_iter().filter_map(with_input).collect();
    for task in &mut tasks {
        task.batch = batch_of(&task.row.phrase_id, n_batches) as usize;
    }
    let size = |task: &PhraseTask| (task.row.duration_s * 1e3) as u64;
    tasks.sort_by(|a, b| {
        (a.batch, Reverse(size(a)), &a.row.phrase_id).cmp(&(
            b.batch,
            Reverse(size(b)),
            &b.row.phrase_id,
        ))
    });
    tasks
}

/// Returns what the store has of the phrase's features for this content and these parameters.
fn state(task: &PhraseTask, ledger: &Ledger, params_hash: &str) -> ItemState {
    let id = &task.row.phrase_id;
    if ledger.get(&beside(id)).is_some_and(|known| known.item.failure.is_some()) {
        return ItemState::Failed;
    }
    ItemState::of(ledger.get(id), |known| {
        known.params_hash == params_hash
            && known.item.input_hash == task.row.content_hash
            && known.item.fingerprint == task.fingerprint()
    })
}

/// Returns every phrase that can have features with what the store has of them, by the parameters of the last run, and
/// whether those are the ones without `--tuning`.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn survey(snapshot: &StoreSnapshot) -> Result<(Vec<(String, ItemState)>, bool), StoreError> {
    let rows: Vec<PhraseRow> = snapshot.table(PhraseRow::schema())?.rows()?;
    let ledger = snapshot.ledger(Extract::NAME)?;
    let usual = params_hash(None);
    let params_hash = last_params_hash(&ledger, &usual, |_| true).unwrap_or_else(|| usual.clone());
    let listed = with_listed_beats(snapshot, &rows)?;
    let mut table = TableCount::default();
    rows.iter().for_each(|row| table.add(row));
    let tasks = plan(rows, &listed, table.n_batches());
    let states = tasks.iter().map(|task| {
        let state = state(task, &ledger, &params_hash);
        (task.row.phrase_id.clone(), state)
    });
    Ok((states.collect(), params_hash == usual))
}

/// Returns whether a file with this digest can be the one that ingest saw.
///
/// The table has one digest of all files of a phrase, which is enough to tell where there is one.
fn is_as_recorded(task: &PhraseTask, hash: &str) -> bool {
    let row = &task.row;
    let is_alone =
        row.motion_url.is_none() && row.features_url.is_none() && row.beats_url.is_none();
    !is_alone || content_hash_of_audio(hash) == row.content_hash
}

/// Refuses audio that is longer or shorter than ingest read in its header, by more than a frame,
/// unless what is missing was counted.
fn as_long_as_recorded(task: &PhraseTask, extracted: ExtractedFeatures) -> PhraseOutcome {
    let (found_s, said_s) = (extracted.duration_s(), task.row.duration_s);
    let is_near = |s: f64| (s - said_s).abs() <= frames_to_s(1);
    if extracted.audio.is_none() || is_near(found_s) || is_near(found_s + extracted.lost_s()) {
        return Ok(extracted);
    }
    let path = &task.url;
    let message = format!(
        "{path}: has {found_s:.2} s of audio but {said_s:.2} s by its header; re-encode the file, \
         for example with: ffmpeg -i IN OUT.flac"
    );
    Err(Failure::new(FailureKind::LengthMismatch, path, message))
}

/// The name under which a phrase fails whose earlier rows stay.
fn beside(id: &str) -> String {
    format!("{id} @ {}", Extract::NAME)
}

/// Returns the phrase of an item: the item itself, but where a phrase failed whose earlier rows stay.
fn without_suffix(item: &str) -> &str {
    item.strip_suffix(Extract::NAME).and_then(|id| id.strip_suffix(" @ ")).unwrap_or(item)
}

fn work_off(
    job: &ExtractJob<'_>,
    target: &StoreTarget<'_>,
    tasks: Vec<PhraseTask>,
    writer: &BatchWriter<'_>,
    done: &Mutex<ExtractTally>,
) -> anyhow::Result<()> {
    let mut batches: HashMap<usize, PhraseBatch> = HashMap::new();
    for task in &tasks {
        let empty = || PhraseBatch { n_missing: 0, outcomes: BTreeMap::new() };
        batches.entry(task.batch).or_insert_with(empty).n_missing += 1;
    }
    let batches = Mutex::new(batches);
    let budget = Budget::new(job.memory_bytes);
    let mut inputs = PhraseInputs::open(&tasks, &target.options);
    let mut queue = tasks.into_iter().peekable();
    let mut under_way = None;
    pool::run(
        job.n_workers,
        || {
            // After an interrupt the batch that is under way is still completed.
            let batch = Some(queue.peek()?.batch);
            if batch != under_way && job.progress.is_interrupted() {
                lock(done).is_stopped = true;
                return None;
            }
            under_way = batch;
            let task = queue.next()?;
            let input = inputs.next(&task);
            Some((task, input))
        },
        |(task, input): (PhraseTask, PhraseInput)| -> anyhow::Result<()> {
            let PhraseInput { file, content, permit: _permit } = input;
            let outcome = {
                let _share = budget.take(needed_bytes(task.row.duration_s, task.size_bytes));
                extract(task.origin, &file, content, |hash| is_as_recorded(&task, hash), &job.rules)
                    .and_then(|extracted| as_long_as_recorded(&task, extracted))
            };
            job.progress.advance(task.row.duration_s.round() as u64);
            lock(done).add(&task.row.phrase_id, &outcome);
            let number = task.batch;
            let finished = {
                let mut batches = lock(&batches);
                let Some(batch) = batches.get_mut(&number) else { return Ok(()) };
                batch.outcomes.insert(task.row.phrase_id.clone(), (task, outcome));
                batch.n_missing -= 1;
                if batch.n_missing == 0 { batches.remove(&number) } else { None }
            };
            if let Some(batch) = finished {
                writer.commit(batch)?;
            }
            Ok(())
        },
    )
}
