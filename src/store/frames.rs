//! Frame tables item by item, and frames kept at hand on this machine.

use std::collections::BTreeSet;
use std::fs::File;
use std::sync::{Mutex, PoisonError};

use ndarray::{Array2, Array3, Axis};
use parquet::errors::ParquetError;

use super::StoreError;
use super::frame_rows::{FrameColumns, GatheredFrames};
use super::reader::Snapshot;

impl Snapshot {
    /// Returns a snapshot of one part alone.
    pub fn part(&self, i: usize) -> Self {
        Self {
            store: self.store.clone(),
            schema: self.schema.clone(),
            parts: vec![self.parts[i].clone()],
            item: self.item.clone(),
            within: self.within.clone(),
        }
    }

    /// Calls `visit` with the frames of each item of a frame table that is among `wanted`, in the order
    /// in which they lie; row groups without any are not read. Of a table with dancers the items are soloists;
    /// [`Snapshot::visit_groups`] reads groups, too.
    ///
    /// # Shapes
    /// - frames: `[n_frames, n_channels]`
    ///
    /// # Errors
    /// As [`Snapshot::visit_groups`], and when an item has several dancers.
    pub fn visit_items<E: From<StoreError>>(
        &self,
        wanted: &BTreeSet<String>,
        mut visit: impl FnMut(&str, Array2<f32>) -> Result<(), E>,
    ) -> Result<(), E> {
        self.visit_groups(wanted, |item, frames| match frames.len_of(Axis(0)) {
            1 => visit(item, frames.index_axis_move(Axis(0), 0)),
            n => Err(self.broken(item, several_dancers(n)).into()),
        })
    }

    /// Calls `visit` with the frames of all dancers of each item of a frame table that is among `wanted`, in the
    /// order in which they lie; row groups without any are not read. Soloists are groups of one, and so are the
    /// items of a table without dancers.
    ///
    /// # Shapes
    /// - frames: `[n_dancers, n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError`] when a part cannot be read, has other columns, an item's dancers or a dancer's frames are not
    /// 0, 1, 2 and so on, or a dancer has more or fewer frames than another; and whatever `visit` returns.
    pub fn visit_groups<E: From<StoreError>>(
        &self,
        wanted: &BTreeSet<String>,
        mut visit: impl FnMut(&str, Array3<f32>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut item = String::new();
        let mut gathered = GatheredFrames::new(self.schema.n_frame_channels());
        let mut finish = |item: &str, gathered: GatheredFrames| -> Result<(), E> {
            if gathered.is_empty() {
                return Ok(());
            }
            visit(item, gathered.into_group().map_err(|what| self.broken(item, what))?)
        };
        for batch in self.batches_of(wanted)? {
            let batch = batch?;
            let columns = FrameColumns::of(&batch, &self.schema)
                .map_err(|what| self.broken("a batch", what))?;
            let mut row = 0;
            while row < batch.num_rows() {
                let name = columns.items.value(row);
                let end = (row + 1..batch.num_rows())
                    .find(|&i| columns.items.value(i) != name)
                    .unwrap_or(batch.num_rows());
                if name != item {
                    let next = GatheredFrames::new(self.schema.n_frame_channels());
                    finish(&item, std::mem::replace(&mut gathered, next))?;
                    item = name.to_owned();
                }
                if wanted.contains(name) {
                    gathered.take(&columns, row..end).map_err(|what| self.broken(name, what))?;
                }
                row = end;
            }
        }
        finish(&item, gathered)
    }

    fn broken(&self, item: &str, what: String) -> StoreError {
        let places: Vec<_> =
            self.parts.iter().map(|live| self.store.url_of(&live.part.path)).collect();
        StoreError::Parquet {
            table: self.schema.name.to_owned(),
            place: places.join(" and "),
            source: Box::new(ParquetError::General(format!("{item} {what}"))),
        }
    }
}

/// Says of an item that it is a group where a soloist is read.
pub(super) fn several_dancers(n_dancers: usize) -> String {
    format!("has {n_dancers} dancers where one is read")
}

/// Rows of numbers of one width, appended in any order and read at random: in memory, or in a file of
/// this machine that other processes do not see and that is removed with the program.
#[derive(Debug)]
pub struct FrameSpool {
    width: usize,
    kept: SpoolStorage,
}

#[derive(Debug)]
enum SpoolStorage {
    Memory(Mutex<Vec<f32>>),
    File { file: File, n_rows: Mutex<u64> },
}

impl FrameSpool {
    /// Makes an empty spool in memory.
    pub fn in_memory(width: usize) -> Self {
        Self { width, kept: SpoolStorage::Memory(Mutex::default()) }
    }

