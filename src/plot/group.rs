//! The plot of a group: the paths of all dancers as they are seen from above.

use ndarray::ArrayView3;

use super::axis::number;
use super::frame::{self, PLOT_TOP_PX};
use super::header::{self, Fact, LINE_PX, counted};
use super::motion_panel::MotionPanel;
use super::motion_path::{FloorPath, PathColors};
use super::scene::{Rect, Scene};
use super::style::{LEFT_PX, MARGIN_PX, MISSING, PAPER, TICK_PX};
use super::{Format, Picture, PlotError, check_width, write};
use crate::motion::MOTION_DIM;
use crate::motion::group::DANCER_COLORS;
use crate::units::{FPS, frames_to_s};

/// Height of the panel, and the least and largest share of its width that it is.
const MIN_HEIGHT_PX: f64 = 360.0;
const HEIGHT_SHARE: f64 = 0.7;

/// A group, or an excerpt.
#[derive(Clone, Copy, Debug)]
pub struct GroupPlot<'a> {
    /// The title of the plot, for example the name of the phrase.
    pub title: &'a str,
    /// `[N, T, 25]`; values that are not finite are gaps.
    pub group: ArrayView3<'a, f32>,
}

/// Returns a plot of the paths of a group, `width_px` CSS pixels wide (a PNG has two pixels for each): each
/// dancer in its colour, with a ring where it starts and a dot where it ends.
///
/// # Errors
/// A group without dancers or frames or of other than 25 channels, or a page that is too small or too large.
pub fn group(plot: &GroupPlot<'_>, width_px: u32, format: Format) -> Result<Picture, PlotError> {
    write(&scene(plot, width_px)?, format)
}

/// Lays the plot out.
pub(super) fn scene(plot: &GroupPlot<'_>, width_px: u32) -> Result<Scene, PlotError> {
    check_width(width_px)?;
    let (n_dancers, n_frames, n_channels) = plot.group.dim();
    if n_dancers == 0 || n_frames == 0 || n_channels != MOTION_DIM {
        return Err(PlotError::Group { n_dancers, n_frames, n_channels, wanted: MOTION_DIM });
    }
    let width_px = f64::from(width_px);
    let title = plot.title.to_owned();
    let mut scene = Scene { width_px, height_px: 0.0, title, items: Vec::new() };
    let (left, right) = (LEFT_PX, width_px - MARGIN_PX);
    header::title(&mut scene, left, right, plot.title);
    let base = header::FACTS_BASE_PX;
    let n_lines = header::facts(&mut scene, left, right, base, facts(plot), usize::MAX);
    let top = header::HEADER_PX + n_lines.saturating_sub(1) as f64 * LINE_PX;

    let width = right - left;
    let height = (HEIGHT_SHARE * width).max(MIN_HEIGHT_PX);
    let rect = Rect { left, top: top + PLOT_TOP_PX, width, height };
    let paths: Vec<FloorPath> = plot.group.outer_iter().map(FloorPath::of_frames).collect();
    let colored: Vec<(&FloorPath, PathColors)> = paths
        .iter()
        .enumerate()
        .map(|(i, path)| {
            let color = color_of(i);
            (path, PathColors { path: color, start: color, end: color })
        })
        .collect();
    let panel = MotionPanel::Path;
    paths[0].heading_with(&mut scene, rect, [panel.heading(), panel.unit()], &[]);
    FloorPath::draw_all(&colored, &mut scene, rect);
    FloorPath::hollow_starts(&colored, &mut scene, rect, PAPER);
    scene.height_px = rect.bottom() + frame::X_TITLE_PX + MARGIN_PX;
    Ok(scene)
}

fn color_of(dancer: usize) -> [u8; 3] {
    DANCER_COLORS[dancer % DANCER_COLORS.len()]
}

fn facts(plot: &GroupPlot<'_>) -> Vec<Fact> {
    let (n_dancers, n_frames, _) = plot.group.dim();
    let mut facts = vec![
        Fact::plain(counted(n_dancers as u64, "dancer")),
        Fact::plain(format!("{:.2} s", frames_to_s(n_frames))),
        Fact::plain(format!("{} at {FPS} fps", counted(n_frames as u64, "frame"))),
        Fact::plain("ring: start, dot: end".to_owned()),
    ];
    for (i, frames) in plot.group.outer_iter().enumerate() {
        let text = format!("{i}: {} m", number(FloorPath::length_m(frames)));
        facts.push(Fact { key: Some((color_of(i), TICK_PX)), text });
    }
    let n_missing = plot.group.iter().filter(|value| !value.is_finite()).count();
    if n_missing > 0 {
        let text = format!("{} not finite", counted(n_missing as u64, "value"));
        facts.push(Fact { key: Some((MISSING, TICK_PX)), text });
    }
    facts
}
