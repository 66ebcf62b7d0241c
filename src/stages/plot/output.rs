//! The picture that every kind of plot writes.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};

use crate::plot::{Format, MAX_WIDTH_PX, MIN_WIDTH_PX, Picture};
use crate::stages::Summary;
use crate::store;

/// Widths that a plot can have, as a flag takes them.
pub const WIDTHS_PX: std::ops::RangeInclusive<i64> = MIN_WIDTH_PX as i64..=MAX_WIDTH_PX as i64;

/// Returns the format that the name of the output asks for; standard output is given PNG.
///
/// # Errors
/// When it is no format of plots.
pub fn format_of(output: &Path) -> anyhow::Result<Format> {
    if store::is_standard_output(output) {
        return Ok(Format::Png);
    }
    let extension = output.extension().map(|e| e.to_string_lossy()).unwrap_or_default();
    Format::of_path_extension(&extension).ok_or_else(|| {
        let found = match extension.as_ref() {
            "" => "has no extension".to_owned(),
            other => format!("has the extension .{other}"),
        };
        anyhow!(
            "--output {} {found}, which is no format of plots; name it .png or .svg",
            output.display()
        )
    })
}

/// Writes a picture of `what`, whole or not at all; in a dry run not at all.
///
/// # Errors
/// The error of the file system.
pub fn write_picture(
    what: String,
    output: &Path,
    picture: &Picture,
    dry_run: bool,
) -> anyhow::Result<Box<dyn Summary>> {
    if !dry_run {
        store::write_file(output, |out| out.write_all(&picture.bytes))
            .with_context(|| format!("while writing {}", output.display()))?;
    }
    let (width_px, height_px) = (picture.width_px, picture.height_px);
    Ok(Box::new(PlotSummary { what, output: output.to_owned(), width_px, height_px, dry_run }))
}

/// The summary of a plot.
struct PlotSummary {
    what: String,
    output: PathBuf,
    width_px: u32,
    height_px: u32,
    dry_run: bool,
}

impl Summary for PlotSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let PlotSummary { what, output, width_px, height_px, dry_run } = self;
        let would = if *dry_run { "would draw " } else { "" };
        writeln!(out, "{would}{what} → {} ({width_px} × {height_px} px)", output.display())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let PlotSummary { what, output, width_px, height_px, dry_run } = self;
        serde_json::json!({
            "to": output,
            "dry_run": dry_run,
            "drawn": what,
            "width_px": width_px,
            "height_px": height_px,
        })
    }
}
