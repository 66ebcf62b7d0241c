//! PNG bytes of pixels.

use ::png::{BitDepth, ColorType, Compression, Encoder, PixelDimensions, Unit};

use super::PlotError;
use super::scene::Image;
use super::style::SCALE;

/// CSS pixels per metre: 96 per inch.
const CSS_PX_PER_M: f64 = 96.0 / 0.0254;

/// Encodes red, green and blue bytes, row by row from the top.
pub(super) fn rgb(width: u32, height: u32, pixels: &[u8]) -> Result<Vec<u8>, PlotError> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::High);
    // Rows of heat maps and paper repeat as they are; differences of cells are noise.
    encoder.set_filter(::png::Filter::NoFilter);
    // So that viewers and printers show the page at its size.
    let per_m = (CSS_PX_PER_M * f64::from(SCALE)).round() as u32;
    encoder.set_pixel_dims(Some(PixelDimensions { xppu: per_m, yppu: per_m, unit: Unit::Meter }));
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()?;
    Ok(bytes)
}

/// Encodes an image with its palette, one pixel per cell.
pub(super) fn indexed(image: &Image) -> Result<Vec<u8>, PlotError> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, image.n_columns as u32, image.n_rows as u32);
    encoder.set_color(ColorType::Indexed);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::High);
    encoder.set_filter(::png::Filter::NoFilter);
    encoder.set_palette(image.palette.as_flattened());
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&image.indices)?;
    writer.finish()?;
    Ok(bytes)
}
