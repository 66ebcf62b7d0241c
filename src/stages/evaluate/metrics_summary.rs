//! The account of an evaluation that ends in numbers and no verdicts: of groups, and of tokenizers.

use std::collections::BTreeSet;
use std::io::{self, Write};

use crate::stages::Summary;
use crate::store::tables::MetricRow;

/// The summary of an evaluation without verdicts.
pub struct MetricsSummary {
    pub store: String,
    pub run: String,
    /// What was measured: groups, phrases.
    pub items: &'static str,
    pub n_motions: usize,
    pub length_s: f64,
    pub is_up_to_date: bool,
    pub dry_run: bool,
    pub metrics: Vec<MetricRow>,
    /// Metrics that people are shown; all where empty.
    pub shown: &'static [&'static str],
    pub took_s: f64,
}

impl Summary for MetricsSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { store, run, items, n_motions, length_s, took_s, .. } = self;
        writeln!(out, "evaluate {run} → {store}")?;
        if self.dry_run {
            let what = if self.is_up_to_date { "nothing to do for" } else { "would evaluate" };
            return writeln!(out, "  {what} {n_motions} {items} ({length_s:.1} s)");
        }
        let done = match self.is_up_to_date {
            true => ", evaluated before".to_owned(),
            false => format!(" evaluated; {took_s:.1} s"),
        };
        writeln!(out, "  {n_motions} {items} ({length_s:.1} s){done}")?;
        let columns: BTreeSet<(&str, &str)> =
            self.metrics.iter().map(|row| (row.split.as_str(), row.subject.as_str())).collect();
        let is_shown =
            |row: &&MetricRow| self.shown.is_empty() || self.shown.contains(&&*row.metric);
        let names: BTreeSet<(&str, &str)> = self
            .metrics
            .iter()
            .filter(is_shown)
            .map(|row| (row.metric.as_str(), row.variant.as_str()))
            .collect();
        write!(out, "\n  {:<38}", "")?;
        for (split, subject) in &columns {
            write!(out, " {:>16}", format!("{split}/").chars().take(16).collect::<String>())?;
            let _ = subject;
        }
        write!(out, "\n  {:<38}", "")?;
        for (_, subject) in &columns {
            write!(out, " {subject:>16}")?;
        }
        writeln!(out)?;
        for (metric, variant) in names {
            let name = if variant.is_empty() {
                metric.to_owned()
            } else {
                format!("{metric} ({variant})")
            };
            write!(out, "  {name:<38}")?;
            for (split, subject) in &columns {
                let is = |row: &&MetricRow| {
                    row.metric == metric
                        && row.variant == variant
                        && row.split == *split
                        && row.subject == *subject
                };
                let value = self.metrics.iter().find(is).and_then(|row| row.value);
                let text = value.map_or_else(|| "-".to_owned(), |x| format!("{x:.3}"));
                write!(out, " {text:>16}")?;
            }
            writeln!(out)?;
        }
        writeln!(
            out,
            "\n  motiongen query --store {store} \"select subject, split, metric, variant, value, ci_low, ci_high \
             from metrics where run = '{run}'\""
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        serde_json::json!({
            "store": self.store,
            "run": self.run,
            "n_motions": self.n_motions,
            "length_s": self.length_s,
            "is_up_to_date": self.is_up_to_date,
            "dry_run": self.dry_run,
            "n_metrics": self.metrics.len(),
            "took_s": self.took_s,
        })
    }
}
