//! The plot of a training run's losses.

use super::axis::{StepAxis, number};
use super::chart::{self, BAND_OPACITY, CurveKind, TrainingChart};
use super::curve::{self, DOT_PX};
use super::frame::{self, PANEL_GAP_PX, PLOT_TOP_PX};
use super::header::{self, Fact, LINE_PX, counted};
use super::scene::{Anchor, Rect, Scene, SceneItem};
use super::style::{CAP_HEIGHT, INK, LEFT_PX, MARGIN_PX, MUTED, PART_PX, TEXT_PX};
use super::training_panel::{TrainingPanel, TrainingStage};
use super::value_axis::ValueScale;
use super::{Format, Picture, PlotError, check_width, font, write};

/// A run, as far as it is drawn.
#[derive(Clone, Copy, Debug)]
pub struct TrainingPlot<'a> {
    /// The title of the plot: the run's name.
    pub title: &'a str,
    /// Stages to draw, from the top.
    pub stages: &'a [StageCurves],
}

/// The logged rows of a stage.
#[derive(Clone, Debug, PartialEq)]
pub struct StageCurves {
    pub stage: TrainingStage,
    /// Steps done, skipped ones included; the axis goes from 0 to here.
    pub n_steps: u64,
    /// Whole epochs.
    pub n_epochs: u64,
    /// Time of training in seconds.
    pub elapsed_s: f64,
    /// Steps that were skipped because something was not finite.
    pub n_skipped: u64,
    /// Steps done and loss at the validation with the least loss.
    pub best: Option<(u64, f64)>,
    /// Panels to draw, from the top, or from the left and the top.
    pub panels: Vec<PanelCurves>,
}

/// The curves of a panel, each as (steps done, value) with rising steps. Steps of which nothing was
/// logged are not in it.
#[derive(Clone, Debug, PartialEq)]
pub struct PanelCurves {
    pub panel: TrainingPanel,
    pub steps: Vec<(u64, f64)>,
    /// The decoder's value, where each network has its own.
    pub decoder_steps: Vec<(u64, f64)>,
    /// Means of epochs, at the middle of each.
    pub epochs: Vec<(u64, f64)>,
    pub validation: Vec<(u64, f64)>,
    /// Validation of the weights themselves, where `validation` is that of their average.
    pub live_validation: Vec<(u64, f64)>,
}

impl PanelCurves {
    /// Returns a panel without curves.
    pub fn new(panel: TrainingPanel) -> Self {
        Self {
            panel,
            steps: Vec::new(),
            decoder_steps: Vec::new(),
            epochs: Vec::new(),
            validation: Vec::new(),
            live_validation: Vec::new(),
        }
    }

    fn of(&self, kind: CurveKind) -> &[(u64, f64)] {
        match kind {
            CurveKind::Steps => &self.steps,
            CurveKind::DecoderSteps => &self.decoder_steps,
            CurveKind::Epochs => &self.epochs,
            CurveKind::LiveValidation => &self.live_validation,
            CurveKind::Validation => &self.validation,
        }
    }
}

/// From the baseline of a stage's heading to that of the line below it.
const FACTS_PX: f64 = 20.0;
/// Space between a stage and the heading of the next, and between the last line over the panels and their room.
const STAGE_GAP_PX: f64 = 46.0;
const PANELS_GAP_PX: f64 = 14.0;
/// Space between panels side by side, in which the right one has its labels.
const COLUMN_GAP_PX: f64 = 64.0;
/// Panels narrower than this are not put side by side.
const MIN_COLUMN_PX: f64 = 200.0;
/// Heights: of a panel alone, of the loss, of other losses, of what is no loss, and side by side.
const ALONE_PX: f64 = 320.0;
const LOSS_PX: f64 = 280.0;
const PART_LOSS_PX: f64 = 150.0;
const SMALL_PX: f64 = 96.0;
const GRID_PX: f64 = 170.0;
/// Length of a line in the legend, height of a band there, and spaces after a key and an entry.
const KEY_PX: f64 = 18.0;
const KEY_BAND_PX: f64 = 9.0;
const KEY_GAP_PX: f64 = 6.0;
const ENTRY_GAP_PX: f64 = 20.0;

/// Returns a plot of a training run, `width_px` CSS pixels wide (a PNG has two pixels for each):
/// losses on log scales over the steps of each stage, stage below stage.
///
/// # Errors
/// Nothing to plot, or a page that is too small or too large.
pub fn training(
    plot: &TrainingPlot<'_>,
    width_px: u32,
    format: Format,
) -> Result<Picture, PlotError> {
    write(&scene(plot, width_px)?, format)
}

