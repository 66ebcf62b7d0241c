//! Storage: the only room that names a path, a URL, object_store, parquet or polars.
//!
//! A store is a folder, here or in a bucket: `<table>/<key>.parquet` are its parts and
//! `commits/<stage>/<key>.json` say which of them count. See `docs/architecture.md`.

mod cache;
mod catalogue;
mod client;
mod commit;
mod compact;
mod counted;
mod currency;
mod delta;
mod digest;
mod error;
mod frame_rows;
mod frames;
mod item;
mod lease;
mod ledger;
mod local;
mod location;
mod manifest;
mod number_columns;
mod output;
mod parquet_object;
mod part;
mod patience;
mod prepared;
#[cfg(feature = "query")]
mod query;
mod reader;
mod redaction;
mod remote;
pub(crate) mod schema;
mod shard;
mod source;
#[cfg(feature = "query")]
mod sql;
mod stage_log;
mod store_snapshot;
pub mod tables;
mod vacuum;

pub use cache::Cache;
pub use client::{ClientOptions, memory_traffic};
pub use commit::{Commit, CommitResult};
pub use compact::{Compaction, compact};
pub use counted::Traffic;
pub use currency::{outdated_features, outdated_generations};
pub use delta::write_delta_logs;
pub use digest::{digest, digest_of, digest_texts};
pub use error::{RemoteError, StoreError};
pub use frames::FrameSpool;
pub use item::ItemTables;
pub use lease::Lease;
pub use ledger::{Ledger, SettledItem};
pub use location::{ListedObject, Location, PutOutcome};
pub use manifest::{Item, Manifest, Part};
#[cfg(test)]
pub use number_columns::tests::parquet_of;
pub use number_columns::{NumberColumnsError, number_columns};
pub use output::{STANDARD_OUTPUT, is_standard_output, replace_file, temporary_beside, write_file};
pub use part::{FinishedPart, Label, PartWriter};
pub use patience::Patience;
pub use prepared::prepared;
#[cfg(feature = "query")]
pub use query::{Answer, DataFormat, Format, TableInfo, TextTable, query, table_infos};
pub use reader::Snapshot;
pub use redaction::{lines, one_line, redacted};
pub use schema::{Cell, Column, ColumnType, Row, TableSchema, TimestampUs};
pub use shard::{Shard, batch_of, shard_of, split_of};
pub use source::{
    Content, Listing, OrderedContents, Source, SourceFile, SourceProblem, SourceProblemKind,
    content_of,
};
pub use store_snapshot::{LivePart, StoreSnapshot, checkpoint, live_parts, origin_of};
pub use vacuum::{VacuumRemovals, vacuum};
