//! `compact`: parts that hold dead rows or are small become few whole ones.

use std::io::{self, Write};
use std::time::Instant;

use super::{ClientParams, Contract, Progress, Stage, Summary, lease};
use crate::store::{self, Compaction, Location};

/// The stage.
pub struct Compact;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket that holds the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Write a Delta Lake log beside every table, so that delta_scan, polars and Spark see which parts count.
    #[arg(long)]
    pub delta: bool,
    /// Say what would be rewritten, and write nothing.
    #[arg(long)]
    pub dry_run: bool,
    #[command(flatten)]
    pub client: ClientParams,
}

impl Stage for Compact {
    const NAME: &'static str = "compact";
    const ABOUT: &'static str = "rewrite parts that hold dead rows or are small";
    const CONTRACT: Contract = Contract {
        reads: "every table",
        writes: "parts in place of others, which vacuum removes; with --delta, TABLE/_delta_log",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        let store = Location::open(&params.store, &params.client.options())?;
        let lease = match params.dry_run {
            true => None,
            false => {
                store.sweep();
                let what = format!("store {store}");
                let (lease, _) =
                    lease::take(&store, Self::NAME, &what, &|text| progress.note(text))?;
                Some(lease)
            }
        };
        let mut is_begun = std::cell::Cell::new(false);
        let step = |_: u64, n_chunks: u64| {
            if !is_begun.replace(true) {
                progress.start(Self::NAME, "chunks", n_chunks);
            }
            progress.advance(1);
            progress.is_interrupted() || lease.as_ref().is_some_and(|lease| lease.check().is_err())
        };
        let done = store::compact(&store, params.dry_run, &step)?;
        if *is_begun.get_mut() {
            progress.finish();
        }
        let mut delta = Vec::new();
        if let Some(lease) = &lease {
            lease.check()?;
            if params.delta && !done.is_interrupted {
                delta = store::write_delta_logs(&store)?;
            }
        }
        let (store, dry_run) = (store.to_string(), params.dry_run);
        let took_s = started.elapsed().as_secs_f64();
        Ok(Box::new(CompactSummary { store, dry_run, done, delta, took_s }))
    }
}

struct CompactSummary {
    store: String,
    dry_run: bool,
    done: Compaction,
    /// Tables whose Delta Lake log was written.
    delta: Vec<&'static str>,
    took_s: f64,
}

impl Summary for CompactSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Compaction { n_parts_before, n_parts_old, n_parts_new, n_rows, n_bytes, .. } =
            self.done;
        writeln!(out, "compact {}", self.store)?;
        if n_parts_old == 0 {
            writeln!(out, "  nothing to do: {n_parts_before} parts, none small or with dead rows")?;
        } else if self.dry_run {
            writeln!(out, "  would rewrite {n_parts_old} of {n_parts_before} parts")?;
        } else {
            let n_after = n_parts_before - n_parts_old + n_parts_new;
            let verb = if self.done.is_interrupted { "stopped, rewrote" } else { "rewrote" };
            writeln!(
                out,
                "  {verb} {n_parts_old} of {n_parts_before} parts as {n_parts_new} ({n_rows} rows, {:.1} MB) in \
                 {:.1} s; {n_after} count",
                n_bytes as f64 / 1e6,
                self.took_s
            )?;
            writeln!(out, "  the old ones go with: motiongen vacuum --store {}", self.store)?;
        }
        if self.done.n_unknown > 0 {
            let n = self.done.n_unknown;
            writeln!(
                out,
                "  {n} parts of versions that this program does not read were left alone"
            )?;
        }
        if !self.delta.is_empty() {
            writeln!(out, "  Delta Lake logs written: {}", self.delta.join(", "))?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn is_stopped(&self) -> bool {
        self.done.is_interrupted
    }

    fn figures(&mut self) -> serde_json::Value {
        let Compaction { n_parts_before, n_parts_old, n_parts_new, n_rows, n_bytes, .. } =
            self.done;
        serde_json::json!({
            "store": self.store,
            "dry_run": self.dry_run,
            "n_parts_before": n_parts_before,
            "n_parts_old": n_parts_old,
            "n_parts_new": n_parts_new,
            "n_rows": n_rows,
            "n_bytes": n_bytes,
            "n_unknown": self.done.n_unknown,
            "delta": self.delta,
            "took_s": self.took_s,
        })
    }
}
