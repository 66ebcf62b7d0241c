//! Dots with intervals: the numbers of all subjects on one scale.

use super::names::{self, OWN, TRUTHS};
use super::numbers::{interval, number};
use super::rows::Row;
use super::{BY_CONSTRUCTION, Metric};

/// Sizes in CSS pixels.
const WIDTH_PX: f64 = 190.0;
const LANE_PX: f64 = 6.0;
const FOOT_PX: f64 = 13.0;
/// Room on either side, so that dots at the ends are whole.
const SIDE_PX: f64 = 5.0;
const DOT_PX: f64 = 2.4;
const OWN_DOT_PX: f64 = 3.4;

/// Ratios of the largest value to the smallest for which the scale is logarithmic; beyond them the smallest is a
/// zero that was rounded.
const LOG_RATIOS: std::ops::Range<f64> = 30.0..1e9;
/// So begins the protocol of a number that says how many windows it asks for.
const TOO_FEW: &str = "too few";
/// Fewer values than this are no comparison.
const MIN_VALUES: usize = 2;

/// From the least to the greatest number of a row, across the chart.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Scale {
    low: f64,
    high: f64,
    is_log: bool,
}

impl Scale {
    /// Takes in values and ends of intervals; on a scale of logarithms the values alone count, since ends
    /// may not be above 0.
    ///
    /// None where all are the same.
    fn of(metrics: &[&Metric]) -> Option<Self> {
        let values = || metrics.iter().filter_map(|metric| metric.finite());
        let (low, high) = extent(values());
        if low > 0.0 && LOG_RATIOS.contains(&(high / low)) {
            return Some(Self { low, high, is_log: true });
        }
        let ends = metrics.iter().filter_map(|m| m.interval()).flat_map(|(low, high)| [low, high]);
        let (low, high) = extent(values().chain(ends));
        (high > low).then_some(Self { low, high, is_log: false })
    }

    /// Returns the x of a number; of one beyond the ends that of the end.
    fn x(&self, value: f64) -> f64 {
        let place = |x: f64| if self.is_log { x.max(f64::MIN_POSITIVE).ln() } else { x };
        let (low, high) = (place(self.low), place(self.high));
        // Halves, since the difference of two numbers may be beyond the greatest.
        let share = (place(value) / 2.0 - low / 2.0) / (high / 2.0 - low / 2.0);
        SIDE_PX + share.clamp(0.0, 1.0) * (WIDTH_PX - 2.0 * SIDE_PX)
    }
}

fn extent(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)))
}

/// Returns the class in which a subject has its colour.
pub(super) fn color_class(subject: &str) -> String {
    match names::SUBJECTS.get(names::order(subject)) {
        Some((name, _)) => format!("of-{}", name.replace('_', "-")),
        None => "of-others".to_owned(),
    }
}

/// Returns a number with its interval and what was counted, as a sentence has it.
pub(super) fn told(metric: &Metric) -> String {
    let subject = names::words(&metric.subject);
    match (metric.finite(), metric.interval()) {
        (Some(value), Some((low, high))) => {
            format!("{subject}: {} {}", number(value), interval(low, high))
        }
        (Some(value), None) => format!("{subject}: {}", number(value)),
        (None, _) if metric.is_by_construction() => format!("{subject}: {BY_CONSTRUCTION}"),
        (None, _) if metric.protocol.starts_with(TOO_FEW) => {
            format!("{subject}: {}", metric.protocol)
        }
        (None, _) => format!("{subject}: {TOO_FEW} (n = {})", metric.n),
    }
}

/// A subject as tables and figures name it.
pub(super) struct SubjectKey {
    pub class: String,
    pub words: String,
    pub meaning: &'static str,
}

impl SubjectKey {
    pub fn new(subject: &str) -> Self {
        Self {
            class: color_class(subject),
            words: names::words(subject),
            meaning: names::meaning(subject),
        }
    }
}

/// The chart of a row.
pub(super) struct DotChart {
    pub width_px: f64,
    pub height_px: f64,
    pub lane_px: f64,
    /// Height of all lanes.
    pub lanes_px: f64,
    pub left_px: f64,
    pub middle_px: f64,
    pub right_px: f64,
    pub right: String,
    pub baseline_px: f64,
    pub name: String,
    /// All numbers, as a sentence has them.
    pub numbers: String,
    /// Where zero is, if the scale runs through it.
    pub zero: Option<String>,
    /// Where the number of real motion is.
    pub truth: Option<String>,
    pub marks: Vec<DotMark>,
    pub low: String,
    pub high: String,
    pub is_log: bool,
}

/// The number of a subject, with its interval, in a lane of its own.
pub(super) struct DotMark {
    pub class: String,
    pub number: String,
    pub top_px: f64,
    pub middle_px: f64,
    pub radius_px: f64,
    pub x: String,
    pub interval: Option<(String, String)>,
}