/// Lays the plot out.
pub(super) fn scene(plot: &TrainingPlot<'_>, width_px: u32) -> Result<Scene, PlotError> {
    check_width(width_px)?;
    if plot.stages.iter().all(|stage| stage.panels.is_empty()) {
        return Err(PlotError::NoPanels { known: TrainingPanel::known() });
    }
    let width_px = f64::from(width_px);
    let title = plot.title.to_owned();
    let mut scene = Scene { width_px, height_px: 0.0, title, items: Vec::new() };
    let right = width_px - MARGIN_PX;
    header::title(&mut scene, LEFT_PX, right, plot.title);
    let mut base = header::HEADER_PX;
    for curves in plot.stages.iter().filter(|stage| !stage.panels.is_empty()) {
        let bottom = Stage::new(curves, LEFT_PX, right).draw(&mut scene, base);
        scene.height_px = bottom + MARGIN_PX;
        base = bottom + STAGE_GAP_PX;
    }
    Ok(scene)
}

/// A stage in the making.
struct Stage<'a> {
    curves: &'a StageCurves,
    left: f64,
    right: f64,
    /// Panels side by side, and the width of each.
    n_columns: usize,
    width: f64,
    charts: Vec<TrainingChart>,
}

impl<'a> Stage<'a> {
    fn new(curves: &'a StageCurves, left: f64, right: f64) -> Self {
        let half = (right - left - COLUMN_GAP_PX) / 2.0;
        let is_grid = curves.stage == TrainingStage::Finetune
            && curves.panels.len() > 1
            && half >= MIN_COLUMN_PX;
        let (n_columns, width) = if is_grid { (2, half) } else { (1, right - left) };
        let charts = curves.panels.iter().map(|panel| {
            let kinds = CurveKind::ALL.into_iter().map(|kind| (kind, panel.of(kind)));
            let best = curves.best.filter(|_| panel.panel == TrainingPanel::Loss);
            TrainingChart::new(panel.panel.scale(), kinds, best, curves.n_steps, width)
        });
        let charts = charts.collect();
        Self { curves, left, right, n_columns, width, charts }
    }

    /// Draws the stage, with the baseline of its heading at `base`; returns where it ends.
    fn draw(&self, scene: &mut Scene, base: f64) -> f64 {
        let stage = self.curves.stage;
        let at = [self.left, base];
        scene.text(at, Anchor::Start, stage.heading(), PART_PX, INK);
        let at = [self.left + font::width_px(stage.heading(), PART_PX) + KEY_GAP_PX * 2.0, base];
        let meaning = font::elide(stage.meaning(), TEXT_PX, self.right - at[0]);
        scene.text(at, Anchor::Start, &meaning, TEXT_PX, MUTED);
        let base = base + FACTS_PX;
        let n = header::facts(scene, self.left, self.right, base, self.facts(), usize::MAX);
        let base = base + n as f64 * LINE_PX + 2.0;
        let n = self.legend(scene, base);
        let top = base + n.saturating_sub(1) as f64 * LINE_PX + PANELS_GAP_PX;
        self.panels(scene, top)
    }

    fn facts(&self) -> Vec<Fact> {
        let c = self.curves;
        let mut facts = vec![
            Fact::plain(counted(c.n_steps, "step")),
            Fact::plain(counted(c.n_epochs, "epoch")),
            Fact::plain(format!("{} min", number(c.elapsed_s / 60.0))),
        ];
        if let Some((step, loss)) = c.best {
            let text = format!("best validation loss {} at step {step}", number(loss));
            facts.push(Fact::plain(text));
        }
        facts.push(Fact::plain(format!("{} skipped", counted(c.n_skipped, "step"))));
        let n_left_out: u64 = self.charts.iter().map(|chart| chart.n_left_out).sum();
        if n_left_out > 0 {
            let values = counted(n_left_out, "value");
            facts.push(Fact::plain(format!("{values} left out: not above 0, or not finite")));
        }
        facts
    }

    /// Draws what each kind of curve looks like, with the first line at `base`; returns the number of
    /// lines.
    fn legend(&self, scene: &mut Scene, base: f64) -> usize {
        let is_drawn = |kind: &CurveKind| self.charts.iter().any(|c| c.kinds().any(|k| k == *kind));
        let mut entries: Vec<(Option<CurveKind>, String)> = CurveKind::ALL
            .into_iter()
            .filter(is_drawn)
            .map(|kind| (Some(kind), self.label(kind)))
            .collect();
        if self.charts.iter().any(TrainingChart::has_best) {
            entries.push((None, "best".to_owned()));
        }
        let widths: Vec<f64> = entries
            .iter()
            .map(|(_, label)| KEY_PX + KEY_GAP_PX + font::width_px(label, TEXT_PX))
            .collect();
        let places = header::flow(&widths, self.left, self.right, ENTRY_GAP_PX);
        for ((kind, label), (x, line)) in entries.iter().zip(&places) {
            let base = base + *line as f64 * LINE_PX;
            self.key(scene, *kind, *x, base - CAP_HEIGHT * TEXT_PX / 2.0);
            let at = [x + KEY_PX + KEY_GAP_PX, base];
            scene.text(at, Anchor::Start, label, TEXT_PX, INK);
        }
        places.last().map_or(0, |(_, line)| line + 1)
    }

