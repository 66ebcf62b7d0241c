//! Catalogues: what a stage's manifests say, in one Parquet file that is read in place of them.
//!
//! `catalogue/<stage>/<number>-<digest>.parquet` has one row per item, the latest word on it, sorted by name;
//! its footer lists the commits that it covers, their parts, and the items whose rows in them are dead. It says
//! nothing that the manifests do not say, so whoever comes by may write one, a lost race is harmless, and one
//! that cannot be read is passed over.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use arrow_array::builder::{Int32Builder, StringBuilder};
use arrow_array::{Array as _, ArrayRef, Int32Array, RecordBatch, StringArray};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;
use serde::{Deserialize, Serialize};

use super::StoreError;
use super::digest::{digest, digest_texts};
use super::location::{Listed, Location};
use super::manifest::{Header, Item, Manifest, Part, Rank, stage_and_key};
use super::parquet_object::{ParquetObject, Wanted, names};

/// Layout of catalogues; one of another layout is passed over.
const FORMAT: u32 = 1;
/// Folder of the catalogues.
pub(super) const FOLDER: &str = "catalogue";
const SUFFIX: &str = ".parquet";
/// Catalogues of a stage that are kept: the newest, and the one that readers may have under way.
const N_KEPT: usize = 2;
/// Rows of a row group: what is read to look one item up.
const ROW_GROUP_ROWS: usize = 64 << 10;
/// Texts of the footer.
/// Bytes that are read of the end of a remote catalogue in one request: its list of commits.
const TAIL_BYTES: u64 = 1 << 20;
const META: &str = "motiongen.catalogue";
const META_DIGEST: &str = "motiongen.catalogue_digest";

pub(super) const ITEM: &str = "item";
const COMMIT: &str = "commit";
const HEADER: &str = "settled_by";
const FINGERPRINT: &str = "fingerprint";
const INPUT_HASH: &str = "input_hash";
const FAILURE: &str = "failure";

/// Why a catalogue is of no use.
pub(super) type Unusable = String;

/// What the footer of a catalogue says.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Meta {
    format: u32,
    stage: String,
    n_items: u64,
    /// The commits that settled the items.
    pub headers: Vec<Header>,
    /// The commits whose parts hold their rows.
    pub commits: Vec<Entry>,
}

/// A commit, as a catalogue knows it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Entry {
    pub key: String,
    pub generation: u32,
    pub parts: Vec<Part>,
    pub n_items: u64,
    /// Items whose rows in the parts are dead; none are named where all are.
    pub dead: Vec<String>,
    pub is_dead: bool,
}

/// A catalogue that was opened.
pub(super) struct Catalogue {
    pub meta: Meta,
    path: String,
    file: ParquetObject,
}

/// The latest word on an item, as a catalogue has it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row<'a> {
    pub item: &'a str,
    pub commit: usize,
    pub header: usize,
}

impl Catalogue {
    /// Opens the newest catalogue of a stage that is good for the manifests that are there.
    ///
    /// `listed` are the catalogues of the stage, `keys` the commits of which there are manifests.
    pub fn newest(
        store: &Location,
        stage: &str,
        listed: &[Listed],
        keys: &HashSet<&str>,
    ) -> Option<Self> {
        let mut listed: Vec<_> = listed.iter().filter(|l| is_catalogue(&l.path)).collect();
        listed.sort_by(|a, b| b.path.cmp(&a.path));
        for one in listed.into_iter().take(N_KEPT) {
            match Self::open(store, stage, one).and_then(|found| found.checked(keys)) {
                Ok(catalogue) => return Some(catalogue),
                Err(why) => {
                    let place = store.url_of(&one.path);
                    tracing::info!("{place}: catalogue is passed over: {why}");
                }
            }
        }
        None
    }

    fn open(store: &Location, stage: &str, listed: &Listed) -> Result<Self, Unusable> {
        let file = ParquetObject::open(store, &listed.path, listed.size_bytes, TAIL_BYTES)
            .map_err(|e| e.to_string())?;
        let text = file.text(META).ok_or("it has no list of commits")?;
        if file.text(META_DIGEST) != Some(digest(text.as_bytes()).as_str()) {
            return Err("its list of commits is damaged".to_owned());
        }
        let meta: Meta = serde_json::from_str(text).map_err(|e| e.to_string())?;
        if meta.format != FORMAT || meta.stage != stage {
            let Meta { format, stage: found, .. } = &meta;
            return Err(format!("it is of format {format} and stage {found}"));
        }
        Ok(Self { meta, path: store.url_of(&listed.path), file })
    }

