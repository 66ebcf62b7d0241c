//! The phrases of a store, made batch by batch.
//!
//! As in extract, a batch is a range of the phrases' stable hash, cut by the table of phrases alone: every
//! process, at any time, writes the same motions under the same name. Phrases of a batch are made side by side,
//! and the batch is committed when its last one is done.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::num::NonZeroUsize;
use std::sync::Mutex;

use anyhow::bail;
use ndarray::Array2;

use super::maker::{GeneratedMotion, MotionMaker, generation_id};
use super::music::PhraseMusic;
use super::params::Tracks;
use super::{Generate, GenerateTally};
use crate::stages::batch::{BatchJob, n_batches};
use crate::stages::beats::{self, BeatSource, PhraseBeats};
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::item_state::ItemState;
use crate::stages::pool::{self, lock};
use crate::stages::{Progress, Stage as _, lease};
use crate::store::tables::{self, ExtractionRow, GenerationRow, PhraseRow};
use crate::store::{
    Item, Label, Ledger, Location, Row as _, Shard, Snapshot, StoreError, StoreSnapshot, batch_of,
    checkpoint, digest, outdated_features,
};
use crate::units::frames_to_s;

/// Where the items of this stage come from, as its commits name it.
const ITEMS_FROM: &str = "phrases";
/// Most music in a batch, about: what a kill can cost.
const MAX_BATCH_S: f64 = 600.0;
/// Most phrases in a batch, about.
const MAX_BATCH_PHRASES: usize = 64;
/// Most frames of features that are read ahead: 85 MB.
const MAX_FRAMES_AHEAD: usize = 128 << 10;

/// The store and what is asked of it.
pub struct TrackTarget<'a> {
    pub store: &'a Location,
    pub shard: Shard,
    pub params_hash: &'a str,
    pub force: bool,
    pub dry_run: bool,
    pub tracks: Tracks,
    pub split: Option<&'a str>,
    /// Only these; all where empty.
    pub phrases: &'a [String],
    pub n_samples: usize,
    pub n_workers: NonZeroUsize,
}

impl<'a> TrackTarget<'a> {
    fn batches(&self, ledger: &'a Ledger) -> BatchJob<'a> {
        BatchJob {
            store: self.store,
            stage: Generate::NAME,
            params_hash: self.params_hash,
            origin: ITEMS_FROM,
            ledger,
        }
    }
}

/// A phrase to generate motion for.
pub struct TrackTask {
    batch: u64,
    pub row: PhraseRow,
    n_frames: usize,
    beats: PhraseBeats,
    /// Whether its features are of other content than it has now.
    has_old_features: bool,
    /// Samples that are missing.
    samples: Vec<usize>,
}

impl TrackTask {
    /// Returns what tells whether motions have to be made again though the phrase's files are the same. Beats that
    /// are as release 0.1 had them leave its motions alone.
    fn fingerprint(&self) -> String {
        let content_hash = &self.row.content_hash;
        let is_newer =
            self.beats.is_numbered() || self.beats.source() == Some(BeatSource::BeatsFile);
        if is_newer {
            digest(format!("{content_hash}\n{}", self.beats.describe()).as_bytes())
        } else {
            content_hash.clone()
        }
    }

    /// Returns what the store has of a motion of a run for this content, these beats and the parameters of `target`.
    pub fn state(
        &self,
        run: &str,
        sample: usize,
        ledger: &Ledger,
        target: &TrackTarget,
    ) -> ItemState {
        let known = ledger.get(&generation_id(run, &self.row.phrase_id, sample));
        let state = ItemState::of(known, |known| {
            known.params_hash == target.params_hash
                && known.item.input_hash == self.row.content_hash
                && known.item.fingerprint == self.fingerprint()
        });
        let failure = known.and_then(|known| known.item.failure.as_deref());
        match failure {
            Some(failure) if self.is_mended(failure, target.store) => ItemState::Missing,
            _ => state,
        }
    }

