//! Curves of one quantity of a motion over time.

use ndarray::Array1;

use super::axis::{self, Tick, TimeAxis, number};
use super::curve::{self, DOT_PX};
use super::motion_panel::MotionPanel;
use super::reduce::{self, Extent};
use super::scene::{Anchor, Point, Rect, Scene, SceneItem};
use super::style::{
    BLUE, CAP_HEIGHT, CURVE_PX, GREEN, GRID, HAIRLINE_PX, INK, PURPLE, Rgb, TEXT_PX, VERMILLION,
};
use super::value_axis::ValueAxis;
use super::{font, frame};
use crate::motion::phase::WRAP_BARS;
use crate::motion::trajectory::QUATERNION_NORM_TOLERANCE;
use crate::motion::{Channel, Trajectory};
use crate::units::FPS;

/// How dark the band from the least to the greatest value of each column is.
const BAND_OPACITY: f64 = 0.2;
/// Free space above the greatest and below the least value, as a share of what lies between.
const PAD_SHARE: f64 = 0.05;
/// Norms beyond this factor of 1 are no quaternions, and have an axis from 0.
const MAX_NORM_FACTOR: f64 = 2.0;
/// Lower end of the log axis of jerk as a share of its head; smaller values are of no interest.
const JERK_SHARE: f64 = 1e-6;
/// Least distance of two labels on the axis of norms.
const LABEL_PX: f64 = 20.0;
/// Length of a dash of a limit, and of the gap behind it.
const DASH_PX: f64 = 6.0;
const DASH_GAP_PX: f64 = 4.0;
/// Length of a line in a legend, and spaces after it and between two entries.
const KEY_PX: f64 = 12.0;
const KEY_GAP_PX: f64 = 4.0;
const ENTRY_GAP_PX: f64 = 10.0;
/// From the baseline of a heading, and of the legend beside it, to the panel.
const LEGEND_UP_PX: f64 = 12.0;

/// The colours of the axes of the world; w of a quaternion comes before them.
const AXES: [(&str, Rgb); 3] = [("x", BLUE), ("y", GREEN), ("z", PURPLE)];
const W: (&str, Rgb) = ("w", INK);

/// The values of one curve.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Line {
    /// Empty where the heading says it all.
    pub label: &'static str,
    pub color: Rgb,
    /// One value per frame; NaN where there is none.
    pub values: Array1<f32>,
}

/// Returns the curves of a panel; none of [`MotionPanel::Path`].
pub(super) fn lines(panel: MotionPanel, motion: &Trajectory) -> Vec<Line> {
    let lines_of = |channel: Channel, parts: &[(&'static str, Rgb)]| -> Vec<Line> {
        let group = motion.channel(channel);
        let columns = group.columns().into_iter().zip(parts);
        columns
            .map(|(values, &(label, color))| Line { label, color, values: values.to_owned() })
            .collect()
    };
    let alone = |values: Array1<f32>| vec![Line { label: "", color: BLUE, values }];
    match panel {
        MotionPanel::Position => lines_of(Channel::Position, &AXES),
        MotionPanel::Velocity => lines_of(Channel::Velocity, &AXES),
        MotionPanel::Acceleration => lines_of(Channel::Acceleration, &AXES),
        MotionPanel::AngularVelocity => lines_of(Channel::AngularVelocity, &AXES),
        MotionPanel::Quaternion => lines_of(Channel::Quaternion, &[&[W][..], &AXES].concat()),
        MotionPanel::Phase => lines_of(Channel::Phase, &[("", BLUE)]),
        MotionPanel::QuaternionNorm => {
            let quaternions = motion.channel(Channel::Quaternion);
            let rows = quaternions.rows().into_iter();
            alone(rows.map(|q| norm(q.iter().map(|&c| f64::from(c)))).collect())
        }
        MotionPanel::Jerk => alone(jerk(motion)),
        MotionPanel::Path => Vec::new(),
    }
}

/// Returns `|a[t+1] − a[t]| FPS` in m/s³ at each frame; NaN at the last, which has none behind it.
fn jerk(motion: &Trajectory) -> Array1<f32> {
    let a = motion.channel(Channel::Acceleration);
    let n_frames = a.nrows();
    (0..n_frames)
        .map(|t| {
            if t + 1 == n_frames {
                return f32::NAN;
            }
            let (from, to) = (a.row(t), a.row(t + 1));
            norm(to.iter().zip(from).map(|(&to, &from)| (f64::from(to) - f64::from(from)) * FPS))
        })
        .collect()
}

fn norm(parts: impl Iterator<Item = f64>) -> f32 {
    parts.map(|part| part * part).sum::<f64>().sqrt() as f32
}

/// A vertical axis.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Axis {
    /// From one value to another, both far from 0.
    Between {
        low: f64,
        high: f64,
    },
    Values(ValueAxis),
}