impl DotChart {
    /// Draws a row; nothing where fewer than two subjects have a number, or all the same.
    pub fn new(row: &Row) -> Option<Self> {
        let metrics: Vec<&Metric> =
            row.cells.iter().flatten().copied().filter(|m| m.finite().is_some()).collect();
        if metrics.len() < MIN_VALUES {
            return None;
        }
        let scale = Scale::of(&metrics)?;
        let lanes_px = metrics.len() as f64 * LANE_PX;
        let height_px = lanes_px + FOOT_PX;
        let is_zero_within = !scale.is_log && scale.low < 0.0 && scale.high > 0.0;
        let name = [row.metric, row.variant].map(names::words).join(" ");
        let lanes = metrics.iter().enumerate();
        Some(Self {
            width_px: WIDTH_PX,
            height_px,
            lane_px: LANE_PX,
            lanes_px,
            left_px: SIDE_PX,
            middle_px: WIDTH_PX / 2.0,
            right_px: WIDTH_PX - SIDE_PX,
            right: tenths(WIDTH_PX - SIDE_PX),
            baseline_px: height_px - 2.0,
            name: name.trim_end().to_owned(),
            numbers: metrics.iter().map(|metric| told(metric)).collect::<Vec<_>>().join("; "),
            zero: is_zero_within.then(|| tenths(scale.x(0.0))),
            truth: truth(row).map(|truth| tenths(scale.x(truth))),
            marks: lanes
                .filter_map(|(lane, metric)| DotMark::new(metric, scale, lane as f64 * LANE_PX))
                .collect(),
            low: number(scale.low),
            high: number(scale.high),
            is_log: scale.is_log,
        })
    }
}

impl DotMark {
    fn new(metric: &Metric, scale: Scale, top_px: f64) -> Option<Self> {
        let value = metric.finite()?;
        Some(Self {
            class: color_class(&metric.subject),
            number: told(metric),
            top_px,
            middle_px: top_px + LANE_PX / 2.0,
            radius_px: if metric.subject == OWN { OWN_DOT_PX } else { DOT_PX },
            x: tenths(scale.x(value)),
            interval: metric
                .interval()
                .map(|(low, high)| (tenths(scale.x(low)), tenths(scale.x(high)))),
        })
    }
}

/// Writes a place in the chart, CSS pixels.
pub(super) fn tenths(x: f64) -> String {
    format!("{x:.1}")
}

/// Returns the number of real motion, preferably of music that was not learnt from.
fn truth(row: &Row) -> Option<f64> {
    TRUTHS.into_iter().find_map(|subject| row.of(subject)?.finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::{metric, with_interval};

    fn chart(metrics: &[Metric]) -> String {
        let cells = metrics.iter().map(Some).collect();
        let row = Row { metric: "fid_k", variant: "axes", split: "all", unit: "", cells };
        DotChart::new(&row).map_or_else(String::new, |chart| ChartMarkup { chart }.to_string())
    }

    #[derive(askama::Template)]
    #[template(path = "report/templates/dots.html")]
    struct ChartMarkup {
        chart: DotChart,
    }

    #[test]
    fn all_subjects_are_on_one_scale() {
        let own = with_interval(metric("generated", "all", "fid_k", "axes", Some(3.0)), 2.0, 4.0);
        let truth = metric("held_out_truth", "all", "fid_k", "axes", Some(1.0));
        let told = chart(&[own, truth]);
        // 180 px for 1 to 4.
        assert!(
            told.contains("<path d=\"M65.0 3H185.0\"/><circle cx=\"125.0\" cy=\"3\" r=\"3.4\"/>")
        );
        assert!(told.contains("<circle cx=\"5.0\" cy=\"9\" r=\"2.4\"/>"));
        assert!(
            told.contains("<g class=\"of-held-out-truth\"><title>held out truth: 1.00</title>")
        );
        assert!(told.contains(
            "<title>fid k axes: generated: 3.00 [2.0, 4.0]; held out truth: 1.00</title>"
        ));
        assert!(told.contains("<path class=\"truth\" d=\"M5.0 0V12\"/>"));
        assert!(told.contains(">1.00</text>") && told.contains(">4.00</text>"));
        assert!(!told.contains("log") && !told.contains("class=\"zero\""));
    }

    #[test]
    fn values_far_apart_are_on_a_scale_of_logarithms() {
        let values = [1.0, 10.0, 100.0];
        let metrics = values.map(|x| metric("guest", "all", "fid_k", "axes", Some(x)));
        let told = chart(&metrics);
        for (x, y) in [("5.0", 3), ("95.0", 9), ("185.0", 15)] {
            assert!(told.contains(&format!("<circle cx=\"{x}\" cy=\"{y}\"")), "{told}");
        }
        assert!(told.contains(">log</text>"));
        // An end below 0 has no logarithm.
        let wide = metrics.map(|m| with_interval(m, -1.0, 20.0));
        assert!(chart(&wide).contains("<path d=\"M5.0 9H122.1\"/>"), "{}", chart(&wide));
    }

    #[test]
    fn one_number_is_no_comparison_nor_are_equal_ones() {
        let fid_metric = |x: Option<f64>| metric("generated", "all", "fid_k", "axes", x);
        assert_eq!(
            chart(&[fid_metric(Some(1.0)), fid_metric(None), fid_metric(Some(f64::NAN))]),
            ""
        );
        assert_eq!(chart(&[fid_metric(Some(0.0)), fid_metric(Some(0.0))]), "");
        let told = chart(&[fid_metric(Some(7.0)), with_interval(fid_metric(Some(7.0)), 6.0, 8.0)]);
        assert_eq!(told.matches("<circle cx=\"95.0\"").count(), 2, "{told}");
        assert!(
            chart(&[fid_metric(Some(-1.0)), fid_metric(Some(1.0))])
                .contains("class=\"zero\" d=\"M95.0 ")
        );
        // A rounded zero is no reason for fourteen decades.
        assert!(!chart(&[fid_metric(Some(1e-14)), fid_metric(Some(1.0))]).contains("log"));
    }

    #[test]
    fn what_is_too_little_is_told_so() {
        let metric = Metric { n: 12, ..metric("mean_motion", "all", "fid_k", "axes", None) };
        assert_eq!(told(&metric), "mean motion: too few (n = 12)");
        let protocol = "the phase is relocked, by construction".to_owned();
        assert_eq!(told(&Metric { protocol, ..metric }), "mean motion: by construction");
    }
}