    /// Returns whether a failure was for want of features that are there now.
    fn is_mended(&self, failure: &str, store: &Location) -> bool {
        let for_want =
            || [with_old_features(&self.row, store), without_features(&self.row, store, None)];
        self.n_frames > 0
            && !self.has_old_features
            && for_want().iter().any(|known| known.digest() == failure)
    }
}

type TrackOutcome = Result<GeneratedMotion, Failure>;

/// Makes what `target` lacks.
///
/// # Errors
/// When the store cannot be read or written; what was committed stays.
pub fn run(
    maker: &dyn MotionMaker,
    target: &TrackTarget,
    progress: &dyn Progress,
) -> anyhow::Result<GenerateTally> {
    let mut planned = TrackPlan::new(maker, target)?;
    if target.dry_run || planned.tasks.is_empty() {
        return Ok(planned.done);
    }
    let shard = target.shard.to_string().replace('/', "-of-");
    let name = format!("{}/{}/{shard}", Generate::NAME, maker.identity().run);
    let what = format!("run {}", maker.identity().run);
    let (lease, has_waited) = lease::take(target.store, &name, &what, &|text| progress.note(text))?;
    if has_waited {
        // The other process may have made some of the motions.
        planned = TrackPlan::new(maker, target)?;
    }
    let TrackPlan { snapshot, ledger, tasks, mut done } = planned;
    target.store.sweep();
    snapshot.checkpoint();
    progress.start_audio("generate", done.todo_s.ceil() as u64);
    let mut batches: BTreeMap<u64, Vec<TrackTask>> = BTreeMap::new();
    for task in tasks {
        batches.entry(task.batch).or_default().push(task);
    }
    let batches: Vec<Vec<TrackTask>> = batches.into_values().collect();
    let mut ahead = MusicAhead::new(&snapshot)?;
    for (i, tasks) in batches.iter().enumerate() {
        ahead.read(&batches[i..])?;
        let outcomes = make_batch(maker, target, tasks, &ahead, progress)?;
        done.add(&outcomes);
        lease.check()?;
        commit(maker, target.batches(&ledger), tasks, outcomes)?;
        ahead.forget(tasks);
        if progress.is_interrupted() && i + 1 < batches.len() {
            done.is_interrupted = true;
            break;
        }
    }
    progress.finish();
    checkpoint(target.store, &[Generate::NAME]);
    Ok(done)
}

/// The store as it was when it was looked at, and what it lacks.
struct TrackPlan {
    snapshot: StoreSnapshot,
    ledger: Ledger,
    tasks: Vec<TrackTask>,
    done: GenerateTally,
}

impl TrackPlan {
    fn new(maker: &dyn MotionMaker, target: &TrackTarget) -> anyhow::Result<Self> {
        let snapshot = StoreSnapshot::take(target.store)?;
        let ledger = snapshot.ledger(Generate::NAME)?;
        let mut done = GenerateTally::default();
        let mut tasks = plan(target, &snapshot)?;
        for task in &mut tasks {
            let is_left = |sample: &usize| {
                target.force
                    || !task.state(&maker.identity().run, *sample, &ledger, target).is_done()
            };
            task.samples = (0..target.n_samples).filter(is_left).collect();
            done.n_unchanged += (target.n_samples - task.samples.len()) as u64;
        }
        tasks.retain(|task| !task.samples.is_empty());
        done.n_todo = tasks.iter().map(|task| task.samples.len() as u64).sum();
        done.todo_s =
            tasks.iter().map(|task| frames_to_s(task.n_frames) * task.samples.len() as f64).sum();
        Ok(Self { snapshot, ledger, tasks, done })
    }
}

/// The features of the batches that come next. Parts of `features` hold the phrases of several batches, so
/// batches that lie side by side are read together.
struct MusicAhead {
    table: Snapshot,
    /// Why parts of the table are not read.
    unknown: Option<String>,
    at_hand: HashMap<String, Array2<f32>>,
    /// Batches that were read, and not made yet.
    n_ahead: usize,
}

impl MusicAhead {
    fn new(snapshot: &StoreSnapshot) -> Result<Self, StoreError> {
        let (table, unknown) = snapshot.known_table(tables::features())?;
        let unknown = unknown.map(|e| e.to_string());
        Ok(Self { table, unknown, at_hand: HashMap::new(), n_ahead: 0 })
    }

    /// Reads the features of the first of `batches` and of those behind it that fit, unless they are at hand.
    fn read(&mut self, batches: &[Vec<TrackTask>]) -> Result<(), StoreError> {
        if self.n_ahead > 0 {
            return Ok(());
        }
        let (mut wanted, mut n_frames) = (BTreeSet::new(), 0);
        for tasks in batches {
            n_frames += tasks.iter().map(|task| task.n_frames).sum::<usize>();
            if self.n_ahead > 0 && n_frames > MAX_FRAMES_AHEAD {
                break;
            }
            wanted.extend(tasks.iter().map(|task| task.row.phrase_id.clone()));
            self.n_ahead += 1;
        }
        let at_hand = &mut self.at_hand;
        self.table.visit_items(&wanted, |id, frames| {
            at_hand.insert(id.to_owned(), frames);
            Ok(())
        })
    }

