//! Numbers side by side: one row for a metric, its variant and the music, one cell for a subject.

use super::meaning::{self, is_asked, is_compat};
use super::names::{self, ALL, HELD_OUT, OWN, is_truth};
use super::{BetterDirection, Metric};

/// A number of every subject.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Row<'a> {
    pub metric: &'a str,
    pub variant: &'a str,
    pub split: &'a str,
    pub unit: &'a str,
    /// In the order of the subjects; a truth may be of other music than the row.
    pub cells: Vec<Option<&'a Metric>>,
}

impl Row<'_> {
    pub fn better(&self) -> BetterDirection {
        self.cells.iter().flatten().next().map_or(BetterDirection::Neither, |metric| metric.better)
    }

    pub fn is_compat(&self) -> bool {
        is_compat(self.variant)
    }

    pub fn is_asked(&self) -> bool {
        is_asked(self.metric)
    }

    /// Returns the number of a subject.
    pub fn of(&self, subject: &str) -> Option<&Metric> {
        self.cells.iter().flatten().find(|metric| metric.subject == subject).copied()
    }

    fn is_of(&self, metric: &Metric) -> bool {
        self.metric == metric.metric && self.variant == metric.variant && self.unit == metric.unit
    }

    fn has_only_truths(&self) -> bool {
        self.cells.iter().flatten().all(|metric| is_truth(&metric.subject))
    }
}

/// Returns the subjects that occur: those that are known in their order, then the others as they come.
pub(super) fn subjects(metrics: &[Metric]) -> Vec<&str> {
    let mut found: Vec<&str> = Vec::new();
    for metric in metrics {
        if !found.contains(&metric.subject.as_str()) {
            found.push(&metric.subject);
        }
    }
    found.sort_by_key(|subject| names::order(subject));
    found
}

/// Returns numbers as rows, a cell for each of `subjects`, in the order in which they are shown.
///
/// A subject that has a number twice begins a second row, so that nothing is hidden.
pub(super) fn rows<'a>(metrics: &'a [Metric], subjects: &[&str]) -> Vec<Row<'a>> {
    let mut rows: Vec<Row<'a>> = Vec::new();
    for metric in metrics {
        let Some(column) = subjects.iter().position(|name| *name == metric.subject) else {
            continue;
        };
        let is_free = |row: &&mut Row| {
            row.is_of(metric) && row.split == metric.split && row.cells[column].is_none()
        };
        if let Some(row) = rows.iter_mut().find(is_free) {
            row.cells[column] = Some(metric);
            continue;
        }
        let mut cells = vec![None; subjects.len()];
        cells[column] = Some(metric);
        let Metric { metric, variant, split, unit, .. } = metric;
        rows.push(Row { metric, variant, split, unit, cells });
    }
    lend_truths(&mut rows);
    sort(&mut rows, metrics);
    rows
}

/// Lets real motion, which is measured on its own music, stand beside the numbers of every split.
fn lend_truths(rows: &mut Vec<Row>) {
    let lenders = rows.clone();
    for row in rows.iter_mut().filter(|row| !row.has_only_truths()) {
        for column in 0..row.cells.len() {
            if row.cells[column].is_none() {
                let truths = lenders.iter().filter_map(|lender| lender.cells[column]);
                row.cells[column] = truths
                    .filter(|metric| is_truth(&metric.subject))
                    .find(|metric| row.is_of(metric));
            }
        }
    }
    let lent: Vec<&Metric> = rows
        .iter()
        .filter(|row| !row.has_only_truths())
        .flat_map(|row| row.cells.iter().flatten().copied())
        .collect();
    let is_lent = |metric: &Metric| lent.iter().any(|lent| std::ptr::eq(*lent, metric));
    rows.retain(|row| {
        !row.has_only_truths() || !row.cells.iter().flatten().all(|metric| is_lent(metric))
    });
}

/// Sorts by metric, variant and split; what is not known stays as it comes.
fn sort(rows: &mut [Row], metrics: &[Metric]) {
    let first = |is_match: &dyn Fn(&Metric) -> bool| metrics.iter().position(is_match);
    rows.sort_by_cached_key(|row| {
        (
            meaning::order(row.metric),
            first(&|metric| metric.metric == row.metric),
            row.is_compat(),
            first(&|metric| metric.metric == row.metric && metric.variant == row.variant),
            names::split_order(row.split),
        )
    });
}

/// Splits whose numbers are told rather than those of all music.
const TELLING: [&str; 3] = [HELD_OUT, "validation", "unknown"];

/// Returns the number of a subject, preferably of `split`.
pub(super) fn find<'a>(
    metrics: &'a [Metric],
    subject: &str,
    [metric, variant]: [&str; 2],
    split: &str,
) -> Option<&'a Metric> {
    let candidates = || {
        metrics
            .iter()
            .filter(move |m| m.subject == subject && m.metric == metric && m.variant == variant)
    };
    candidates().find(|m| m.split == split).or_else(|| candidates().next())
}

