//! Catalogues as they are written: the last one merged with the manifests that it does not cover.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;

use arrow_array::builder::{Int32Builder, StringBuilder};
use arrow_array::{ArrayRef, RecordBatch};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;

use super::{
    COMMIT, Catalogue, CatalogueRow, Entry, FAILURE, FINGERPRINT, FOLDER, FORMAT, HEADER,
    INPUT_HASH, ITEM, META, META_DIGEST, Meta, N_KEPT, ROW_GROUP_ROWS, SUFFIX, UnusableReason,
    headers, is_catalogue, number_of,
};
use crate::store::StoreError;
use crate::store::digest::{digest, digest_texts};
use crate::store::location::{ListedObject, Location};
use crate::store::manifest::{Header, Item, Manifest, Rank, stage_and_key};

/// Writes a catalogue of a stage: what `old` says and the manifests that it does not cover.
///
/// `listed` are the catalogues and `manifests` the manifests that are there.
pub(in crate::store) fn write(
    store: &Location,
    stage: &str,
    old: Option<&Catalogue>,
    newer: &[Manifest],
    (listed, manifests): (&[ListedObject], &[ListedObject]),
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
    let mut old: Vec<&ListedObject> = listed.iter().filter(|l| is_catalogue(&l.path)).collect();
    old.sort_by(|a, b| b.path.cmp(&a.path));
    for one in old.into_iter().skip(N_KEPT - 1) {
        // A reader of it falls back on the newest; a process that may not remove it leaves it.
        store.remove(&one.path).ok();
    }
    Ok(())
}

/// Why a catalogue cannot be written.
#[derive(Debug, thiserror::Error)]
pub(in crate::store) enum CatalogueError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("{0}")]
    Unusable(UnusableReason),
}

struct Writer<'a> {
    old: Option<&'a Catalogue>,
    old_headers: &'a [Header],
    newer: &'a [Manifest],
    /// Commits that settled items of `newer`.
    newer_headers: Vec<Vec<Header>>,
    meta: Meta,
    /// New places of the commits of `old`; those that are dead and gone have none.
    old_commits: Vec<Option<usize>>,
    /// Where the commits of `newer` begin in `meta`.
    first_commit: usize,
    headers: Vec<Header>,
    header_places: HeaderPlaces,
    dead: Vec<Vec<String>>,
    writer: ArrowWriter<tempfile::NamedTempFile>,
    schema: SchemaRef,
    rows: CatalogueRows,
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
        let old_headers = old.map_or(Ok(&[][..]), Catalogue::headers);
        let old_headers = old_headers.map_err(CatalogueError::Unusable)?;
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
        let (headers, header_places) = (Vec::new(), HeaderPlaces::default());
        let rows = CatalogueRows::default();
        Ok(Self {
            old,
            old_headers,
            newer,
            newer_headers,
            meta,
            old_commits,
            first_commit,
            headers,
            header_places,
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
        row: CatalogueRow,
        item: &Item,
        newest: &mut std::iter::Peekable<impl Iterator<Item = (&'a str, (usize, usize))>>,
    ) -> Result<(), CatalogueError> {
        while let Some((_, place)) = newest.next_if(|(id, _)| *id < row.item) {
            self.push_newer(place)?;
        }
        let commit = self.old_commits[row.commit]
            .ok_or_else(|| CatalogueError::Unusable(format!("{} is of a dead commit", row.item)))?;
        if let Some(&(_, place)) = newest.peek().filter(|(id, _)| *id == row.item) {
            if self.rank_of(place) > old.rank(row, self.old_headers) {
                // The newer one is written in its turn.
                self.dead[commit].push(row.item.to_owned());
                return Ok(());
            }
            newest.next();
            self.dead[self.first_commit + place.0].push(row.item.to_owned());
        }
        let header = match self.header_places.of_old.get(&row.header) {
            Some(&place) => place,
            None => {
                let place = self.place_of(self.old_headers[row.header].clone());
                self.header_places.of_old.insert(row.header, place);
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
        let place_in_manifest = (m, manifest.header_of(i));
        let header = match self.header_places.of_newer.get(&place_in_manifest) {
            Some(&place) => place,
            None => {
                let place = self.place_of(self.newer_headers[m][place_in_manifest.1].clone());
                self.header_places.of_newer.insert(place_in_manifest, place);
                place
            }
        };
        self.rows.push(self.first_commit + m, header, &manifest.items[i]);
        self.flush_if_full()
    }

    fn place_of(&mut self, header: Header) -> usize {
        let headers = &mut self.headers;
        *self.header_places.all.entry(header).or_insert_with_key(|header| {
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
        // Behind the last row group, where no reader of Parquet looks.
        self.writer.flush().map_err(unusable)?;
        let (bytes, place) = headers::encode(&self.headers, self.writer.bytes_written() as u64);
        self.writer.write_all(&bytes).map_err(|e| unusable(e.into()))?;
        self.meta.header_place = Some(place);
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
struct CatalogueRows {
    n: usize,
    items: StringBuilder,
    commits: Int32Builder,
    headers: Int32Builder,
    fingerprints: StringBuilder,
    input_hashes: StringBuilder,
    failures: StringBuilder,
}

impl CatalogueRows {
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