    /// Drops the features of a batch that was made.
    fn forget(&mut self, tasks: &[TrackTask]) {
        self.n_ahead = self.n_ahead.saturating_sub(1);
        for task in tasks {
            self.at_hand.remove(&task.row.phrase_id);
        }
    }
}

/// Returns the phrases that are to have motions, in the order in which they are made.
pub fn plan(target: &TrackTarget, snapshot: &StoreSnapshot) -> anyhow::Result<Vec<TrackTask>> {
    let store = target.store;
    let mut extracted: HashMap<String, i64> = HashMap::new();
    snapshot.table(ExtractionRow::schema())?.rows_where(|row: &ExtractionRow| {
        extracted.insert(row.phrase_id.clone(), row.n_frames);
        false
    })?;
    let is_wanted = |row: &PhraseRow| {
        let is_of_kind = match target.tracks {
            Tracks::All => true,
            Tracks::Constructed => row.is_constructed(),
            Tracks::Songs => !row.is_constructed() && (row.has_audio || row.has_features),
        };
        let is_named = target.phrases.is_empty() || target.phrases.contains(&row.phrase_id);
        let is_kind = is_of_kind || (!target.phrases.is_empty() && is_named);
        is_kind && is_named && target.split.is_none_or(|split| row.split == split)
    };
    let n_frames = |row: &PhraseRow| {
        let own = row.n_feature_frames.filter(|_| row.is_constructed());
        let n = extracted.get(row.phrase_id.as_str()).copied().or(own).unwrap_or(0);
        usize::try_from(n).unwrap_or(0)
    };
    // Batches depend on the whole table. Rows of other shards are counted and dropped, so that a task's memory is
    // that of its shard.
    let (mut n_rows, mut n_wanted, mut total_s) = (0_usize, 0_usize, 0.0);
    let mut unknown: BTreeSet<&str> = target.phrases.iter().map(String::as_str).collect();
    let rows: Vec<PhraseRow> =
        snapshot.table(PhraseRow::schema())?.rows_where(|row: &PhraseRow| {
            n_rows += 1;
            unknown.remove(row.phrase_id.as_str());
            if !is_wanted(row) {
                return false;
            }
            n_wanted += 1;
            total_s += frames_to_s(n_frames(row)) * target.n_samples as f64;
            target.shard.takes(&row.phrase_id)
        })?;
    if n_rows == 0 {
        bail!(
            "store {store} has no phrases; run first: motiongen ingest --source … --store {store}"
        );
    }
    if let Some(id) = target.phrases.iter().find(|id| unknown.contains(id.as_str())) {
        bail!("store {store} has no phrase {id}");
    }
    let by_length = (total_s / MAX_BATCH_S).ceil() as u64;
    let by_count = n_wanted.div_ceil(MAX_BATCH_PHRASES);
    let n_batches = n_batches(by_count, by_length);
    let outdated = outdated_features(snapshot, &rows)?;
    let mut tasks: Vec<TrackTask> = rows
        .into_iter()
        .map(|row| {
            let (n_frames, beats) = (n_frames(&row), PhraseBeats::default());
            let has_old_features = outdated.contains(&row.phrase_id);
            TrackTask { batch: 0, n_frames, row, beats, has_old_features, samples: Vec::new() }
        })
        .collect();
    let ids: BTreeSet<&str> = tasks.iter().map(|task| task.row.phrase_id.as_str()).collect();
    let mut beats = beats::of_phrases(snapshot, |id| ids.contains(id))?;
    for task in &mut tasks {
        task.beats = beats.remove(&task.row.phrase_id).unwrap_or_default();
        task.batch = batch_of(&task.row.phrase_id, n_batches);
    }
    tasks.sort_by(|a, b| (a.batch, &a.row.phrase_id).cmp(&(b.batch, &b.row.phrase_id)));
    Ok(tasks)
}

/// Makes the phrases of a batch side by side.
fn make_batch(
    maker: &dyn MotionMaker,
    target: &TrackTarget,
    tasks: &[TrackTask],
    ahead: &MusicAhead,
    progress: &dyn Progress,
) -> anyhow::Result<BTreeMap<String, TrackOutcome>> {
    // The longest first, so that no worker is left with it at the end.
    let mut order: Vec<(&TrackTask, usize)> = tasks
        .iter()
        .flat_map(|task| task.samples.iter().map(move |&sample| (task, sample)))
        .collect();
    order.sort_by_key(|(task, sample)| {
        (std::cmp::Reverse(task.n_frames), &task.row.phrase_id, *sample)
    });
    let mut queue = order.into_iter();
    let outcomes = Mutex::new(BTreeMap::new());
    pool::run(
        target.n_workers,
        || queue.next(),
        |(task, sample): (&TrackTask, usize)| -> anyhow::Result<()> {
            let id = &task.row.phrase_id;
            let outcome = match ahead.at_hand.get(id) {
                Some(_) if task.has_old_features => Err(with_old_features(&task.row, target.store)),
                Some(features) => {
                    let music = PhraseMusic {
                        phrase_id: id,
                        content_hash: &task.row.content_hash,
                        source: url_of(&task.row),
                        features: features.view(),
                        beats: task.beats.in_bars(&task.row),
                        // An excerpt may begin anywhere in a bar.
                        has_downbeats: task.beats.is_numbered() || !task.row.is_constructed(),
                    };
                    maker.make(&music, sample, &mut |_| Ok(()))
                }
                None => Err(without_features(&task.row, target.store, ahead.unknown.as_deref())),
            };
            progress.advance(frames_to_s(task.n_frames).round() as u64);
            lock(&outcomes).insert(generation_id(&maker.identity().run, id, sample), outcome);
            Ok(())
        },
    )?;
    Ok(outcomes.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
}

/// Returns the file that a phrase dances to.
pub(in crate::stages) fn url_of(row: &PhraseRow) -> &str {
    row.audio_url.as_deref().or(row.features_url.as_deref()).unwrap_or(&row.source)
}

/// Returns why a phrase has no features; `unknown` says why some were not read.
fn without_features(row: &PhraseRow, store: &Location, unknown: Option<&str>) -> Failure {
    let id = &row.phrase_id;
    if let Some(why) = unknown.filter(|_| row.has_audio || row.has_features) {
        let message = format!("phrase {id}: has no features that this program reads: {why}");
        return Failure::new(FailureKind::Version, url_of(row), message);
    }
    let message = if row.has_audio || row.has_features {
        format!("phrase {id}: has no features; run motiongen extract --store {store} first")
    } else {
        format!("phrase {id}: has no audio and no features, so that there is nothing to dance to")
    };
    Failure::new(FailureKind::NoMusic, url_of(row), message)
}

/// Returns why the features of a phrase are not danced to: its files were replaced since.
fn with_old_features(row: &PhraseRow, store: &Location) -> Failure {
    let id = &row.phrase_id;
    let message = format!(
        "phrase {id}: its features are of files that were replaced since; run motiongen extract --store {store} \
         first"
    );
    Failure::new(FailureKind::StaleFeatures, url_of(row), message)
}

/// Writes a batch: its motions, what is known of them, and what failed.
fn commit(
    maker: &dyn MotionMaker,
    batches: BatchJob,
    tasks: &[TrackTask],
    outcomes: BTreeMap<String, TrackOutcome>,
) -> Result<(), StoreError> {
    let tasks: HashMap<String, (&TrackTask, usize)> = tasks
        .iter()
        .flat_map(|task| task.samples.iter().map(move |&sample| (task, sample)))
        .map(|(task, sample)| {
            (generation_id(&maker.identity().run, &task.row.phrase_id, sample), (task, sample))
        })
        .collect();
    let mut commit = batches.start();
    let mut generations = Vec::new();
    for (id, outcome) in outcomes {
        let (task, sample) = tasks[&id];
        let row = &task.row;
        let failure = outcome.as_ref().err().map(Failure::digest);
        let (fingerprint, input_hash) = (task.fingerprint(), row.content_hash.clone());
        let is_known_failure = failure.is_some()
            && batches.known(&id).is_some_and(|known| {
                known.item.input_hash == input_hash && known.item.failure == failure
            });
        if is_known_failure {
            continue;
        }
        match outcome {
            Ok(made) => {
                let labels = [
                    Label::Text(maker.identity().run.clone()),
                    Label::Text(row.phrase_id.clone()),
                    Label::Number(sample as i32),
                ];
                let part = commit.part(tables::GENERATED, tables::generated)?;
                part.write_labelled_group(&id, &labels, made.frames.view())?;
                let part = commit.part(tables::DECODED, tables::decoded)?;
                part.write_labelled_group(&id, &labels, made.decoded.view())?;
                generations.extend(made.rows);
            }
            Err(failure) => commit.list_failure(&id, url_of(row), &failure),
        }
        commit.settle(Item { id, fingerprint, input_hash, failure });
    }
    commit.rows::<GenerationRow>(&generations)?;
    commit.publish()
}
