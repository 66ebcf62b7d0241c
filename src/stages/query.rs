//! `query`: SQL over every table of a store.

use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Context as _;

use super::{ClientParams, Contract, Progress, Stage, Summary};
use crate::store::{self, Answer, DataFormat, Format, Location, TableInfo, TextTable};

/// The stage.
pub struct Query;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket that holds the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// The statement, for example "select split, count(*) n from phrases group by split".
    #[arg(value_name = "SQL", required_unless_present = "tables")]
    pub sql: Option<String>,
    /// List the tables with their rows, bytes, parts and schema versions instead.
    #[arg(long, conflicts_with = "sql")]
    pub tables: bool,
    /// table, csv, json (an array of rows) or parquet.
    #[arg(long, value_name = "FORMAT", default_value = "table")]
    pub format: Format,
    /// Rows that are written; 0 is all [default: 40 as a table, else all]
    #[arg(long, value_name = "N")]
    pub limit: Option<usize>,
    /// Write the answer to this file, whole or not at all, instead of standard output (-).
    #[arg(long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub client: ClientParams,
    /// With --output: say how much would be written, and write nothing.
    #[arg(long)]
    pub dry_run: bool,
}

impl Stage for Query {
    const NAME: &'static str = "query";
    const ABOUT: &'static str = "ask the tables of a store in SQL";
    const CONTRACT: Contract = Contract { reads: "every table", writes: "standard output" };
    type Params = Params;

    fn run(params: Params, _progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let options = params.client.options();
        let location = Location::open(&params.store, &options)?;
        let Some(sql) = &params.sql else {
            let tables = store::table_infos(&location, &options)?;
            return Ok(Box::new(Tables { tables }));
        };
        let answer = store::query(&location, sql, &options)?;
        let limit = params.limit.map(NonZeroUsize::new);
        let mut selected = match params.format {
            Format::Table => {
                let n_shown = limit.unwrap_or(NonZeroUsize::new(N_SHOWN));
                let table = answer.clone().text_table(n_shown)?;
                QueryResult::Table { table, answer: limited(answer, limit) }
            }
            Format::Data(format) => {
                let answer = limited(answer, limit);
                QueryResult::Data { answer: Some(answer), format, n_rows: 0 }
            }
        };
        let Some(output) = &params.output else { return Ok(Box::new(selected)) };
        if params.dry_run {
            selected.write(&mut io::sink())?;
        } else {
            store::write_file(output, |out| selected.write(out))
                .with_context(|| format!("while writing {}", output.display()))?;
        }
        let (n_rows, output) = (selected.n_rows(), output.clone());
        Ok(Box::new(QuerySummary { n_rows, output, dry_run: params.dry_run }))
    }
}

/// Rows that a table shows unless the user says otherwise.
const N_SHOWN: usize = 40;

fn limited(answer: Answer, limit: Option<Option<NonZeroUsize>>) -> Answer {
    match limit.flatten() {
        Some(n) => answer.limited(n),
        None => answer,
    }
}

enum QueryResult {
    Table {
        table: TextTable,
        answer: Answer,
    },
    /// Rows are read while they are written, and counted.
    Data {
        answer: Option<Answer>,
        format: DataFormat,
        n_rows: u64,
    },
}

impl QueryResult {
    /// Returns the rows as JSON, or why they could not be read.
    fn rows(&mut self) -> Result<serde_json::Value, String> {
        let answer = match self {
            Self::Table { answer, .. } => answer.clone(),
            Self::Data { answer, .. } => match answer.take() {
                Some(answer) => answer,
                None => return Ok(serde_json::Value::Null),
            },
        };
        let mut text = Vec::new();
        answer.write(DataFormat::Json, &mut text).map_err(|e| e.to_string())?;
        serde_json::from_slice(&text).map_err(|e| e.to_string())
    }

    fn n_rows(&self) -> u64 {
        match self {
            Self::Table { table, .. } => table.n_rows as u64,
            Self::Data { n_rows, .. } => *n_rows,
        }
    }
}

impl Summary for QueryResult {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        match self {
            Self::Table { table, .. } => table.write(out),
            Self::Data { answer, format, n_rows } => {
                if let Some(answer) = answer.take() {
                    *n_rows = answer.write(*format, out)?;
                }
                Ok(())
            }
        }
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        match self.rows() {
            Ok(rows) => serde_json::json!({ "rows": rows }),
            Err(error) => serde_json::json!({ "rows": null, "error": error }),
        }
    }

    fn is_data(&self) -> bool {
        true
    }
}

struct QuerySummary {
    n_rows: u64,
    output: PathBuf,
    dry_run: bool,
}

impl Summary for QuerySummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let would = if self.dry_run { "would write " } else { "" };
        writeln!(out, "{would}{} rows → {}", self.n_rows, self.output.display())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        serde_json::json!({ "to": self.output, "dry_run": self.dry_run, "n_rows": self.n_rows })
    }
}

struct Tables {
    tables: Vec<TableInfo>,
}

impl Summary for Tables {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(
            out,
            "{:<16} {:>12} {:>14} {:>7} {:>8}",
            "table", "rows", "bytes", "parts", "version"
        )?;
        for t in &self.tables {
            writeln!(
                out,
                "{:<16} {:>12} {:>14} {:>7} {:>8}",
                t.name, t.n_rows, t.n_bytes, t.n_parts, t.schema_version
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let tables = self.tables.iter().map(|t| {
            serde_json::json!({
                "table": t.name,
                "n_rows": t.n_rows,
                "n_bytes": t.n_bytes,
                "n_parts": t.n_parts,
                "version": t.schema_version,
            })
        });
        serde_json::json!({ "tables": tables.collect::<Vec<_>>() })
    }
}
