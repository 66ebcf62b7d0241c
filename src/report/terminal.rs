//! The report as text, for a terminal.

use std::fmt::Write as _;

use super::comparison::{Verdict, pairs};
use super::grid::subjects;
use super::numbers::{number, value, words};
use super::{CheckLine, Report};

/// Numbers that a terminal shows; the page has all of them.
const KEY: [(&str, &str); 11] = [
    ("pass_rate", "reference"),
    ("pass_rate", "strict"),
    ("locking_r2", "per_song"),
    ("locking_wrong_r2", "per_song"),
    ("locking_p", "per_song"),
    ("beat_alignment_lift", "music_to_motion 0.1 s"),
    ("fid_k", "axes"),
    ("fid_g", ""),
    ("diversity", "axes"),
    ("mean_speed", ""),
    ("jerk_mean", ""),
];

/// Returns the report as text.
pub fn terminal(report: &Report) -> String {
    let mut out = String::new();
    for set in ["reference", "strict"] {
        checks(&mut out, set, report);
    }
    numbers(&mut out, report);
    compared(&mut out, report);
    out
}

fn checks(out: &mut String, set: &str, report: &Report) {
    let lines: Vec<&CheckLine> = report.checks.iter().filter(|line| line.set == set).collect();
    if lines.is_empty() {
        return;
    }
    let n_all = lines.iter().filter(|line| line.n_passed == line.n).count();
    let _ = writeln!(out, "{set} checks: all motions pass {n_all} of {}", lines.len());
    for line in lines.iter().filter(|line| line.n_passed < line.n) {
        let CheckLine { check, n, n_passed, worst_message, .. } = line;
        let _ = writeln!(out, "  {check}: {n_passed} of {n} pass; the worst: {worst_message}");
    }
}

/// A table of the key numbers, a column for each subject.
fn numbers(out: &mut String, report: &Report) {
    if report.metrics.is_empty() {
        return;
    }
    let split = report.main_split();
    let columns = subjects(&report.metrics);
    let mut rows: Vec<Vec<String>> = Vec::new();
    rows.push(std::iter::once(words(split)).chain(columns.iter().map(|s| words(s))).collect());
    for (metric, variant) in KEY {
        let cells: Vec<_> =
            columns.iter().map(|s| report.find(s, split, metric, variant)).collect();
        let Some(first) = cells.iter().flatten().next() else { continue };
        let mut name = words(metric);
        for more in [variant, first.unit.as_str()].into_iter().filter(|more| !more.is_empty()) {
            name = format!("{name}, {}", words(more));
        }
        let cell = |m: &Option<&super::Metric>| m.map_or(String::new(), |m| value(m.value));
        rows.push(std::iter::once(name).chain(cells.iter().map(cell)).collect());
    }
    let width = |i: usize| rows.iter().map(|row| row[i].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..=columns.len()).map(width).collect();
    out.push('\n');
    for row in &rows {
        let mut line = format!("{:<1$}", row[0], widths[0]);
        for (cell, width) in row[1..].iter().zip(&widths[1..]) {
            let _ = write!(line, "  {cell:>width$}");
        }
        let _ = writeln!(out, "{}", line.trim_end());
    }
}

fn compared(out: &mut String, report: &Report) {
    let Some(against) = &report.against else { return };
    let _ = writeln!(out, "\nagainst run {}:", against.run);
    for (name, there, here) in &against.settings {
        let _ = writeln!(out, "  {name}: {there} there, {here} here");
    }
    let pairs = pairs(report, against);
    let changed: Vec<_> = pairs
        .iter()
        .filter(|pair| matches!(pair.verdict, Verdict::Better | Verdict::Worse | Verdict::Differs))
        .filter(|pair| pair.here.split == report.main_split())
        .collect();
    if changed.is_empty() {
        out.push_str("  nothing differs beyond the intervals\n");
    }
    for pair in changed {
        let name = [&pair.here.metric, &pair.here.variant].map(|text| words(text)).join(" ");
        let [there, here] = [pair.there, pair.here].map(|m| value(m.value));
        let (change, verdict) = (number(pair.difference), pair.verdict.text());
        let _ = writeln!(
            out,
            "  {}: {there} there, {here} here ({change}), {verdict}",
            name.trim_end()
        );
    }
}
