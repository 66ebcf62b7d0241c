//! Writes a scene as a bitmap.

use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, PremultipliedColorU8,
    Stroke, Transform,
};

use super::scene::{Image, Point, Rect, Scene, SceneItem, text_start_x};
use super::style::{PAPER, Rgb, SCALE};
use super::{PlotError, font, png};

/// Most device pixels on a side.
const MAX_SIDE_PX: u32 = 1 << 15;

/// Returns the scene as PNG, [`SCALE`] device pixels per CSS pixel.
pub(super) fn write(scene: &Scene) -> Result<Vec<u8>, PlotError> {
    let side = |px: f64| (px * f64::from(SCALE)).round() as u32;
    let (width, height) = (side(scene.width_px), side(scene.height_px));
    let too_large = || PlotError::Size { width_px: width, height_px: height };
    if width > MAX_SIDE_PX || height > MAX_SIDE_PX {
        return Err(too_large());
    }
    let mut page = Pixmap::new(width, height).ok_or_else(too_large)?;
    page.fill(Color::from_rgba8(PAPER[0], PAPER[1], PAPER[2], 255));
    for item in &scene.items {
        draw(&mut page, item);
    }
    let pixels: Vec<u8> =
        page.pixels().iter().flat_map(|p| [p.red(), p.green(), p.blue()]).collect();
    png::rgb(width, height, &pixels)
}

fn draw(page: &mut Pixmap, item: &SceneItem) {
    let scale = Transform::from_scale(SCALE as f32, SCALE as f32);
    match item {
        SceneItem::Area { rect, color, opacity } => {
            let (width, height) = (rect.width as f32, rect.height as f32);
            let rect = tiny_skia::Rect::from_xywh(rect.left as f32, rect.top as f32, width, height);
            if let Some(rect) = rect {
                page.fill_rect(rect, &paint(*color, *opacity), scale, None);
            }
        }
        SceneItem::Polygon { points, color, opacity } => {
            if let Some(path) = path(points, true) {
                let paint = paint(*color, *opacity);
                page.fill_path(&path, &paint, FillRule::Winding, scale, None);
            }
        }
        SceneItem::Polyline { points, color, width_px } => {
            if let Some(path) = path(points, false) {
                let stroke = Stroke {
                    width: *width_px as f32,
                    line_join: LineJoin::Round,
                    line_cap: LineCap::Round,
                    ..Stroke::default()
                };
                page.stroke_path(&path, &paint(*color, 1.0), &stroke, scale, None);
            }
        }
        SceneItem::Text { at, anchor, text, size_px, color } => {
            let scale = f64::from(SCALE);
            let x = text_start_x(*at, *anchor, text, *size_px) * scale;
            font::draw(text, size_px * scale, x, at[1] * scale, |x, y, coverage| {
                blend(page, x, y, *color, coverage);
            });
        }
        SceneItem::Image { rect, image } => draw_image(page, rect, image),
    }
}

fn paint(color: Rgb, opacity: f64) -> Paint<'static> {
    let mut paint = Paint::default();
    let alpha = (opacity.clamp(0.0, 1.0) * 255.0).round() as u8;
    paint.set_color_rgba8(color[0], color[1], color[2], alpha);
    paint
}

fn path(points: &[Point], is_closed: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for (i, &[x, y]) in points.iter().enumerate() {
        if i == 0 {
            builder.move_to(x as f32, y as f32);
        } else {
            builder.line_to(x as f32, y as f32);
        }
    }
    if is_closed {
        builder.close();
    }
    builder.finish()
}

/// Lays `color` over a pixel of the page; outside it does nothing.
fn blend(page: &mut Pixmap, x: i64, y: i64, color: Rgb, coverage: f32) {
    let (width, height) = (i64::from(page.width()), i64::from(page.height()));
    if x < 0 || y < 0 || x >= width || y >= height {
        return;
    }
    let pixel = &mut page.pixels_mut()[(y * width + x) as usize];
    let below = [pixel.red(), pixel.green(), pixel.blue()];
    let [r, g, b] = std::array::from_fn(|c| {
        let (below, above) = (f32::from(below[c]), f32::from(color[c]));
        (below + (above - below) * coverage).round() as u8
    });
    if let Some(mixed) = PremultipliedColorU8::from_rgba(r, g, b, 255) {
        *pixel = mixed;
    }
}

/// Fills each device pixel of `rect` with the cell under its centre.
fn draw_image(page: &mut Pixmap, rect: &Rect, image: &Image) {
    let scale = f64::from(SCALE);
    let (width, height) = (page.width() as usize, page.height() as usize);
    let edge = |px: f64, max: usize| ((px * scale).round().max(0.0) as usize).min(max);
    let (left, right) = (edge(rect.left, width), edge(rect.right(), width));
    let (top, bottom) = (edge(rect.top, height), edge(rect.bottom(), height));
    // The cell under the centre of pixel i of n: floor((i + 1/2) n_cells / n).
    let cell = |i: usize, n: usize, n_cells: usize| (2 * i + 1) * n_cells / (2 * n);
    let pixels = page.pixels_mut();
    for y in top..bottom {
        let row = cell(y - top, bottom - top, image.n_rows);
        for x in left..right {
            let column = cell(x - left, right - left, image.n_columns);
            let index = image.indices[row * image.n_columns + column];
            let [r, g, b] = image.palette[usize::from(index)];
            if let Some(color) = PremultipliedColorU8::from_rgba(r, g, b, 255) {
                pixels[y * width + x] = color;
            }
        }
    }
}