impl Axis {
    /// Returns how far up the axis a value is, 0 at the foot and 1 at the head.
    fn up(&self, value: f64) -> f64 {
        match self {
            Self::Between { low, high } => ((value - low) / (high - low)).clamp(0.0, 1.0),
            Self::Values(axis) => axis.up(value),
        }
    }

    fn ticks(&self, height_px: f64) -> Vec<Tick> {
        match self {
            Self::Between { low, high } => {
                axis::ticks(*low, *high, (height_px / LABEL_PX).floor().max(2.0) as usize)
            }
            Self::Values(axis) => axis.ticks(height_px),
        }
    }
}

/// A curve as it is drawn: stretches without a gap, each of columns and values there.
struct MotionCurve {
    label: &'static str,
    color: Rgb,
    runs: Vec<Vec<(usize, Extent)>>,
}

/// The curves of a panel.
pub(super) struct MotionChart {
    panel: MotionPanel,
    curves: Vec<MotionCurve>,
    n_columns: usize,
    is_reduced: bool,
    /// `None` without a value to show.
    axis: Option<Axis>,
    /// A value that is marked by a dashed line.
    limit: Option<f64>,
}

impl MotionChart {
    /// Brings the curves of a panel to the `width_px` that they have room on; `jerk_limit_m_s3` is
    /// marked in the panel of jerk.
    pub fn new(
        panel: MotionPanel,
        motion: &Trajectory,
        jerk_limit_m_s3: f64,
        width_px: f64,
    ) -> Self {
        let n_columns = curve::n_columns(motion.n_frames(), width_px);
        let curve = |line: Line| {
            let columns = reduce::extents(line.values.view(), n_columns);
            let runs = curve::runs(&columns);
            let runs = if panel == MotionPanel::Phase { parted_at_bars(runs) } else { runs };
            MotionCurve { label: line.label, color: line.color, runs }
        };
        let curves: Vec<MotionCurve> = lines(panel, motion).into_iter().map(curve).collect();
        let limit = match panel {
            MotionPanel::QuaternionNorm => Some(1.0),
            MotionPanel::Jerk => Some(jerk_limit_m_s3).filter(|x| x.is_finite() && *x > 0.0),
            _ => None,
        };
        let axis = axis_of(panel, &curves, limit);
        Self { panel, curves, n_columns, is_reduced: n_columns < motion.n_frames(), axis, limit }
    }

    /// Writes heading, unit and legend over the panel at `rect`.
    pub fn heading(&self, scene: &mut Scene, rect: Rect) {
        let labelled: Vec<&MotionCurve> =
            self.curves.iter().filter(|c| !c.label.is_empty()).collect();
        let width =
            |curve: &&MotionCurve| KEY_PX + KEY_GAP_PX + font::width_px(curve.label, TEXT_PX);
        let gaps = labelled.len().saturating_sub(1) as f64 * ENTRY_GAP_PX;
        let mut x = rect.right() - labelled.iter().map(width).sum::<f64>() - gaps;
        let limit = self.limit.filter(|_| self.panel == MotionPanel::Jerk);
        let limit = limit.map(|limit| format!("limit {}", number(limit))).unwrap_or_default();
        let long = match limit.as_str() {
            "" => self.panel.meaning().to_owned(),
            limit => format!("{}; {limit}", self.panel.meaning()),
        };
        let meanings = [long.as_str(), limit.as_str()];
        let heading = self.panel.heading();
        frame::heading(scene, rect, x - ENTRY_GAP_PX, heading, &meanings, self.panel.unit());
        let base = rect.top - LEGEND_UP_PX;
        for curve in labelled {
            let y = base - CAP_HEIGHT * TEXT_PX / 2.0;
            let points = vec![[x, y], [x + KEY_PX, y]];
            scene.items.push(SceneItem::Polyline {
                points,
                color: curve.color,
                width_px: CURVE_PX,
            });
            let at = [x + KEY_PX + KEY_GAP_PX, base];
            scene.text(at, Anchor::Start, curve.label, TEXT_PX, INK);
            x += width(&curve) + ENTRY_GAP_PX;
        }
    }

