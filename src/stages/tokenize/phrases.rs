//! The phrases of a store, tokenized batch by batch.
//!
//! As in extract and generate, a batch is a range of the phrases' stable hash, cut by the table of phrases alone: every
//! process, at any time, writes the same tokens under the same name.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::num::NonZeroUsize;
use std::sync::Mutex;

use anyhow::{bail, ensure};
use ndarray::{Array2, Array3, ArrayView2, Axis};

use super::Tokenize;
use crate::diffusion::{SamplerConfig, Schedule};
use crate::evaluation::{ReconstructionError, reconstruction_error};
use crate::generation::{EngineError, TokenEngine};
use crate::model::TokensConfig;
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::generate::seed_of;
use crate::stages::pool::{self, lock};
use crate::stages::{Progress, Stage as _, lease};
use crate::store::tables::{self, FailureRow, PhraseRow, TokenRow, TokenizationRow};
use crate::store::{
    Commit, Item, Ledger, Location, Row as _, Shard, StoreSnapshot, TimestampUs, batch_of,
    checkpoint,
};

/// Where the items of this stage come from, as its commits name it.
const ITEMS_FROM: &str = "phrases";
/// Most frames of all dancers in a batch, about: 26 MB of motion, and what a kill can cost.
const MAX_BATCH_FRAMES: usize = 1 << 18;
/// Most phrases in a batch, about.
const MAX_BATCH_PHRASES: usize = 512;

/// The store and what is asked of it.
pub struct TokenizeTarget<'a> {
    pub store: &'a Location,
    pub run: &'a str,
    pub engine: &'a TokenEngine,
    pub sizes: &'a TokensConfig,
    /// Digest of the weights.
    pub weights: &'a str,
    /// How motion is made again; none where nobody asked.
    pub reconstruction: Option<Reconstruction<'a>>,
    pub params_hash: String,
    /// That of the same tokens with their errors: a run without --reconstruct leaves these as they are.
    pub params_hash_with_errors: String,
    pub shard: Shard,
    pub split: Option<&'a str>,
    /// Only these; all where empty.
    pub phrases: &'a [String],
    pub n_workers: NonZeroUsize,
    pub force: bool,
    pub dry_run: bool,
}

/// How motion is made of tokens again.
#[derive(Clone, Copy)]
pub struct Reconstruction<'a> {
    pub sampler: &'a SamplerConfig,
    pub schedule: &'a Schedule,
    pub seed: u64,
}

/// Counts of the phrases that were tokenized, unchanged or failed.
#[derive(Debug, Default)]
pub struct TokenizeTally {
    pub n_todo: u64,
    pub n_unchanged: u64,
    pub n_done: u64,
    pub n_frames: u64,
    /// How often each token was written by this command.
    pub usage: BTreeMap<u32, u64>,
    /// Sums over frames, and how many.
    pub errors: Option<(ReconstructionError, u64)>,
    pub failed: Vec<(String, Failure)>,
    /// Whether phrases are left because the user asked for an end.
    pub is_interrupted: bool,
}

/// The tokens of one dancer.
struct TokenizedDancer {
    n_frames: usize,
    tokens: Vec<u32>,
    error: Option<ReconstructionError>,
}

type TokenizeOutcome = Result<Vec<TokenizedDancer>, Failure>;

impl TokenizeTally {
    fn add(&mut self, id: &str, outcome: &TokenizeOutcome) {
        let dancers = match outcome {
            Ok(dancers) => dancers,
            Err(failure) => {
                self.failed.push((id.to_owned(), failure.clone()));
                return;
            }
        };
        self.n_done += 1;
        for dancer in dancers {
            self.n_frames += dancer.n_frames as u64;
            for &token in &dancer.tokens {
                *self.usage.entry(token).or_default() += 1;
            }
            if let Some(error) = dancer.error {
                let (sum, n) = self.errors.get_or_insert_default();
                sum.position_m += dancer.n_frames as f64 * error.position_m;
                sum.orientation_deg += dancer.n_frames as f64 * error.orientation_deg;
                *n += dancer.n_frames as u64;
            }
        }
    }
}

