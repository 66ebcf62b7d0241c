//! Reading tables: the live rows of a store, one row group in memory at a time.

use std::collections::{BTreeSet, HashSet};

use arrow_array::{BooleanArray, RecordBatch};
use parquet::errors::ParquetError;

use super::StoreError;
use super::location::Location;
use super::parquet_object::{Batches, ParquetObject, TAIL_BYTES, WantedItems, names};
use super::schema::{Row, TableSchema};
use super::store_snapshot::{LivePart, StoreSnapshot};

/// The live rows of one table, as they were when the snapshot was taken.
#[derive(Clone, Debug)]
pub struct Snapshot {
    pub(super) store: Location,
    pub(super) schema: TableSchema,
    pub(super) parts: Vec<LivePart>,
    /// The one item whose rows are wanted; `None` for all.
    pub(super) item: Option<String>,
    /// Where it is looked up which parts items are in.
    pub(super) within: Option<StoreSnapshot>,
}

impl Snapshot {
    /// Takes a snapshot of a table; a table that was never written is empty.
    ///
    /// # Errors
    /// [`StoreError::SchemaVersion`] when a part is of a version that is not read; [`StoreError`] when
    /// the commits cannot be read.
    pub fn take(store: &Location, schema: TableSchema) -> Result<Self, StoreError> {
        StoreSnapshot::take(store)?.table(schema)
    }

    /// Returns the snapshot of some parts, or of one item's rows in them.
    pub(super) fn new(
        store: &Location,
        schema: TableSchema,
        parts: Vec<LivePart>,
        item: Option<String>,
    ) -> Result<Self, StoreError> {
        for live in &parts {
            check_version(store, &schema, live)?;
        }
        Ok(Self { store: store.clone(), schema, parts, item, within: None })
    }

    /// Returns the snapshot as one of a table of `store`.
    pub(super) fn within(self, store: &StoreSnapshot) -> Self {
        Self { within: Some(store.clone()), ..self }
    }

    pub fn parts(&self) -> &[LivePart] {
        &self.parts
    }

    /// Returns the version of the table that this program writes.
    pub fn version(&self) -> u32 {
        self.schema.version
    }

