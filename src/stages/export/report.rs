//! What export says when it is done.

use std::io::{self, Write};

use serde::Serialize;
use serde_json::{Value, json};

use super::checks::ROUNDING;
use crate::generation::{
    FamilyCard, FileEntry, GroupCard, GroupProvenance, ModelCard, TokensCard, TokensProvenance,
};
use crate::stages::Summary;
use crate::store::tables::OnnxCheckRow;

/// What the account of an export tells of a card of one family.
pub trait ExportedCard: FamilyCard + Serialize + Clone + Send {
    /// Returns the number of parameters, for a sentence.
    fn parameters(&self) -> String;

    /// Returns where the weights come from, for a sentence that begins with `of run`.
    fn origin(&self) -> String;

    /// Returns where the weights come from and of which kind they are, for the last line of the account.
    fn kind_and_origin(&self) -> String {
        self.origin()
    }

    /// Returns figures beside those of every family.
    fn figures(&self) -> Vec<(&'static str, Value)> {
        Vec::new()
    }
}

impl ExportedCard for ModelCard {
    fn parameters(&self) -> String {
        format!("{} and {}", self.n_parameters.unet, self.n_parameters.decoder)
    }

    fn origin(&self) -> String {
        let from = &self.provenance;
        format!("{} ({}, step {})", from.run, from.stage, from.unet_step)
    }
}

impl ExportedCard for GroupCard {
    fn parameters(&self) -> String {
        self.n_parameters.to_string()
    }

    fn origin(&self) -> String {
        let GroupProvenance { run, step, .. } = &self.provenance;
        format!("{run} (step {step})")
    }

    fn kind_and_origin(&self) -> String {
        let GroupProvenance { run, step, .. } = &self.provenance;
        format!("{run} (family {}, step {step})", self.family.name())
    }
}

impl ExportedCard for TokensCard {
    fn parameters(&self) -> String {
        (self.n_parameters.tokenizer + self.n_parameters.planner).to_string()
    }

    fn origin(&self) -> String {
        let TokensProvenance { run, tokenizer, step, .. } = &self.provenance;
        format!("{run} (step {step}) and its tokenizer {tokenizer}")
    }

    fn kind_and_origin(&self) -> String {
        let TokensProvenance { run, tokenizer, step, .. } = &self.provenance;
        format!(
            "{run} (family {}, {}, step {step}) and its tokenizer {tokenizer}",
            self.family.name(),
            self.planner.kind.name()
        )
    }

    fn figures(&self) -> Vec<(&'static str, Value)> {
        vec![
            ("tokenizer", self.provenance.tokenizer.clone().into()),
            ("planner", self.planner.kind.name().into()),
        ]
    }
}

/// The account of an export.
pub struct ExportSummary<C> {
    card: C,
    place: String,
    pub checks: Vec<OnnxCheckRow>,
    /// The model was there already, made of the same weights in the same way.
    pub is_up_to_date: bool,
    pub is_dry_run: bool,
}

impl<C> ExportSummary<C> {
    /// Begins the account of a model that goes to a place.
    pub fn new(card: C, place: String) -> Self {
        Self { card, place, checks: Vec::new(), is_up_to_date: false, is_dry_run: false }
    }
}

/// Writes the table of checks; nothing where there are none.
fn write_checks(out: &mut dyn Write, checks: &[OnnxCheckRow]) -> io::Result<()> {
    if !checks.is_empty() {
        writeln!(
            out,
            "{:<14} {:>7} {:>7} {:>9} {:>9} {:>9}  {:>8} {:>8}",
            "check", "samples", "frames", "max", "rms", "allowed", "onnx", "eager"
        )?;
    }
    for row in checks.iter() {
        let seconds = |s: f64| format!("{:.0} ms", 1000.0 * s);
        writeln!(
            out,
            "{:<14} {:>7} {:>7} {:>9.1e} {:>9.1e} {:>9.0e}  {:>8} {:>8}{}",
            row.check,
            row.n_samples,
            row.n_frames,
            row.max_abs,
            row.rms,
            row.tolerance,
            row.onnx_s.map_or_else(|| "-".to_owned(), seconds),
            seconds(row.eager_s),
            if row.check == ROUNDING { "  (rms counts)" } else { "" }
        )?;
    }
    Ok(())
}

/// Writes a line for each file of a model.
fn write_files(out: &mut dyn Write, files: &[FileEntry]) -> io::Result<()> {
    for file in files {
        let mb = file.n_bytes as f64 / 1e6;
        writeln!(out, "  {:<20} {mb:>8.1} MB  {}", file.name, &file.sha256[..16])?;
    }
    Ok(())
}

/// Returns the names and sizes of files, for a sentence.
fn sizes(files: &[FileEntry]) -> String {
    let size = |file: &FileEntry| format!("{} ({:.1} MB)", file.name, file.n_bytes as f64 / 1e6);
    files.iter().map(size).collect::<Vec<_>>().join(" and ")
}

/// Returns the files of a model as programs see them.
fn file_figures(files: &[FileEntry]) -> Vec<serde_json::Value> {
    let figures = |file: &FileEntry| json!({ "name": file.name, "n_bytes": file.n_bytes, "sha256": file.sha256 });
    files.iter().map(figures).collect()
}

impl<C: ExportedCard> Summary for ExportSummary<C> {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { card, place, checks, is_up_to_date, is_dry_run } = self;
        let fields = card.shared();
        if *is_dry_run {
            let (sizes, origin) = (sizes(fields.files), card.origin());
            return writeln!(out, "would check and write {sizes} of run {origin} to {place}");
        }
        write_checks(out, checks)?;
        let note = if *is_up_to_date { ", up to date" } else { "" };
        writeln!(out, "model {}{note} → {place}", fields.name)?;
        write_files(out, fields.files)?;
        writeln!(
            out,
            "  {} parameters, {}, of run {}",
            card.parameters(),
            fields.precision.name(),
            card.kind_and_origin()
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> Value {
        let Self { card, place, checks, is_up_to_date, is_dry_run } = self;
        let fields = card.shared();
        // Figures of the family unet are those of release 0.1.
        let is_unet = C::FAMILY.is_unet();
        let mut figures = json!({ "model": fields.name });
        if !is_unet {
            figures["family"] = C::FAMILY.name().into();
        }
        figures["to"] = place.as_str().into();
        figures["run"] = fields.run.into();
        for (name, value) in card.figures() {
            figures[name] = value;
        }
        figures["precision"] = fields.precision.name().into();
        figures["files"] = file_figures(fields.files).into();
        if !is_unet || !*is_dry_run {
            figures["is_up_to_date"] = (*is_up_to_date).into();
        }
        if !is_unet || *is_dry_run {
            figures["dry_run"] = (*is_dry_run).into();
        }
        if !is_unet || !*is_dry_run {
            figures["n_checks"] = checks.len().into();
        }
        figures
    }
}
