//! One Parquet file in any kind of storage: its footer is read once, and of its rows only what is asked for.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use arrow_array::{Array as _, RecordBatch, StringArray};
use arrow_schema::ArrowError;
use bytes::Bytes;
use futures::future::BoxFuture;
use futures::{FutureExt as _, StreamExt as _};
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt as _};
use parquet::arrow::arrow_reader::{
    ArrowPredicateFn, ArrowReaderBuilder, ArrowReaderMetadata, ArrowReaderOptions,
    ParquetRecordBatchReaderBuilder, RowFilter,
};
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::arrow::{ParquetRecordBatchStreamBuilder, ProjectionMask};
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::metadata::{ParquetMetaData, ParquetMetaDataReader, RowGroupMetaData};
use parquet::file::statistics::Statistics;

use super::client::block_on;
use super::location::{Location, LocationKind};
use super::remote::join;

/// Bytes that are read of the end of a remote part in one request: its footer.
pub(super) const TAIL_BYTES: u64 = 64 << 10;
/// A remote file of up to this size is read in one request.
const WHOLE_BYTES: u64 = 1 << 20;

/// The batches of a file, in order.
pub(super) type Batches = Box<dyn Iterator<Item = Result<RecordBatch, ParquetError>>>;

/// Which rows are wanted.
#[derive(Clone, Copy)]
pub(super) enum WantedItems<'a> {
    All,
    /// Those of one item.
    One(&'a str),
    /// Those of the items, and what lies in one row group with them.
    Near(&'a BTreeSet<String>),
}

impl WantedItems<'_> {
    /// Returns whether a row group that holds names from `min` to `max` may hold what is wanted.
    fn may_lie_within(self, min: Option<&[u8]>, max: Option<&[u8]>) -> bool {
        let within =
            |item: &[u8]| min.is_none_or(|min| min <= item) && max.is_none_or(|max| max >= item);
        match self {
            WantedItems::All => true,
            WantedItems::One(item) => within(item.as_bytes()),
            WantedItems::Near(items) => items.iter().any(|item| within(item.as_bytes())),
        }
    }
}

/// A Parquet file whose footer was read.
pub(super) struct ParquetObject {
    file: Handle,
    metadata: ArrowReaderMetadata,
}

enum Handle {
    Local(PathBuf),
    Remote(RemoteFile),
}

impl ParquetObject {
    /// Opens a file, whose size a manifest or a listing told; of a large one elsewhere the last `tail_bytes` are read
    /// at once.
    pub fn open(
        store: &Location,
        path: &str,
        n_bytes: u64,
        tail_bytes: u64,
    ) -> ParquetResult<Self> {
        match store.kind() {
            LocationKind::Local(root) => {
                let path = root.join(path);
                let file = File::open(&path)?;
                let metadata = ArrowReaderMetadata::load(&file, ArrowReaderOptions::default())?;
                Ok(Self { file: Handle::Local(path), metadata })
            }
            LocationKind::Remote { store, prefix } => {
                let path = join(prefix, path);
                let opened = block_on(RemoteFile::open(store, &path, n_bytes, tail_bytes));
                let (file, metadata) = match opened {
                    // An upload that was raced may have ended with another size than its manifest says.
                    Err(e) if !is_missing(&e) => {
                        let n_bytes = block_on(store.head(&path)).map_err(external)?.size;
                        block_on(RemoteFile::open(store, &path, n_bytes, tail_bytes))?
                    }
                    opened => opened?,
                };
                let metadata =
                    ArrowReaderMetadata::try_new(metadata, ArrowReaderOptions::default())?;
                Ok(Self { file: Handle::Remote(file), metadata })
            }
        }
    }

    /// Returns a text of the footer.
    pub fn text(&self, key: &str) -> Option<&str> {
        let texts = self.metadata.metadata().file_metadata().key_value_metadata()?;
        texts.iter().find(|text| text.key == key)?.value.as_deref()
    }

    /// Returns the bytes of a range.
    pub fn bytes(&self, range: Range<u64>) -> ParquetResult<Bytes> {
        let outside = |n_bytes: u64| {
            let Range { start, end } = &range;
            ParquetError::General(format!("bytes {start} to {end} are wanted of {n_bytes}"))
        };
        match &self.file {
            Handle::Local(path) => {
                let mut file = File::open(path)?;
                let n_bytes = file.metadata()?.len();
                if range.start > range.end || range.end > n_bytes {
                    return Err(outside(n_bytes));
                }
                file.seek(SeekFrom::Start(range.start))?;
                let mut bytes = vec![0; (range.end - range.start) as usize];
                file.read_exact(&mut bytes)?;
                Ok(bytes.into())
            }
            Handle::Remote(file) => {
                if range.start > range.end || range.end > file.n_bytes {
                    return Err(outside(file.n_bytes));
                }
                block_on(file.clone().get_bytes(range))
            }
        }
    }

