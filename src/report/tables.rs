//! The sections of metrics: a table each, with a column for every subject and a chart in every row.

use super::html::{Escaped, put};
use super::meaning::{CHANNELS, Section, meaning_of};
use super::names::{self, music, words};
use super::numbers::{MISSING, interval, value};
use super::rows::{Row, rows, subjects};
use super::{BY_CONSTRUCTION, BetterDirection, Metric, Report, channels, chart};

/// The note on variants that reproduce a published formula.
const COMPAT: &str = "These reproduce a published formula that has a defect, a misplaced parenthesis in \
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

/// Writes what the subjects are, and a section for every question.
pub(super) fn metrics(out: &mut String, report: &Report) {
    let subjects = subjects(&report.metrics);
    if subjects.is_empty() {
        return;
    }
    legend(out, &subjects);
    let rows = rows(&report.metrics, &subjects);
    for section in sections(report) {
        let section_rows: Vec<&Row> =
            rows.iter().filter(|row| meaning_of(row.metric).section == section).collect();
        put!(out, "<section id=\"{}\">\n<h2>{}</h2>\n", section.id(), section.heading());
        let (channels, numbers): (Vec<&Row>, Vec<&Row>) =
            section_rows.into_iter().partition(|row| row.metric == CHANNELS);
        let (compat, plain): (Vec<&Row>, Vec<&Row>) =
            numbers.into_iter().partition(|row| row.is_compat());
        table(out, &plain, &subjects);
        channel_figures(out, &channels);
        if !compat.is_empty() {
            put!(out, "<h3>As published</h3>\n<p>{COMPAT}</p>\n");
            table(out, &compat, &subjects);
        }
        put!(out, "</section>\n");
    }
}

fn legend(out: &mut String, subjects: &[&str]) {
    put!(
        out,
        "<section id=\"{SUBJECTS_ID}\">\n<h2>{SUBJECTS_HEADING}</h2>\n<dl class=\"legend\">\n"
    );
    for subject in subjects {
        put!(
            out,
            "<div><dt class=\"key {}\">{}</dt><dd>{}</dd></div>\n",
            chart::color_class(subject),
            Escaped(&words(subject)),
            names::meaning(subject)
        );
    }
    put!(out, "</dl>\n</section>\n");
}

/// Writes rows as a table, those of a metric under what it means.
fn table(out: &mut String, rows: &[&Row], subjects: &[&str]) {
    if rows.is_empty() {
        return;
    }
    // What was asked is measured of what was generated alone; columns for others would be empty.
    let is_asked = rows.iter().all(|row| row.is_asked());
    let columns: Vec<usize> = (0..subjects.len())
        .filter(|i| !is_asked || rows.iter().any(|row| row.cells[*i].is_some()))
        .collect();
    put!(
        out,
        "<div class=\"scroll\"><table class=\"metrics\">\n<thead><tr><th scope=\"col\"></th>"
    );
    for i in &columns {
        put!(
            out,
            "<th scope=\"col\" title=\"{}\"><span class=\"key {}\">{}</span></th>",
            names::meaning(subjects[*i]),
            chart::color_class(subjects[*i]),
            Escaped(&words(subjects[*i]))
        );
    }
    put!(out, "<th scope=\"col\">all on one scale</th></tr></thead>\n");
    for of_metric in rows.chunk_by(|a, b| a.metric == b.metric) {
        put!(out, "<tbody>\n");
        heading(out, of_metric[0], columns.len() + 2);
        for row in of_metric {
            line(out, row, &columns);
        }
        put!(out, "</tbody>\n");
    }
    put!(out, "</table></div>\n");
}

fn heading(out: &mut String, row: &Row, n_columns: usize) {
    let meaning = meaning_of(row.metric);
    let way = match row.better() {
        BetterDirection::Higher => "<em>↑ higher is better</em>",
        BetterDirection::Lower => "<em>↓ lower is better</em>",
        BetterDirection::Neither => "",
    };
    put!(
        out,
        "<tr class=\"about\"><th colspan=\"{n_columns}\" scope=\"rowgroup\"><div><code>{}</code> {} {} \
         {way}</div></th></tr>\n",
        Escaped(row.metric),
        meaning.text,
        meaning.ideal
    );
}

fn line(out: &mut String, row: &Row, columns: &[usize]) {
    put!(out, "<tr><th scope=\"row\">");
    if !row.variant.is_empty() {
        put!(out, "{} ", Escaped(&words(row.variant)));
    }
    put!(out, "<small>{}", Escaped(&music(row.split)));
    if !row.unit.is_empty() {
        put!(out, ", {}", Escaped(row.unit));
    }
    put!(out, "</small></th>");
    for i in columns {
        cell(out, row, row.cells[*i]);
    }
    put!(out, "<td class=\"chart\">");
    chart::dots(out, row);
    put!(out, "</td></tr>\n");
}

fn cell(out: &mut String, row: &Row, metric: Option<&Metric>) {
    let Some(metric) = metric else {
        let missing = if row.is_asked() { "" } else { MISSING };
        put!(out, "<td title=\"not measured\">{missing}</td>");
        return;
    };
    if metric.finite().is_none() && metric.is_by_construction() {
        put!(
            out,
            "<td class=\"moot\" title=\"{}\">{BY_CONSTRUCTION}</td>",
            Escaped(&tooltip(metric))
        );
        return;
    }
    let class = if metric.subject == names::OWN { " class=\"own\"" } else { "" };
    put!(out, "<td{class} title=\"{}\">{}", Escaped(&tooltip(metric)), value(metric.value));
    if let Some((low, high)) = metric.interval() {
        put!(out, " <span class=\"interval\">{}</span>", interval(low, high));
    }
    put!(out, "</td>");
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

/// Writes a figure for each split that has distances of channels.
fn channel_figures(out: &mut String, rows: &[&Row]) {
    let mut splits: Vec<&str> = Vec::new();
    for row in rows {
        if !splits.contains(&row.split) {
            splits.push(row.split);
        }
    }
    if splits.is_empty() {
        return;
    }
    let meaning = meaning_of(CHANNELS);
    put!(
        out,
        "<h3>Channel by channel</h3>\n<p><code>{CHANNELS}</code> {} {}</p>\n<div class=\"figures\">\n",
        meaning.text,
        meaning.ideal
    );
    for split in splits {
        let split_rows: Vec<&Row> = rows.iter().copied().filter(|row| row.split == split).collect();
        channels::bars(out, &split_rows, &music(split));
    }
    put!(out, "</div>\n");
}

#[cfg(test)]
mod tests {
    use super::super::example::{metric, with_interval};
    use super::*;

    fn told(metrics: Vec<Metric>) -> String {
        let mut out = String::new();
        super::metrics(&mut out, &Report { metrics, ..Report::default() });
        out
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
