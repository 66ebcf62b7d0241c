//! What stands over the panels: a title, and lines of facts below it.

use super::font;
use super::scene::{Anchor, Rect, Scene};
use super::style::{CAP_HEIGHT, INK, MUTED, Rgb, TEXT_PX, TICK_PX, TITLE_PX};

/// Baselines of the title and of the line below it.
const TITLE_BASE_PX: f64 = 38.0;
pub(super) const FACTS_BASE_PX: f64 = 58.0;
/// Where the room of what follows begins.
pub(super) const HEADER_PX: f64 = 76.0;
/// From one line of facts, or of a legend, to the next.
pub(super) const LINE_PX: f64 = 17.0;
/// Space between two facts, in which a dot stands.
const FACT_GAP_PX: f64 = 24.0;

/// A piece of the lines below a title; `key` is the colour and width of a mark before it.
pub(super) struct Fact {
    pub key: Option<(Rgb, f64)>,
    pub text: String,
}

impl Fact {
    pub fn plain(text: String) -> Self {
        Self { key: None, text }
    }
}

/// Returns a number of things with their name in the singular or plural.
pub(super) fn counted(n: u64, one: &str) -> String {
    format!("{n} {one}{}", if n == 1 { "" } else { "s" })
}

/// Returns where pieces of these widths begin on lines from `left` to `right`: x, and the line from 0.
pub(super) fn flow(widths: &[f64], left: f64, right: f64, gap_px: f64) -> Vec<(f64, usize)> {
    let (mut x, mut line) = (left, 0);
    widths
        .iter()
        .enumerate()
        .map(|(i, &width)| {
            if i > 0 {
                x += gap_px;
                if x + width > right {
                    (x, line) = (left, line + 1);
                }
            }
            let start = x;
            x += width;
            (start, line)
        })
        .collect()
}

/// Writes the title of the page.
pub(super) fn title(scene: &mut Scene, left: f64, right: f64, title: &str) {
    let title = font::elide(title, TITLE_PX, right - left);
    scene.text([left, TITLE_BASE_PX], Anchor::Start, &title, TITLE_PX, INK);
}

/// Writes facts on at most `max_lines` lines, the first with its baseline at `base`, and leaves out
/// what has no room there; returns how many lines there are.
pub(super) fn facts(
    scene: &mut Scene,
    left: f64,
    right: f64,
    base: f64,
    facts: Vec<Fact>,
    max_lines: usize,
) -> usize {
    let key_px = |fact: &Fact| if fact.key.is_some() { TICK_PX * 2.0 } else { 0.0 };
    let widths: Vec<f64> =
        facts.iter().map(|fact| key_px(fact) + font::width_px(&fact.text, TEXT_PX)).collect();
    let mut n_lines = 0;
    for (fact, (start, line)) in facts.iter().zip(flow(&widths, left, right, FACT_GAP_PX)) {
        if line >= max_lines {
            break;
        }
        let base = base + line as f64 * LINE_PX;
        if line < n_lines {
            let middle = [start - FACT_GAP_PX / 2.0, base];
            scene.text(middle, Anchor::Middle, "·", TEXT_PX, MUTED);
        }
        n_lines = line + 1;
        if let Some((color, width)) = fact.key {
            let height = CAP_HEIGHT * TEXT_PX + 2.0;
            let top = base - height + 1.0;
            scene.area(Rect { left: start, top, width, height }, color, 1.0);
        }
        let start = start + key_px(fact);
        let text = font::elide(&fact.text, TEXT_PX, right - start);
        scene.text([start, base], Anchor::Start, &text, TEXT_PX, MUTED);
    }
    n_lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_flow_over_lines() {
        type Case = (&'static [f64], &'static [(f64, usize)]);
        let cases: [Case; 4] = [
            (&[], &[]),
            (&[20.0, 30.0, 10.0], &[(10.0, 0), (34.0, 0), (68.0, 0)]),
            (&[20.0, 70.0, 10.0], &[(10.0, 0), (10.0, 1), (84.0, 1)]),
            (&[200.0, 5.0], &[(10.0, 0), (10.0, 1)]),
        ];
        for (widths, wanted) in cases {
            assert_eq!(flow(widths, 10.0, 100.0, 4.0), wanted, "{widths:?}");
        }
    }

    #[test]
    fn things_are_counted() {
        assert_eq!([0, 1, 2].map(|n| counted(n, "step")), ["0 steps", "1 step", "2 steps"]);
    }
}
