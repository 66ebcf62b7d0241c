//! Reading tables: the live rows of a store, one row group in memory at a time.

use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

use arrow_array::{Array as _, BooleanArray, RecordBatch, StringArray};
use arrow_schema::ArrowError;
use bytes::Bytes;
use futures::future::BoxFuture;
use futures::{FutureExt as _, StreamExt as _, TryFutureExt as _};
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt as _};
use parquet::arrow::arrow_reader::{
    ArrowPredicateFn, ArrowReaderBuilder, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
    RowFilter,
};
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::arrow::{ParquetRecordBatchStreamBuilder, ProjectionMask};
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::metadata::{ParquetMetaData, ParquetMetaDataReader, RowGroupMetaData};
use parquet::file::statistics::Statistics;

use super::StoreError;
use super::client::block_on;
use super::commit::{LivePart, live_parts};
use super::location::{Kind, Location};
use super::remote::join;
use super::schema::{Row, TableSchema};

/// The batches of a part, in order.
type Batches = Box<dyn Iterator<Item = Result<RecordBatch, ParquetError>>>;

/// The live rows of one table, as they were when the snapshot was taken.
#[derive(Clone, Debug)]
pub struct Snapshot {
    pub(super) store: Location,
    pub(super) schema: TableSchema,
    pub(super) parts: Vec<LivePart>,
    /// The one item whose rows are wanted; `None` for all.
    pub(super) item: Option<String>,
}

impl Snapshot {
    /// Takes a snapshot of a table; a table that nobody has written is empty.
    ///
    /// # Errors
    /// [`StoreError::SchemaVersion`] when a part is of a version that is not read; [`StoreError`] when
    /// the commits cannot be read.
    pub fn take(store: &Location, schema: TableSchema) -> Result<Self, StoreError> {
        let parts = live_parts(store)?.remove(schema.name).unwrap_or_default();
        Self::new(store, schema, parts, None)
    }