/// Returns the split of which a number of what was generated is told first: of those that there are, the
/// music that the model learned least from.
pub(super) fn telling_split<'a>(metrics: &'a [Metric], [metric, variant]: [&str; 2]) -> &'a str {
    let is_it = |m: &&Metric| m.subject == OWN && m.metric == metric && m.variant == variant;
    let splits = || metrics.iter().filter(is_it).map(|metric| metric.split.as_str());
    let first = TELLING.into_iter().find_map(|wanted| splits().find(|split| *split == wanted));
    first.or_else(|| splits().next()).unwrap_or(ALL)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::metric;

    fn told(rows: &[Row]) -> Vec<String> {
        let cell = |cell: &Option<&Metric>| match cell {
            Some(metric) => format!("{}:{}", metric.subject, metric.split),
            None => "–".to_owned(),
        };
        rows.iter()
            .map(|row| {
                let cells: Vec<String> = row.cells.iter().map(cell).collect();
                format!("{} {} {} | {}", row.metric, row.variant, row.split, cells.join(" "))
            })
            .collect()
    }

    #[test]
    fn subjects_are_in_order_and_unknown_ones_last() {
        let metrics = ["visitor", "training_truth", "shuffled", "generated", "guest", "shuffled"]
            .map(|subject| metric(subject, "all", "fid_g", "", Some(1.0)));
        let wanted = ["generated", "shuffled", "training_truth", "visitor", "guest"];
        assert_eq!(subjects(&metrics), wanted);
    }

    #[test]
    fn rows_follow_the_table_of_meanings_and_what_is_unknown_comes_last() {
        let metrics = [
            metric("generated", "all", "news", "b", Some(1.0)),
            metric("generated", "held_out", "fid_k", "axes", Some(1.0)),
            metric("generated", "all", "fid_k", "axes_compat", Some(1.0)),
            metric("generated", "all", "fid_k", "markers", Some(1.0)),
            metric("generated", "all", "fid_k", "axes", Some(1.0)),
            metric("generated", "all", "ails", "", Some(1.0)),
            metric("generated", "all", "news", "a", Some(1.0)),
            metric("generated", "all", "locking_p", "per_song", Some(1.0)),
        ];
        let wanted = [
            "locking_p per_song all | generated:all",
            "fid_k axes all | generated:all",
            "fid_k axes held_out | generated:held_out",
            "fid_k markers all | generated:all",
            "fid_k axes_compat all | generated:all",
            "news b all | generated:all",
            "news a all | generated:all",
            "ails  all | generated:all",
        ];
        assert_eq!(told(&rows(&metrics, &["generated"])), wanted);
    }

    #[test]
    fn truths_stand_beside_the_numbers_of_every_split() {
        let metrics = [
            metric("generated", "all", "fid_g", "", Some(1.0)),
            metric("generated", "held_out", "fid_g", "", Some(1.0)),
            metric("shuffled", "held_out", "fid_g", "", Some(1.0)),
            metric("held_out_truth", "held_out", "fid_g", "", Some(1.0)),
            metric("training_truth", "all", "fid_g", "", Some(1.0)),
            metric("held_out_truth", "held_out", "diversity", "axes", Some(1.0)),
            metric("training_truth", "all", "diversity", "axes", Some(1.0)),
        ];
        let subjects = subjects(&metrics);
        let wanted = [
            "fid_g  all | generated:all – held_out_truth:held_out training_truth:all",
            "fid_g  held_out | generated:held_out shuffled:held_out held_out_truth:held_out \
             training_truth:all",
            "diversity axes all | – – – training_truth:all",
            "diversity axes held_out | – – held_out_truth:held_out –",
        ];
        assert_eq!(told(&rows(&metrics, &subjects)), wanted);
    }

    #[test]
    fn a_second_number_has_a_row_of_its_own() {
        let metrics = [1.0, 2.0].map(|x| metric("generated", "all", "fid_g", "", Some(x)));
        let rows = rows(&metrics, &["generated"]);
        let values: Vec<_> = rows.iter().map(|row| row.of("generated").map(|m| m.value)).collect();
        assert_eq!(values, [Some(Some(1.0)), Some(Some(2.0))]);
    }

    #[test]
    fn music_that_was_not_learnt_from_is_told_first() {
        let metrics = [
            metric("generated", "all", "fid_g", "", Some(1.0)),
            metric("generated", "held_out", "fid_g", "", Some(2.0)),
            metric("generated", "all", "diversity", "axes", Some(3.0)),
        ];
        assert_eq!(telling_split(&metrics, ["fid_g", ""]), "held_out");
        assert_eq!(telling_split(&metrics, ["diversity", "axes"]), "all");
        assert_eq!(telling_split(&metrics, ["fid_k", "axes"]), "all");
        let fid_metric = |split: &str| metric("generated", split, "fid_g", "", Some(1.0));
        assert_eq!(
            telling_split(
                &[fid_metric("all"), fid_metric("unknown"), fid_metric("validation")],
                ["fid_g", ""]
            ),
            { "validation" }
        );
        assert_eq!(telling_split(&[fid_metric("trained_on")], ["fid_g", ""]), "trained_on");
        let found = find(&metrics, "generated", ["fid_g", ""], "all").map(|m| m.value);
        assert_eq!(found, Some(Some(1.0)));
    }
}
