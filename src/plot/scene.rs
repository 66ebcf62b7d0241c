//! What is on the page and where, before it is written in a format.
//!
//! Places are in CSS pixels from the upper left corner. What is added later lies on top.

use super::colormap::Palette;
use super::font;
use super::style::Rgb;

/// A place: x to the right, y down.
pub(super) type Point = [f64; 2];

/// An upright rectangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rect {
    pub left: f64,
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

impl Rect {
    pub fn right(&self) -> f64 {
        self.left + self.width
    }

    pub fn bottom(&self) -> f64 {
        self.top + self.height
    }
}

/// Which end of a text its place names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

/// One thing on the page.
#[derive(Clone, Debug)]
pub(super) enum SceneItem {
    Area {
        rect: Rect,
        color: Rgb,
        opacity: f64,
    },
    Polygon {
        points: Vec<Point>,
        color: Rgb,
        opacity: f64,
    },
    Polyline {
        points: Vec<Point>,
        color: Rgb,
        width_px: f64,
    },
    /// One line of text; `at` is on its baseline.
    Text {
        at: Point,
        anchor: Anchor,
        text: String,
        size_px: f64,
        color: Rgb,
    },
    Image {
        rect: Rect,
        image: Image,
    },
}

/// A picture whose cells fill the rectangle in which it is shown, with sharp edges.
#[derive(Clone, Debug)]
pub(super) struct Image {
    pub n_columns: usize,
    pub n_rows: usize,
    /// Colour of each cell as an index into `palette`, row by row from the top.
    pub indices: Vec<u8>,
    pub palette: Box<Palette>,
}

/// A page.
#[derive(Clone, Debug)]
pub(super) struct Scene {
    pub width_px: f64,
    pub height_px: f64,
    /// A description of the page, for readers that cannot see it.
    pub title: String,
    pub items: Vec<SceneItem>,
}

impl Scene {
    pub fn area(&mut self, rect: Rect, color: Rgb, opacity: f64) {
        self.items.push(SceneItem::Area { rect, color, opacity });
    }

    /// Adds a horizontal line of `width_px` whose upper edge is at `top`.
    pub fn horizontal(&mut self, from: f64, to: f64, top: f64, width_px: f64, color: Rgb) {
        let rect = Rect { left: from, top, width: to - from, height: width_px };
        self.area(rect, color, 1.0);
    }

    /// Adds a vertical line of `width_px` around `x`, moved by less than a pixel to be sharp.
    pub fn vertical(&mut self, x: f64, from: f64, to: f64, width_px: f64, color: Rgb) {
        let left = ((x - width_px / 2.0) * 2.0).round() / 2.0;
        let rect = Rect { left, top: from, width: width_px, height: to - from };
        self.area(rect, color, 1.0);
    }

    /// Adds a dot of `width_px` around a place.
    pub fn dot(&mut self, [x, y]: Point, width_px: f64, color: Rgb) {
        // A thick line with round ends that hardly goes anywhere.
        let points = vec![[x - 0.01, y], [x + 0.01, y]];
        self.items.push(SceneItem::Polyline { points, color, width_px });
    }

    pub fn text(&mut self, at: Point, anchor: Anchor, text: &str, size_px: f64, color: Rgb) {
        if !text.is_empty() {
            self.items.push(SceneItem::Text { at, anchor, text: text.to_owned(), size_px, color });
        }
    }
}

/// Returns where a text begins.
pub(super) fn text_start_x(at: Point, anchor: Anchor, text: &str, size_px: f64) -> f64 {
    match anchor {
        Anchor::Start => at[0],
        Anchor::Middle => at[0] - font::width_px(text, size_px) / 2.0,
        Anchor::End => at[0] - font::width_px(text, size_px),
    }
}
