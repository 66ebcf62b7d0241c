//! Writes a scene as SVG.
//!
//! Text stays text, in DejaVu Sans or, where that is missing, Verdana, whose widths are the same
//! within a few per cent. Images are embedded PNG with one pixel per cell.

use std::fmt::{self, Write as _};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::scene::{Anchor, Point, Rect, Scene, SceneItem};
use super::style::{PAPER, Rgb};
use super::{PlotError, png};
use crate::markup::Escaped;

const FONTS: &str = "'DejaVu Sans', Verdana, sans-serif";

/// Returns the scene as SVG.
pub(super) fn write(scene: &Scene) -> Result<Vec<u8>, PlotError> {
    let mut out = String::new();
    let (width, height) = (Number(scene.width_px), Number(scene.height_px));
    line(
        &mut out,
        format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" \
             xmlns:xlink=\"http://www.w3.org/1999/xlink\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"{FONTS}\" role=\"img\">"
        ),
    );
    line(&mut out, format_args!("<title>{}</title>", Escaped(&scene.title)));
    let paper = Hex(PAPER);
    line(&mut out, format_args!("<rect width=\"{width}\" height=\"{height}\" fill=\"{paper}\"/>"));
    for item in &scene.items {
        write_item(&mut out, item)?;
    }
    out.push_str("</svg>\n");
    Ok(out.into_bytes())
}

fn write_item(out: &mut String, item: &SceneItem) -> Result<(), PlotError> {
    match item {
        SceneItem::Area { rect, color, opacity } => line(
            out,
            format_args!(
                "<rect {} fill=\"{}\"{}/>",
                RectAttributes(rect),
                Hex(*color),
                Opacity(*opacity)
            ),
        ),
        SceneItem::Polygon { points, color, opacity } => line(
            out,
            format_args!(
                "<polygon points=\"{}\" fill=\"{}\"{}/>",
                Points(points),
                Hex(*color),
                Opacity(*opacity)
            ),
        ),
        SceneItem::Polyline { points, color, width_px } => line(
            out,
            format_args!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{}\" \
                 stroke-linejoin=\"round\" stroke-linecap=\"round\"/>",
                Points(points),
                Hex(*color),
                Number(*width_px)
            ),
        ),
        SceneItem::Text { at, anchor, text, size_px, color } => line(
            out,
            format_args!(
                "<text x=\"{}\" y=\"{}\" font-size=\"{}\" fill=\"{}\"{}>{}</text>",
                Number(at[0]),
                Number(at[1]),
                Number(*size_px),
                Hex(*color),
                match anchor {
                    Anchor::Start => "",
                    Anchor::Middle => " text-anchor=\"middle\"",
                    Anchor::End => " text-anchor=\"end\"",
                },
                Escaped(text)
            ),
        ),
        SceneItem::Image { rect, image } => line(
            out,
            format_args!(
                "<image {} preserveAspectRatio=\"none\" style=\"image-rendering:pixelated\" \
                 xlink:href=\"data:image/png;base64,{}\"/>",
                RectAttributes(rect),
                STANDARD.encode(png::indexed(image)?)
            ),
        ),
    }
    Ok(())
}

fn line(out: &mut String, text: fmt::Arguments<'_>) {
    // A string takes all that is written to it.
    let _ = writeln!(out, "{text}");
}

/// A number with at most two decimals and no idle zeros.
struct Number(f64);

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = format!("{:.2}", self.0);
        let text = text.trim_end_matches('0').trim_end_matches('.');
        f.write_str(if text == "-0" { "0" } else { text })
    }
}

struct Hex(Rgb);

impl fmt::Display for Hex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [r, g, b] = self.0;
        write!(f, "#{r:02x}{g:02x}{b:02x}")
    }
}

struct Opacity(f64);

impl fmt::Display for Opacity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0 < 1.0 { write!(f, " fill-opacity=\"{}\"", Number(self.0)) } else { Ok(()) }
    }
}

struct RectAttributes<'a>(&'a Rect);

impl fmt::Display for RectAttributes<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (x, y) = (Number(self.0.left), Number(self.0.top));
        let (width, height) = (Number(self.0.width), Number(self.0.height));
        write!(f, "x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"")
    }
}

struct Points<'a>(&'a [Point]);

impl fmt::Display for Points<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, &[x, y]) in self.0.iter().enumerate() {
            write!(f, "{}{},{}", if i == 0 { "" } else { " " }, Number(x), Number(y))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let cases = [(1.0, "1"), (0.5, "0.5"), (-0.001, "0"), (100.0, "100"), (2.345, "2.35")];
        for (number, wanted) in cases {
            assert_eq!(Number(number).to_string(), wanted);
        }
    }
}