    /// Draws the curves with their axis; `marks` are the x of vertical lines below the curves.
    pub fn draw(&self, scene: &mut Scene, rect: Rect, time: &TimeAxis, marks: &[f64]) {
        let Some(axis) = self.axis else {
            return frame::nothing(scene, rect, "no values");
        };
        let y = |value: f64| rect.bottom() - axis.up(value) * rect.height;
        for tick in time.ticks() {
            scene.vertical(time.x(tick.value), rect.top, rect.bottom(), HAIRLINE_PX, GRID);
        }
        frame::value_grid(scene, rect, &axis.ticks(rect.height), y);
        let x = |column: usize| {
            time.left + (column as f64 + 0.5) * rect.width / self.n_columns.max(1) as f64
        };
        if self.is_reduced {
            for curve in &self.curves {
                for run in &curve.runs {
                    let upper = run.iter().map(|&(i, e)| [x(i), y(e.max)]);
                    let lower = run.iter().rev().map(|&(i, e)| [x(i), y(e.min)]);
                    let points: Vec<Point> = upper.chain(lower).collect();
                    let (color, opacity) = (curve.color, BAND_OPACITY);
                    scene.items.push(SceneItem::Polygon { points, color, opacity });
                }
            }
        }
        for &mark in marks {
            scene.vertical(mark, rect.top, rect.bottom(), HAIRLINE_PX, VERMILLION);
        }
        if let Some(limit) = self.limit {
            dashes(scene, rect, y(limit));
        }
        for curve in &self.curves {
            for run in &curve.runs {
                let points: Vec<Point> = run.iter().map(|&(i, e)| [x(i), y(e.mean)]).collect();
                let color = curve.color;
                match points.as_slice() {
                    &[alone] => scene.dot(alone, DOT_PX, color),
                    _ => {
                        scene.items.push(SceneItem::Polyline { points, color, width_px: CURVE_PX })
                    }
                }
            }
        }
    }
}

/// Draws a dashed line across a panel.
fn dashes(scene: &mut Scene, rect: Rect, y: f64) {
    let top = (y * 2.0).round() / 2.0 - HAIRLINE_PX / 2.0;
    let mut x = rect.left;
    while x < rect.right() {
        let end = (x + DASH_PX).min(rect.right());
        scene.horizontal(x, end, top, HAIRLINE_PX, VERMILLION);
        x += DASH_PX + DASH_GAP_PX;
    }
}

/// Parts the stretches of a phase where a bar ends, so that no line joins its end to the next begin.
fn parted_at_bars(runs: Vec<Vec<(usize, Extent)>>) -> Vec<Vec<(usize, Extent)>> {
    let is_same_bar = |a: &(usize, Extent), b: &(usize, Extent)| b.1.mean >= a.1.mean - WRAP_BARS;
    runs.iter().flat_map(|run| run.chunk_by(is_same_bar).map(<[_]>::to_vec)).collect()
}