    /// Refuses a catalogue that counts rows of a commit whose manifest is gone.
    fn checked(self, keys: &HashSet<&str>) -> Result<Self, Unusable> {
        let is_gone = |entry: &&Entry| !entry.is_dead && !keys.contains(entry.key.as_str());
        match self.meta.commits.iter().find(is_gone) {
            Some(entry) => Err(format!("commit {} is gone", entry.key)),
            None => Ok(self),
        }
    }

    /// Where the catalogue lies, as a URL.
    pub fn place(&self) -> &str {
        &self.path
    }

    /// Returns how many items the catalogue has.
    pub fn n_items(&self) -> u64 {
        self.meta.n_items
    }

    /// Returns the rank of a row.
    pub fn rank(&self, row: Row) -> Rank<'_> {
        let entry = &self.meta.commits[row.commit];
        Rank::new(&self.meta.headers[row.header], entry.generation, &entry.key)
    }

    /// Visits the names of all items, in order, and which commits they are of.
    pub fn visit(&self, mut visit: impl FnMut(Row)) -> Result<(), Unusable> {
        self.batches(Wanted::All, Some(&[ITEM, COMMIT, HEADER]), |batch| {
            (0..batch.n_rows()).try_for_each(|i| {
                visit(batch.row(i)?);
                Ok(())
            })
        })
    }

    /// Visits all items, in order, with all that is known of them.
    pub fn visit_items(&self, mut visit: impl FnMut(Row, Item)) -> Result<(), Unusable> {
        self.batches(Wanted::All, None, |batch| {
            (0..batch.n_rows()).try_for_each(|i| {
                let (row, item) = (batch.row(i)?, batch.item(i)?);
                visit(row, item);
                Ok(())
            })
        })
    }

    /// Returns the commit that holds what is known of an item, and by which it was settled.
    pub fn find(&self, item: &str) -> Result<Option<(usize, usize)>, Unusable> {
        let (mut found, wanted) = (None, BTreeSet::from([item.to_owned()]));
        // The columns of the row group at once, rather than the names first.
        self.batches(Wanted::Near(&wanted), Some(&[ITEM, COMMIT, HEADER]), |batch| {
            if let Some(i) = batch.items.iter().position(|known| known == Some(item)) {
                let row = batch.row(i)?;
                found = Some((row.commit, row.header));
            }
            Ok(())
        })?;
        Ok(found)
    }

    fn batches(
        &self,
        wanted: Wanted,
        columns: Option<&[&str]>,
        mut visit: impl FnMut(&Columns) -> Result<(), Unusable>,
    ) -> Result<(), Unusable> {
        let text = |e: ParquetError| e.to_string();
        let mut n_rows = 0;
        for batch in self.file.batches(ITEM, wanted, columns).map_err(text)? {
            let batch = batch.map_err(text)?;
            n_rows += batch.num_rows() as u64;
            visit(&Columns::of(&batch, &self.meta).ok_or("its columns are others")?)?;
        }
        if matches!(wanted, Wanted::All) && n_rows != self.meta.n_items {
            return Err(format!("it has {n_rows} of {} items", self.meta.n_items));
        }
        Ok(())
    }
}

/// The columns of a batch of a catalogue.
struct Columns<'a> {
    batch: &'a RecordBatch,
    meta: &'a Meta,
    items: &'a StringArray,
    commits: &'a Int32Array,
    headers: &'a Int32Array,
}

impl<'a> Columns<'a> {
    fn of(batch: &'a RecordBatch, meta: &'a Meta) -> Option<Self> {
        let numbers =
            |name: &str| batch.column_by_name(name)?.as_any().downcast_ref::<Int32Array>();
        let items = names(batch, ITEM).ok()?;
        Some(Self { batch, meta, items, commits: numbers(COMMIT)?, headers: numbers(HEADER)? })
    }

    fn n_rows(&self) -> usize {
        self.batch.num_rows()
    }