    /// Takes a snapshot of the parts of a table that this program reads, and tells why it leaves out the first
    /// of the others.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn take_known(
        store: &Location,
        schema: TableSchema,
    ) -> Result<(Self, Option<StoreError>), StoreError> {
        let mut parts = live_parts(store)?.remove(schema.name).unwrap_or_default();
        let mut unknown = None;
        parts.retain(|live| match check_version(store, &schema, live) {
            Ok(()) => true,
            Err(e) => {
                unknown.get_or_insert(e);
                false
            }
        });
        Ok((Self::new(store, schema, parts, None)?, unknown))
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
        Ok(Self { store: store.clone(), schema, parts, item })
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
            Some(item) => Wanted::One(item),
            None => Wanted::All,
        };
        self.wanted(wanted)
    }

    /// Returns the live rows of the row groups that may hold some of the items.
    pub(super) fn batches_of<'a>(
        &'a self,
        items: &'a BTreeSet<String>,
    ) -> impl Iterator<Item = Result<RecordBatch, StoreError>> + 'a {
        self.wanted(Wanted::Near(items))
    }

    fn wanted<'a>(
        &'a self,
        wanted: Wanted<'a>,
    ) -> impl Iterator<Item = Result<RecordBatch, StoreError>> + 'a {
        self.parts.iter().flat_map(move |live| {
            let failed = move |source| StoreError::Parquet {
                table: self.schema.name.to_owned(),
                place: self.store.url_of(&live.part.path),
                source: Box::new(source),
            };
            let column = self.schema.item_column();
            let batches: Batches = match open(&self.store, &live.part.path, column, wanted) {
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
fn without(
    batch: &RecordBatch,
    column: &str,
    superseded: &[String],
) -> Result<RecordBatch, ParquetError> {
    if superseded.is_empty() {
        return Ok(batch.clone());
    }
    let items = items(batch, column)
        .ok_or_else(|| ParquetError::General(format!("no text column {column}")))?;
    let dead: std::collections::HashSet<&str> = superseded.iter().map(String::as_str).collect();
    let keep: BooleanArray =
        items.iter().map(|item| Some(item.is_some_and(|i| !dead.contains(i)))).collect();
    Ok(arrow_select::filter::filter_record_batch(batch, &keep)?)
}

fn items<'a>(batch: &'a RecordBatch, column: &str) -> Option<&'a StringArray> {
    batch.column_by_name(column)?.as_any().downcast_ref::<StringArray>()
}

/// Which rows are wanted.
#[derive(Clone, Copy)]
enum Wanted<'a> {
    All,
    /// Those of one item.
    One(&'a str),
    /// Those of the items, and what lies in one row group with them.
    Near(&'a BTreeSet<String>),
}

impl Wanted<'_> {
    /// Returns whether a row group that holds names from `min` to `max` may hold what is wanted.
    fn may_lie_within(self, min: Option<&[u8]>, max: Option<&[u8]>) -> bool {
        let within =
            |item: &[u8]| min.is_none_or(|min| min <= item) && max.is_none_or(|max| max >= item);
        match self {
            Wanted::All => true,
            Wanted::One(item) => within(item.as_bytes()),
            Wanted::Near(items) => items.iter().any(|item| within(item.as_bytes())),
        }
    }
}

/// Narrows a reader to what is wanted: row groups that cannot hold it are not read, and where one item
/// is wanted only its rows are decoded.
fn narrow<T>(
    builder: ArrowReaderBuilder<T>,
    column: &'static str,
    wanted: Wanted,
) -> ArrowReaderBuilder<T> {
    let groups = builder.metadata().row_groups().iter().enumerate();
    let groups =
        groups.filter(|(_, group)| may_hold(group, column, wanted)).map(|(i, _)| i).collect();
    let builder = builder.with_row_groups(groups);
    let Wanted::One(item) = wanted else { return builder };
    let mask = ProjectionMask::columns(builder.parquet_schema(), [column]);
    let item = item.to_owned();
    let is_wanted = ArrowPredicateFn::new(mask, move |batch| {
        let found = items(&batch, column)
            .ok_or_else(|| ArrowError::SchemaError(format!("no text column {column}")))?;
        Ok(found.iter().map(|found| Some(found == Some(item.as_str()))).collect())
    });
    builder.with_row_filter(RowFilter::new(vec![Box::new(is_wanted)]))
}

/// Returns whether the statistics of a row group leave room for what is wanted.
fn may_hold(group: &RowGroupMetaData, column: &str, wanted: Wanted) -> bool {
    let column = group.columns().iter().find(|c| c.column_path().string() == column);
    let Some(Statistics::ByteArray(names)) = column.and_then(|c| c.statistics()) else {
        return true;
    };
    // Both ends may be cut short, the least downwards and the greatest upwards.
    wanted.may_lie_within(
        names.min_opt().map(|min| min.data()),
        names.max_opt().map(|max| max.data()),
    )
}

fn open(
    store: &Location,
    path: &str,
    column: &'static str,
    wanted: Wanted,
) -> ParquetResult<Batches> {
    match store.kind() {
        Kind::Local(root) => {
            let file = std::fs::File::open(root.join(path))?;
            Ok(Box::new(
                narrow(ParquetRecordBatchReaderBuilder::try_new(file)?, column, wanted)
                    .build()?
                    .map(|batch| batch.map_err(ParquetError::from)),
            ))
        }
        Kind::Remote { store, prefix } => {
            let path = join(prefix, path);
            let stream = block_on(async {
                let size = store.head(&path).await.map_err(external)?.size;
                let object = RemotePart { store: Arc::clone(store), path, size };
                narrow(ParquetRecordBatchStreamBuilder::new(object).await?, column, wanted).build()
            })?;
            let mut stream = Box::pin(stream);
            Ok(Box::new(std::iter::from_fn(move || block_on(stream.next()))))
        }
    }
}

/// A Parquet part in an object store, read by ranges.
struct RemotePart {
    store: Arc<dyn ObjectStore>,
    path: ObjectPath,
    size: u64,
}

impl AsyncFileReader for RemotePart {
    fn get_bytes(&mut self, range: Range<u64>) -> BoxFuture<'_, ParquetResult<Bytes>> {
        async move { self.store.get_range(&self.path, range).await.map_err(external) }.boxed()
    }

    fn get_byte_ranges(
        &mut self,
        ranges: Vec<Range<u64>>,
    ) -> BoxFuture<'_, ParquetResult<Vec<Bytes>>> {
        async move { self.store.get_ranges(&self.path, &ranges).await.map_err(external) }.boxed()
    }

    fn get_metadata<'a>(
        &'a mut self,
        _options: Option<&'a ArrowReaderOptions>,
    ) -> BoxFuture<'a, ParquetResult<Arc<ParquetMetaData>>> {
        let size = self.size;
        ParquetMetaDataReader::new().load_and_finish(self, size).map_ok(Arc::new).boxed()
    }
}

fn external(error: object_store::Error) -> ParquetError {
    ParquetError::External(Box::new(error))
}
