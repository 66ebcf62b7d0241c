//! Delta Lake logs: which parts of a table count, in the words of other engines.
//!
//! `<table>/_delta_log/<version>.json` is written beside the parts by `compact --delta`, protocol 1 for readers and
//! 2 for writers: what DuckDB's `delta_scan`, polars and Spark read. It repeats what the commits say, as of when it
//! was written; this program never reads its tables from it.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use bytes::Bytes;
use serde_json::{Value, json};

use super::StoreError;
use super::digest::digest_texts;
use super::location::{Location, PutOutcome};
use super::schema::{ColumnType, TableSchema, TimestampUs};
use super::store_snapshot::{LivePart, StoreSnapshot};
use super::tables;

/// Versions of the protocol for readers and for writers.
const PROTOCOL: [u64; 2] = [1, 2];
const FOLDER: &str = "_delta_log";
/// Times that a version is written again that another process wrote first.
const RETRIES: usize = 8;

/// The state of a table by its log.
#[derive(Default)]
struct Log {
    next_version: u64,
    /// Parts that count, by their path below the table.
    active: BTreeSet<String>,
    schema: Option<String>,
}

/// Brings the Delta Lake logs of all tables up to what counts now; returns the tables whose log changed.
///
/// # Errors
/// [`StoreError::DeltaLog`] when a log is of another protocol, or a part holds dead rows, which the protocol cannot
/// say; [`StoreError`] when the store cannot be read or written.
pub fn write_delta_logs(store: &Location) -> Result<Vec<&'static str>, StoreError> {
    let snapshot = StoreSnapshot::take(store)?;
    let mut changed = Vec::new();
    for schema in tables::all() {
        let parts = snapshot.parts(schema.name)?;
        if let Some(live) = parts.iter().find(|live| !live.superseded.is_empty()) {
            let n_dead = live.superseded.len();
            let reason = format!(
                "cannot say that {n_dead} items of {} are dead, which were replaced meanwhile; run motiongen \
                 compact --delta again",
                live.part.path
            );
            return Err(of_table(store, schema.name, reason));
        }
        if write(store, &schema, &parts)? {
            changed.push(schema.name);
        }
    }
    Ok(changed)
}

/// Returns the parts that the logs of all tables name, below the store.
///
/// # Errors
/// As [`write_delta_logs`].
pub(super) fn active_paths(store: &Location) -> Result<HashSet<String>, StoreError> {
    let mut paths = HashSet::new();
    for schema in tables::all() {
        let log = read(store, schema.name)?;
        paths.extend(log.active.into_iter().map(|path| format!("{}/{path}", schema.name)));
    }
    Ok(paths)
}

fn of_table(store: &Location, table: &str, reason: String) -> StoreError {
    let place = store.url_of(&format!("{table}/{FOLDER}"));
    StoreError::DeltaLog { table: table.to_owned(), place, reason }
}

/// Replays a table's log; one that is not there says nothing.
fn read(store: &Location, table: &str) -> Result<Log, StoreError> {
    let refuse = |reason: String| of_table(store, table, reason);
    let version_of = |path: &str| -> Option<u64> {
        let (_, name) = path.rsplit_once('/')?;
        name.strip_suffix(".json")?.parse().ok()
    };
    let mut listed = store.list(&format!("{table}/{FOLDER}"))?;
    listed.retain(|l| version_of(&l.path).is_some());
    let mut log = Log::default();
    for (listed, bytes) in listed.iter().zip(store.read_many(&listed)?) {
        if version_of(&listed.path) != Some(log.next_version) {
            return Err(refuse(format!("has no version {}", log.next_version)));
        }
        log.next_version += 1;
        for line in bytes.split(|b| *b == b'\n').filter(|line| !line.is_empty()) {
            let action: Value = serde_json::from_slice(line)
                .map_err(|e| refuse(format!("is damaged in {} ({e})", listed.path)))?;
            if let Some(protocol) = action.get("protocol") {
                let version_of =
                    |name: &str| protocol.get(name).and_then(Value::as_u64).unwrap_or(0);
                let found = [version_of("minReaderVersion"), version_of("minWriterVersion")];
                if found != PROTOCOL {
                    return Err(refuse(format!(
                        "is of protocol {}/{}, this program writes {}/{}; move it away",
                        found[0], found[1], PROTOCOL[0], PROTOCOL[1]
                    )));
                }
            }
            let path = |name: &str| Some(action.get(name)?.get("path")?.as_str()?.to_owned());
            if let Some(path) = path("add") {
                log.active.insert(path);
            }
            if let Some(path) = path("remove") {
                log.active.remove(&path);
            }
            if let Some(schema) = action.get("metaData").and_then(|m| m.get("schemaString")) {
                log.schema = schema.as_str().map(str::to_owned);
            }
        }
    }
    Ok(log)
}