    fn row(&self, i: usize) -> Result<Row<'a>, Unusable> {
        let place = |n: i32, len: usize| usize::try_from(n).ok().filter(|n| *n < len);
        let commit = place(self.commits.value(i), self.meta.commits.len());
        let header = place(self.headers.value(i), self.meta.headers.len());
        match (commit, header) {
            (Some(commit), Some(header)) => Ok(Row { item: self.items.value(i), commit, header }),
            _ => Err(format!("item {} is of no commit", self.items.value(i))),
        }
    }

    fn item(&self, i: usize) -> Result<Item, Unusable> {
        let text = |name: &str| {
            let column = names(self.batch, name).map_err(|e| e.to_string())?;
            Ok::<_, Unusable>((!column.is_null(i)).then(|| column.value(i).to_owned()))
        };
        Ok(Item {
            id: self.items.value(i).to_owned(),
            fingerprint: text(FINGERPRINT)?.unwrap_or_default(),
            input_hash: text(INPUT_HASH)?.unwrap_or_default(),
            failure: text(FAILURE)?,
        })
    }
}

/// Returns whether a path is that of a catalogue.
fn is_catalogue(path: &str) -> bool {
    number_of(path).is_some()
}

/// Returns the number of the catalogue at a path.
fn number_of(path: &str) -> Option<u64> {
    let (_, name) = path.rsplit_once('/')?;
    let (number, _) = name.strip_suffix(SUFFIX)?.split_once('-')?;
    number.parse().ok()
}

/// Writes a catalogue of a stage: what `old` says and the manifests that it does not cover.
///
/// `listed` are the catalogues and `manifests` the manifests that are there.
pub(super) fn write(
    store: &Location,
    stage: &str,
    old: Option<&Catalogue>,
    newer: &[Manifest],
    (listed, manifests): (&[Listed], &[Listed]),
) -> Result<(), CatalogueError> {
    let file = store.temporary(&format!("{FOLDER}/{stage}/x"))?;
    let there: HashSet<&str> =
        manifests.iter().filter_map(|l| Some(stage_and_key(&l.path)?.1)).collect();
    let (file, meta) = Writer::new(file, stage, old, newer, &there)?.write()?;
    let mut keys: Vec<&str> = meta.commits.iter().map(|entry| entry.key.as_str()).collect();
    keys.sort_unstable();
    let name = &digest_texts(std::iter::once(stage).chain(keys))[..16];
    let number = listed.iter().filter_map(|l| number_of(&l.path)).max().map_or(1, |n| n + 1);
    store.put_file_new(&format!("{FOLDER}/{stage}/{number:08}-{name}{SUFFIX}"), file)?;
    let mut old: Vec<&Listed> = listed.iter().filter(|l| is_catalogue(&l.path)).collect();
    old.sort_by(|a, b| b.path.cmp(&a.path));
    for one in old.into_iter().skip(N_KEPT - 1) {
        // Who reads it falls back on the newest; who may not remove it leaves it.
        store.remove(&one.path).ok();
    }
    Ok(())
}

/// What keeps a catalogue from being written.
#[derive(Debug, thiserror::Error)]
pub(super) enum CatalogueError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("{0}")]
    Unusable(Unusable),
}

struct Writer<'a> {
    old: Option<&'a Catalogue>,
    newer: &'a [Manifest],
    /// Commits that settled items of `newer`.
    newer_headers: Vec<Vec<Header>>,
    meta: Meta,
    /// New places of the commits of `old`; those that are dead and gone have none.
    old_commits: Vec<Option<usize>>,
    /// Where the commits of `newer` begin in `meta`.
    first_commit: usize,
    headers: HeaderPlaces,
    dead: Vec<Vec<String>>,
    writer: ArrowWriter<tempfile::NamedTempFile>,
    schema: SchemaRef,
    rows: Rows,
}

/// Places of headers in the new catalogue, which lists those that its rows name.
#[derive(Default)]
struct HeaderPlaces {
    all: HashMap<Header, usize>,
    of_old: HashMap<usize, usize>,
    of_newer: HashMap<(usize, usize), usize>,
}

