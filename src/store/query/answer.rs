//! The rows that a query selected, written as a table or as data.

use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::str::FromStr;
use std::sync::mpsc::sync_channel;

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use polars::prelude::*;

use super::explain::Explainer;
use crate::store::{StoreError, one_line};

/// Rows of a batch, as many as a row group of the tables has.
const BATCH_ROWS: NonZeroUsize = NonZeroUsize::new(64 << 10).expect("65536 is not 0");

/// How an answer is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// For people.
    Table,
    /// For programs.
    Data(DataFormat),
}

/// How an answer is written for programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DataFormat {
    Csv,
    /// An array with one object per row.
    Json,
    Parquet,
}

impl FromStr for Format {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "table" => Ok(Format::Table),
            "csv" => Ok(Format::Data(DataFormat::Csv)),
            "json" => Ok(Format::Data(DataFormat::Json)),
            "parquet" => Ok(Format::Data(DataFormat::Parquet)),
            _ => Err("use table, csv, json or parquet".into()),
        }
    }
}

/// The rows that a query selects, which are read when they are written.
#[derive(Clone)]
pub struct Answer {
    frame: LazyFrame,
    columns: SchemaRef,
    explainer: Explainer,
}

impl std::fmt::Debug for Answer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Answer").field("columns", &self.columns).finish_non_exhaustive()
    }
}

impl Answer {
    pub(super) fn new(frame: LazyFrame, columns: SchemaRef, explainer: Explainer) -> Self {
        Self { frame, columns, explainer }
    }

    pub(super) fn of_frame(frame: DataFrame) -> Self {
        let columns = frame.schema().clone();
        Self { frame: frame.lazy(), columns, explainer: Explainer::default() }
    }

    /// Returns the answer without the rows behind the first `n`.
    #[must_use]
    pub fn limited(self, n: NonZeroUsize) -> Self {
        Self { frame: self.frame.limit(rows(n)), ..self }
    }

    /// Reads the first `n_shown` rows, or all, as a text.
    ///
    /// # Errors
    /// [`StoreError::Query`].
    pub fn text_table(self, n_shown: Option<NonZeroUsize>) -> Result<TextTable, StoreError> {
        let Self { frame, explainer, .. } = self;
        // One more tells whether there are more.
        let frame = match n_shown {
            Some(n) => frame.limit(rows(n).saturating_add(1)),
            None => frame,
        };
        let frame = frame.collect().map_err(|e| StoreError::Query(explainer.explain(&e)))?;
        let cut = n_shown.filter(|n| frame.height() > n.get());
        let frame = cut.map_or(frame.clone(), |n| frame.head(Some(n.get())));
        Ok(TextTable { text: text_table(&frame).to_string(), n_rows: frame.height(), cut })
    }

    /// Writes all rows as data, batch by batch in the order of the answer; returns how many there were.
    ///
    /// # Errors
    /// The error of `out`, and [`StoreError::Query`] within [`io::Error`].
    pub fn write(self, format: DataFormat, out: &mut dyn Write) -> io::Result<u64> {
        let Self { frame, columns, explainer } = self;
        let failed = |e: PolarsError| match e {
            PolarsError::IO { error, .. } => io::Error::new(error.kind(), error),
            e => io::Error::other(StoreError::Query(explainer.explain(&e))),
        };
        let mut n_rows = 0;
        let mut counted = |batch: &DataFrame| n_rows += batch.height() as u64;
        match format {
            DataFormat::Csv => {
                let mut writer = CsvWriter::new(out).batched(&columns).map_err(failed)?;
                for_each_batch(frame, &failed, |batch| {
                    counted(&batch);
                    writer.write_batch(&batch).map_err(failed)
                })?;
                writer.finish().map_err(failed)?;
            }
            DataFormat::Json => {
                let mut is_first = true;
                for_each_batch(frame, &failed, |mut batch| {
                    counted(&batch);
                    write_objects(&mut batch, &mut is_first, out, &failed)
                })?;
                out.write_all(if is_first { b"[]\n" } else { b"]\n" })?;
            }
            DataFormat::Parquet => {
                let mut writer = ParquetWriter::new(out)
                    .with_compression(ParquetCompression::Zstd(None))
                    .batched(&columns)
                    .map_err(failed)?;
                for_each_batch(frame, &failed, |batch| {
                    counted(&batch);
                    writer.write_batch(&batch).map_err(failed)
                })?;
                writer.finish().map_err(failed)?;
            }
        }
        Ok(n_rows)
    }
}