    /// Draws a key of the legend from `x` on, around `y`; without a kind that of the best value.
    fn key(&self, scene: &mut Scene, kind: Option<CurveKind>, x: f64, y: f64) {
        let middle = [x + KEY_PX / 2.0, y];
        let Some(kind) = kind else { return chart::ring(scene, middle) };
        let color = kind.color();
        if kind == CurveKind::Steps && self.steps_per_column() > 1.0 {
            let (top, height) = (y - KEY_BAND_PX / 2.0, KEY_BAND_PX);
            scene.area(Rect { left: x, top, width: KEY_PX, height }, color, BAND_OPACITY);
        }
        let points = vec![[x, y], [x + KEY_PX, y]];
        scene.items.push(SceneItem::Polyline { points, color, width_px: kind.width_px() });
        if kind.has_dots() {
            scene.dot(middle, DOT_PX, color);
        }
    }

    fn label(&self, kind: CurveKind) -> String {
        let n = self.steps_per_column();
        let has_live = self.curves.panels.iter().any(|panel| !panel.live_validation.is_empty());
        match kind {
            CurveKind::Steps if n > 1.0 => format!("mean and range of {n:.0} steps"),
            CurveKind::Steps => "steps".to_owned(),
            CurveKind::DecoderSteps => "decoder’s learning rate".to_owned(),
            CurveKind::Epochs => "mean of an epoch".to_owned(),
            CurveKind::Validation if has_live => "validation, averaged weights".to_owned(),
            CurveKind::Validation => "validation".to_owned(),
            CurveKind::LiveValidation => "validation, live weights".to_owned(),
        }
    }

    /// Returns how many steps a point of a curve of steps stands for.
    fn steps_per_column(&self) -> f64 {
        let n_steps = usize::try_from(self.curves.n_steps).unwrap_or(usize::MAX);
        n_steps as f64 / curve::n_columns(n_steps, self.width).max(1) as f64
    }

    /// Draws the panels below `top`; returns where their labels end.
    fn panels(&self, scene: &mut Scene, mut top: f64) -> f64 {
        let n_panels = self.charts.len();
        let mut bottom = top;
        for (i, (curves, chart)) in self.curves.panels.iter().zip(&self.charts).enumerate() {
            let column = i % self.n_columns;
            let left = self.left + column as f64 * (self.width + COLUMN_GAP_PX);
            let height = self.height_px(curves.panel);
            let rect = Rect { left, top: top + PLOT_TOP_PX, width: self.width, height };
            let axis = StepAxis { n_steps: self.curves.n_steps, left, width: self.width };
            self.heading(scene, rect, curves.panel, chart);
            chart.draw(scene, rect, &axis);
            let ticks = axis.ticks();
            let x = |value: f64| axis.x(value);
            frame::x_ticks(scene, ticks.iter().map(|tick| x(tick.value)), rect.bottom());
            if i + self.n_columns >= n_panels {
                let labels = ticks.iter().map(|tick| (x(tick.value), tick.label.as_str()));
                frame::x_labels(scene, labels, [left, axis.right()], rect.bottom(), "step");
            }
            bottom = rect.bottom();
            if column + 1 == self.n_columns {
                top = bottom + PANEL_GAP_PX;
            }
        }
        bottom + frame::X_TITLE_PX
    }

    fn height_px(&self, panel: TrainingPanel) -> f64 {
        match panel {
            _ if self.charts.len() == 1 => ALONE_PX,
            _ if self.n_columns > 1 => GRID_PX,
            TrainingPanel::Loss => LOSS_PX,
            _ if panel.scale() == ValueScale::Log => PART_LOSS_PX,
            _ => SMALL_PX,
        }
    }

    fn heading(&self, scene: &mut Scene, rect: Rect, panel: TrainingPanel, chart: &TrainingChart) {
        let peak = chart.peak.map(|peak| format!("up to {}, beyond the axis", number(peak)));
        let meaning = [panel.meaning(), peak.as_deref().unwrap_or_default()];
        let long =
            meaning.into_iter().filter(|text| !text.is_empty()).collect::<Vec<_>>().join("; ");
        // What is beyond the axis matters more than what the name means.
        let short = peak.as_deref().unwrap_or_default();
        let heading = panel.heading(self.curves.stage);
        frame::heading(scene, rect, rect.right(), heading, &[&long, short], panel.unit());
    }
}