/// A phrase to tokenize.
struct TokenizeTask {
    batch: u64,
    row: PhraseRow,
}

/// Returns what the tokens of a phrase are called in tables.
fn tokenization_id(run: &str, phrase_id: &str) -> String {
    format!("{run}/{phrase_id}")
}

/// Tokenizes what `target` lacks.
///
/// # Errors
/// When the store cannot be read or written; what was committed stays.
pub fn run(target: &TokenizeTarget, progress: &dyn Progress) -> anyhow::Result<TokenizeTally> {
    let mut planned = Plan::new(target)?;
    if target.dry_run || planned.tasks.is_empty() {
        return Ok(planned.done);
    }
    let shard = target.shard.to_string().replace('/', "-of-");
    let name = format!("{}/{}/{shard}", Tokenize::NAME, target.run);
    let what = format!("tokens of run {}", target.run);
    let (lease, has_waited) = lease::take(target.store, &name, &what, &|text| progress.note(text))?;
    if has_waited {
        // The other process may have done some of the phrases.
        planned = Plan::new(target)?;
    }
    let Plan { snapshot, ledger, tasks, mut done } = planned;
    target.store.sweep();
    snapshot.checkpoint();
    progress.start(Tokenize::NAME, "phrases", tasks.len() as u64);
    let (table, unknown) = snapshot.known_table(tables::motion())?;
    let unknown = unknown.map(|e| e.to_string());
    let mut batches: BTreeMap<u64, Vec<TokenizeTask>> = BTreeMap::new();
    for task in tasks {
        batches.entry(task.batch).or_default().push(task);
    }
    let n_batches = batches.len();
    for (i, tasks) in batches.into_values().enumerate() {
        let wanted: BTreeSet<String> =
            tasks.iter().map(|task| task.row.phrase_id.clone()).collect();
        let mut motions: HashMap<String, Array3<f32>> = HashMap::new();
        table.visit_groups(&wanted, |id, motion| {
            motions.insert(id.to_owned(), motion);
            Ok::<_, anyhow::Error>(())
        })?;
        let outcomes = do_batch(target, &tasks, &motions, unknown.as_deref(), progress)?;
        for (id, outcome) in &outcomes {
            done.add(id, outcome);
        }
        lease.check()?;
        commit(target, &ledger, &tasks, outcomes)?;
        if progress.is_interrupted() && i + 1 < n_batches {
            done.is_interrupted = true;
            break;
        }
    }
    progress.finish();
    checkpoint(target.store, &[Tokenize::NAME]);
    Ok(done)
}

/// The store as it was when it was looked at, and what it lacks.
struct Plan {
    snapshot: StoreSnapshot,
    ledger: Ledger,
    tasks: Vec<TokenizeTask>,
    done: TokenizeTally,
}

impl Plan {
    fn new(target: &TokenizeTarget) -> anyhow::Result<Self> {
        let store = target.store;
        let snapshot = StoreSnapshot::take(store)?;
        let ledger = snapshot.ledger(Tokenize::NAME)?;
        let rows: Vec<PhraseRow> = snapshot.table(PhraseRow::schema())?.rows()?;
        if !rows.iter().any(|row| row.has_motion) {
            bail!("store {store} has no phrases with motion; run ingest or library on it first");
        }
        for id in target.phrases {
            let row = rows.iter().find(|row| row.phrase_id == *id);
            let has_motion = row.map(|row| row.has_motion);
            ensure!(has_motion.is_some(), "store {store} has no phrase {id}");
            ensure!(has_motion == Some(true), "phrase {id} of store {store} has no motion");
        }
        let is_wanted = |row: &PhraseRow| {
            let is_named = target.phrases.is_empty() || target.phrases.contains(&row.phrase_id);
            row.has_motion && is_named && target.split.is_none_or(|split| row.split == split)
        };
        let mut tasks: Vec<TokenizeTask> =
            rows.into_iter().filter(is_wanted).map(|row| TokenizeTask { batch: 0, row }).collect();
        let frames = |row: &PhraseRow| {
            let n_frames = row.n_frames.and_then(|n| usize::try_from(n).ok()).unwrap_or(0);
            n_frames * row.count_dancers()
        };
        let n_frames: usize = tasks.iter().map(|task| frames(&task.row)).sum();
        let by_length = n_frames.div_ceil(MAX_BATCH_FRAMES);
        let by_count = tasks.len().div_ceil(MAX_BATCH_PHRASES);
        // A power of two, so that shards in powers of two hold whole batches.
        let n_batches = by_length.max(by_count).max(1).next_power_of_two() as u64;
        tasks.retain(|task| target.shard.takes(&task.row.phrase_id));
        let n_mine = tasks.len();
        tasks.retain(|task| target.force || !is_settled(target, &ledger, &task.row));
        for task in &mut tasks {
            task.batch = batch_of(&task.row.phrase_id, n_batches);
        }
        tasks.sort_by(|a, b| (a.batch, &a.row.phrase_id).cmp(&(b.batch, &b.row.phrase_id)));
        let done = TokenizeTally {
            n_todo: tasks.len() as u64,
            n_unchanged: (n_mine - tasks.len()) as u64,
            ..TokenizeTally::default()
        };
        Ok(Self { snapshot, ledger, tasks, done })
    }
}

