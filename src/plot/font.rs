//! The typeface of bitmaps, and the widths by which text is placed.
//!
//! DejaVu Sans, cut down by `font/make.sh`; its licence is beside it.

use std::sync::LazyLock;

use ab_glyph::{Font as _, FontRef, PxScale, PxScaleFont, ScaleFont as _};

static FONT: LazyLock<FontRef<'static>> = LazyLock::new(|| {
    FontRef::try_from_slice(include_bytes!("font/DejaVuSans-subset.ttf"))
        .expect("font/DejaVuSans-subset.ttf, which is part of the program, is a font")
});

/// Returns the font at `size_px` pixels per em.
fn scaled(size_px: f64) -> PxScaleFont<&'static FontRef<'static>> {
    // ab_glyph scales by the height of a line, typography by the em.
    let em = FONT.units_per_em().unwrap_or(2048.0);
    FONT.as_scaled(PxScale::from(size_px as f32 * FONT.height_unscaled() / em))
}

/// Returns the width of a line of text in pixels.
pub(super) fn width_px(text: &str, size_px: f64) -> f64 {
    let font = scaled(size_px);
    let mut width = 0.0;
    let mut previous = None;
    for id in text.chars().map(|c| font.glyph_id(c)) {
        width += previous.map_or(0.0, |p| font.kern(p, id)) + font.h_advance(id);
        previous = Some(id);
    }
    f64::from(width)
}

/// Returns `text`, shortened with "…" where it is wider than `max_px`.
pub(super) fn elide(text: &str, size_px: f64, max_px: f64) -> String {
    if width_px(text, size_px) <= max_px {
        return text.to_owned();
    }
    let mut kept: String = text.chars().take(MAX_ELIDED_CHARS).collect();
    while !kept.is_empty() {
        kept.pop();
        let short = format!("{}…", kept.trim_end());
        if width_px(&short, size_px) <= max_px {
            return short;
        }
    }
    String::new()
}

/// No line of a plot has room for more.
const MAX_ELIDED_CHARS: usize = 2000;

/// Draws a line of text that begins at `x` on the baseline `y`: calls `cover` with each pixel's
/// place and how much of it the text covers, 0 to 1.
pub(super) fn draw(text: &str, size_px: f64, x: f64, y: f64, mut cover: impl FnMut(i64, i64, f32)) {
    let font = scaled(size_px);
    let mut at = ab_glyph::point(x as f32, y as f32);
    let mut previous = None;
    for id in text.chars().map(|c| font.glyph_id(c)) {
        at.x += previous.map_or(0.0, |p| font.kern(p, id));
        let glyph = id.with_scale_and_position(font.scale(), at);
        if let Some(outline) = font.outline_glyph(glyph) {
            let corner = outline.px_bounds().min;
            outline.draw(|dx, dy, coverage| {
                cover(
                    corner.x as i64 + i64::from(dx),
                    corner.y as i64 + i64::from(dy),
                    coverage.clamp(0.0, 1.0),
                );
            });
        }
        at.x += font.h_advance(id);
        previous = Some(id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plot::style::CAP_HEIGHT;

    #[test]
    fn the_font_has_every_sign_that_plots_use() {
        for c in "AZaz09 ♯♭°×·–—µσ−±≤≥…→éßŁőЖя".chars() {
            assert_ne!(FONT.glyph_id(c).0, 0, "no glyph for {c:?}");
        }
    }

    #[test]
    fn figures_are_as_wide_and_as_high_as_the_typeface_says() {
        // DejaVu Sans: a figure advances 1303 of 2048 units.
        let wanted = 4.0 * 1303.0 / 2048.0 * 20.0;
        assert!((width_px("2026", 20.0) - wanted).abs() < 0.01, "{}", width_px("2026", 20.0));
        let (mut top, mut bottom) = (i64::MAX, i64::MIN);
        draw("H", 100.0, 10.0, 200.0, |_, y, coverage| {
            if coverage > 0.5 {
                (top, bottom) = (top.min(y), bottom.max(y));
            }
        });
        assert_eq!(bottom, 199);
        assert!((200.0 - top as f64 - 100.0 * CAP_HEIGHT).abs() < 1.0, "{top}");
    }

    #[test]
    fn long_text_is_shortened_to_fit() {
        assert_eq!(elide("short", 12.0, 100.0), "short");
        let short = elide("a rather long title of a song", 12.0, 100.0);
        assert!(short.ends_with('…') && width_px(&short, 12.0) <= 100.0, "{short}");
        assert_eq!(elide("W", 12.0, 3.0), "");
    }
}
