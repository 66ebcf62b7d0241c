//! The account of an export of a model of tokens.

use std::io::{self, Write};

use serde_json::json;

use crate::generation::{TokensCard, TokensProvenance};
use crate::stages::Summary;
use crate::stages::export::report::{file_figures, sizes, write_checks, write_files};
use crate::store::tables::OnnxCheckRow;

/// The account of an export of a model of tokens.
pub struct TokensExportSummary {
    pub card: TokensCard,
    pub place: String,
    pub checks: Vec<OnnxCheckRow>,
    pub is_up_to_date: bool,
    pub is_dry_run: bool,
}

impl Summary for TokensExportSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { card, place, checks, is_up_to_date, is_dry_run } = self;
        let TokensProvenance { run, tokenizer, step, .. } = &card.provenance;
        if *is_dry_run {
            let sizes = sizes(&card.files);
            return writeln!(
                out,
                "would check and write {sizes} of run {run} (step {step}) and its tokenizer {tokenizer} to {place}"
            );
        }
        write_checks(out, checks)?;
        let note = if *is_up_to_date { ", up to date" } else { "" };
        writeln!(out, "model {}{note} → {place}", card.name)?;
        write_files(out, &card.files)?;
        writeln!(
            out,
            "  {} parameters, {}, of run {run} (family {}, {}, step {step}) and its tokenizer {tokenizer}",
            card.n_parameters.tokenizer + card.n_parameters.planner,
            card.precision.name(),
            card.family.name(),
            card.planner.kind.name(),
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
            "tokenizer": self.card.provenance.tokenizer,
            "planner": self.card.planner.kind.name(),
            "precision": self.card.precision.name(),
            "files": file_figures(&self.card.files),
            "is_up_to_date": self.is_up_to_date,
            "dry_run": self.is_dry_run,
            "n_checks": self.checks.len(),
        })
    }
}