    /// Makes an empty spool in a nameless file of the folder for temporary files (`TMPDIR`).
    ///
    /// # Errors
    /// [`StoreError::Io`] when no file can be made.
    pub fn in_file(width: usize) -> Result<Self, StoreError> {
        let file = tempfile::tempfile().map_err(|e| failed("make", e))?;
        Ok(Self { width, kept: SpoolStorage::File { file, n_rows: Mutex::new(0) } })
    }

    /// Appends rows, and returns the place of the first.
    ///
    /// # Errors
    /// [`StoreError::Io`] when the disk is full.
    ///
    /// # Panics
    /// When `rows` has another width.
    pub fn append(&self, rows: ndarray::ArrayView2<f32>) -> Result<u64, StoreError> {
        assert_eq!(rows.ncols(), self.width, "width of the spool");
        let values = rows.iter().copied();
        match &self.kept {
            SpoolStorage::Memory(kept) => {
                let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
                let first = kept.len() / self.width.max(1);
                kept.extend(values);
                Ok(first as u64)
            }
            SpoolStorage::File { file, n_rows } => {
                let bytes: Vec<u8> = values.flat_map(f32::to_le_bytes).collect();
                let first = {
                    let mut n_rows = n_rows.lock().unwrap_or_else(PoisonError::into_inner);
                    let first = *n_rows;
                    *n_rows += rows.nrows() as u64;
                    first
                };
                write_at(file, &bytes, first * self.row_bytes()).map_err(|e| failed("write", e))?;
                Ok(first)
            }
        }
    }

    /// Reads rows from `first` on until `target` is full.
    ///
    /// # Errors
    /// [`StoreError::Io`] when the file cannot be read, or ends before.
    pub fn read(&self, first: u64, target: &mut [f32]) -> Result<(), StoreError> {
        match &self.kept {
            SpoolStorage::Memory(kept) => {
                let kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
                let start = first as usize * self.width;
                let source = kept.get(start..start + target.len()).ok_or_else(|| {
                    failed("read", std::io::Error::from(std::io::ErrorKind::UnexpectedEof))
                })?;
                target.copy_from_slice(source);
            }
            SpoolStorage::File { file, .. } => {
                let mut bytes = vec![0; size_of_val(target)];
                read_at(file, &mut bytes, first * self.row_bytes())
                    .map_err(|e| failed("read", e))?;
                for (target, bytes) in target.iter_mut().zip(bytes.as_chunks::<4>().0) {
                    *target = f32::from_le_bytes(*bytes);
                }
            }
        }
        Ok(())
    }

