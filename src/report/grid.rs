//! Numbers side by side: a row for each metric and variant, a column for each subject.

use std::collections::BTreeMap;

use super::meaning::{is_compat, meaning_of, order_of};
use super::{Metric, SUBJECTS};

/// A metric of all subjects.
#[derive(Debug)]
pub struct GridRow<'a> {
    pub metric: &'a str,
    pub variant: &'a str,
    pub unit: &'a str,
    /// In the order of the grid's subjects.
    pub cells: Vec<Option<&'a Metric>>,
}

/// Numbers of one section.
#[derive(Debug)]
pub struct Grid<'a> {
    pub subjects: Vec<&'a str>,
    pub rows: Vec<GridRow<'a>>,
}

/// Returns the subjects that have numbers, in order.
pub fn subjects<'a>(metrics: impl IntoIterator<Item = &'a Metric>) -> Vec<&'a str> {
    let mut found: Vec<&str> = metrics.into_iter().map(|m| m.subject.as_str()).collect();
    found.sort_unstable();
    found.dedup();
    let place = |name: &str| SUBJECTS.iter().position(|known| *known == name);
    found.sort_by_key(|name| place(name).unwrap_or(SUBJECTS.len()));
    found
}

impl<'a> Grid<'a> {
    /// Puts the numbers of a section side by side, those of `is_wanted` metrics; what only repeats published
    /// defects comes last.
    pub fn new(metrics: &'a [Metric], section: usize, is_wanted: impl Fn(&Metric) -> bool) -> Self {
        let is_of_section = |m: &&Metric| meaning_of(&m.metric).section == section && is_wanted(m);
        let metrics: Vec<&Metric> = metrics.iter().filter(is_of_section).collect();
        let subjects = subjects(metrics.iter().copied());
        let mut rows: BTreeMap<_, GridRow<'a>> = BTreeMap::new();
        for m in metrics {
            let key =
                (is_compat(&m.variant), order_of(&m.metric), m.metric.as_str(), m.variant.as_str());
            let row = rows.entry(key).or_insert_with(|| GridRow {
                metric: &m.metric,
                variant: &m.variant,
                unit: &m.unit,
                cells: vec![None; subjects.len()],
            });
            if let Some(i) = subjects.iter().position(|name| *name == m.subject) {
                row.cells[i] = Some(m);
            }
        }
        Self { subjects, rows: rows.into_values().collect() }
    }
}
