//! Curves of one quantity over the steps of training.

use super::axis::StepAxis;
use super::curve::{self, DOT_PX};
use super::frame;
use super::reduce::{self, Extent};
use super::scene::{Point, Rect, Scene, SceneItem};
use super::style::{BLUE, CURVE_PX, GREEN, GRID, HAIRLINE_PX, INK, PAPER, PURPLE, Rgb, VERMILLION};
use super::value_axis::{ValueAxis, ValueScale};

/// How dark the band from the least to the greatest value of each column is: lighter than where it
/// has a panel of its own.
pub(super) const BAND_OPACITY: f64 = 0.25;
/// Width of curves of steps, which are restless, and of a step without neighbours; the other curves
/// lie on them.
const STEPS_PX: f64 = 1.0;
const STEP_DOT_PX: f64 = 3.0;
/// Points of a curve that are marked with dots are at least this far apart on average.
const MIN_DOT_GAP_PX: f64 = 9.0;
/// Width of the ring around the best value, and of the paper in it.
const RING_PX: f64 = 10.0;
const RING_HOLE_PX: f64 = 5.0;
/// A linear axis ends at this multiple of what is exceeded by one column in fifty, if any value is
/// beyond it: a few peaks would press all else to the foot.
const HEAD_MULTIPLE: f64 = 2.0;
const HEAD_SHARE: f64 = 0.98;
/// Space above the greatest value of a linear axis, as a factor.
const HEADROOM: f64 = 1.05;

/// The kind of a curve, which decides how it looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CurveKind {
    Steps,
    /// Of the decoder, where each network has its own value.
    DecoderSteps,
    Epochs,
    LiveValidation,
    Validation,
}

impl CurveKind {
    /// Every kind, those first that lie below the others.
    pub const ALL: [Self; 5] =
        [Self::Steps, Self::DecoderSteps, Self::Epochs, Self::LiveValidation, Self::Validation];

    pub fn color(self) -> Rgb {
        match self {
            Self::Steps => BLUE,
            Self::DecoderSteps => PURPLE,
            Self::Epochs => INK,
            Self::LiveValidation => GREEN,
            Self::Validation => VERMILLION,
        }
    }

    /// Returns whether there is a value at each step rather than at some.
    fn is_per_step(self) -> bool {
        matches!(self, Self::Steps | Self::DecoderSteps)
    }

    pub fn width_px(self) -> f64 {
        if self.is_per_step() { STEPS_PX } else { CURVE_PX }
    }

    pub fn has_dots(self) -> bool {
        matches!(self, Self::LiveValidation | Self::Validation)
    }
}

/// A curve as it is drawn: stretches without a gap, of steps and values there.
struct TrainingCurve {
    kind: CurveKind,
    runs: Vec<Vec<(f64, Extent)>>,
    has_dots: bool,
}

/// The curves of a panel.
pub(super) struct TrainingChart {
    curves: Vec<TrainingCurve>,
    /// `None` without a value to show.
    axis: Option<ValueAxis>,
    best: Option<(u64, f64)>,
    /// Values that have no place on the scale.
    pub n_left_out: u64,
    /// The greatest value, where it is beyond the head of the axis.
    pub peak: Option<f64>,
}

impl TrainingChart {
    /// Brings curves, each of (steps done, value), to the `width_px` that they have room on.
    ///
    /// `best` is marked if the scale has a place for it.
    pub fn new<'a>(
        scale: ValueScale,
        curves: impl IntoIterator<Item = (CurveKind, &'a [(u64, f64)])>,
        best: Option<(u64, f64)>,
        n_steps: u64,
        width_px: f64,
    ) -> Self {
        let mut n_left_out = 0;
        let curves: Vec<TrainingCurve> = curves
            .into_iter()
            .map(|(kind, points)| {
                let held = || points.iter().copied().filter(|&(_, value)| scale.holds(value));
                let n_held = held().count();
                n_left_out += (points.len() - n_held) as u64;
                let has_dots = kind.has_dots() && n_held as f64 * MIN_DOT_GAP_PX <= width_px;
                TrainingCurve { kind, runs: runs(kind, held, n_held, n_steps, width_px), has_dots }
            })
            .filter(|curve| !curve.runs.is_empty())
            .collect();
        let (axis, peak) = axis(scale, &curves);
        let best = best.filter(|&(_, value)| scale.holds(value));
        Self { curves, axis, best, n_left_out, peak }
    }

    pub fn kinds(&self) -> impl Iterator<Item = CurveKind> {
        self.curves.iter().map(|curve| curve.kind)
    }

    pub fn has_best(&self) -> bool {
        self.best.is_some() && self.axis.is_some()
    }