/// Writes the version that makes a table's log say which parts count; returns whether there was need to.
fn write(store: &Location, schema: &TableSchema, parts: &[LivePart]) -> Result<bool, StoreError> {
    for _ in 0..RETRIES {
        let log = read(store, schema.name)?;
        let Some(text) = version(&log, schema, parts, TimestampUs::now().0 / 1000) else {
            return Ok(false);
        };
        let path = format!("{}/{FOLDER}/{:020}.json", schema.name, log.next_version);
        if store.put_new(&path, Bytes::from(text))? == PutOutcome::Written {
            return Ok(true);
        }
    }
    Err(of_table(store, schema.name, "is being written by others; try again".to_owned()))
}

/// Returns the actions that lead from `log` to `parts`, a line each; none where it says so already.
fn version(log: &Log, schema: &TableSchema, parts: &[LivePart], now_ms: i64) -> Option<String> {
    let name_of = |live: &LivePart| {
        let path = live.part.path.as_str();
        path.strip_prefix(schema.name).unwrap_or(path).trim_start_matches('/').to_owned()
    };
    let live: BTreeMap<String, &LivePart> = parts.iter().map(|l| (name_of(l), l)).collect();
    let mut actions = Vec::new();
    if log.next_version == 0 {
        if live.is_empty() {
            return None;
        }
        actions.push(json!({"protocol": {
            "minReaderVersion": PROTOCOL[0], "minWriterVersion": PROTOCOL[1],
        }}));
    }
    let columns = schema_text(schema);
    if log.schema.as_ref() != Some(&columns) {
        actions.push(json!({"metaData": {
            "id": id_of(schema),
            "name": schema.name,
            "description": schema.description,
            "format": {"provider": "parquet", "options": {}},
            "schemaString": columns,
            "partitionColumns": [],
            "configuration": {},
            "createdTime": now_ms,
        }}));
    }
    for path in log.active.iter().filter(|path| !live.contains_key(*path)) {
        actions.push(json!({"remove": {
            "path": path, "deletionTimestamp": now_ms, "dataChange": true,
        }}));
    }
    for (path, live) in live.iter().filter(|(path, _)| !log.active.contains(*path)) {
        actions.push(json!({"add": {
            "path": path,
            "partitionValues": {},
            "size": live.part.n_bytes,
            "modificationTime": now_ms,
            "dataChange": true,
            "stats": json!({"numRecords": live.part.n_rows}).to_string(),
        }}));
    }
    if actions.is_empty() {
        return None;
    }
    let info = json!({"commitInfo": {
        "timestamp": now_ms,
        "operation": "WRITE",
        "operationParameters": {"mode": "Overwrite"},
        "engineInfo": super::commit::program(),
    }});
    actions.insert(0, info);
    Some(actions.iter().map(|action| format!("{action}\n")).collect())
}

/// Returns a table's columns as the protocol has them.
fn schema_text(schema: &TableSchema) -> String {
    let fields: Vec<Value> = schema
        .columns
        .iter()
        .map(|column| {
            let name = match column.column_type {
                ColumnType::Utf8 => "string",
                ColumnType::Boolean => "boolean",
                ColumnType::Int32 => "integer",
                ColumnType::Int64 => "long",
                ColumnType::Float32 => "float",
                ColumnType::Float64 => "double",
                ColumnType::TimestampUs => "timestamp",
            };
            let metadata = json!({"comment": column.description, "unit": column.unit});
            json!({
                "name": column.name, "type": name, "nullable": column.nullable,
                "metadata": metadata,
            })
        })
        .collect();
    json!({"type": "struct", "fields": fields}).to_string()
}

/// Returns the name of a table that the protocol asks for, in the form of a UUID.
fn id_of(schema: &TableSchema) -> String {
    let digits = digest_texts(["motiongen table", schema.name]);
    let part = |from: usize, to: usize| &digits[from..to];
    format!("{}-{}-4{}-8{}-{}", part(0, 8), part(8, 12), part(12, 15), part(15, 18), part(18, 30))
}
