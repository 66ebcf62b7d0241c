//! The sections of metrics: a table each, with a column for every subject and a chart in every row.

use askama::Template;

use super::channels::BarFigure;
use super::chart::{DotChart, SubjectKey};
use super::meaning::{CHANNELS, Section, meaning_of};
use super::names::{self, music, words};
use super::numbers::{MISSING, interval, value};
use super::rows::{Row, rows, subjects};
use super::{BY_CONSTRUCTION, BetterDirection, Metric, Report};

/// The note on variants that reproduce a published formula.
pub(super) const COMPAT: &str = "These reproduce a published formula that has a defect, a misplaced parenthesis in \
                      its acceleration, and are only for comparison with published numbers.";

/// The section that says what the numbers are held against, in links, and its heading.
pub(super) const SUBJECTS_ID: &str = "subjects";
pub(super) const SUBJECTS_HEADING: &str = "What it is held against";

/// Returns the sections that have numbers.
pub(super) fn sections(report: &Report) -> Vec<Section> {
    let has_numbers = |section: &Section| {
        report.metrics.iter().any(|metric| meaning_of(&metric.metric).section == *section)
    };
    Section::ALL.into_iter().filter(has_numbers).collect()
}

/// What the subjects are, and a section for every question.
#[derive(Template)]
#[template(path = "report/templates/metrics.html")]
pub(super) struct MetricsSections<'a> {
    subjects: Vec<SubjectKey>,
    sections: Vec<MetricSection<'a>>,
}

struct MetricSection<'a> {
    id: &'static str,
    heading: &'static str,
    plain: Option<MetricTable<'a>>,
    channels: Option<ChannelFigures>,
    /// Numbers that reproduce a published formula with a defect.
    compat: Option<MetricTable<'a>>,
}

struct MetricTable<'a> {
    columns: Vec<SubjectKey>,
    n_columns: usize,
    bodies: Vec<MetricBody<'a>>,
}

/// The rows of a metric under what it means.
struct MetricBody<'a> {
    metric: &'a str,
    text: &'static str,
    ideal: &'static str,
    way: Option<&'static str>,
    rows: Vec<MetricRow<'a>>,
}

struct MetricRow<'a> {
    variant: String,
    music: String,
    unit: &'a str,
    cells: Vec<MetricCell>,
    chart: Option<DotChart>,
}

struct MetricCell {
    class: &'static str,
    title: String,
    text: String,
    interval: Option<String>,
}

/// A figure for each split that has distances of channels.
struct ChannelFigures {
    metric: &'static str,
    text: &'static str,
    ideal: &'static str,
    figures: Vec<BarFigure>,
}

impl<'a> MetricsSections<'a> {
    /// Takes the numbers of a report; none where there are none.
    pub fn new(report: &'a Report) -> Option<Self> {
        let subjects = subjects(&report.metrics);
        if subjects.is_empty() {
            return None;
        }
        let rows = rows(&report.metrics, &subjects);
        let section = |section: Section| {
            let section_rows: Vec<&Row<'a>> =
                rows.iter().filter(|row| meaning_of(row.metric).section == section).collect();
            let (channels, numbers): (Vec<&Row>, Vec<&Row>) =
                section_rows.into_iter().partition(|row| row.metric == CHANNELS);
            let (compat, plain): (Vec<&Row>, Vec<&Row>) =
                numbers.into_iter().partition(|row| row.is_compat());
            MetricSection {
                id: section.id(),
                heading: section.heading(),
                plain: MetricTable::new(&plain, &subjects),
                channels: ChannelFigures::new(&channels),
                compat: MetricTable::new(&compat, &subjects),
            }
        };
        let sections = sections(report).into_iter().map(section).collect();
        Some(Self {
            subjects: subjects.iter().map(|name| SubjectKey::new(name)).collect(),
            sections,
        })
    }
}