/// Returns whether the store has the phrase's tokens, of this motion and these weights.
fn is_settled(target: &TokenizeTarget, ledger: &Ledger, row: &PhraseRow) -> bool {
    ledger.get(&tokenization_id(target.run, &row.phrase_id)).is_some_and(|known| {
        let hashes = [&target.params_hash, &target.params_hash_with_errors];
        known.item.succeeded()
            && known.item.input_hash == row.content_hash
            && hashes.contains(&&known.params_hash)
            && (target.reconstruction.is_none() || known.params_hash == target.params_hash)
    })
}

/// Tokenizes the phrases of a batch side by side.
fn do_batch(
    target: &TokenizeTarget,
    tasks: &[TokenizeTask],
    motions: &HashMap<String, Array3<f32>>,
    unknown: Option<&str>,
    progress: &dyn Progress,
) -> anyhow::Result<BTreeMap<String, TokenizeOutcome>> {
    let mut queue = tasks.iter();
    let outcomes = Mutex::new(BTreeMap::new());
    pool::run(
        target.n_workers,
        || queue.next(),
        |task: &TokenizeTask| -> anyhow::Result<()> {
            let id = &task.row.phrase_id;
            let outcome = match motions.get(id) {
                Some(motion) => guarded(source_of(&task.row), || {
                    let dancers = motion.axis_iter(Axis(0)).enumerate();
                    dancers.map(|(i, motion)| tokenize(target, &task.row, i, motion)).collect()
                }),
                None => Err(without_motion(&task.row, unknown)),
            };
            progress.advance(1);
            lock(&outcomes).insert(tokenization_id(target.run, id), outcome);
            Ok(())
        },
    )?;
    Ok(outcomes.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
}

/// Writes the motion of one dancer as tokens, and, where asked, makes it again.
fn tokenize(
    target: &TokenizeTarget,
    row: &PhraseRow,
    dancer: usize,
    motion: ArrayView2<f32>,
) -> Result<TokenizedDancer, Failure> {
    let failed = |error: EngineError| {
        let message = format!("phrase {}: {error}", row.phrase_id);
        Failure::new(FailureKind::Engine, source_of(row), message)
    };
    let windows = target.engine.windows(motion);
    let tokens = target.engine.tokens(&windows).map_err(failed)?;
    let error = match target.reconstruction {
        None => None,
        Some(Reconstruction { sampler, schedule, seed }) => {
            let n_frames: Vec<usize> = windows.iter().map(Array2::nrows).collect();
            let seed = seed_of(seed, &row.phrase_id, dancer, 0);
            let how = (sampler, schedule);
            let made = target.engine.motion(&tokens, &n_frames, how, seed).map_err(failed)?;
            let pairs = windows.iter().zip(&made).map(|(was, made)| (was.view(), made.view()));
            reconstruction_error(pairs)
        }
    };
    Ok(TokenizedDancer { n_frames: motion.nrows(), tokens, error })
}

fn source_of(row: &PhraseRow) -> &str {
    row.motion_url.as_deref().unwrap_or(&row.source)
}

/// Returns why a phrase has no motion; `unknown` says why some were not read.
fn without_motion(row: &PhraseRow, unknown: Option<&str>) -> Failure {
    let id = &row.phrase_id;
    if let Some(why) = unknown {
        let message = format!("phrase {id}: has no motion that this program reads: {why}");
        return Failure::new(FailureKind::Version, source_of(row), message);
    }
    let message = format!("phrase {id}: has no motion in the table; ingest it again");
    Failure::new(FailureKind::NoMotion, source_of(row), message)
}

/// Writes a batch: its tokens, what is known of them, and what failed.
fn commit(
    target: &TokenizeTarget,
    ledger: &Ledger,
    tasks: &[TokenizeTask],
    outcomes: BTreeMap<String, TokenizeOutcome>,
) -> anyhow::Result<()> {
    let rows: HashMap<String, &PhraseRow> = tasks
        .iter()
        .map(|task| (tokenization_id(target.run, &task.row.phrase_id), &task.row))
        .collect();
    let mut commit = Commit::new(target.store, Tokenize::NAME, &target.params_hash, ITEMS_FROM);
    let (mut tokens, mut tokenizations, mut failures) = (Vec::new(), Vec::new(), Vec::new());
    for (id, outcome) in outcomes {
        let row = rows[&id];
        let failure = outcome.as_ref().err().map(Failure::digest);
        let (fingerprint, input_hash) = (row.content_hash.clone(), row.content_hash.clone());
        let is_known_failure = failure.is_some()
            && ledger.get(&id).is_some_and(|known| {
                known.params_hash == target.params_hash
                    && known.item.input_hash == input_hash
                    && known.item.failure == failure
            });
        if is_known_failure {
            continue;
        }
        match outcome {
            Ok(dancers) => {
                for (dancer, of_dancer) in (0_i32..).zip(&dancers) {
                    tokenizations.push(tokenization_row(target, &id, row, dancer, of_dancer));
                    tokens.extend((0_i32..).zip(&of_dancer.tokens).map(|(position, &token)| {
                        TokenRow {
                            tokenization: id.clone(),
                            run: target.run.to_owned(),
                            phrase_id: row.phrase_id.clone(),
                            dancer,
                            position,
                            token: token as i32,
                        }
                    }));
                }
            }
            Err(failure) => failures.push(FailureRow {
                stage: Tokenize::NAME.to_owned(),
                phrase_id: id.clone(),
                source: source_of(row).to_owned(),
                kind: failure.kind.name().to_owned(),
                message: failure.message,
                time: TimestampUs::now(),
            }),
        }
        commit.settle(Item { id, fingerprint, input_hash, failure }, ledger);
    }
    if !tokens.is_empty() {
        commit.part(TokenRow::schema().name, TokenRow::schema)?.write_rows(&tokens)?;
    }
    if !tokenizations.is_empty() {
        let schema = TokenizationRow::schema;
        commit.part(schema().name, schema)?.write_rows(&tokenizations)?;
    }
    if !failures.is_empty() {
        commit.part(FailureRow::schema().name, FailureRow::schema)?.write_rows(&failures)?;
    }
    if !commit.is_empty() {
        commit.publish()?;
    }
    Ok(())
}

fn tokenization_row(
    target: &TokenizeTarget,
    id: &str,
    row: &PhraseRow,
    dancer: i32,
    made: &TokenizedDancer,
) -> TokenizationRow {
    TokenizationRow {
        tokenization: id.to_owned(),
        run: target.run.to_owned(),
        phrase_id: row.phrase_id.clone(),
        dancer,
        weights: target.weights.to_owned(),
        n_codes: target.sizes.codes as i32,
        frames_per_token: target.sizes.frames_per_token as i32,
        n_frames: made.n_frames as i64,
        n_tokens: made.tokens.len() as i64,
        position_error_m: made.error.map(|error| error.position_m),
        orientation_error_deg: made.error.map(|error| error.orientation_deg),
        content_hash: row.content_hash.clone(),
    }
}
