//! One item's rows in every table, without reading those of the others.

use std::collections::BTreeMap;

use ndarray::{Array2, Array3, Axis};
use parquet::errors::ParquetError;

use super::StoreError;
use super::frame_rows::{FrameColumns, GatheredFrames};
use super::frames::several_dancers;
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

    /// Returns the item's frames of a frame table; `None` if it has none. Of a table with dancers the item is a
    /// soloist; [`ItemTables::group`] reads groups, too.
    ///
    /// # Shapes
    /// - returns: `[n_frames, n_channels]`
    ///
    /// # Errors
    /// As [`ItemTables::group`], and when the item has several dancers.
    pub fn frames(&self, table: TableSchema) -> Result<Option<Array2<f32>>, StoreError> {
        let Some(group) = self.group(table.clone())? else { return Ok(None) };
        match group.len_of(Axis(0)) {
            1 => Ok(Some(group.index_axis_move(Axis(0), 0))),
            n => Err(self.broken(&table, &several_dancers(n))),
        }
    }

    /// Returns the frames of all the item's dancers of a frame table; `None` if it has none. A soloist is a group of
    /// one, and so is an item of a table without dancers.
    ///
    /// # Shapes
    /// - returns: `[n_dancers, n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read, is of another version or has other columns, when its dancers or a
    /// dancer's frames are not 0, 1, 2 and so on, or a dancer has more or fewer frames than another.
    pub fn group(&self, table: TableSchema) -> Result<Option<Array3<f32>>, StoreError> {
        let broken = |what: String| self.broken(&table, &what);
        let mut gathered = GatheredFrames::new(table.n_frame_channels());
        for batch in self.snapshot(table.clone())?.batches() {
            let batch = batch?;
            let columns = FrameColumns::of(&batch, &table).map_err(broken)?;
            gathered.take(&columns, 0..batch.num_rows()).map_err(broken)?;
        }
        if gathered.is_empty() {
            return Ok(None);
        }
        gathered.into_group().map(Some).map_err(broken)
    }

    fn snapshot(&self, table: TableSchema) -> Result<Snapshot, StoreError> {
        let parts = self.parts.get(table.name).cloned().unwrap_or_default();
        Snapshot::new(&self.store, table, parts, Some(self.item.clone()))
    }

    fn broken(&self, table: &TableSchema, what: &str) -> StoreError {
        let parts = self.parts.get(table.name).into_iter().flatten();
        let places: Vec<_> = parts.map(|live| self.store.url_of(&live.part.path)).collect();
        StoreError::Parquet {
            table: table.name.to_owned(),
            place: places.join(" and "),
            source: Box::new(ParquetError::General(format!("{} {what}", self.item))),
        }
    }
}
