//! What stands around a panel: its heading, ticks and labels.

use super::axis::Tick;
use super::font;
use super::scene::{Anchor, Rect, Scene};
use super::style::{
    AXIS, CAP_HEIGHT, GRID, HAIRLINE_PX, HEADING_PX, INK, MARGIN_PX, MUTED, TEXT_PX, TICK_GAP_PX,
    TICK_PX,
};

/// Within a panel's room: baseline of the heading, upper edge of the plot; and space below it.
const HEADING_BASE_PX: f64 = 14.0;
pub(super) const PLOT_TOP_PX: f64 = 26.0;
pub(super) const PANEL_GAP_PX: f64 = 18.0;
/// Space between a heading and what explains it.
const HEADING_GAP_PX: f64 = 10.0;
/// Below the last panel: baselines of the labels and of the axis title.
const X_LABEL_PX: f64 = 19.0;
pub(super) const X_TITLE_PX: f64 = 37.0;

/// Writes the heading of the panel at `rect`, the first of `meanings` that ends before `right`, and
/// the unit over the labels of the vertical axis.
pub(super) fn heading(
    scene: &mut Scene,
    rect: Rect,
    right: f64,
    heading: &str,
    meanings: &[&str],
    unit: &str,
) {
    let base = rect.top - PLOT_TOP_PX + HEADING_BASE_PX;
    scene.text([rect.left, base], Anchor::Start, heading, HEADING_PX, INK);
    let left = rect.left + font::width_px(heading, HEADING_PX) + HEADING_GAP_PX;
    let fits = |text: &&&str| left + font::width_px(text, TEXT_PX) <= right;
    if let Some(meaning) = meanings.iter().find(fits) {
        scene.text([left, base], Anchor::Start, meaning, TEXT_PX, MUTED);
    }
    let at = [rect.left - TICK_GAP_PX - TICK_PX, base];
    scene.text(at, Anchor::End, unit, TEXT_PX, MUTED);
}

/// Draws a grid line and a label at each tick of the vertical axis; `y` tells where a value is.
pub(super) fn value_grid(scene: &mut Scene, rect: Rect, ticks: &[Tick], y: impl Fn(f64) -> f64) {
    for tick in ticks {
        let y = (y(tick.value) * 2.0).round() / 2.0;
        scene.horizontal(rect.left, rect.right(), y - HAIRLINE_PX / 2.0, HAIRLINE_PX, GRID);
        let at = [rect.left - TICK_GAP_PX * 2.0, y + CAP_HEIGHT * TEXT_PX / 2.0];
        scene.text(at, Anchor::End, &tick.label, TEXT_PX, INK);
    }
}

/// Draws tick lines below a panel.
pub(super) fn x_ticks(scene: &mut Scene, x: impl Iterator<Item = f64>, bottom: f64) {
    let top = bottom + HAIRLINE_PX;
    x.for_each(|x| scene.vertical(x, top, top + TICK_PX, HAIRLINE_PX, AXIS));
}

/// Writes the labels, each at its x, and the title of the horizontal axis below a panel.
pub(super) fn x_labels<'a>(
    scene: &mut Scene,
    labels: impl Iterator<Item = (f64, &'a str)>,
    [left, right]: [f64; 2],
    bottom: f64,
    title: &str,
) {
    for (x, label) in labels {
        // Long labels at the right end move left to stay on the page.
        let half_px = font::width_px(label, TEXT_PX) / 2.0;
        let max_x = right + MARGIN_PX - TICK_GAP_PX - half_px;
        let at = [x.min(max_x), bottom + X_LABEL_PX];
        scene.text(at, Anchor::Middle, label, TEXT_PX, INK);
    }
    let at = [left + (right - left) / 2.0, bottom + X_TITLE_PX];
    scene.text(at, Anchor::Middle, title, TEXT_PX, MUTED);
}

/// Draws what stands in place of a panel without anything to show.
pub(super) fn nothing(scene: &mut Scene, rect: Rect, why: &str) {
    scene.area(rect, GRID, 0.5);
    let y = rect.top + (rect.height + CAP_HEIGHT * TEXT_PX) / 2.0;
    scene.text([rect.left + rect.width / 2.0, y], Anchor::Middle, why, TEXT_PX, MUTED);
}
