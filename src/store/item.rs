//! One item's rows in every table, without reading those of the others.

use std::collections::BTreeMap;

use arrow_array::{Array as _, Float32Array, Int32Array, RecordBatch};
use ndarray::Array2;
use parquet::errors::ParquetError;

use super::StoreError;
use super::location::Location;
use super::reader::Snapshot;
use super::schema::{Row, TableSchema};
use super::store_snapshot::{LivePart, StoreSnapshot};

/// The live rows of one item, as they were when it was looked up.
///
/// The commits tell which parts they are in; of those, only the row groups are read that may hold
/// the item.
#[derive(Clone, Debug)]
pub struct ItemTables {
    store: Location,
    item: String,
    parts: BTreeMap<String, Vec<LivePart>>,
}

impl ItemTables {
    /// Looks an item up; one that was not settled has no rows.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn take(store: &Location, item: &str) -> Result<Self, StoreError> {
        StoreSnapshot::take(store)?.item(item)
    }

    pub(super) fn new(
        store: &Location,
        item: &str,
        parts: BTreeMap<String, Vec<LivePart>>,
    ) -> Self {
        Self { store: store.clone(), item: item.to_owned(), parts }
    }

    /// Returns the item's rows of a table.
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read, is of another version or has other columns.
    pub fn rows<R: Row>(&self) -> Result<Vec<R>, StoreError> {
        self.snapshot(R::schema())?.rows()
    }

    /// Returns the item's frames of a frame table; `None` if it has none.
    ///
    /// # Shapes
    /// - returns: `[n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read, is of another version or has other columns, or
    /// when its frames are not 0, 1, 2 and so on.
    pub fn frames(&self, table: TableSchema) -> Result<Option<Array2<f32>>, StoreError> {
        let n_channels = table.columns.len() - table.frame_column() - 1;
        let batches: Vec<RecordBatch> =
            self.snapshot(table.clone())?.batches().collect::<Result<_, _>>()?;
        let n_frames = batches.iter().map(RecordBatch::num_rows).sum();
        if n_frames == 0 {
            return Ok(None);
        }
        let mut frames = Array2::zeros((n_frames, n_channels));
        let mut first = 0;
        for batch in batches {
            self.fill(&mut frames, first, &table, &batch)?;
            first += batch.num_rows();
        }
        Ok(Some(frames))
    }

    /// Copies the rows of `batch` to the frames from `first` on.
    fn fill(
        &self,
        frames: &mut Array2<f32>,
        first: usize,
        table: &TableSchema,
        batch: &RecordBatch,
    ) -> Result<(), StoreError> {
        let broken = |what: String| self.broken(table, what);
        let column = |i: usize| batch.column_by_name(&table.columns[i].name);
        let numbers = column(table.frame_column())
            .and_then(|c| c.as_any().downcast_ref::<Int32Array>())
            .ok_or_else(|| broken("has no frame numbers".to_owned()))?;
        for (number, expected) in numbers.values().iter().zip(first..) {
            if usize::try_from(*number) != Ok(expected) {
                return Err(broken(format!("has frame {number} where frame {expected} should be")));
            }
        }
        for (mut to, i) in frames.columns_mut().into_iter().zip(table.frame_column() + 1..) {
            let from = column(i)
                .and_then(|c| c.as_any().downcast_ref::<Float32Array>())
                .ok_or_else(|| broken(format!("has no numbers in {}", table.columns[i].name)))?;
            for (to, from) in to.iter_mut().skip(first).zip(from.values()) {
                *to = *from;
            }
        }
        Ok(())
    }

    fn snapshot(&self, table: TableSchema) -> Result<Snapshot, StoreError> {
        let parts = self.parts.get(table.name).cloned().unwrap_or_default();
        Snapshot::new(&self.store, table, parts, Some(self.item.clone()))
    }

    fn broken(&self, table: &TableSchema, what: String) -> StoreError {
        let parts = self.parts.get(table.name).into_iter().flatten();
        let places: Vec<_> = parts.map(|live| self.store.url_of(&live.part.path)).collect();
        StoreError::Parquet {
            table: table.name.to_owned(),
            place: places.join(" and "),
            source: Box::new(ParquetError::General(format!("{} {what}", self.item))),
        }
    }
}