    /// Draws the curves with their axis.
    pub fn draw(&self, scene: &mut Scene, rect: Rect, steps: &StepAxis) {
        let Some(axis) = self.axis else {
            return frame::nothing(scene, rect, "no values");
        };
        let y = |value: f64| rect.bottom() - axis.up(value) * rect.height;
        for tick in steps.ticks() {
            let x = steps.x(tick.value);
            scene.vertical(x, rect.top, rect.bottom(), HAIRLINE_PX, GRID);
        }
        frame::value_grid(scene, rect, &axis.ticks(rect.height), y);
        for curve in &self.curves {
            for run in &curve.runs {
                band(scene, run, curve.kind, steps, y);
            }
        }
        for curve in &self.curves {
            for run in &curve.runs {
                line(scene, run, curve, steps, y);
            }
        }
        if let Some((step, value)) = self.best {
            ring(scene, [steps.x(step as f64), y(value)]);
        }
    }
}

/// Draws the mark of the best value.
pub(super) fn ring(scene: &mut Scene, at: Point) {
    scene.dot(at, RING_PX, VERMILLION);
    scene.dot(at, RING_HOLE_PX, PAPER);
}

/// Returns the stretches of a curve: of values at every step one point per column, with gaps where
/// there are none; of values at some steps all of them, unless they are closer than can be drawn.
fn runs<I: Iterator<Item = (u64, f64)>>(
    kind: CurveKind,
    held: impl Fn() -> I,
    n_held: usize,
    n_steps: u64,
    width_px: f64,
) -> Vec<Vec<(f64, Extent)>> {
    let n = usize::try_from(n_steps).unwrap_or(usize::MAX);
    if n_held == 0 {
        return Vec::new();
    }
    if !kind.is_per_step() && curve::n_columns(n_held, width_px) == n_held {
        let extent = |value| Extent { min: value, mean: value, max: value };
        return vec![held().map(|(step, value)| (step as f64, extent(value))).collect()];
    }
    let n_columns = curve::n_columns(n, width_px);
    let columns = reduce::extents_of_steps(held(), n_steps, n_columns);
    // The middle of the steps of a column.
    let step = |column: usize| (column as f64 + 0.5) * n_steps as f64 / n_columns as f64 + 0.5;
    let runs = curve::runs(&columns);
    let runs = runs.into_iter().map(|run| run.into_iter().map(|(i, e)| (step(i), e)).collect());
    let runs: Vec<Vec<_>> = runs.collect();
    if kind.is_per_step() { runs } else { vec![runs.concat()] }
}

/// Returns the axis that shows the curves, and the greatest value if that is beyond it.
fn axis(scale: ValueScale, curves: &[TrainingCurve]) -> (Option<ValueAxis>, Option<f64>) {
    let extents = || curves.iter().flat_map(|curve| curve.runs.iter().flatten()).map(|(_, e)| e);
    if extents().next().is_none() {
        return (None, None);
    }
    let low = extents().map(|e| e.min).fold(f64::INFINITY, f64::min);
    let high = extents().map(|e| e.max).fold(f64::NEG_INFINITY, f64::max);
    if scale == ValueScale::Log {
        return (Some(ValueAxis::log(low, high)), None);
    }
    let mut means: Vec<f64> = extents().map(|e| e.mean).collect();
    let k = ((means.len() - 1) as f64 * HEAD_SHARE) as usize;
    let (_, &mut usual, _) = means.select_nth_unstable_by(k, f64::total_cmp);
    let head = HEAD_MULTIPLE * usual;
    if usual > 0.0 && head < high {
        return (Some(ValueAxis::linear(low, head)), Some(high));
    }
    (Some(ValueAxis::linear(low, HEADROOM * high)), None)
}

/// Draws the range of a stretch, where its columns have one.
fn band(
    scene: &mut Scene,
    run: &[(f64, Extent)],
    kind: CurveKind,
    steps: &StepAxis,
    y: impl Fn(f64) -> f64,
) {
    if !kind.is_per_step() || run.len() < 2 || run.iter().all(|(_, e)| e.min == e.max) {
        return;
    }
    let upper = run.iter().map(|&(step, e)| [steps.x(step), y(e.max)]);
    let lower = run.iter().rev().map(|&(step, e)| [steps.x(step), y(e.min)]);
    let points = upper.chain(lower).collect();
    scene.items.push(SceneItem::Polygon { points, color: kind.color(), opacity: BAND_OPACITY });
}

