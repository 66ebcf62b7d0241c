//! Small pictures beside the numbers.

use std::fmt::Write as _;

use super::grid::GridRow;
use super::numbers::{number, words};
use super::{Metric, OWN};
use crate::view::escaped;

const WIDTH_PX: f64 = 180.0;
const ROW_PX: f64 = 9.0;
const EDGE_PX: f64 = 6.0;

/// Returns a row's numbers as dots on one scale, each with its interval; empty for fewer than two numbers.
pub fn intervals(row: &GridRow) -> String {
    let cells: Vec<&Metric> =
        row.cells.iter().flatten().copied().filter(|m| m.value.is_some()).collect();
    if cells.len() < 2 {
        return String::new();
    }
    let ends = |m: &Metric| [m.value, m.ci_low, m.ci_high];
    let known = || cells.iter().flat_map(|m| ends(m)).flatten().filter(|x| x.is_finite());
    let (low, high) =
        (known().fold(f64::INFINITY, f64::min), known().fold(f64::NEG_INFINITY, f64::max));
    let span = if high > low { high - low } else { 1.0 };
    let x = |value: f64| EDGE_PX + (WIDTH_PX - 2.0 * EDGE_PX) * (value - low) / span;
    let height = ROW_PX * cells.len() as f64 + 2.0;
    let mut out = format!(
        "<svg class=\"dots\" viewBox=\"0 0 {WIDTH_PX} {height}\" width=\"{WIDTH_PX}\" height=\"{height}\" \
         role=\"img\"><title>{} from {} to {}</title>",
        escaped(&words(row.metric)),
        number(low),
        number(high)
    );
    for (i, m) in cells.iter().enumerate() {
        let y = 1.0 + ROW_PX * (i as f64 + 0.5);
        let class = if m.subject == OWN { "own" } else { "other" };
        if let (Some(a), Some(b)) = (m.ci_low, m.ci_high) {
            let (a, b) = (x(a), x(b));
            let _ = write!(
                out,
                "<line class=\"{class}\" x1=\"{a:.1}\" x2=\"{b:.1}\" y1=\"{y}\" y2=\"{y}\"/>"
            );
        }
        let at = x(m.value.unwrap_or(low));
        let _ = write!(
            out,
            "<circle class=\"{class}\" cx=\"{at:.1}\" cy=\"{y}\" r=\"3\"><title>{}: {}</title></circle>",
            escaped(&words(&m.subject)),
            number(m.value.unwrap_or(f64::NAN))
        );
    }
    out.push_str("</svg>");
    out
}

/// Returns the distances of channels as bars, those of generated motion over those of held-out real motion.
pub fn channels(own: &[&Metric], real: &[&Metric]) -> String {
    const LABEL_PX: f64 = 150.0;
    const BAR_PX: f64 = 320.0;
    const VALUE_PX: f64 = 60.0;
    const LINE_PX: f64 = 16.0;
    let sizes = own.iter().chain(real).filter_map(|m| m.value);
    let most = sizes.fold(0.0, f64::max).max(f64::MIN_POSITIVE);
    let width = LABEL_PX + BAR_PX + VALUE_PX;
    let height = LINE_PX * own.len() as f64 + 4.0;
    let mut out = format!(
        "<svg class=\"bars\" viewBox=\"0 0 {width} {height}\" role=\"img\"><title>Distance of each channel \
         from the ground truth</title>"
    );
    for (i, m) in own.iter().enumerate() {
        let top = 2.0 + LINE_PX * i as f64;
        let base = top + 0.7 * LINE_PX;
        let name = escaped(&words(&m.variant));
        let edge = LABEL_PX - 6.0;
        let _ = write!(out, "<text x=\"{edge}\" y=\"{base:.1}\" text-anchor=\"end\">{name}</text>");
        let held_out = real.iter().find(|r| r.variant == m.variant).and_then(|r| r.value);
        for (value, class, offset) in [(m.value, "own", 2.0), (held_out, "real", 8.0)] {
            let Some(value) = value else { continue };
            let y = top + offset;
            let long = BAR_PX * value / most;
            let _ = write!(
                out,
                "<rect class=\"{class}\" x=\"{LABEL_PX}\" y=\"{y:.1}\" width=\"{long:.1}\" height=\"5\">\
                 <title>{name}: {}</title></rect>",
                number(value)
            );
        }
        let x = LABEL_PX + 4.0 + BAR_PX * m.value.unwrap_or(0.0) / most;
        let text = m.value.map_or_else(|| "constant".to_owned(), number);
        let _ = write!(out, "<text x=\"{x:.1}\" y=\"{base:.1}\">{text}</text>");
    }
    out.push_str("</svg>");
    out
}
