//! The account of an export of a model of groups.

use std::io::{self, Write};

use serde_json::json;

use crate::generation::{FileEntry, GroupCard, GroupProvenance};
use crate::stages::Summary;
use crate::stages::export::report::write_checks;
use crate::store::tables::OnnxCheckRow;

/// The account of an export of a model of groups.
pub struct GroupExportSummary {
    pub card: GroupCard,
    pub place: String,
    pub checks: Vec<OnnxCheckRow>,
    pub is_up_to_date: bool,
    pub is_dry_run: bool,
}

impl Summary for GroupExportSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { card, place, checks, is_up_to_date, is_dry_run } = self;
        if *is_dry_run {
            let size = |f: &FileEntry| format!("{} ({:.1} MB)", f.name, f.n_bytes as f64 / 1e6);
            let sizes: Vec<String> = card.files.iter().map(size).collect();
            let GroupProvenance { run, step, .. } = &card.provenance;
            let sizes = sizes.join(" and ");
            return writeln!(
                out,
                "would check and write {sizes} of run {run} (step {step}) to {place}"
            );
        }
        write_checks(out, checks)?;
        let note = if *is_up_to_date { ", up to date" } else { "" };
        writeln!(out, "model {}{note} → {place}", card.name)?;
        for file in &card.files {
            let mb = file.n_bytes as f64 / 1e6;
            writeln!(out, "  {:<20} {mb:>8.1} MB  {}", file.name, &file.sha256[..16])?;
        }
        writeln!(
            out,
            "  {} parameters, {}, of run {} (family {}, step {})",
            card.n_parameters,
            card.precision.name(),
            card.provenance.run,
            card.family.name(),
            card.provenance.step
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let files = self.card.files.iter().map(
            |file| json!({ "name": file.name, "n_bytes": file.n_bytes, "sha256": file.sha256 }),
        );
        json!({
            "model": self.card.name,
            "family": self.card.family.name(),
            "to": self.place,
            "run": self.card.provenance.run,
            "precision": self.card.precision.name(),
            "files": files.collect::<Vec<_>>(),
            "is_up_to_date": self.is_up_to_date,
            "dry_run": self.is_dry_run,
            "n_checks": self.checks.len(),
        })
    }
}
