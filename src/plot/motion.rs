//! The plot of a motion: the reference's six panels, and others that are asked for.

use super::axis::{TimeAxis, number};
use super::curve;
use super::frame::{self, PANEL_GAP_PX, PLOT_TOP_PX};
use super::header::{self, Fact, LINE_PX, counted};
use super::motion_chart::MotionChart;
use super::motion_panel::MotionPanel;
use super::motion_path::FloorPath;
use super::scene::{Rect, Scene};
use super::style::{HAIRLINE_PX, LEFT_PX, MARGIN_PX, MISSING, TICK_PX, VERMILLION};
use super::{Format, Picture, PlotError, check_width, write};
use crate::motion::Trajectory;
use crate::units::{FPS, frames_to_s};

/// A motion, or an excerpt, and what is known of its beats.
#[derive(Clone, Copy, Debug)]
pub struct MotionPlot<'a> {
    /// The title of the plot, for example the name of the phrase.
    pub title: &'a str,
    /// Values that are not finite are gaps.
    pub motion: &'a Trajectory,
    /// Beats in seconds from the begin of the whole motion; those outside the excerpt are left out.
    pub beat_times_s: &'a [f64],
    /// Number of the first frame in the whole motion.
    pub first_frame: usize,
    /// Mean jerk up to which the reference lets a motion pass, m/s³; a dashed line.
    pub jerk_limit_m_s3: f64,
}

/// Width in CSS pixels that a plot of motion has unless another is asked for.
pub const MOTION_WIDTH_PX: u32 = 1000;

/// Space between panels side by side, in which the right one has its labels.
const COLUMN_GAP_PX: f64 = 64.0;
/// Panels narrower than this, in which heading and legend would touch, are not put side by side.
const MIN_COLUMN_PX: f64 = 225.0;
/// Heights: of a curve among others, of one alone, and of the path from above.
const CURVE_HEIGHT_PX: f64 = 170.0;
const ALONE_HEIGHT_PX: f64 = 320.0;
const PATH_HEIGHT_PX: f64 = 360.0;
/// Beats closer than this on average are not drawn: they would be a veil.
const MIN_BEAT_GAP_PX: f64 = 5.0;

/// Returns a plot of a motion, `width_px` CSS pixels wide (a PNG has two pixels for each): curves over
/// time, two side by side where they have room, and below them the path if it is among the panels.
///
/// # Errors
/// No panels, or a page that is too small or too large.
pub fn motion(
    plot: &MotionPlot<'_>,
    panels: &[MotionPanel],
    width_px: u32,
    format: Format,
) -> Result<Picture, PlotError> {
    write(&scene(plot, panels, width_px)?, format)
}

/// Lays the plot out.
pub(super) fn scene(
    plot: &MotionPlot<'_>,
    panels: &[MotionPanel],
    width_px: u32,
) -> Result<Scene, PlotError> {
    check_width(width_px)?;
    if panels.is_empty() {
        return Err(PlotError::NoPanels { known: MotionPanel::known() });
    }
    let width_px = f64::from(width_px);
    let title = plot.title.to_owned();
    let mut scene = Scene { width_px, height_px: 0.0, title, items: Vec::new() };
    let (left, right) = (LEFT_PX, width_px - MARGIN_PX);
    let curves: Vec<MotionPanel> =
        panels.iter().copied().filter(|panel| *panel != MotionPanel::Path).collect();
    let grid = Grid::new(curves.len(), left, right);

    header::title(&mut scene, left, right, plot.title);
    let facts = facts(plot, !curves.is_empty(), &grid);
    let base = header::FACTS_BASE_PX;
    let n_lines = header::facts(&mut scene, left, right, base, facts, usize::MAX);
    let mut top = header::HEADER_PX + n_lines.saturating_sub(1) as f64 * LINE_PX;
    let mut bottom = top;
    if !curves.is_empty() {
        bottom = draw_curves(&mut scene, plot, &curves, &grid, top);
        top = bottom + PANEL_GAP_PX;
    }
    if let Some(panel) = panels.iter().find(|panel| **panel == MotionPanel::Path) {
        let (width, height) = (right - left, PATH_HEIGHT_PX);
        let rect = Rect { left, top: top + PLOT_TOP_PX, width, height };
        let path = FloorPath::of(plot.motion);
        path.heading(&mut scene, rect, panel.heading(), panel.unit());
        path.draw(&mut scene, rect);
        bottom = rect.bottom() + frame::X_TITLE_PX;
    }
    scene.height_px = bottom + MARGIN_PX;
    Ok(scene)
}

/// Where panels side by side are.
struct Grid {
    n_columns: usize,
    left: f64,
    /// Width and height of a panel.
    width: f64,
    height: f64,
}