    /// Returns the rows that are wanted by their `column`: row groups that cannot hold them are not read, and
    /// where one item is wanted only its rows are decoded. Of the columns those that are named are read, or all.
    pub fn batches(
        &self,
        column: &'static str,
        wanted: WantedItems,
        columns: Option<&[&str]>,
    ) -> ParquetResult<Batches> {
        match &self.file {
            Handle::Local(path) => {
                // Copies of one handle would share its position.
                let file = File::open(path)?;
                let metadata = self.metadata.clone();
                let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata);
                let batches = narrow(builder, column, wanted, columns).build()?;
                Ok(Box::new(batches.map(|batch| batch.map_err(ParquetError::from))))
            }
            Handle::Remote(file) => {
                let (file, metadata) = (file.clone(), self.metadata.clone());
                let builder = ParquetRecordBatchStreamBuilder::new_with_metadata(file, metadata);
                let stream = narrow(builder, column, wanted, columns).build()?;
                let mut stream = Box::pin(stream);
                Ok(Box::new(std::iter::from_fn(move || block_on(stream.next()))))
            }
        }
    }
}

/// Returns the names in a column of texts.
pub(super) fn names<'a>(batch: &'a RecordBatch, column: &str) -> ParquetResult<&'a StringArray> {
    batch
        .column_by_name(column)
        .and_then(|names| names.as_any().downcast_ref::<StringArray>())
        .ok_or_else(|| ParquetError::General(format!("no text column {column}")))
}

fn narrow<T>(
    builder: ArrowReaderBuilder<T>,
    column: &'static str,
    wanted: WantedItems,
    columns: Option<&[&str]>,
) -> ArrowReaderBuilder<T> {
    let groups = builder.metadata().row_groups().iter().enumerate();
    let groups =
        groups.filter(|(_, group)| may_hold(group, column, wanted)).map(|(i, _)| i).collect();
    let mut builder = builder.with_row_groups(groups);
    if let Some(columns) = columns {
        let mask = ProjectionMask::columns(builder.parquet_schema(), columns.iter().copied());
        builder = builder.with_projection(mask);
    }
    let WantedItems::One(item) = wanted else { return builder };
    let mask = ProjectionMask::columns(builder.parquet_schema(), [column]);
    let item = item.to_owned();
    let is_wanted = ArrowPredicateFn::new(mask, move |batch| {
        let found = names(&batch, column).map_err(|e| ArrowError::SchemaError(e.to_string()))?;
        Ok(found.iter().map(|found| Some(found == Some(item.as_str()))).collect())
    });
    builder.with_row_filter(RowFilter::new(vec![Box::new(is_wanted)]))
}

/// Returns whether the statistics of a row group leave room for what is wanted.
fn may_hold(group: &RowGroupMetaData, column: &str, wanted: WantedItems) -> bool {
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

/// A file in an object store, read by ranges; its end is at hand.
#[derive(Clone)]
struct RemoteFile {
    store: Arc<dyn ObjectStore>,
    path: ObjectPath,
    n_bytes: u64,
    tail: Bytes,
}

impl RemoteFile {
    async fn open(
        store: &Arc<dyn ObjectStore>,
        path: &ObjectPath,
        n_bytes: u64,
        tail_bytes: u64,
    ) -> ParquetResult<(Self, Arc<ParquetMetaData>)> {
        let start = if n_bytes <= WHOLE_BYTES { 0 } else { n_bytes.saturating_sub(tail_bytes) };
        let tail = store.get_range(path, start..n_bytes).await.map_err(external)?;
        let (store, path) = (Arc::clone(store), path.clone());
        let mut file = Self { store, path, n_bytes, tail };
        let reader = ParquetMetaDataReader::new();
        let metadata = reader.load_and_finish(&mut file, n_bytes).await?;
        Ok((file, Arc::new(metadata)))
    }

    /// Returns a range that lies within the end of the file.
    fn at_hand(&self, range: &Range<u64>) -> Option<Bytes> {
        let start = self.n_bytes - self.tail.len() as u64;
        let first = range.start.checked_sub(start)?;
        let last = range.end.checked_sub(start)?;
        (first <= last && last <= self.tail.len() as u64)
            .then(|| self.tail.slice(first as usize..last as usize))
    }
}

impl AsyncFileReader for RemoteFile {
    fn get_bytes(&mut self, range: Range<u64>) -> BoxFuture<'_, ParquetResult<Bytes>> {
        async move {
            match self.at_hand(&range) {
                Some(bytes) => Ok(bytes),
                None => self.store.get_range(&self.path, range).await.map_err(external),
            }
        }
        .boxed()
    }

    fn get_byte_ranges(
        &mut self,
        ranges: Vec<Range<u64>>,
    ) -> BoxFuture<'_, ParquetResult<Vec<Bytes>>> {
        async move {
            let at_hand: Option<Vec<Bytes>> = ranges.iter().map(|r| self.at_hand(r)).collect();
            match at_hand {
                Some(bytes) => Ok(bytes),
                None => self.store.get_ranges(&self.path, &ranges).await.map_err(external),
            }
        }
        .boxed()
    }

    fn get_metadata<'a>(
        &'a mut self,
        _options: Option<&'a ArrowReaderOptions>,
    ) -> BoxFuture<'a, ParquetResult<Arc<ParquetMetaData>>> {
        let n_bytes = self.n_bytes;
        async move {
            let reader = ParquetMetaDataReader::new();
            Ok(Arc::new(reader.load_and_finish(self, n_bytes).await?))
        }
        .boxed()
    }
}

fn external(error: object_store::Error) -> ParquetError {
    ParquetError::External(Box::new(error))
}

fn is_missing(error: &ParquetError) -> bool {
    let ParquetError::External(cause) = error else { return false };
    matches!(
        cause.downcast_ref::<object_store::Error>(),
        Some(object_store::Error::NotFound { .. })
    )
}