/// Returns the axis that shows the curves; `None` without a value.
fn axis_of(panel: MotionPanel, curves: &[MotionCurve], limit: Option<f64>) -> Option<Axis> {
    let extents = || curves.iter().flat_map(|c| c.runs.iter().flatten()).map(|(_, e)| e);
    extents().next()?;
    let low = extents().map(|e| e.min).fold(f64::INFINITY, f64::min);
    let high = extents().map(|e| e.max).fold(f64::NEG_INFINITY, f64::max);
    let axis = match panel {
        MotionPanel::Quaternion => ValueAxis::linear(low.min(-1.0), high.max(1.0)),
        MotionPanel::Phase => ValueAxis::linear(low, high.max(1.0)),
        MotionPanel::QuaternionNorm => {
            let low = low.min(1.0 - QUATERNION_NORM_TOLERANCE);
            let high = high.max(1.0 + QUATERNION_NORM_TOLERANCE);
            if low >= 1.0 / MAX_NORM_FACTOR && high <= MAX_NORM_FACTOR {
                return Some(Axis::Between { low, high });
            }
            ValueAxis::linear(low, high * (1.0 + PAD_SHARE))
        }
        MotionPanel::Jerk => {
            let head = limit.map_or(high, |limit| limit.max(high));
            // A body at rest has no jerk at all; that lies at the foot.
            let head = if head > 0.0 { head } else { 1.0 };
            let positive = extents().map(|e| e.min).filter(|&x| x > 0.0);
            let least = positive.fold(head, f64::min);
            ValueAxis::log(least.max(head * JERK_SHARE), head)
        }
        _ => {
            let pad = PAD_SHARE * (high.max(0.0) - low.min(0.0));
            let foot = if low < 0.0 { low - pad } else { 0.0 };
            ValueAxis::linear(foot, high.max(0.0) + pad)
        }
    };
    Some(Axis::Values(axis))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use ndarray::Array2;

    fn motion(
        n_frames: usize,
        channel: Channel,
        value: impl Fn(usize, usize) -> f32,
    ) -> Trajectory {
        let mut frames = Array2::zeros((n_frames, MOTION_DIM));
        for t in 0..n_frames {
            for (i, column) in channel.range().enumerate() {
                frames[[t, column]] = value(t, i);
            }
        }
        Trajectory::new(frames).unwrap()
    }

    #[test]
    fn curves_are_the_channels_and_what_follows_from_them() {
        let moving = motion(5, Channel::Acceleration, |t, i| (t * t) as f32 * [1.0, 0.0, 2.0][i]);
        let labels =
            |panel| -> Vec<&str> { lines(panel, &moving).iter().map(|line| line.label).collect() };
        assert_eq!(labels(MotionPanel::Quaternion), ["w", "x", "y", "z"]);
        assert_eq!(labels(MotionPanel::Acceleration), ["x", "y", "z"]);
        assert_eq!(labels(MotionPanel::Phase), [""]);
        assert!(labels(MotionPanel::Path).is_empty());
        assert_eq!(lines(MotionPanel::Acceleration, &moving)[2].values[3], 18.0);
        let jerk = &lines(MotionPanel::Jerk, &moving)[0].values;
        // |Δa| FPS = √5 (2t + 1) 30, rounded to single precision.
        for t in 0..4 {
            let wanted = 5.0_f32.sqrt() * (2 * t + 1) as f32 * 30.0;
            assert!((jerk[t] - wanted).abs() < 1e-4 * wanted, "{} at {t}", jerk[t]);
        }
        assert!(jerk[4].is_nan());
        let turned = motion(3, Channel::Quaternion, |_, i| [0.6, 0.0, -0.8, 0.5][i]);
        let norm = &lines(MotionPanel::QuaternionNorm, &turned)[0].values;
        assert!(norm.iter().all(|n| (n - 1.25_f32.sqrt()).abs() < 1e-6), "{norm}");
    }

    #[test]
    fn a_phase_begins_anew_at_each_bar_and_what_is_not_finite_is_a_gap() {
        let phase = motion(9, Channel::Phase, |t, _| match t {
            6 => f32::NAN,
            t => (t as f32 * 0.3).fract(),
        });
        let chart = MotionChart::new(MotionPanel::Phase, &phase, 50_000.0, 400.0);
        let lengths: Vec<_> = chart.curves[0].runs.iter().map(Vec::len).collect();
        assert_eq!(lengths, [4, 2, 2]);
    }

    #[test]
    fn axes_hold_what_belongs_to_the_panel() {
        let axis =
            |panel, motion: &Trajectory| MotionChart::new(panel, motion, 50_000.0, 400.0).axis;
        let still = motion(4, Channel::Quaternion, |_, i| [1.0, 0.0, 0.0, 0.0][i]);
        let near = |low: f64, high: f64| Some(Axis::Values(ValueAxis::linear(low, high)));
        assert_eq!(axis(MotionPanel::Quaternion, &still), near(-1.0, 1.0));
        assert_eq!(axis(MotionPanel::Phase, &still), near(0.0, 1.0));
        assert_eq!(axis(MotionPanel::Position, &still), near(0.0, 0.0));
        let Some(Axis::Between { low, high }) = axis(MotionPanel::QuaternionNorm, &still) else {
            panic!("norms near 1 have an axis around 1");
        };
        assert!((low - 0.95).abs() < 1e-12 && (high - 1.05).abs() < 1e-12, "{low} to {high}");
        let broken = motion(4, Channel::Quaternion, |_, _| 0.0);
        assert_eq!(axis(MotionPanel::QuaternionNorm, &broken), near(0.0, 1.05 * 1.05));
        // At rest: the limit is all that there is to see.
        let rest = axis(MotionPanel::Jerk, &still);
        assert_eq!(rest, Some(Axis::Values(ValueAxis::log(50_000.0, 50_000.0))));
        let sunk = motion(3, Channel::Position, |_, _| -2.0);
        let axis = axis(MotionPanel::Position, &sunk).unwrap();
        assert!((axis.up(-2.0) - 0.1 / 2.2).abs() < 1e-12 && axis.up(0.0) < 1.0);
        let nothing = motion(3, Channel::Position, |_, _| f32::NAN);
        assert!(MotionChart::new(MotionPanel::Position, &nothing, 50_000.0, 400.0).axis.is_none());
    }
}