impl Grid {
    fn new(n_panels: usize, left: f64, right: f64) -> Self {
        let half = (right - left - COLUMN_GAP_PX) / 2.0;
        let is_double = n_panels > 1 && half >= MIN_COLUMN_PX;
        let (n_columns, width) = if is_double { (2, half) } else { (1, right - left) };
        let height = if n_panels == 1 { ALONE_HEIGHT_PX } else { CURVE_HEIGHT_PX };
        Self { n_columns, left, width, height }
    }

    fn left_of(&self, i: usize) -> f64 {
        self.left + (i % self.n_columns) as f64 * (self.width + COLUMN_GAP_PX)
    }

    fn time(&self, i: usize, plot: &MotionPlot<'_>) -> TimeAxis {
        TimeAxis {
            start_s: frames_to_s(plot.first_frame),
            n_frames: plot.motion.n_frames(),
            left: self.left_of(i),
            width: self.width,
        }
    }
}

/// Draws curves below `top`; returns where their labels end.
fn draw_curves(
    scene: &mut Scene,
    plot: &MotionPlot<'_>,
    panels: &[MotionPanel],
    grid: &Grid,
    mut top: f64,
) -> f64 {
    let mut bottom = top;
    for (i, &panel) in panels.iter().enumerate() {
        let time = grid.time(i, plot);
        let (left, width, height) = (time.left, time.width, grid.height);
        let rect = Rect { left, top: top + PLOT_TOP_PX, width, height };
        let chart = MotionChart::new(panel, plot.motion, plot.jerk_limit_m_s3, width);
        chart.heading(scene, rect);
        let (_, beats_x) = beats(plot.beat_times_s, &time);
        // The bars are read off the phase; elsewhere beats would be lines among lines.
        let marks = if panel == MotionPanel::Phase { beats_x.as_slice() } else { &[] };
        chart.draw(scene, rect, &time, marks);
        if panel != MotionPanel::Phase {
            for &x in &beats_x {
                let foot = rect.top - HAIRLINE_PX;
                scene.vertical(x, foot - TICK_PX, foot, HAIRLINE_PX, VERMILLION);
            }
        }
        let ticks = time.ticks();
        frame::x_ticks(scene, ticks.iter().map(|tick| time.x(tick.value)), rect.bottom());
        if i + grid.n_columns >= panels.len() {
            let labels = ticks.iter().map(|tick| (time.x(tick.value), tick.label.as_str()));
            let ends = [time.left, time.right()];
            frame::x_labels(scene, labels, ends, rect.bottom(), "time (s)");
        }
        bottom = rect.bottom();
        if i % grid.n_columns + 1 == grid.n_columns {
            top = bottom + PANEL_GAP_PX;
        }
    }
    bottom + frame::X_TITLE_PX
}

/// Returns how many beats an excerpt has, and where they are: nowhere if they are too close.
fn beats(beat_times_s: &[f64], time: &TimeAxis) -> (usize, Vec<f64>) {
    let half_frame_s = 0.5 / FPS;
    let shown = time.start_s - half_frame_s..time.end_s() + half_frame_s;
    let beats = beat_times_s.iter().filter(|&s| shown.contains(s));
    let x: Vec<f64> = beats.map(|&s| time.x(s)).collect();
    let n_beats = x.len();
    let fits = n_beats as f64 * MIN_BEAT_GAP_PX <= time.width;
    (n_beats, if fits { x } else { Vec::new() })
}

fn facts(plot: &MotionPlot<'_>, has_curves: bool, grid: &Grid) -> Vec<Fact> {
    let n_frames = plot.motion.n_frames();
    let duration_s = frames_to_s(n_frames);
    let decimals = if duration_s < 1000.0 { 2 } else { 0 };
    let mut facts = vec![
        Fact::plain(format!("{duration_s:.decimals$} s")),
        Fact::plain(format!("{} at {FPS} fps", counted(n_frames as u64, "frame"))),
    ];
    let (n_beats, beats_x) = beats(plot.beat_times_s, &grid.time(0, plot));
    if has_curves && n_beats > 0 {
        facts.push(if beats_x.is_empty() {
            Fact::plain(format!("{n_beats} beats, too close to draw"))
        } else {
            let key = Some((VERMILLION, HAIRLINE_PX * 1.5));
            Fact { key, text: counted(n_beats as u64, "beat") }
        });
    }
    facts.push(Fact::plain(format!(
        "path of {} m",
        number(FloorPath::length_m(plot.motion.view()))
    )));
    let n_missing = plot.motion.view().iter().filter(|value| !value.is_finite()).count();
    if n_missing > 0 {
        let text = format!("{} not finite", counted(n_missing as u64, "value"));
        facts.push(Fact { key: Some((MISSING, TICK_PX)), text });
    }
    let n_columns = curve::n_columns(n_frames, grid.width);
    if has_curves && n_columns < n_frames {
        let n = n_frames as f64 / n_columns as f64;
        facts.push(Fact::plain(format!("curves: mean and range of {n:.0} frames")));
    }
    facts
}
