//! SQL over the tables of a store: the one file that knows polars.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::str::FromStr;

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use polars::io::cloud::{CloudOptions, options::CloudRetryConfig};
use polars::prelude::*;
use polars::sql::{SQLContext, extract_table_identifiers};

use super::location::{Kind, Location};
use super::reader::check_version;
use super::schema::{Column as TableColumn, ColumnType, TableSchema};
use super::store_snapshot::{LivePart, StoreSnapshot};
use super::tables;
use super::{ClientOptions, StoreError};

/// Names offered when a name is not found.
const N_SUGGESTIONS: usize = 3;
/// Statements that polars would act out on the answer's own copy of a table.
const CHANGING: [&str; 7] = ["alter", "create", "delete", "drop", "insert", "truncate", "update"];

/// What polars calls a count that has no name.
const COUNT_COLUMN: &str = "len";

/// How an answer is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    Table,
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
            "csv" => Ok(Format::Csv),
            "json" => Ok(Format::Json),
            "parquet" => Ok(Format::Parquet),
            _ => Err("use table, csv, json or parquet".into()),
        }
    }
}

/// The rows that a query selected.
#[derive(Debug)]
pub struct Answer {
    frame: DataFrame,
}

/// What a store holds of one table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TableInfo {
    pub name: &'static str,
    pub n_rows: u64,
    /// Bytes of the live parts.
    pub n_bytes: u64,
    pub n_parts: usize,
    pub schema_version: u32,
}

/// Runs one SQL statement over the tables of a store.
///
/// Selections and filters are pushed down to the Parquet parts; a table that nobody has written yet
/// is empty.
///
/// # Errors
/// [`StoreError::Query`] in the user's terms: an unknown column or table comes with the nearest
/// names; [`StoreError::SchemaVersion`] when a part is of a version that is not read.
pub fn query(store: &Location, sql: &str, options: &ClientOptions) -> Result<Answer, StoreError> {
    let verb = sql.split_whitespace().next().unwrap_or_default().to_lowercase();
    if CHANGING.contains(&verb.as_str()) {
        let reason = "would change the tables, which only stages do; begin with \"select\"";
        return Err(StoreError::Query(format!("\"{verb}\" {reason}")));
    }
    let schemas = tables::all();
    let snapshot = StoreSnapshot::take(store)?;
    if let Some((table, column)) = counted_table(sql)
        && let Some(schema) = schemas.iter().find(|s| s.name.eq_ignore_ascii_case(table))
    {
        let n_rows = count_rows(store, schema, &snapshot.parts(schema.name)?, options)?;
        return Ok(Answer { frame: count_frame(column, n_rows)? });
    }
    let mut context = SQLContext::new();
    let named = extract_table_identifiers(sql, false, true).unwrap_or_default();
    for schema in &schemas {
        // Only tables that the statement names are opened: a scan reads footers.
        let mut spellings = named.iter().filter(|n| n.eq_ignore_ascii_case(schema.name)).peekable();
        if spellings.peek().is_some() {
            let live = snapshot.parts(schema.name)?;
            let frame = scan(store, schema, &live, options)?;
            spellings.for_each(|name| context.register(name, frame.clone()));
        }
    }
    let explain = |e: PolarsError| StoreError::Query(explain(&e, &schemas, &named));
    let frame = context.execute(sql).and_then(LazyFrame::collect).map_err(explain)?;
    Ok(Answer { frame })
}

/// Returns what a store holds, a line per table.
///
/// # Errors
/// As [`query`].
pub fn table_infos(
    store: &Location,
    options: &ClientOptions,
) -> Result<Vec<TableInfo>, StoreError> {
    let mut parts = StoreSnapshot::take(store)?.live_parts()?;
    let info = |schema: TableSchema| {
        let live = parts.remove(schema.name).unwrap_or_default();
        let n_rows = count_rows(store, &schema, &live, options)?;
        Ok(TableInfo {
            name: schema.name,
            n_rows,
            n_bytes: live.iter().map(|l| l.part.n_bytes).sum(),
            n_parts: live.len(),
            schema_version: schema.version,
        })
    };
    tables::all().into_iter().map(info).collect()
}