    fn row_bytes(&self) -> u64 {
        (self.width * size_of::<f32>()) as u64
    }
}

fn failed(action: &'static str, source: std::io::Error) -> StoreError {
    let place = format!("the frames at hand in {}", std::env::temp_dir().display());
    StoreError::Io { action, place, source }
}

#[cfg(unix)]
fn write_at(file: &File, bytes: &[u8], offset: u64) -> std::io::Result<()> {
    std::os::unix::fs::FileExt::write_all_at(file, bytes, offset)
}

#[cfg(unix)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> std::io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

#[cfg(windows)]
fn write_at(file: &File, mut bytes: &[u8], mut offset: u64) -> std::io::Result<()> {
    while !bytes.is_empty() {
        let n = std::os::windows::fs::FileExt::seek_write(file, bytes, offset)?;
        bytes = &bytes[n..];
        offset += n as u64;
    }
    Ok(())
}

#[cfg(windows)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> std::io::Result<()> {
    let mut done = 0;
    while done < bytes.len() {
        let at = offset + done as u64;
        match std::os::windows::fs::FileExt::seek_read(file, &mut bytes[done..], at)? {
            0 => return Err(std::io::ErrorKind::UnexpectedEof.into()),
            n => done += n,
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::{Commit, Item, Ledger, Location, tables};
    use ndarray::array;
    use std::collections::BTreeMap;

    #[test]
    fn rows_come_back_from_where_they_were_put() {
        let file = FrameSpool::in_file(3).expect("a temporary file");
        for spool in [FrameSpool::in_memory(3), file] {
            let first = spool.append(array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]].view());
            let second = spool.append(array![[7.0, 8.0, 9.0]].view());
            assert_eq!((first.ok(), second.ok()), (Some(0), Some(2)));
            let mut rows = [0.0; 6];
            spool.read(1, &mut rows).expect("two rows are there");
            assert_eq!(rows, [4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
            let error = spool.read(2, &mut rows).expect_err("one row is there");
            let place = format!("the frames at hand in {}", std::env::temp_dir().display());
            assert_eq!(error.to_string(), format!("{place}: could not read"));
        }
    }

    fn frames(n: usize, start: f32) -> Array2<f32> {
        Array2::from_shape_fn((n, 25), |(t, i)| start + t as f32 + 0.01 * i as f32)
    }

    fn commit(store: &Location, items: &[(&str, Array2<f32>)]) {
        let ledger = Ledger::read(store, "ingest").unwrap();
        let mut commit = Commit::new(store, "ingest", "rules", "source");
        for (id, frames) in items {
            let part = commit.part(tables::MOTION, tables::motion).unwrap();
            part.write_frames(id, frames.view()).unwrap();
            let input_hash = format!("{id} of {}", frames[[0, 0]]);
            let fingerprint = String::new();
            commit.settle(
                Item { id: (*id).to_owned(), fingerprint, input_hash, failure: None },
                &ledger,
            );
        }
        commit.publish().unwrap();
    }

    fn visit(store: &Location, wanted: &[&str], n: usize) -> BTreeMap<String, Array2<f32>> {
        let snapshot = Snapshot::take(store, tables::motion()).unwrap();
        let wanted = wanted.iter().map(|&id| id.to_owned()).collect();
        let mut found = BTreeMap::new();
        let visited = snapshot.visit_items(&wanted, |id, frames| {
            assert!(found.insert(id.to_owned(), frames).is_none(), "{id} comes twice");
            if found.len() < n {
                return Ok(());
            }
            Err(StoreError::Query("enough".to_owned()))
        });
        assert_eq!(visited.is_err(), found.len() == n);
        found
    }

    #[test]
    fn items_come_whole_once_and_as_they_are_now() {
        let folder = tempfile::tempdir().unwrap();
        let store = Location::local(folder.path()).unwrap();
        // Longer than what is read at once, between shorter ones.
        let long = frames(3000, 5.0);
        commit(&store, &[("a", frames(2, 1.0)), ("b", long.clone()), ("c", frames(1, 3.0))]);
        commit(&store, &[("a", frames(4, 9.0)), ("d", frames(7, 2.0))]);
        let found = visit(&store, &["a", "b", "d", "e"], 9);
        let expected = [("a", frames(4, 9.0)), ("b", long), ("d", frames(7, 2.0))];
        let expected = expected.map(|(id, frames)| (id.to_owned(), frames));
        assert!(found == BTreeMap::from(expected), "{:?}", found.keys());
        assert_eq!(visit(&store, &["a", "b", "c", "d"], 2).len(), 2);
        assert!(visit(&store, &[], 9).is_empty());
    }
}
