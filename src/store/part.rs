//! Writing parts: immutable Parquet files that hold some of a table's rows.

use std::sync::Arc;

use arrow_array::builder::StringBuilder;
use arrow_array::{ArrayRef, Float32Array, Int32Array, RecordBatch};
use arrow_schema::SchemaRef;
use ndarray::{Axis, s};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::{KeyValue, SortingColumn};
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;
use tempfile::NamedTempFile;

use super::StoreError;
use super::schema::{Row, TableSchema};

/// Rows of a row group: large enough to compress, small enough to hold in memory.
pub(super) const ROW_GROUP_ROWS: usize = 64 << 10;
/// Rows of a data page, the smallest unit that a filter can skip.
const PAGE_ROWS: usize = 8 << 10;

/// Writes one part to a temporary file, at most one row group of it in memory.
pub struct PartWriter {
    table: TableSchema,
    schema: SchemaRef,
    writer: ArrowWriter<NamedTempFile>,
    frames: FrameBuffer,
    n_rows: u64,
}

/// Rows of a frame table that wait for their row group.
#[derive(Default)]
struct FrameBuffer {
    /// Items, what else names them, and how many rows each has here.
    items: Vec<(String, Vec<Label>, usize)>,
    dancer: Vec<i32>,
    frame: Vec<i32>,
    channels: Vec<Vec<f32>>,
}

/// The value of a label column of an item; the same for all its frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Label {
    Text(String),
    Number(i32),
}

/// A finished part, not yet published.
pub struct FinishedPart {
    pub file: NamedTempFile,
    pub n_rows: u64,
}