/// Draws the means of a stretch.
fn line(
    scene: &mut Scene,
    run: &[(f64, Extent)],
    curve: &TrainingCurve,
    steps: &StepAxis,
    y: impl Fn(f64) -> f64,
) {
    let color = curve.kind.color();
    let points: Vec<Point> = run.iter().map(|&(step, e)| [steps.x(step), y(e.mean)]).collect();
    if curve.has_dots || points.len() == 1 {
        let width_px = if curve.kind.is_per_step() { STEP_DOT_PX } else { DOT_PX };
        points.iter().for_each(|&point| scene.dot(point, width_px, color));
    }
    if points.len() > 1 {
        scene.items.push(SceneItem::Polyline { points, color, width_px: curve.kind.width_px() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(
        scale: ValueScale,
        kind: CurveKind,
        points: &[(u64, f64)],
        n_steps: u64,
    ) -> TrainingChart {
        TrainingChart::new(scale, [(kind, points)], None, n_steps, 100.0)
    }

    /// Returns the steps and means of each stretch of a chart's first curve.
    fn means(chart: &TrainingChart) -> Vec<Vec<(f64, f64)>> {
        let runs = chart.curves.first().map(|curve| curve.runs.as_slice()).unwrap_or_default();
        runs.iter().map(|run| run.iter().map(|&(step, e)| (step, e.mean)).collect()).collect()
    }

    #[test]
    fn a_step_without_a_value_is_a_gap_and_a_validation_is_none() {
        let points = [(1, 4.0), (2, 2.0), (4, f64::NAN), (5, 1.0), (6, -3.0)];
        let steps = chart(ValueScale::Log, CurveKind::Steps, &points, 6);
        assert_eq!(means(&steps), [vec![(1.0, 4.0), (2.0, 2.0)], vec![(5.0, 1.0)]]);
        assert_eq!(steps.n_left_out, 2);
        let validation = chart(ValueScale::Log, CurveKind::Validation, &points, 6);
        assert_eq!(means(&validation), [vec![(1.0, 4.0), (2.0, 2.0), (5.0, 1.0)]]);
        let linear = chart(ValueScale::Linear, CurveKind::Steps, &points, 6);
        assert_eq!((linear.n_left_out, means(&linear).len()), (1, 2));
    }

    #[test]
    fn many_steps_are_brought_to_columns_of_two_pixels() {
        let points: Vec<_> = (1..=1000).map(|step| (step, (step % 20) as f64 + 1.0)).collect();
        for kind in [CurveKind::Steps, CurveKind::Epochs] {
            let chart = chart(ValueScale::Log, kind, &points, 1000);
            let means = means(&chart);
            assert_eq!((means.len(), means[0].len()), (1, 50), "{kind:?}");
            // Steps 1 to 20, whose values are 2 to 20 and 1.
            assert_eq!(means[0][0], (10.5, 10.5), "{kind:?}");
        }
        let validation = chart(ValueScale::Log, CurveKind::Validation, &points[..12], 1000);
        assert!(!validation.curves[0].has_dots, "12 dots on 100 px");
        assert!(
            chart(ValueScale::Log, CurveKind::Validation, &points[..11], 1000).curves[0].has_dots
        );
    }

    #[test]
    fn nothing_to_show_is_no_axis() {
        for points in [&[][..], &[(1, 0.0), (2, f64::INFINITY)]] {
            let chart = chart(ValueScale::Log, CurveKind::Steps, points, 2);
            assert_eq!((chart.axis, chart.kinds().count()), (None, 0));
            assert_eq!(chart.n_left_out, points.len() as u64);
        }
    }

    #[test]
    fn a_few_peaks_do_not_press_a_linear_axis_down() {
        let mut points: Vec<_> = (1..=100).map(|step| (step, 1.0)).collect();
        assert_eq!(chart(ValueScale::Linear, CurveKind::Steps, &points, 100).peak, None);
        points[7].1 = 50.0;
        let peaked = chart(ValueScale::Linear, CurveKind::Steps, &points, 100);
        assert_eq!((peaked.peak, peaked.axis), (Some(50.0), Some(ValueAxis::linear(0.0, 2.0))));
        let log = chart(ValueScale::Log, CurveKind::Steps, &points, 100);
        assert_eq!((log.peak, log.axis), (None, Some(ValueAxis::log(1.0, 50.0))));
    }

    #[test]
    fn the_best_is_marked_where_it_has_a_place() {
        let points = [(1, 2.0), (2, 1.0)];
        let marked = |best| {
            TrainingChart::new(
                ValueScale::Log,
                [(CurveKind::Validation, &points[..])],
                best,
                2,
                100.0,
            )
            .has_best()
        };
        assert_eq!([None, Some((2, 1.0)), Some((2, 0.0))].map(marked), [false, true, false]);
    }
}
