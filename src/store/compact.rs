//! Compaction: parts that hold dead rows, are small, or are older than a column that is not null are written anew,
//! whole.
//!
//! The live rows do not change, so other processes need not wait: a compaction repeats the latest settlement of each
//! item under the rank of the commit that settled it. A commit that settles an item meanwhile outranks it, and of
//! two compactions of the same items one counts. The old parts stay where they are until vacuum takes them.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use arrow_array::RecordBatch;
use parquet::errors::ParquetError;
use xxhash_rust::xxh3::xxh3_64;

use super::StoreError;
use super::commit::{KEY_DIGITS, input_hash, program, publish_manifest, publish_part};
use super::digest::digest_texts;
use super::location::{Location, PutOutcome};
use super::manifest::{COMPACTED_FORMAT, Compacted, Header, Item, Manifest};
use super::parquet_object::names;
use super::part::{PartWriter, ROW_GROUP_ROWS};
use super::reader::Snapshot;
use super::schema::TableSchema;
use super::shard::batch_of;
use super::stage_log::{CommitState, StageLog};
use super::store_snapshot::LivePart;
use super::tables;

/// Most items and bytes that a commit of a compaction has, about: what one of them needs in memory, and what a kill
/// can cost.
const MAX_ITEMS: u64 = 4096;
const MAX_BYTES: u64 = 64 << 20;
/// A commit is small that has less than this share of both.
const SMALL: u64 = 4;

/// The result of a compaction, or of its dry run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Compaction {
    /// Parts that counted before, in all stages.
    pub n_parts_before: u64,
    /// Parts that were written anew.
    pub n_parts_old: u64,
    /// Parts that stand in their place; none where nothing was written.
    pub n_parts_new: u64,
    pub n_rows: u64,
    pub n_bytes: u64,
    /// Parts that were left alone because this program does not read their version.
    pub n_unknown: u64,
    pub is_interrupted: bool,
}

/// One stage's part of the work.
struct Plan {
    log: StageLog,
    /// The commits that are written anew.
    commits: HashMap<String, CommitState>,
    n_chunks: u64,
}

/// An item that is written anew.
struct LiveItem {
    item: Item,
    header: usize,
    commit: Arc<str>,
}

/// Writes the parts anew that hold dead rows or are small, stage by stage; with `dry_run` it counts them and writes
/// nothing. `step` is told how many of how many chunks are done, and says whether to stop.
///
/// # Errors
/// [`StoreError`] when the store cannot be read or written; what was committed stays, and nothing is lost.
pub fn compact(
    store: &Location,
    dry_run: bool,
    step: &dyn Fn(u64, u64) -> bool,
) -> Result<Compaction, StoreError> {
    let mut done = Compaction::default();
    let logs = StageLog::read_all(store)?;
    let plans: Vec<Plan> = logs
        .into_iter()
        .map(|log| plan(log, &mut done))
        .collect::<Result<Vec<_>, _>>()?
        .into_iter()
        .flatten()
        .collect();
    done.n_parts_old =
        plans.iter().flat_map(|p| p.commits.values()).map(|c| c.parts.len() as u64).sum();
    if dry_run {
        return Ok(done);
    }
    let n_chunks = plans.iter().map(|plan| plan.n_chunks).sum();
    let mut n_done = 0;
    for plan in plans {
        let stage = plan.log.stage.clone();
        for chunk in chunks(&plan)? {
            write(store, &stage, &plan, chunk, &mut done)?;
            n_done += 1;
            if step(n_done, n_chunks) {
                done.is_interrupted = true;
                return Ok(done);
            }
        }
        if let Err(e) = StageLog::read(store, &stage)?.checkpoint(true) {
            tracing::warn!("{store}: no catalogue of {stage} was written: {e}");
        }
    }
    Ok(done)
}

/// Returns the table of that name, if this program knows it.
fn schema_of(table: &str) -> Option<TableSchema> {
    tables::all().into_iter().find(|schema| schema.name == table)
}

/// Returns which commits of a stage are written anew, if any.
fn plan(log: StageLog, done: &mut Compaction) -> Result<Option<Plan>, StoreError> {
    let state = log.state()?;
    let live: Vec<&CommitState> = state.iter().filter(|commit| !commit.is_dead).collect();
    let n_items: u64 = live.iter().map(|commit| commit.n_live()).sum();
    let n_bytes: u64 = live.iter().map(|commit| commit.n_bytes()).sum();
    done.n_parts_before += live.iter().map(|commit| commit.parts.len() as u64).sum::<u64>();
    let n_chunks = n_items.div_ceil(MAX_ITEMS).max(n_bytes.div_ceil(MAX_BYTES)).max(1);
    let n_chunks = n_chunks.next_power_of_two();
    let is_small = |commit: &CommitState| {
        commit.n_live() < MAX_ITEMS / SMALL && commit.n_bytes() < MAX_BYTES / SMALL
    };
    let mut commits = HashMap::new();
    let mut n_dirty = 0;
    for commit in live {
        let is_known = |part: &super::Part| {
            schema_of(&part.table).is_some_and(|schema| schema.reads(part.schema_version))
        };
        // Other engines cannot know what older parts do not say.
        let lacks_values = |part: &super::Part| {
            schema_of(&part.table).is_some_and(|schema| schema.lacks_values(part.schema_version))
        };
        if !commit.parts.iter().all(is_known) {
            done.n_unknown += commit.parts.len() as u64;
            continue;
        }
        let is_dirty = !commit.dead.is_empty() || commit.parts.iter().any(lacks_values);
        if is_dirty || is_small(commit) {
            n_dirty += usize::from(is_dirty);
            commits.insert(commit.key.to_string(), commit.clone());
        }
    }
    // Commits that are small and as few as they would be again are left as they are.
    let is_worth_it = n_dirty > 0 || commits.len() as u64 > n_chunks;
    Ok(is_worth_it.then_some(Plan { log, commits, n_chunks }))
}

