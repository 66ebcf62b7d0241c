//! SQL over the tables of a store: the only files that know polars.

mod answer;
mod explain;

use std::collections::BTreeMap;

use polars::io::cloud::{CloudOptions, options::CloudRetryConfig};
use polars::prelude::*;
use polars::sql::{SQLContext, extract_table_identifiers};

pub use answer::{Answer, DataFormat, Format, TextTable};
use explain::{Explainer, first_line, unknown_table};

use super::location::{Location, LocationKind};
use super::reader::check_version;
use super::schema::{Column as TableColumn, ColumnType, TableSchema};
use super::sql::{self, StatementKind};
use super::store_snapshot::{LivePart, StoreSnapshot};
use super::tables;
use super::{ClientOptions, StoreError};

/// The name that polars gives to a count without one.
const COUNT_COLUMN: &str = "len";

/// The size and schema of a table in a store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TableInfo {
    pub name: &'static str,
    pub n_rows: u64,
    /// Bytes of the live parts.
    pub n_bytes: u64,
    pub n_parts: usize,
    pub schema_version: u32,
}

/// Reads one SQL statement over the tables of a store.
///
/// Selections and filters are pushed down to the Parquet parts; a table that was never written is empty.
/// Rows are read when the answer is written.
///
/// # Errors
/// [`StoreError::NoStore`] where nothing was ever committed; [`StoreError::Query`] in the user's terms: an
/// unknown column or table comes with the nearest names; [`StoreError::SchemaVersion`] when a part is of a
/// version that is not read.
pub fn query(store: &Location, sql: &str, options: &ClientOptions) -> Result<Answer, StoreError> {
    let asked = sql::read(sql).map_err(StoreError::Query)?;
    check_is_store(store)?;
    let schemas = tables::all();
    let named_sql = match asked {
        StatementKind::Tables => return Ok(Answer::of_frame(frame_of_tables(store, options)?)),
        StatementKind::Columns { table } => {
            let schema = schemas.iter().find(|schema| schema.name.eq_ignore_ascii_case(&table));
            let schema =
                schema.ok_or_else(|| StoreError::Query(unknown_table(&table, &schemas)))?;
            return Ok(Answer::of_frame(frame_of_columns(schema)));
        }
        StatementKind::Rows { named } => named,
    };
    let snapshot = StoreSnapshot::take(store)?;
    if let Some((table, column)) = counted_table(sql)
        && let Some(schema) = schemas.iter().find(|s| s.name.eq_ignore_ascii_case(table))
    {
        let n_rows = count_rows(store, schema, &snapshot.parts(schema.name)?, options)?;
        return Ok(Answer::of_frame(count_frame(column, n_rows)?));
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
    let mut planned = |sql: &str| {
        let mut frame = context.execute(sql)?;
        let columns = frame.collect_schema()?;
        Ok((frame, columns))
    };
    let explainer = Explainer::new(schemas, named);
    // Names are a courtesy: what the engine does not take with them, it is given as it was typed.
    let plan = named_sql.and_then(|sql| planned(&sql).ok()).map_or_else(|| planned(sql), Ok);
    let (frame, columns) = plan.map_err(|e| StoreError::Query(explainer.explain(&e)))?;
    Ok(Answer::new(frame, columns, explainer))
}

/// Refuses a place where nothing was ever committed, which is mistyped more often than empty.
fn check_is_store(store: &Location) -> Result<(), StoreError> {
    if store.is_store()? { Ok(()) } else { Err(StoreError::NoStore { place: store.to_string() }) }
}

/// Returns what a store holds, a line per table.
///
/// # Errors
/// As [`query`].
pub fn table_infos(
    store: &Location,
    options: &ClientOptions,
) -> Result<Vec<TableInfo>, StoreError> {
    check_is_store(store)?;
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

/// Returns what [`table_infos`] tells, as `show tables` answers it.
fn frame_of_tables(store: &Location, options: &ClientOptions) -> Result<DataFrame, StoreError> {
    let infos = table_infos(store, options)?;
    let names: Vec<&str> = infos.iter().map(|info| info.name).collect();
    let numbers = |number: fn(&TableInfo) -> u64| infos.iter().map(number).collect::<Vec<u64>>();
    let columns = vec![
        Column::new("name".into(), names),
        Column::new("n_rows".into(), numbers(|info| info.n_rows)),
        Column::new("n_bytes".into(), numbers(|info| info.n_bytes)),
        Column::new("n_parts".into(), numbers(|info| info.n_parts as u64)),
        Column::new("schema_version".into(), numbers(|info| info.schema_version.into())),
    ];
    DataFrame::new_infer_height(columns).map_err(|e| StoreError::Query(first_line(&e)))
}

/// Returns the columns of a table, as `describe` answers them.
fn frame_of_columns(schema: &TableSchema) -> DataFrame {
    let texts =
        |text: fn(&TableColumn) -> String| schema.columns.iter().map(text).collect::<Vec<String>>();
    let nullable: Vec<bool> = schema.columns.iter().map(|column| column.nullable).collect();
    let columns = vec![
        Column::new("name".into(), texts(|column| column.name.to_string())),
        Column::new("type".into(), texts(|column| column.column_type.name().to_owned())),
        Column::new("nullable".into(), nullable),
        Column::new("unit".into(), texts(|column| column.unit.to_owned())),
        Column::new("description".into(), texts(|column| column.description.to_string())),
    ];
    DataFrame::new_infer_height(columns).expect("invariant: a value for each column in each")
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

/// Returns the rows of parts of a version that is read, with the columns that are newer: null where they may be,
/// else what they say that older parts have.
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
        match column.absent {
            _ if found.contains(name) => col(name),
            Some(value) => lit(value).cast(data_type(column.column_type)).alias(name),
            None if column.nullable => lit(NULL).cast(data_type(column.column_type)).alias(name),
            None => col(name),
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
        LocationKind::Local(root) => {
            let path = |p| PlRefPath::new(root.join(p).to_string_lossy());
            ScanSources::Paths(paths().map(path).collect())
        }
        LocationKind::Remote { .. } if store.url().starts_with("memory://") => {
            let read: Result<Vec<_>, _> = paths().map(|p| store.read(p)).collect();
            ScanSources::Buffers(read?.into_iter().map(|b| b.to_vec().into()).collect())
        }
        LocationKind::Remote { .. } => {
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
