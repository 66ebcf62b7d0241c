//! The plot of tokens: how often each code is used, the one that is used most first.

use super::axis::{self, number};
use super::frame::{self, PLOT_TOP_PX};
use super::header::{self, Fact, LINE_PX, counted};
use super::scene::{Rect, Scene};
use super::style::{BLUE, HAIRLINE_PX, LEFT_PX, MARGIN_PX, TICK_PX, VERMILLION};
use super::{Format, Picture, PlotError, check_width, write};

/// Height of the panel.
const HEIGHT_PX: f64 = 280.0;
/// Most ticks on an axis.
const MAX_TICKS: usize = 6;
/// Share of a code's room that its bar takes, where there is room.
const BAR_SHARE: f64 = 0.8;

/// Tokens of a run, and what is known of them.
#[derive(Clone, Copy, Debug)]
pub struct TokensPlot<'a> {
    /// The title of the plot, for example the name of the run.
    pub title: &'a str,
    /// How often each code was written, code after code.
    pub counts: &'a [u64],
    /// exp(−Σ p ln p) of their shares.
    pub perplexity: f64,
    pub n_phrases: u64,
}

/// Returns a plot of the shares of codes, `width_px` CSS pixels wide (a PNG has two pixels for each), with a line where all
/// would be, were they used alike.
///
/// # Errors
/// No tokens, or a page that is too small or too large.
pub fn tokens(plot: &TokensPlot<'_>, width_px: u32, format: Format) -> Result<Picture, PlotError> {
    write(&scene(plot, width_px)?, format)
}

/// Lays the plot out.
pub(super) fn scene(plot: &TokensPlot<'_>, width_px: u32) -> Result<Scene, PlotError> {
    check_width(width_px)?;
    let n_tokens: u64 = plot.counts.iter().sum();
    if n_tokens == 0 {
        return Err(PlotError::NoTokens);
    }
    let width_px = f64::from(width_px);
    let title = plot.title.to_owned();
    let mut scene = Scene { width_px, height_px: 0.0, title, items: Vec::new() };
    let (left, right) = (LEFT_PX, width_px - MARGIN_PX);
    header::title(&mut scene, left, right, plot.title);
    let base = header::FACTS_BASE_PX;
    let n_lines = header::facts(&mut scene, left, right, base, facts(plot, n_tokens), usize::MAX);
    let top = header::HEADER_PX + n_lines.saturating_sub(1) as f64 * LINE_PX + PLOT_TOP_PX;
    let rect = Rect { left, top, width: right - left, height: HEIGHT_PX };
    frame::heading(&mut scene, rect, right, "usage", &["codes by how often they are used"], "%");
    draw(&mut scene, rect, plot.counts, n_tokens);
    scene.height_px = rect.bottom() + frame::X_TITLE_PX + MARGIN_PX;
    Ok(scene)
}

fn draw(scene: &mut Scene, rect: Rect, counts: &[u64], n_tokens: u64) {
    let mut counts = counts.to_vec();
    counts.sort_unstable_by(|a, b| b.cmp(a));
    let percent = |n: u64| 100.0 * n as f64 / n_tokens as f64;
    let high = percent(counts[0]);
    let y = |value: f64| rect.bottom() - value / high * rect.height;
    frame::value_grid(scene, rect, &axis::ticks(0.0, high, MAX_TICKS), y);
    let room = rect.width / counts.len() as f64;
    for (i, &n) in counts.iter().enumerate().filter(|(_, n)| **n > 0) {
        let width = if room > 2.0 { BAR_SHARE * room } else { room };
        let left = rect.left + i as f64 * room + (room - width) / 2.0;
        let top = y(percent(n));
        scene.area(Rect { left, top, width, height: rect.bottom() - top }, BLUE, 1.0);
    }
    let even = y(100.0 / counts.len() as f64);
    scene.horizontal(rect.left, rect.right(), even, HAIRLINE_PX, VERMILLION);
    let ticks = axis::ticks(0.0, counts.len() as f64, MAX_TICKS);
    let x = |value: f64| rect.left + value * room;
    frame::x_ticks(scene, ticks.iter().map(|tick| x(tick.value)), rect.bottom());
    let labels = ticks.iter().map(|tick| (x(tick.value), tick.label.as_str()));
    frame::x_labels(scene, labels, [rect.left, rect.right()], rect.bottom(), "codes");
}

fn facts(plot: &TokensPlot<'_>, n_tokens: u64) -> Vec<Fact> {
    let n_codes = plot.counts.len() as u64;
    let n_used = plot.counts.iter().filter(|&&n| n > 0).count();
    let share = 100.0 * plot.perplexity / n_codes as f64;
    vec![
        Fact::plain(counted(n_tokens, "token")),
        Fact::plain(format!("of {}", counted(plot.n_phrases, "phrase"))),
        Fact::plain(format!("{n_used} of {} in use", counted(n_codes, "code"))),
        Fact::plain(format!("perplexity {} ({} %)", number(plot.perplexity), number(share))),
        Fact { key: Some((VERMILLION, TICK_PX)), text: "were all used alike".to_owned() },
    ]
}
