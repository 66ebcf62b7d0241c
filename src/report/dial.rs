//! What consistency does: runs of groups of one model side by side, a row for each γ, and a figure for each number.

use askama::Template;

use super::chart::tenths;
use super::meaning::meaning_of;
use super::names::{OWN, music, words};
use super::numbers::{MISSING, interval, number, value};
use super::rows::telling_split;
use super::{DialRun, Metric, Report};

/// Numbers that are followed over γ, by metric and variant.
const FOLLOWED: [[&str; 2]; 7] = [
    ["unison_index", ""],
    ["gmc_correlation", ""],
    ["tif", ""],
    ["dancer_diversity", ""],
    ["dancer_velocity_difference", ""],
    ["fid_k", "axes"],
    ["group_locking", ""],
];

/// Sizes in CSS pixels.
const WIDTH_PX: f64 = 240.0;
const HEIGHT_PX: f64 = 120.0;
/// Room on either side for numbers.
const SIDE_PX: f64 = 34.0;
const TOP_PX: f64 = 8.0;
const FOOT_PX: f64 = 18.0;

/// The section.
#[derive(Template)]
#[template(path = "report/templates/dial.html")]
pub(super) struct DialSection<'a> {
    music: String,
    columns: Vec<DialColumn>,
    rows: Vec<DialRow<'a>>,
    figures: Vec<DialFigure>,
}

struct DialColumn {
    name: String,
    text: &'static str,
}

struct DialRow<'a> {
    gamma: String,
    run: &'a str,
    class: &'static str,
    cells: Vec<DialCell>,
}

struct DialCell {
    title: String,
    value: String,
    interval: Option<String>,
}

/// A number over γ.
struct DialFigure {
    name: String,
    numbers: String,
    width_px: f64,
    height_px: f64,
    left: String,
    right: String,
    baseline: String,
    foot: String,
    line: String,
    points: Vec<DialPoint>,
    low: String,
    low_y: String,
    high: String,
    high_y: String,
}

struct DialPoint {
    x: String,
    y: String,
    ends: Option<(String, String)>,
    title: String,
}

/// Returns the number of a run that is followed.
fn followed<'a>(run: &'a DialRun, split: &str, [metric, variant]: [&str; 2]) -> Option<&'a Metric> {
    run.metrics.iter().find(|number| {
        number.subject == OWN
            && number.split == split
            && number.metric == metric
            && number.variant == variant
    })
}

fn name_of([metric, variant]: [&str; 2]) -> String {
    format!("{} {}", words(metric), words(variant)).trim_end().to_owned()
}

impl<'a> DialSection<'a> {
    /// Takes the runs of a report; none where there are fewer than two.
    pub fn new(report: &'a Report) -> Option<Self> {
        if report.dial.len() < 2 {
            return None;
        }
        let split = telling_split(&report.metrics, FOLLOWED[0]);
        let cell = |run: &DialRun, name: [&str; 2]| {
            let found = followed(run, split, name);
            DialCell {
                title: found.map(|metric| metric.protocol.clone()).unwrap_or_default(),
                value: value(found.and_then(Metric::finite)),
                interval: found.and_then(Metric::interval).map(|(low, high)| interval(low, high)),
            }
        };
        let rows = report.dial.iter().map(|run| DialRow {
            gamma: run.consistency.to_string(),
            run: &run.run,
            class: if run.is_this { "own" } else { "" },
            cells: FOLLOWED.iter().map(|&name| cell(run, name)).collect(),
        });
        Some(Self {
            music: music(split),
            columns: FOLLOWED
                .iter()
                .map(|&name| DialColumn { name: name_of(name), text: meaning_of(name[0]).text })
                .collect(),
            rows: rows.collect(),
            figures: FOLLOWED
                .iter()
                .filter_map(|&name| DialFigure::new(&report.dial, split, name))
                .collect(),
        })
    }
}