fn rows(n: NonZeroUsize) -> IdxSize {
    IdxSize::try_from(n.get()).unwrap_or(IdxSize::MAX)
}

/// Runs a plan and hands on its batches, of which there are few at a time.
fn for_each_batch(
    frame: LazyFrame,
    failed: &dyn Fn(PolarsError) -> io::Error,
    mut each: impl FnMut(DataFrame) -> io::Result<()>,
) -> io::Result<()> {
    let (sender, receiver) = sync_channel(1);
    // The plan asks to be stopped once the reader has gone.
    let send = PlanCallback::new(move |batch| Ok(sender.send(batch).is_err()));
    let plan = frame.sink_batches(send, true, Some(BATCH_ROWS)).map_err(failed)?;
    std::thread::scope(|scope| {
        let run = scope.spawn(move || plan.collect_with_engine(Engine::Streaming).map(drop));
        let written = receiver.iter().try_for_each(|mut batch| {
            // Writers take columns in one piece.
            batch.rechunk_mut();
            each(batch)
        });
        drop(receiver);
        let run = run.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        written.and_then(|()| run.map_err(failed))
    })
}

/// Writes the rows of a batch as elements of an array that has been begun, or begins here.
fn write_objects(
    batch: &mut DataFrame,
    is_first: &mut bool,
    out: &mut dyn Write,
    failed: &dyn Fn(PolarsError) -> io::Error,
) -> io::Result<()> {
    let mut text = Vec::new();
    let mut writer = JsonWriter::new(&mut text).with_json_format(JsonFormat::JsonLines);
    writer.finish(batch).map_err(failed)?;
    for line in text.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
        out.write_all(if std::mem::take(is_first) { b"[" } else { b"," })?;
        out.write_all(line)?;
    }
    Ok(())
}

/// An answer as people read it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TextTable {
    text: String,
    pub n_rows: usize,
    /// As many rows as are shown, where there are more.
    cut: Option<NonZeroUsize>,
}

impl TextTable {
    /// Writes the rows, and a line where some were left out.
    ///
    /// # Errors
    /// The error of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "{}", self.text)?;
        match self.cut {
            Some(n) => writeln!(out, "the first {n} rows of more; --limit 0 shows all"),
            None => Ok(()),
        }
    }
}

fn text_table(frame: &DataFrame) -> Table {
    let mut table = Table::new();
    table.load_preset(presets::UTF8_FULL_CONDENSED);
    table.set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(frame.get_column_names().iter().map(|name| one_line(name)));
    for (column, series) in table.column_iter_mut().zip(frame.columns()) {
        if series.dtype().is_numeric() {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    for row in 0..frame.height() {
        table.add_row(frame.columns().iter().map(|column| match column.get(row) {
            Ok(AnyValue::String(text)) => one_line(text),
            Ok(AnyValue::StringOwned(text)) => one_line(&text),
            Ok(AnyValue::Null) => NULL_TEXT.to_owned(),
            // Display would round floats to a few digits.
            Ok(AnyValue::Float32(x)) => x.to_string(),
            Ok(AnyValue::Float64(x)) => x.to_string(),
            Ok(value) => value.to_string(),
            Err(_) => String::new(),
        }));
    }
    table
}

/// How a table shows that there is no value; an empty text is empty.
const NULL_TEXT: &str = "null";