/// The items of a chunk, and what the commits say that settled them.
struct Chunk {
    items: BTreeMap<String, LiveItem>,
    headers: Arc<Vec<Header>>,
    /// Hashes of the names of all items of the stage.
    known: Arc<HashSet<u64>>,
}

/// Returns the live items of the commits that are written anew, by ranges of the stable hash of their names, as
/// stages batch them.
fn chunks(plan: &Plan) -> Result<Vec<Chunk>, StoreError> {
    let mut chunks: BTreeMap<u64, BTreeMap<String, LiveItem>> = BTreeMap::new();
    let mut headers: Vec<Header> = Vec::new();
    let mut places: HashMap<Header, usize> = HashMap::new();
    let mut known = HashSet::new();
    plan.log.visit(|word| {
        known.insert(xxh3_64(word.item.id.as_bytes()));
        let Some(commit) = plan.commits.get(word.commit) else { return };
        let header = *places.entry(word.header.clone()).or_insert_with(|| {
            headers.push(word.header.clone());
            headers.len() - 1
        });
        let chunk = chunks.entry(batch_of(&word.item.id, plan.n_chunks)).or_default();
        let commit = Arc::clone(&commit.key);
        chunk.insert(word.item.id.clone(), LiveItem { item: word.item, header, commit });
    })?;
    let (headers, known) = (Arc::new(headers), Arc::new(known));
    let chunk = |items| Chunk { items, headers: Arc::clone(&headers), known: Arc::clone(&known) };
    Ok(chunks.into_values().map(chunk).collect())
}

/// Writes a chunk: its parts, then their manifest.
fn write(
    store: &Location,
    stage: &str,
    plan: &Plan,
    chunk: Chunk,
    done: &mut Compaction,
) -> Result<(), StoreError> {
    let names: BTreeSet<&str> = chunk.items.values().map(|live| &*live.commit).collect();
    let commits: Vec<&CommitState> =
        names.iter().filter_map(|name| plan.commits.get(*name)).collect();
    let tables: BTreeSet<&str> =
        commits.iter().flat_map(|c| &c.parts).map(|part| part.table.as_str()).collect();
    let schemas: Vec<TableSchema> = tables.into_iter().filter_map(schema_of).collect();
    let key = key_of(stage, &schemas, &names, &chunk);
    let ids: BTreeSet<String> = chunk.items.keys().cloned().collect();
    let items: Vec<Item> = chunk.items.values().map(|live| live.item.clone()).collect();
    let input_hash = input_hash(&items);
    let mut parts = Vec::new();
    for schema in schemas {
        let (name, version) = (schema.name, schema.version);
        let mut rows = PartRows::new(schema.clone());
        for commit in &commits {
            for part in commit.parts.iter().filter(|part| part.table == name) {
                let live = LivePart {
                    part: part.clone(),
                    superseded: Arc::clone(&commit.dead),
                    commit: Arc::clone(&commit.key),
                };
                let place = store.url_of(&part.path);
                let table = Snapshot::new(store, schema.clone(), vec![live], None)?;
                for batch in table.batches_of(&ids)? {
                    rows.take(&batch?, &chunk, &commit.key).map_err(|source| {
                        let (table, source) = (name.to_owned(), Box::new(source));
                        StoreError::Parquet { table, place: place.clone(), source }
                    })?;
                }
            }
        }
        if rows.is_empty() {
            continue;
        }
        let file = store.temporary(&format!("{name}/part"))?;
        let finished = rows.write(PartWriter::new(schema, file)?)?.finish(&[
            ("schema_version", version.to_string()),
            ("table", name.to_owned()),
            ("program", program()),
            ("params_hash", String::new()),
            ("input_hash", input_hash.clone()),
        ])?;
        let part = publish_part(store, name, version, &key, finished)?;
        done.n_parts_new += 1;
        done.n_rows += part.n_rows;
        done.n_bytes += part.n_bytes;
        parts.push(part);
    }
    let manifest = manifest(stage, key, &commits, chunk, parts, items);
    match publish_manifest(store, &manifest)? {
        PutOutcome::Written | PutOutcome::AlreadyThere => Ok(()),
    }
}

