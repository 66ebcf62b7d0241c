//! Plots: arrays in, the bytes of a PNG or SVG image out.
//!
//! A plot is first laid out as a `scene` (text, lines, areas and images at places in CSS pixels),
//! which `raster` and `svg` then write; so both formats show the same. Sizes and colours are the
//! house's (`style`, `colormap`). The same scene gives the same bytes.

mod axis;
mod colormap;
mod curve;
mod error;
mod features;
mod font;
mod heatmap;
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

pub use error::PlotError;
pub use features::{FeaturesPlot, MAX_WIDTH_PX, MIN_WIDTH_PX, features};
pub use panel::Panel;

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

/// Writes a scene in a format.
fn write(scene: &scene::Scene, format: Format) -> Result<Picture, PlotError> {
    let (bytes, scale) = match format {
        Format::Png => (raster::write(scene)?, style::SCALE),
        Format::Svg => (svg::write(scene)?, 1),
    };
    let side = |css_px: f64| (css_px * f64::from(scale)).round() as u32;
    Ok(Picture { bytes, width_px: side(scene.width_px), height_px: side(scene.height_px) })
}