impl<'a> Writer<'a> {
    fn new(
        file: tempfile::NamedTempFile,
        stage: &str,
        old: Option<&'a Catalogue>,
        newer: &'a [Manifest],
        there: &HashSet<&str>,
    ) -> Result<Self, CatalogueError> {
        let mut meta = Meta { format: FORMAT, stage: stage.to_owned(), ..Meta::default() };
        let mut old_commits = Vec::new();
        for entry in old.iter().flat_map(|old| &old.meta.commits) {
            // What was vacuumed is not told for ever.
            let is_known = !entry.is_dead || there.contains(entry.key.as_str());
            old_commits.push(is_known.then_some(meta.commits.len()));
            meta.commits.extend(is_known.then(|| entry.clone()));
        }
        let first_commit = meta.commits.len();
        meta.commits.extend(newer.iter().map(|manifest| Entry {
            key: manifest.key.clone(),
            generation: manifest.generation(),
            parts: manifest.parts.clone(),
            n_items: manifest.items.len() as u64,
            dead: Vec::new(),
            is_dead: false,
        }));
        let dead = vec![Vec::new(); meta.commits.len()];
        let schema = schema();
        let item = ColumnPath::from(ITEM);
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::try_new(1).expect("1 is a zstd level")))
            .set_dictionary_enabled(false)
            .set_statistics_enabled(EnabledStatistics::None)
            .set_column_statistics_enabled(item.clone(), EnabledStatistics::Chunk)
            .set_column_encoding(item, Encoding::DELTA_BYTE_ARRAY)
            .set_max_row_group_row_count(Some(ROW_GROUP_ROWS))
            .build();
        let writer =
            ArrowWriter::try_new(file, Arc::clone(&schema), Some(properties)).map_err(unusable)?;
        let newer_headers = newer.iter().map(Manifest::headers).collect();
        let (headers, rows) = (HeaderPlaces::default(), Rows::default());
        Ok(Self {
            old,
            newer,
            newer_headers,
            meta,
            old_commits,
            first_commit,
            headers,
            dead,
            writer,
            schema,
            rows,
        })
    }

    /// Merges the rows of the old catalogue with what the newer manifests say.
    fn write(mut self) -> Result<(tempfile::NamedTempFile, Meta), CatalogueError> {
        let newer = self.newer;
        let mut newest: BTreeMap<&'a str, (usize, usize)> = BTreeMap::new();
        for (m, manifest) in newer.iter().enumerate() {
            for (i, item) in manifest.items.iter().enumerate() {
                let Some(&known) = newest.get(item.id.as_str()) else {
                    newest.insert(&item.id, (m, i));
                    continue;
                };
                let is_later = self.rank_of((m, i)) > self.rank_of(known);
                if is_later {
                    newest.insert(&item.id, (m, i));
                }
                let loser = if is_later { known.0 } else { m };
                self.dead[self.first_commit + loser].push(item.id.clone());
            }
        }
        let mut newest = newest.into_iter().peekable();
        if let Some(old) = self.old {
            let mut merged = Ok(());
            let visited = old.visit_items(|row, item| {
                if merged.is_ok() {
                    merged = self.merge(old, row, &item, &mut newest);
                }
            });
            visited.map_err(CatalogueError::Unusable)?;
            merged?;
        }
        for (_, place) in newest {
            self.push_newer(place)?;
        }
        self.flush()?;
        self.finish()
    }

    /// Writes what comes before a row of the old catalogue, and the row unless it is outranked.
    fn merge(
        &mut self,
        old: &Catalogue,
        row: Row,
        item: &Item,
        newest: &mut std::iter::Peekable<impl Iterator<Item = (&'a str, (usize, usize))>>,
    ) -> Result<(), CatalogueError> {
        while let Some((_, place)) = newest.next_if(|(id, _)| *id < row.item) {
            self.push_newer(place)?;
        }
        let commit = self.old_commits[row.commit]
            .ok_or_else(|| CatalogueError::Unusable(format!("{} is of a dead commit", row.item)))?;
        if let Some(&(_, place)) = newest.peek().filter(|(id, _)| *id == row.item) {
            if self.rank_of(place) > old.rank(row) {
                // The newer one is written in its turn.
                self.dead[commit].push(row.item.to_owned());
                return Ok(());
            }
            newest.next();
            self.dead[self.first_commit + place.0].push(row.item.to_owned());
        }
        let header = match self.headers.of_old.get(&row.header) {
            Some(&place) => place,
            None => {
                let place = self.place_of(old.meta.headers[row.header].clone());
                self.headers.of_old.insert(row.header, place);
                place
            }
        };
        self.rows.push(commit, header, item);
        self.flush_if_full()
    }

    fn rank_of(&self, (m, i): (usize, usize)) -> Rank<'_> {
        let manifest = &self.newer[m];
        let header = &self.newer_headers[m][manifest.header_of(i)];
        Rank::new(header, manifest.generation(), &manifest.key)
    }

    fn push_newer(&mut self, (m, i): (usize, usize)) -> Result<(), CatalogueError> {
        let manifest = &self.newer[m];
        let of_manifest = (m, manifest.header_of(i));
        let header = match self.headers.of_newer.get(&of_manifest) {
            Some(&place) => place,
            None => {
                let place = self.place_of(self.newer_headers[m][of_manifest.1].clone());
                self.headers.of_newer.insert(of_manifest, place);
                place
            }
        };
        self.rows.push(self.first_commit + m, header, &manifest.items[i]);
        self.flush_if_full()
    }

    fn place_of(&mut self, header: Header) -> usize {
        let headers = &mut self.meta.headers;
        *self.headers.all.entry(header).or_insert_with_key(|header| {
            headers.push(header.clone());
            headers.len() - 1
        })
    }

    fn flush_if_full(&mut self) -> Result<(), CatalogueError> {
        if self.rows.n < ROW_GROUP_ROWS { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<(), CatalogueError> {
        if self.rows.n == 0 {
            return Ok(());
        }
        self.meta.n_items += self.rows.n as u64;
        let batch = std::mem::take(&mut self.rows).into_batch(&self.schema);
        self.writer.write(&batch).map_err(unusable)
    }

    fn finish(mut self) -> Result<(tempfile::NamedTempFile, Meta), CatalogueError> {
        for (entry, mut dead) in self.meta.commits.iter_mut().zip(self.dead) {
            entry.dead.append(&mut dead);
            entry.is_dead |= entry.dead.len() as u64 == entry.n_items;
            if entry.is_dead {
                entry.dead.clear();
                entry.parts.clear();
            } else {
                entry.dead.sort_unstable();
            }
        }
        let text = serde_json::to_string(&self.meta)
            .expect("invariant: a catalogue's footer holds only strings and numbers");
        let sum = digest(text.as_bytes());
        for (key, value) in [(META, text), (META_DIGEST, sum)] {
            self.writer.append_key_value_metadata(KeyValue::new(key.to_owned(), value));
        }
        Ok((self.writer.into_inner().map_err(unusable)?, self.meta))
    }
}

fn unusable(error: ParquetError) -> CatalogueError {
    CatalogueError::Unusable(error.to_string())
}

fn schema() -> SchemaRef {
    let text = |name, nullable| Field::new(name, DataType::Utf8, nullable);
    let number = |name| Field::new(name, DataType::Int32, false);
    Arc::new(Schema::new(vec![
        text(ITEM, false),
        number(COMMIT),
        number(HEADER),
        text(FINGERPRINT, false),
        text(INPUT_HASH, false),
        text(FAILURE, true),
    ]))
}

/// Rows on their way into a catalogue.
#[derive(Default)]
struct Rows {
    n: usize,
    items: StringBuilder,
    commits: Int32Builder,
    headers: Int32Builder,
    fingerprints: StringBuilder,
    input_hashes: StringBuilder,
    failures: StringBuilder,
}

impl Rows {
    fn push(&mut self, commit: usize, header: usize, item: &Item) {
        self.n += 1;
        self.items.append_value(&item.id);
        self.commits.append_value(commit as i32);
        self.headers.append_value(header as i32);
        self.fingerprints.append_value(&item.fingerprint);
        self.input_hashes.append_value(&item.input_hash);
        self.failures.append_option(item.failure.as_ref());
    }

    fn into_batch(mut self, schema: &SchemaRef) -> RecordBatch {
        let columns: Vec<ArrayRef> = vec![
            Arc::new(self.items.finish()),
            Arc::new(self.commits.finish()),
            Arc::new(self.headers.finish()),
            Arc::new(self.fingerprints.finish()),
            Arc::new(self.input_hashes.finish()),
            Arc::new(self.failures.finish()),
        ];
        RecordBatch::try_new(Arc::clone(schema), columns)
            .expect("invariant: the builders are those of the schema, all of one length")
    }
}