fn manifest(
    stage: &str,
    key: String,
    commits: &[&CommitState],
    chunk: Chunk,
    parts: Vec<super::Part>,
    items: Vec<Item>,
) -> Manifest {
    // The headers that this chunk names, in the order in which it names them.
    let (mut headers, mut places) = (Vec::new(), HashMap::new());
    let header_indices = chunk.items.values().map(|live| {
        *places.entry(live.header).or_insert_with(|| {
            headers.push(chunk.headers[live.header].clone());
            headers.len() as u32 - 1
        })
    });
    let header_indices = header_indices.collect();
    let generation = 1 + commits.iter().map(|commit| commit.generation).max().unwrap_or(0);
    Manifest {
        format: COMPACTED_FORMAT,
        stage: stage.to_owned(),
        key,
        sequence: headers.iter().map(|header| header.sequence).max().unwrap_or(0),
        program: program(),
        params_hash: String::new(),
        origin: String::new(),
        parts,
        items,
        compacted: Some(Compacted { generation, commits: headers, of: header_indices }),
    }
}

/// Returns the key of a chunk: the digest of what determines its bytes.
fn key_of(stage: &str, schemas: &[TableSchema], commits: &BTreeSet<&str>, chunk: &Chunk) -> String {
    let program = program();
    let versions: Vec<String> =
        schemas.iter().map(|schema| format!("{} {}", schema.name, schema.version)).collect();
    let mut texts = vec!["compaction", stage, &program];
    texts.extend(versions.iter().map(String::as_str));
    texts.push("commits");
    texts.extend(commits);
    texts.push("items");
    for live in chunk.items.values() {
        texts.push(&live.item.id);
        texts.push(&chunk.headers[live.header].key);
        texts.push(&live.commit);
    }
    digest_texts(texts)[..KEY_DIGITS].to_owned()
}

/// Rows of a table on their way into a part, item by item.
struct PartRows {
    schema: TableSchema,
    batches: Vec<RecordBatch>,
    /// Items, their batches, and their rows in those.
    runs: Vec<(String, usize, std::ops::Range<usize>)>,
}

impl PartRows {
    fn new(schema: TableSchema) -> Self {
        Self { schema, batches: Vec::new(), runs: Vec::new() }
    }

    fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    /// Takes the rows of a batch of `commit` that are of the chunk and count.
    fn take(
        &mut self,
        batch: &RecordBatch,
        chunk: &Chunk,
        commit: &str,
    ) -> Result<(), ParquetError> {
        let columns = self.schema.arrow();
        let places: Vec<usize> = columns
            .fields()
            .iter()
            .map(|field| batch.schema_ref().index_of(field.name()))
            .collect::<Result<_, _>>()?;
        let column = self.schema.item_column();
        let items = names(batch, column)?;
        let (mut row, mut is_taken) = (0, false);
        while row < batch.num_rows() {
            let item = items.value(row);
            let end = (row + 1..batch.num_rows()).find(|&i| items.value(i) != item);
            let end = end.unwrap_or(batch.num_rows());
            if chunk.items.get(item).is_some_and(|live| &*live.commit == commit) {
                self.runs.push((item.to_owned(), self.batches.len(), row..end));
                is_taken = true;
            } else if !chunk.known.contains(&xxh3_64(item.as_bytes())) {
                let what = format!("has rows of {item}, which its commit does not name");
                return Err(ParquetError::General(what));
            }
            row = end;
        }
        if is_taken {
            self.batches.push(batch.project(&places)?);
        }
        Ok(())
    }

    /// Writes the rows in order of items, whole items to a row group as long as they fit.
    fn write(mut self, mut writer: PartWriter) -> Result<PartWriter, StoreError> {
        // Stable: rows of one item are in order, batch by batch.
        self.runs.sort_by(|a, b| a.0.cmp(&b.0));
        let mut waiting: Vec<(usize, usize)> = Vec::new();
        let mut runs = self.runs.iter().peekable();
        while let Some((item, ..)) = runs.peek() {
            let mut of_item: Vec<(usize, usize)> = Vec::new();
            while let Some((_, batch, rows)) = runs.next_if(|(other, ..)| other == item) {
                of_item.extend(rows.clone().map(|row| (*batch, row)));
            }
            if !waiting.is_empty() && waiting.len() + of_item.len() > ROW_GROUP_ROWS {
                self.flush(&mut writer, &mut waiting)?;
            }
            waiting.append(&mut of_item);
            while waiting.len() >= ROW_GROUP_ROWS {
                let rest = waiting.split_off(ROW_GROUP_ROWS);
                self.flush(&mut writer, &mut waiting)?;
                waiting = rest;
            }
        }
        self.flush(&mut writer, &mut waiting)?;
        Ok(writer)
    }

    fn flush(
        &self,
        writer: &mut PartWriter,
        waiting: &mut Vec<(usize, usize)>,
    ) -> Result<(), StoreError> {
        if waiting.is_empty() {
            return Ok(());
        }
        let batches: Vec<&RecordBatch> = self.batches.iter().collect();
        let batch = arrow_select::interleave::interleave_record_batch(&batches, waiting)
            .map_err(|e| writer.failed(ParquetError::from(e)))?;
        waiting.clear();
        writer.write_row_group(&batch)
    }
}