impl<'a> MetricTable<'a> {
    /// Takes rows, those of a metric under what it means; none where there are none.
    fn new(rows: &[&Row<'a>], subjects: &[&str]) -> Option<Self> {
        if rows.is_empty() {
            return None;
        }
        // What was asked is measured of what was generated alone; columns for others would be empty.
        let is_asked = rows.iter().all(|row| row.is_asked());
        let columns: Vec<usize> = (0..subjects.len())
            .filter(|i| !is_asked || rows.iter().any(|row| row.cells[*i].is_some()))
            .collect();
        let bodies = rows.chunk_by(|a, b| a.metric == b.metric);
        Some(Self {
            columns: columns.iter().map(|i| SubjectKey::new(subjects[*i])).collect(),
            // The name of the row, and the chart.
            n_columns: columns.len() + 2,
            bodies: bodies.map(|rows| MetricBody::new(rows, &columns)).collect(),
        })
    }
}

impl<'a> MetricBody<'a> {
    fn new(rows: &[&Row<'a>], columns: &[usize]) -> Self {
        let first = rows[0];
        let meaning = meaning_of(first.metric);
        Self {
            metric: first.metric,
            text: meaning.text,
            ideal: meaning.ideal,
            way: match first.better() {
                BetterDirection::Higher => Some("↑ higher is better"),
                BetterDirection::Lower => Some("↓ lower is better"),
                BetterDirection::Neither => None,
            },
            rows: rows
                .iter()
                .map(|row| MetricRow {
                    variant: words(row.variant),
                    music: music(row.split),
                    unit: row.unit,
                    cells: columns.iter().map(|i| MetricCell::new(row, row.cells[*i])).collect(),
                    chart: DotChart::new(row),
                })
                .collect(),
        }
    }
}

impl MetricCell {
    fn new(row: &Row, metric: Option<&Metric>) -> Self {
        let Some(metric) = metric else {
            let text = if row.is_asked() { "" } else { MISSING }.to_owned();
            return Self { class: "", title: "not measured".to_owned(), text, interval: None };
        };
        let title = tooltip(metric);
        if metric.finite().is_none() && metric.is_by_construction() {
            return Self { class: "moot", title, text: BY_CONSTRUCTION.to_owned(), interval: None };
        }
        Self {
            class: if metric.subject == names::OWN { "own" } else { "" },
            title,
            text: value(metric.value),
            interval: metric.interval().map(|(low, high)| interval(low, high)),
        }
    }
}

impl ChannelFigures {
    fn new(rows: &[&Row]) -> Option<Self> {
        let mut splits: Vec<&str> = Vec::new();
        for row in rows {
            if !splits.contains(&row.split) {
                splits.push(row.split);
            }
        }
        if splits.is_empty() {
            return None;
        }
        let meaning = meaning_of(CHANNELS);
        let figure = |split: &str| {
            let of_split: Vec<&Row> =
                rows.iter().copied().filter(|row| row.split == split).collect();
            BarFigure::new(&of_split, &music(split))
        };
        Some(Self {
            metric: CHANNELS,
            text: meaning.text,
            ideal: meaning.ideal,
            figures: splits.into_iter().map(figure).collect(),
        })
    }
}

/// Returns what a number rests on.
fn tooltip(metric: &Metric) -> String {
    let counted = match metric.finite() {
        Some(_) => format!("n = {}", metric.n),
        None if metric.is_by_construction() => return metric.protocol.clone(),
        None => format!("too few (n = {})", metric.n),
    };
    if metric.protocol.is_empty() { counted } else { format!("{counted}; {}", metric.protocol) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::{metric, with_interval};

    fn told(metrics: Vec<Metric>) -> String {
        let report = Report { metrics, ..Report::default() };
        format!("{}\n", MetricsSections::new(&report).expect("numbers"))
    }

    #[test]
    fn a_number_has_its_interval_and_what_it_rests_on() {
        let own = Metric {
            n: 120,
            protocol: "chunks of 75 \"frames\"".to_owned(),
            ..with_interval(
                metric("generated", "held_out", "fid_k", "axes", Some(0.1234)),
                0.1,
                0.15,
            )
        };
        let few = Metric { n: 12, ..metric("mean_motion", "held_out", "fid_k", "axes", None) };
        let truth = metric("training_truth", "all", "fid_k", "axes", Some(0.01));
        let told = told(vec![own, few, truth, metric("retrieval", "all", "fid_g", "", Some(1.0))]);
        for wanted in [
            "<td class=\"own\" title=\"n = 120; chunks of 75 &quot;frames&quot;\">0.123 \
             <span class=\"interval\">[0.10, 0.15]</span></td>",
            "<td title=\"not measured\">–</td><td title=\"too few (n = 12)\">–</td>",
            "<td title=\"n = 100\">0.0100</td>",
            "<th scope=\"row\">axes <small>held-out music</small></th>",
            "<code>fid_k</code> Fréchet distance of speeds and accelerations",
            "<em>↓ lower is better</em>",
        ] {
            assert!(told.contains(wanted), "{wanted} in {told}");
        }
    }

    #[test]
    fn sections_and_subjects_are_in_order() {
        let told = told(vec![
            metric("visitor", "all", "new_metric", "", Some(1.0)),
            metric("generated", "all", "pass_rate", "strict", Some(1.0)),
            metric("shuffled", "all", "locking_p", "per_song", Some(1.0)),
            metric("generated", "all", "control_position", "largest", Some(1.0)),
        ]);
        let headings: Vec<&str> =
            told.split("<h2>").skip(2).filter_map(|rest| rest.split('<').next()).collect();
        assert_eq!(
            headings,
            ["Does it follow its music?", "Is it sound?", "Does it do what was asked?", "Other"]
        );
        let columns = |table: &str| -> Vec<String> {
            let (head, _) = table.split_once("</thead>").expect("a head");
            let names = head.split("<span class=\"key ").skip(1);
            names.filter_map(|rest| Some(rest.split(['>', '<']).nth(1)?.to_owned())).collect()
        };
        let tables: Vec<Vec<String>> = told.split("<table").skip(1).map(columns).collect();
        let all = ["generated", "shuffled", "visitor"];
        assert_eq!(tables[0], all);
        assert_eq!(tables[1], all);
        assert_eq!(tables[2], ["generated"]);
        assert_eq!(tables[3], all);
        assert!(told.contains("<code>new_metric</code>"));
    }

    #[test]
    fn every_subject_is_explained() {
        let told = told(vec![
            metric("untrained", "all", "fid_g", "", Some(1.0)),
            metric("ground_truth", "all", "fid_g", "", Some(1.0)),
            metric("visitor", "all", "fid_g", "", Some(1.0)),
        ]);
        let (legend, _) = told.split_once("</dl>").expect("a legend");
        assert_eq!(
            legend,
            "<section id=\"subjects\">\n<h2>What it is held against</h2>\n<dl class=\"legend\">\n<div><dt \
             class=\"key of-untrained\">untrained</dt><dd>the run’s own network with its first weights: what \
             sampler and post-processing give before anything is learned</dd></div>\n<div><dt class=\"key \
             of-ground-truth\">ground truth</dt><dd>all real motion, as evaluations of release 0.1 have \
             it</dd></div>\n<div><dt class=\"key of-others\">visitor</dt><dd></dd></div>\n"
        );
    }

    #[test]
    fn a_number_that_post_processing_makes_is_none() {
        let relocked = Metric {
            protocol: "the phase is relocked to the music, by <construction>".to_owned(),
            ..metric("generated", "all", "phase_error", "", None)
        };
        let protocol = relocked.protocol.replace(['<', '>'], "");
        let told = told(vec![
            Metric { protocol, ..relocked.clone() },
            metric("shuffled", "all", "phase_error", "", Some(0.25)),
            Metric { subject: "visitor".to_owned(), ..relocked },
        ]);
        assert!(told.contains(
            "<td class=\"moot\" title=\"the phase is relocked to the music, by construction\">by \
             construction</td>"
        ));
        assert!(told.contains(
            "title=\"too few (n = 100); the phase is relocked to the music, by &lt;construction&gt;\">–</td>"
        ));
    }

    #[test]
    fn what_reproduces_a_defect_is_set_apart_at_the_end() {
        let told = told(vec![
            metric("generated", "all", "fid_k", "axes_compat", Some(7.0)),
            metric("generated", "all", "fid_g", "", Some(1.0)),
            metric("generated", "all", "channel_distance", "velocity_x", Some(1.0)),
        ]);
        let at = |text: &str| told.find(text).unwrap_or_else(|| panic!("no {text}"));
        assert!(at(">fid_g<") < at("Channel by channel"));
        assert!(at("Channel by channel") < at(COMPAT) && at(COMPAT) < at(">7.00<"));
        assert_eq!(told.matches("<table").count(), 2);
        assert_eq!(told.matches(">velocity x</text>").count(), 1);
    }
}
