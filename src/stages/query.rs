//! `query`: SQL over every table of a store.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context as _;

use super::{ClientParams, Contract, Progress, Stage, Summary};
use crate::store::{self, Answer, Format, Location, TableInfo};

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
    /// Write the answer to this file, whole or not at all, instead of standard output.
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
        let mut answer = store::query(&location, sql, &options)?;
        let Some(output) = &params.output else {
            return Ok(Box::new(Selected { answer, format: params.format }));
        };
        let n_rows = answer.n_rows();
        if !params.dry_run {
            store::write_file(output, |out| answer.write(params.format, out))
                .with_context(|| format!("while writing {}", output.display()))?;
        }
        Ok(Box::new(Written { n_rows, output: output.clone(), dry_run: params.dry_run }))
    }
}

struct Selected {
    answer: Answer,
    format: Format,
}

impl Summary for Selected {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        self.answer.write(self.format, out)
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let mut text = Vec::new();
        // Rows that cannot be written as JSON are told as none.
        let written = self.answer.write(Format::Json, &mut text);
        let rows: serde_json::Value =
            written.ok().and_then(|()| serde_json::from_slice(&text).ok()).unwrap_or_default();
        serde_json::json!({ "rows": rows })
    }
}

struct Written {
    n_rows: usize,
    output: PathBuf,
    dry_run: bool,
}

impl Summary for Written {
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