    /// Returns the live rows, part by part; within a part they are sorted as the schema says.
    pub fn batches(&self) -> impl Iterator<Item = Result<RecordBatch, StoreError>> + '_ {
        let wanted = match &self.item {
            Some(item) => WantedItems::One(item),
            None => WantedItems::All,
        };
        self.wanted(wanted)
    }

    /// Returns the live rows of the row groups that may hold some of the items; parts that do not hold them are
    /// not opened.
    pub(super) fn batches_of<'a>(
        &'a self,
        items: &'a BTreeSet<String>,
    ) -> Result<impl Iterator<Item = Result<RecordBatch, StoreError>> + 'a, StoreError> {
        let parts: Vec<&LivePart> = match &self.within {
            Some(store) => store.parts_near(self.schema.name, &self.parts, items)?,
            None => self.parts.iter().collect(),
        };
        Ok(self.batches_in(parts.into_iter(), WantedItems::Near(items)))
    }

    fn wanted<'a>(
        &'a self,
        wanted: WantedItems<'a>,
    ) -> impl Iterator<Item = Result<RecordBatch, StoreError>> + 'a {
        self.batches_in(self.parts.iter(), wanted)
    }

    fn batches_in<'a>(
        &'a self,
        parts: impl Iterator<Item = &'a LivePart> + 'a,
        wanted: WantedItems<'a>,
    ) -> impl Iterator<Item = Result<RecordBatch, StoreError>> + 'a {
        parts.flat_map(move |live| {
            let failed = move |source| StoreError::Parquet {
                table: self.schema.name.to_owned(),
                place: self.store.url_of(&live.part.path),
                source: Box::new(source),
            };
            let column = self.schema.item_column();
            let opened =
                ParquetObject::open(&self.store, &live.part.path, live.part.n_bytes, TAIL_BYTES)
                    .and_then(|file| file.batches(column, wanted, None));
            let batches: Batches = match opened {
                Ok(batches) => batches,
                Err(e) => Box::new(std::iter::once(Err(e))),
            };
            batches.map(move |batch| {
                let batch = batch.map_err(failed)?;
                let batch = self.schema.completed(batch, live.part.schema_version);
                self.check_columns(&batch, &live.part.path)?;
                without(&batch, column, &live.superseded).map_err(failed)
            })
        })
    }

    /// Reads the whole table into rows; for tables with one row per item.
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read or has other columns.
    ///
    /// # Panics
    /// When `R` is a row of another table.
    pub fn rows<R: Row>(&self) -> Result<Vec<R>, StoreError> {
        self.rows_where(|_| true)
    }

    /// Reads the table, and keeps the rows of which `is_wanted` says so; one batch of the others is in
    /// memory at a time.
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read or has other columns.
    ///
    /// # Panics
    /// When `R` is a row of another table.
    pub fn rows_where<R: Row>(
        &self,
        mut is_wanted: impl FnMut(&R) -> bool,
    ) -> Result<Vec<R>, StoreError> {
        assert_eq!(R::schema().name, self.schema.name, "rows of another table");
        let mut rows = Vec::new();
        for batch in self.batches() {
            let batch = batch?;
            let read = R::from_batch(&batch).ok_or_else(|| self.columns_error(&batch, ""))?;
            rows.extend(read.into_iter().filter(&mut is_wanted));
        }
        Ok(rows)
    }

    /// Visits the rows of items, part by part; parts and row groups without any are not read.
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read or has other columns.
    ///
    /// # Panics
    /// When `R` is a row of another table.
    pub fn visit_rows_of<R: Row>(
        &self,
        items: &BTreeSet<String>,
        mut visit: impl FnMut(R),
    ) -> Result<(), StoreError> {
        assert_eq!(R::schema().name, self.schema.name, "rows of another table");
        let column = self.schema.item_column();
        for batch in self.batches_of(items)? {
            let batch = batch?;
            let columns_error = || self.columns_error(&batch, "");
            let found = names(&batch, column).map_err(|_| columns_error())?;
            let keep: BooleanArray =
                found.iter().map(|item| Some(item.is_some_and(|i| items.contains(i)))).collect();
            let batch = arrow_select::filter::filter_record_batch(&batch, &keep)
                .map_err(|_| columns_error())?;
            R::from_batch(&batch).ok_or_else(columns_error)?.into_iter().for_each(&mut visit);
        }
        Ok(())
    }

    fn check_columns(&self, batch: &RecordBatch, path: &str) -> Result<(), StoreError> {
        let expected = self.schema.arrow();
        if expected.fields().iter().all(|f| {
            batch
                .schema_ref()
                .field_with_name(f.name())
                .is_ok_and(|g| g.data_type() == f.data_type())
        }) {
            return Ok(());
        }
        Err(self.columns_error(batch, path))
    }

    fn columns_error(&self, batch: &RecordBatch, path: &str) -> StoreError {
        let found: Vec<_> = batch
            .schema_ref()
            .fields()
            .iter()
            .map(|f| format!("{}: {}", f.name(), f.data_type()))
            .collect();
        let missing = self
            .schema
            .arrow()
            .fields()
            .iter()
            .map(|f| format!("{}: {}", f.name(), f.data_type()))
            .filter(|f| !found.contains(f))
            .collect();
        let place = self.store.url_of(path);
        StoreError::Columns { table: self.schema.name.to_owned(), place, missing, found }
    }
}

pub(super) fn check_version(
    store: &Location,
    schema: &TableSchema,
    live: &LivePart,
) -> Result<(), StoreError> {
    let found = live.part.schema_version;
    if schema.reads(found) {
        return Ok(());
    }
    let remedy = if found > schema.version {
        "install a newer motiongen"
    } else {
        "run the stage that wrote it again with --force"
    };
    let place = store.url_of(&live.part.path);
    let table = schema.name.to_owned();
    let supported = schema.readable();
    Err(StoreError::SchemaVersion { table, place, found, supported, remedy })
}

/// Returns the rows whose item is not among `superseded`.
pub(super) fn without(
    batch: &RecordBatch,
    column: &str,
    superseded: &[String],
) -> Result<RecordBatch, ParquetError> {
    if superseded.is_empty() {
        return Ok(batch.clone());
    }
    let items = names(batch, column)?;
    let dead: HashSet<&str> = superseded.iter().map(String::as_str).collect();
    let keep: BooleanArray =
        items.iter().map(|item| Some(item.is_some_and(|i| !dead.contains(i)))).collect();
    Ok(arrow_select::filter::filter_record_batch(batch, &keep)?)
}