/// Returns how many rows of a table count. Commits tell it of their parts; of a part with dead rows, which is
/// written in the part alone, the names are read.
fn count_rows(
    store: &Location,
    schema: &TableSchema,
    live: &[LivePart],
    options: &ClientOptions,
) -> Result<u64, StoreError> {
    let (whole, partial): (Vec<_>, Vec<_>) =
        live.iter().cloned().partition(|l| l.superseded.is_empty());
    for part in &whole {
        check_version(store, schema, part)?;
    }
    let n_whole: u64 = whole.iter().map(|l| l.part.n_rows).sum();
    if partial.is_empty() {
        return Ok(n_whole);
    }
    let counted = scan(store, schema, &partial, options)?
        .select([len().cast(DataType::UInt64)])
        .collect()
        .and_then(|frame| frame.columns()[0].u64()?.get(0).ok_or_else(no_count));
    counted.map(|n| n_whole + n).map_err(|e| StoreError::Query(first_line(&e)))
}

/// Returns the table whose rows a statement counts, if it does nothing else, and what the count is called.
fn counted_table(sql: &str) -> Option<(&str, &str)> {
    let is_name = |word: &&str| {
        word.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
            && word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    let rest = sql.trim().trim_end_matches(';').trim_end();
    let (select, rest) = rest.split_once(char::is_whitespace)?;
    let (count, rest) = rest.split_once('(')?;
    let (star, rest) = rest.split_once(')')?;
    let is_count = select.eq_ignore_ascii_case("select")
        && count.trim().eq_ignore_ascii_case("count")
        && star.trim() == "*"
        && rest.starts_with(char::is_whitespace);
    let words: Vec<&str> = rest.split_whitespace().collect();
    let (table, column) = match (is_count, words.as_slice()) {
        (true, [from, table]) if from.eq_ignore_ascii_case("from") => (*table, COUNT_COLUMN),
        (true, [column, from, table]) if from.eq_ignore_ascii_case("from") => (*table, *column),
        (true, [r#as, column, from, table])
            if r#as.eq_ignore_ascii_case("as") && from.eq_ignore_ascii_case("from") =>
        {
            (*table, *column)
        }
        _ => return None,
    };
    Some((table, column)).filter(|(table, column)| is_name(table) && is_name(column))
}

fn count_frame(column: &str, n_rows: u64) -> Result<DataFrame, StoreError> {
    let name = PlSmallStr::from(column);
    // As polars counts, while it can.
    let count = match IdxSize::try_from(n_rows) {
        Ok(n) => Column::new(name, [n]),
        Err(_) => Column::new(name, [n_rows]),
    };
    DataFrame::new(1, vec![count]).map_err(|e| StoreError::Query(first_line(&e)))
}

fn no_count() -> PolarsError {
    PolarsError::NoData("a count without a row".into())
}

impl Answer {
    pub fn n_rows(&self) -> usize {
        self.frame.height()
    }

    /// Writes the answer in a format.
    ///
    /// # Errors
    /// What the writer says.
    pub fn write(&mut self, format: Format, out: &mut dyn Write) -> std::io::Result<()> {
        let other = |e: PolarsError| match e {
            PolarsError::IO { error, .. } => std::io::Error::new(error.kind(), error),
            e => std::io::Error::other(e),
        };
        let frame = &mut self.frame;
        match format {
            Format::Table => writeln!(out, "{}", text_table(frame)),
            Format::Csv => CsvWriter::new(out).finish(frame).map_err(other),
            Format::Json => {
                let json = JsonFormat::Json;
                JsonWriter::new(&mut *out).with_json_format(json).finish(frame).map_err(other)?;
                writeln!(out)
            }
            Format::Parquet => ParquetWriter::new(out)
                .with_compression(ParquetCompression::Zstd(None))
                .finish(frame)
                .map(|_| ())
                .map_err(other),
        }
    }
}

fn text_table(frame: &DataFrame) -> Table {
    let mut table = Table::new();
    table.load_preset(presets::UTF8_FULL_CONDENSED);
    table.set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(frame.get_column_names().iter().map(|n| n.as_str()));
    for (column, series) in table.column_iter_mut().zip(frame.columns()) {
        if series.dtype().is_numeric() {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    for row in 0..frame.height() {
        table.add_row(frame.columns().iter().map(|column| match column.get(row) {
            Ok(AnyValue::String(text)) => text.to_owned(),
            Ok(AnyValue::StringOwned(text)) => text.to_string(),
            Ok(AnyValue::Null) => String::new(),
            // Display would round floats to a few digits.
            Ok(AnyValue::Float32(x)) => x.to_string(),
            Ok(AnyValue::Float64(x)) => x.to_string(),
            Ok(value) => value.to_string(),
            Err(_) => String::new(),
        }));
    }
    table
}

/// Returns the live rows of a table as a lazy frame.
fn scan(
    store: &Location,
    schema: &TableSchema,
    live: &[LivePart],
    options: &ClientOptions,
) -> Result<LazyFrame, StoreError> {
    for part in live {
        check_version(store, schema, part)?;
    }
    let failed = |e: PolarsError| StoreError::Query(first_line(&e));
    // Whole parts of one version are scanned together; a part with superseded rows gets a filter of its own.
    let (whole, partial): (Vec<_>, Vec<_>) = live.iter().partition(|l| l.superseded.is_empty());
    let mut by_version: BTreeMap<u32, Vec<&LivePart>> = BTreeMap::new();
    for part in whole {
        by_version.entry(part.part.schema_version).or_default().push(part);
    }
    let mut frames = Vec::new();
    for (version, parts) in by_version {
        frames.push(completed(scan_parts(store, &parts, options)?, schema, version)?);
    }
    for part in partial {
        let item = schema.item_column();
        let superseded = Series::new(item.into(), part.superseded.as_slice());
        let dead = col(item).is_in(lit(superseded).implode(false), false);
        let frame = scan_parts(store, &[part], options)?.filter(dead.not());
        frames.push(completed(frame, schema, part.part.schema_version)?);
    }
    match frames.len() {
        0 => Ok(empty(schema).lazy()),
        1 => Ok(frames.remove(0)),
        _ => concat(frames, UnionArgs::default()).map_err(failed),
    }
}

/// Returns the rows of parts of a version that is read, with nulls in the nullable columns that are newer.
fn completed(
    mut frame: LazyFrame,
    schema: &TableSchema,
    version: u32,
) -> Result<LazyFrame, StoreError> {
    if version >= schema.version {
        return Ok(frame);
    }
    let found = frame.collect_schema().map_err(|e| StoreError::Query(first_line(&e)))?;
    let column = |column: &TableColumn| {
        let name = column.name.as_ref();
        if found.contains(name) || !column.nullable {
            col(name)
        } else {
            lit(NULL).cast(data_type(column.column_type)).alias(name)
        }
    };
    Ok(frame.select(schema.columns.iter().map(column).collect::<Vec<_>>()))
}

fn scan_parts(
    store: &Location,
    parts: &[&LivePart],
    options: &ClientOptions,
) -> Result<LazyFrame, StoreError> {
    let paths = || parts.iter().map(|l| l.part.path.as_str());
    let sources = match store.kind() {
        Kind::Local(root) => {
            let path = |p| PlRefPath::new(root.join(p).to_string_lossy());
            ScanSources::Paths(paths().map(path).collect())
        }
        Kind::Remote { .. } if store.url().starts_with("memory://") => {
            let read: Result<Vec<_>, _> = paths().map(|p| store.read(p)).collect();
            ScanSources::Buffers(read?.into_iter().map(|b| b.to_vec().into()).collect())
        }
        Kind::Remote { .. } => {
            ScanSources::Paths(paths().map(|p| PlRefPath::new(store.url_of(p))).collect())
        }
    };
    let mut cloud_options = CloudOptions::default();
    cloud_options.retry_config =
        CloudRetryConfig { max_retries: Some(options.max_retries), ..Default::default() };
    let cloud_options = Some(cloud_options);
    // A folder called `split=test` above the store is no column of its tables.
    let hive_options = HiveOptions::new_disabled();
    let args =
        ScanArgsParquet { glob: false, cloud_options, hive_options, ..ScanArgsParquet::default() };
    LazyFrame::scan_parquet_sources(sources, args).map_err(|e| StoreError::Query(first_line(&e)))
}

fn empty(schema: &TableSchema) -> DataFrame {
    let columns =
        schema.columns.iter().map(|c| Field::new(c.name.as_ref().into(), data_type(c.column_type)));
    DataFrame::empty_with_schema(&columns.collect())
}

fn data_type(column_type: ColumnType) -> DataType {
    match column_type {
        ColumnType::Utf8 => DataType::String,
        ColumnType::Boolean => DataType::Boolean,
        ColumnType::Int32 => DataType::Int32,
        ColumnType::Int64 => DataType::Int64,
        ColumnType::Float32 => DataType::Float32,
        ColumnType::Float64 => DataType::Float64,
        ColumnType::TimestampUs => DataType::Datetime(TimeUnit::Microseconds, Some(TimeZone::UTC)),
    }
}

/// Says what is wrong with a statement in terms of the store's tables.
fn explain(error: &PolarsError, schemas: &[TableSchema], named: &[String]) -> String {
    let text = first_line(error);
    if let Some(table) = between(&text, "relation '", "'") {
        let known: Vec<_> = schemas.iter().map(|s| s.name).collect();
        return format!(
            "table \"{table}\" not found; nearest: {}; a store has {}",
            nearest(table, &known).join(", "),
            known.join(", ")
        );
    }
    let column = between(&text, "unable to find column \"", "\"")
        .or_else(|| between(&text, "no column named '", "'"));
    let Some(column) = column else { return text };
    let of_tables: Vec<_> =
        schemas.iter().filter(|s| named.iter().any(|n| n.eq_ignore_ascii_case(s.name))).collect();
    let columns: Vec<&str> =
        of_tables.iter().flat_map(|s| s.columns.iter().map(|c| c.name.as_ref())).collect();
    if columns.is_empty() {
        return text;
    }
    let lists: Vec<_> = of_tables
        .iter()
        .map(|s| {
            let names: Vec<_> = s.columns.iter().map(|c| c.name.as_ref()).collect();
            format!("table {} has {}", s.name, names.join(", "))
        })
        .collect();
    format!(
        "column \"{column}\" not found; nearest: {}; {}",
        nearest(column, &columns).join(", "),
        lists.join("; ")
    )
}

/// Returns the names most like `name`, best first.
fn nearest<'a>(name: &str, known: &[&'a str]) -> Vec<&'a str> {
    // Tables that are joined share columns; each is offered once.
    let known: BTreeSet<_> = known.iter().collect();
    let mut scored: Vec<_> =
        known.iter().map(|k| (strsim::jaro_winkler(&name.to_lowercase(), k), **k)).collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    scored.into_iter().take(N_SUGGESTIONS).map(|(_, k)| k).collect()
}

fn between<'a>(text: &'a str, before: &str, after: &str) -> Option<&'a str> {
    let start = text.find(before)? + before.len();
    let length = text[start..].find(after)?;
    Some(&text[start..start + length])
}

fn first_line(error: &PolarsError) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}