impl DialFigure {
    /// Draws a number over γ; nothing where fewer than two runs have it.
    fn new(runs: &[DialRun], split: &str, name: [&str; 2]) -> Option<Self> {
        let known: Vec<(f64, &Metric)> = runs
            .iter()
            .filter_map(|run| Some((run.consistency, followed(run, split, name)?)))
            .filter(|(_, metric)| metric.finite().is_some())
            .collect();
        if known.len() < 2 {
            return None;
        }
        let ends = known.iter().flat_map(|(_, metric)| {
            let interval = metric.interval().map(|(low, high)| [Some(low), Some(high)]);
            interval.unwrap_or_default().into_iter().flatten().chain(metric.finite())
        });
        let (mut low, mut high) =
            ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        if high <= low {
            (low, high) = (low - 0.5, high + 0.5);
        }
        let bottom = HEIGHT_PX - FOOT_PX;
        let x_of = |gamma: f64| SIDE_PX + (gamma + 1.0) / 2.0 * (WIDTH_PX - 2.0 * SIDE_PX);
        let y_of =
            |x: f64| bottom - (x / 2.0 - low / 2.0) / (high / 2.0 - low / 2.0) * (bottom - TOP_PX);
        let mut line = String::new();
        let mut points = Vec::new();
        for (i, (gamma, metric)) in known.iter().enumerate() {
            let at = metric.finite()?;
            let (x, y) = (tenths(x_of(*gamma)), tenths(y_of(at)));
            line.push_str(&format!("{}{x} {y}", if i == 0 { "M" } else { "L" }));
            let ends = metric.interval();
            let words = ends.map(|(low, high)| interval(low, high)).unwrap_or_default();
            points.push(DialPoint {
                title: format!("γ {gamma}: {} {words}", number(at)).trim_end().to_owned(),
                ends: ends.map(|(low, high)| (tenths(y_of(low)), tenths(y_of(high)))),
                x,
                y,
            });
        }
        let numbers: Vec<String> = points.iter().map(|point| point.title.clone()).collect();
        Some(Self {
            name: name_of(name),
            numbers: numbers.join("; "),
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            left: tenths(x_of(-1.0)),
            right: tenths(x_of(1.0)),
            baseline: tenths(bottom),
            foot: tenths(HEIGHT_PX - 4.0),
            line,
            points,
            low: number(low),
            low_y: tenths(bottom),
            high: number(high),
            high_y: tenths(TOP_PX + 6.0),
        })
    }
}

/// Returns a line for each γ, as a terminal has them; nothing for fewer than two runs.
pub(super) fn lines(report: &Report) -> Vec<String> {
    if report.dial.len() < 2 {
        return Vec::new();
    }
    let split = telling_split(&report.metrics, FOLLOWED[0]);
    let mut lines = vec![format!("consistency, {}", music(split))];
    for run in &report.dial {
        let numbers = FOLLOWED.iter().map(|&name| {
            let found = followed(run, split, name);
            let told = found.and_then(Metric::finite).map_or(MISSING.to_owned(), number);
            let ends = found.and_then(Metric::interval);
            let ends = ends.map(|(low, high)| format!(" {}", interval(low, high)));
            format!("{} {told}{}", name_of(name), ends.unwrap_or_default())
        });
        let numbers: Vec<String> = numbers.collect();
        lines.push(format!("γ {} ({}): {}", run.consistency, run.run, numbers.join(", ")));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::{metric, with_interval};

    fn run(consistency: f64, unison: Option<f64>) -> DialRun {
        let index = metric(OWN, "held_out", "unison_index", "", unison);
        let index = match unison {
            Some(x) => with_interval(index, x - 0.1, x + 0.1),
            None => index,
        };
        let tif = metric(OWN, "held_out", "tif", "", Some(0.0));
        let metrics = vec![index, tif];
        DialRun {
            run: format!("g{consistency}"),
            consistency,
            is_this: consistency == 0.0,
            metrics,
        }
    }

    fn report(dial: Vec<DialRun>) -> Report {
        let metrics = dial.first().map(|run| run.metrics.clone()).unwrap_or_default();
        Report { dial, metrics, ..Report::default() }
    }

    #[test]
    fn there_is_a_row_for_each_gamma_and_a_figure_for_each_number() {
        let report = report(vec![run(-1.0, Some(0.2)), run(0.0, Some(0.5)), run(1.0, None)]);
        let section = DialSection::new(&report).expect("three runs");
        assert_eq!(section.rows.len(), 3);
        let told = section.to_string();
        assert!(
            told.contains("<th scope=\"row\">-1</th>")
                && told.contains("<td class=\"text\">g-1</td>")
        );
        // Two runs have the index, three the frequency.
        assert_eq!(told.matches("<circle ").count(), 5, "{told}");
        assert_eq!(section.figures.len(), 2);
        // −1 is at the left, 0 in the middle; 0.1 is the lowest end of an interval and 0.6 the highest.
        let index = &section.figures[0];
        assert_eq!((index.points[0].x.as_str(), index.points[1].x.as_str()), ("34.0", "120.0"));
        let y = |i: usize| index.points[i].ends.clone().expect("an interval");
        assert_eq!((y(0).0.as_str(), y(1).1.as_str()), ("102.0", "8.0"));
        assert_eq!(index.line, "M34.0 83.2L120.0 26.8");
        let lines = lines(&report);
        assert_eq!(lines.len(), 4);
        assert!(lines[1].starts_with("γ -1 (g-1): unison index 0.200 [0.1"), "{}", lines[1]);
        assert!(
            lines[3].starts_with("γ 1 (g1): unison index –, gmc correlation –"),
            "{}",
            lines[3]
        );
    }

    #[test]
    fn one_run_is_no_comparison() {
        let report = report(vec![run(0.5, Some(0.2))]);
        assert!(DialSection::new(&report).is_none() && lines(&report).is_empty());
    }
}
