//! What export says when it is done.

use std::io::{self, Write};

use serde_json::json;

use super::Params;
use super::checks::{CheckResults, ROUNDING};
use super::files::ExportedFiles;
use crate::generation::{FileEntry, ModelCard};
use crate::stages::Summary;
use crate::stages::model_files::folder_of;
use crate::store::Location;
use crate::store::tables::OnnxCheckRow;

/// The account of an export.
pub struct ExportSummary {
    card: ModelCard,
    place: String,
    checks: Vec<OnnxCheckRow>,
    is_up_to_date: bool,
}

impl ExportSummary {
    pub fn written(
        params: &Params,
        store: &Location,
        files: &ExportedFiles,
        results: CheckResults,
    ) -> Self {
        Self {
            checks: results.rows,
            is_up_to_date: false,
            ..Self::up_to_date(params, store, files)
        }
    }

    /// A model that is there already, made of the same weights in the same way.
    pub fn up_to_date(params: &Params, store: &Location, files: &ExportedFiles) -> Self {
        let place = store.url_of(&folder_of(&params.model));
        Self { card: files.card.clone(), place, checks: Vec::new(), is_up_to_date: true }
    }
}

/// Writes the table of checks; nothing where there are none.
pub(super) fn write_checks(out: &mut dyn Write, checks: &[OnnxCheckRow]) -> io::Result<()> {
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
pub(super) fn write_files(out: &mut dyn Write, files: &[FileEntry]) -> io::Result<()> {
    for file in files {
        let mb = file.n_bytes as f64 / 1e6;
        writeln!(out, "  {:<20} {mb:>8.1} MB  {}", file.name, &file.sha256[..16])?;
    }
    Ok(())
}

/// Returns the names and sizes of files, for a sentence.
pub(super) fn sizes(files: &[FileEntry]) -> String {
    let size = |file: &FileEntry| format!("{} ({:.1} MB)", file.name, file.n_bytes as f64 / 1e6);
    files.iter().map(size).collect::<Vec<_>>().join(" and ")
}

/// Returns the files of a model as programs see them.
pub(super) fn file_figures(files: &[FileEntry]) -> Vec<serde_json::Value> {
    let figures = |file: &FileEntry| json!({ "name": file.name, "n_bytes": file.n_bytes, "sha256": file.sha256 });
    files.iter().map(figures).collect()
}

impl Summary for ExportSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { card, place, checks, is_up_to_date } = self;
        write_checks(out, checks)?;
        writeln!(
            out,
            "model {}{} → {place}",
            card.name,
            if *is_up_to_date { ", up to date" } else { "" }
        )?;
        write_files(out, &card.files)?;
        writeln!(
            out,
            "  {} and {} parameters, {}, of run {} ({}, step {})",
            card.n_parameters.unet,
            card.n_parameters.decoder,
            card.precision.name(),
            card.provenance.run,
            card.provenance.stage,
            card.provenance.unet_step
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let mut figures = of_card(&self.card, &self.place);
        figures["is_up_to_date"] = self.is_up_to_date.into();
        figures["n_checks"] = self.checks.len().into();
        figures
    }
}

/// Returns what is told of a model in either case.
fn of_card(card: &ModelCard, place: &str) -> serde_json::Value {
    json!({
        "model": card.name,
        "to": place,
        "run": card.provenance.run,
        "precision": card.precision.name(),
        "files": file_figures(&card.files),
    })
}

/// The summary of a dry run.
pub struct ExportDryRun {
    place: String,
    card: ModelCard,
}

impl ExportDryRun {
    pub fn new(params: &Params, files: &ExportedFiles, store: &Location) -> Self {
        Self { place: store.url_of(&folder_of(&params.model)), card: files.card.clone() }
    }
}

impl Summary for ExportDryRun {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let provenance = &self.card.provenance;
        writeln!(
            out,
            "would check and write {} of run {} ({}, step {}) to {}",
            sizes(&self.card.files),
            provenance.run,
            provenance.stage,
            provenance.unet_step,
            self.place
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let mut figures = of_card(&self.card, &self.place);
        figures["dry_run"] = true.into();
        figures
    }
}
