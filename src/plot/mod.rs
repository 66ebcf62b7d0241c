//! Plots: arrays in, the bytes of a PNG or SVG image out.
//!
//! A plot is first laid out as a `scene` (text, lines, areas and images at places in CSS pixels),
//! which `raster` and `svg` then write; so both formats show the same. Sizes and colours are the
//! house's (`style`, `colormap`). The same scene gives the same bytes.

mod axis;
mod chart;
mod colormap;
mod curve;
mod error;
mod features;
mod font;
mod frame;
mod group;
mod header;
mod heatmap;
mod motion;
mod motion_chart;
mod motion_panel;
mod motion_path;
mod page;
mod panel;
mod png;
mod raster;
mod reduce;
mod scene;
mod style;
mod svg;
#[cfg(test)]
mod tests;
mod tokens;
mod training;
mod training_panel;
mod value_axis;

pub use error::PlotError;
pub use features::{FeaturesPlot, features};
pub use group::{GroupPlot, group};
pub use motion::{MOTION_WIDTH_PX, MotionPlot, motion};
pub use motion_panel::MotionPanel;
pub use panel::Panel;
pub use tokens::{TokensPlot, tokens};
pub use training::{PanelCurves, StageCurves, TrainingPlot, training};
pub use training_panel::{TrainingPanel, TrainingStage};

/// Widths in CSS pixels that a plot can have.
pub const MIN_WIDTH_PX: u32 = 320;
pub const MAX_WIDTH_PX: u32 = 8192;

/// The file formats of a plot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Pixels, two per CSS pixel in each direction.
    Png,
    /// Vectors; heat maps are embedded images, one pixel per cell.
    Svg,
}

impl Format {
    /// Returns the format that a file extension such as `png` stands for, in any case.
    pub fn of_path_extension(extension: &str) -> Option<Self> {
        match extension.to_ascii_lowercase().as_str() {
            "png" => Some(Self::Png),
            "svg" => Some(Self::Svg),
            _ => None,
        }
    }
}

/// A finished plot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// The file.
    pub bytes: Vec<u8>,
    /// Size in pixels: of the device for PNG, of CSS for SVG.
    pub width_px: u32,
    pub height_px: u32,
}

/// Returns the names of panels, as messages list them.
fn names_of<P: Copy>(all: &[P], name_of: fn(P) -> &'static str) -> String {
    all.iter().map(|&panel| name_of(panel)).collect::<Vec<_>>().join(", ")
}

/// Returns the panel of a name.
fn panel_named<P: Copy>(
    all: &[P],
    name_of: fn(P) -> &'static str,
    name: &str,
) -> Result<P, PlotError> {
    let found = all.iter().copied().find(|&panel| name_of(panel) == name);
    found.ok_or_else(|| PlotError::UnknownPanel {
        name: name.to_owned(),
        known: names_of(all, name_of),
    })
}

fn check_width(width_px: u32) -> Result<(), PlotError> {
    if (MIN_WIDTH_PX..=MAX_WIDTH_PX).contains(&width_px) {
        return Ok(());
    }
    Err(PlotError::Width { width_px, min_px: MIN_WIDTH_PX, max_px: MAX_WIDTH_PX })
}

/// Writes a scene in a format.
fn write(scene: &scene::Scene, format: Format) -> Result<Picture, PlotError> {
    let (bytes, scale) = match format {
        Format::Png => (raster::write(scene)?, style::SCALE),
        Format::Svg => (svg::write(scene)?, 1),
    };
    let side = |css_px: f64| (css_px * f64::from(scale)).round() as u32;
    Ok(Picture { bytes, width_px: side(scene.width_px), height_px: side(scene.height_px) })
}