impl PartWriter {
    /// Starts a part of `table` in `file`.
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    pub fn new(table: TableSchema, file: NamedTempFile) -> Result<Self, StoreError> {
        let schema = table.arrow();
        let sorting: Vec<_> = table
            .sorted_by
            .iter()
            .filter_map(|name| table.columns.iter().position(|c| c.name == *name))
            .map(|i| SortingColumn { column_idx: i as i32, descending: false, nulls_first: false })
            .collect();
        let mut properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::try_new(1).expect("1 is a zstd level")))
            // A dictionary of floats is larger than the floats and takes three times as long; names
            // repeat once per frame, and there it pays.
            .set_dictionary_enabled(false)
            .set_statistics_enabled(EnabledStatistics::Page)
            .set_max_row_group_row_count(Some(ROW_GROUP_ROWS))
            .set_data_page_row_count_limit(PAGE_ROWS)
            .set_sorting_columns(Some(sorting));
        if table.sorted_by.len() > 1 {
            let item = ColumnPath::from(table.item_column());
            properties = properties
                .set_column_dictionary_enabled(item.clone(), true)
                .set_column_bloom_filter_enabled(item.clone(), true)
                .set_column_bloom_filter_max_ndv(item, ROW_GROUP_ROWS as u64 / 16);
        }
        let writer = ArrowWriter::try_new(file, Arc::clone(&schema), Some(properties.build()))
            .map_err(|e| failed(&table, e))?;
        let channels = vec![Vec::new(); table.n_frame_channels()];
        let frames = FrameBuffer { channels, ..Default::default() };
        Ok(Self { table, schema, writer, frames, n_rows: 0 })
    }

    /// Appends rows of a row type.
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    pub fn write_rows<R: Row>(&mut self, rows: &[R]) -> Result<(), StoreError> {
        debug_assert_eq!(R::schema(), self.table, "rows of another table");
        self.n_rows += rows.len() as u64;
        self.writer.write(&R::to_batch(rows)).map_err(|e| failed(&self.table, e))
    }

    /// Appends rows of the table's Arrow schema as a row group.
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    pub(super) fn write_row_group(&mut self, batch: &RecordBatch) -> Result<(), StoreError> {
        self.n_rows += batch.num_rows() as u64;
        self.writer
            .write(batch)
            .and_then(|()| self.writer.flush())
            .map_err(|e| failed(&self.table, e))
    }

    /// Returns the error of a part that cannot be written.
    pub(super) fn failed(&self, source: ParquetError) -> StoreError {
        failed(&self.table, source)
    }

    /// Appends the frames of one item to a frame table; in one with dancers they are a soloist's, dancer 0.
    ///
    /// Row groups hold whole items as long as an item is shorter than a row group.
    ///
    /// # Shapes
    /// - `frames`: `[n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    ///
    /// # Panics
    /// When `frames` has another number of channels than the table.
    pub fn write_frames(
        &mut self,
        item: &str,
        frames: ndarray::ArrayView2<f32>,
    ) -> Result<(), StoreError> {
        self.write_labelled_frames(item, &[], frames)
    }

    /// Appends the frames of one item to a frame table that has labels, given in the order of its columns; in one
    /// with dancers they are a soloist's, dancer 0.
    ///
    /// # Shapes
    /// - `frames`: `[n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    ///
    /// # Panics
    /// When there are more or fewer labels or channels than the table has.
    pub fn write_labelled_frames(
        &mut self,
        item: &str,
        labels: &[Label],
        frames: ndarray::ArrayView2<f32>,
    ) -> Result<(), StoreError> {
        self.write_labelled_group(item, labels, frames.insert_axis(Axis(0)))
    }

    /// Appends the frames of the dancers of one item to a frame table, dancer by dancer.
    ///
    /// # Shapes
    /// - `frames`: `[n_dancers, n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    ///
    /// # Panics
    /// When `frames` has another number of channels than the table, or several dancers where the table has none.
    pub fn write_group(
        &mut self,
        item: &str,
        frames: ndarray::ArrayView3<f32>,
    ) -> Result<(), StoreError> {
        self.write_labelled_group(item, &[], frames)
    }

    /// Appends the frames of the dancers of one item to a frame table that has labels, given in the order of its
    /// columns.
    ///
    /// # Shapes
    /// - `frames`: `[n_dancers, n_frames, n_channels]`
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    ///
    /// # Panics
    /// When there are more or fewer labels or channels than the table has, or several dancers where it has none.
    pub fn write_labelled_group(
        &mut self,
        item: &str,
        labels: &[Label],
        frames: ndarray::ArrayView3<f32>,
    ) -> Result<(), StoreError> {
        let (n_dancers, n_frames, n_channels) = frames.dim();
        let table = &self.table;
        assert_eq!(n_channels, self.frames.channels.len(), "channels of {}", table.name);
        assert_eq!(labels.len(), table.n_labels(), "labels of {}", table.name);
        assert!(n_dancers <= 1 || table.dancer_column().is_some(), "{} has no dancers", table.name);
        let waiting = self.frames.frame.len();
        if waiting > 0 && waiting + n_dancers * n_frames > ROW_GROUP_ROWS {
            self.flush_frames()?;
        }
        for (dancer, frames) in frames.outer_iter().enumerate() {
            let mut first = 0;
            while first < n_frames {
                let buffer = &mut self.frames;
                let room = ROW_GROUP_ROWS - buffer.frame.len();
                let end = n_frames.min(first + room);
                let piece = frames.slice(s![first..end, ..]);
                buffer.items.push((item.to_owned(), labels.to_vec(), piece.nrows()));
                buffer.dancer.extend(std::iter::repeat_n(dancer as i32, piece.nrows()));
                buffer.frame.extend((first..end).map(|i| i as i32));
                for (channel, values) in buffer.channels.iter_mut().zip(piece.columns()) {
                    channel.extend(values);
                }
                if buffer.frame.len() >= ROW_GROUP_ROWS {
                    self.flush_frames()?;
                }
                first = end;
            }
        }
        Ok(())
    }

    fn flush_frames(&mut self) -> Result<(), StoreError> {
        let buffer = &mut self.frames;
        let n_rows = buffer.frame.len();
        if n_rows == 0 {
            return Ok(());
        }
        let items: Vec<(String, Vec<Label>, usize)> = buffer.items.drain(..).collect();
        let mut columns: Vec<ArrayRef> =
            vec![repeated(items.iter().map(|(name, _, n)| (name.as_str(), *n)), n_rows)];
        for label in 0..self.table.n_labels() {
            let label_and_count =
                move |(_, labels, n): &(String, Vec<Label>, usize)| (labels[label].clone(), *n);
            columns.push(labels_of(items.iter().map(label_and_count), n_rows));
        }
        let dancer = std::mem::take(&mut buffer.dancer);
        if self.table.dancer_column().is_some() {
            columns.push(Arc::new(Int32Array::from(dancer)));
        }
        columns.push(Arc::new(Int32Array::from(std::mem::take(&mut buffer.frame))));
        for channel in &mut buffer.channels {
            columns.push(Arc::new(Float32Array::from(std::mem::take(channel))));
        }
        let batch = RecordBatch::try_new(Arc::clone(&self.schema), columns)
            .expect("invariant: the buffer has the table's columns, all of one length");
        self.n_rows += n_rows as u64;
        self.writer
            .write(&batch)
            .and_then(|()| self.writer.flush())
            .map_err(|e| failed(&self.table, e))
    }

    /// Ends the part, with `metadata` in its footer.
    ///
    /// # Errors
    /// [`StoreError::Parquet`].
    pub fn finish(mut self, metadata: &[(&str, String)]) -> Result<FinishedPart, StoreError> {
        self.flush_frames()?;
        for (key, value) in metadata {
            self.writer.append_key_value_metadata(KeyValue::new(
                format!("motiongen.{key}"),
                value.clone(),
            ));
        }
        let file = self.writer.into_inner().map_err(|e| failed(&self.table, e))?;
        Ok(FinishedPart { file, n_rows: self.n_rows })
    }
}

/// A column of texts, each repeated.
fn repeated<'a>(texts: impl Iterator<Item = (&'a str, usize)>, n_rows: usize) -> ArrayRef {
    let mut column = StringBuilder::with_capacity(n_rows, n_rows * 16);
    for (text, n) in texts {
        (0..n).for_each(|_| column.append_value(text));
    }
    Arc::new(column.finish())
}

/// A column of labels of one kind, each repeated.
fn labels_of(labels: impl Iterator<Item = (Label, usize)> + Clone, n_rows: usize) -> ArrayRef {
    let numbers = labels.clone().map(|(label, n)| match label {
        Label::Number(number) => Some((number, n)),
        Label::Text(_) => None,
    });
    match numbers.collect::<Option<Vec<_>>>() {
        Some(numbers) => {
            let all = numbers.into_iter().flat_map(|(number, n)| std::iter::repeat_n(number, n));
            Arc::new(all.collect::<Int32Array>())
        }
        None => {
            let texts: Vec<(String, usize)> = labels
                .map(|(label, n)| match label {
                    Label::Text(text) => (text, n),
                    Label::Number(number) => (number.to_string(), n),
                })
                .collect();
            repeated(texts.iter().map(|(text, n)| (text.as_str(), *n)), n_rows)
        }
    }
}

fn failed(table: &TableSchema, source: ParquetError) -> StoreError {
    let place = "the part being written".to_owned();
    StoreError::Parquet { table: table.name.to_owned(), place, source: Box::new(source) }
}
