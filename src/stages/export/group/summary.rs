//! The account of an export of a model of groups.

use std::io::{self, Write};

use serde_json::json;

use crate::generation::{GroupCard, GroupProvenance};
use crate::stages::Summary;
use crate::stages::export::report::{file_figures, sizes, write_checks, write_files};
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
            let GroupProvenance { run, step, .. } = &card.provenance;
            let sizes = sizes(&card.files);
            return writeln!(
                out,
                "would check and write {sizes} of run {run} (step {step}) to {place}"
            );
        }
        write_checks(out, checks)?;
        let note = if *is_up_to_date { ", up to date" } else { "" };
        writeln!(out, "model {}{note} → {place}", card.name)?;
        write_files(out, &card.files)?;
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
        json!({
            "model": self.card.name,
            "family": self.card.family.name(),
            "to": self.place,
            "run": self.card.provenance.run,
            "precision": self.card.precision.name(),
            "files": file_figures(&self.card.files),
            "is_up_to_date": self.is_up_to_date,
            "dry_run": self.is_dry_run,
            "n_checks": self.checks.len(),
        })
    }
}
