//! Tables side by side: what differs, and by how much.

use super::digest::{ColumnDigest, TableDigest};
use super::table::{Table, Values};

/// How far numbers of a column may lie apart.
pub struct Tolerances {
    /// Relative to a column's root mean square, for columns that are not named.
    pub usual: f64,
    /// `TABLE.COLUMN` or `TABLE`, and its tolerance; the last that fits counts. With an infinite one a column is not
    /// compared, be it of numbers or of text.
    pub named: Vec<(String, f64)>,
}

impl Tolerances {
    fn of(&self, table: &str, column: &str) -> f64 {
        let fits = |name: &str| name == table || name == format!("{table}.{column}");
        let found = self.named.iter().rev().find(|(name, _)| fits(name));
        found.map_or(self.usual, |(_, tolerance)| *tolerance)
    }
}

/// Returns a sentence for each column of two tables that differs.
pub fn tables(name: &str, a: &Table, b: &Table, tolerances: &Tolerances) -> Vec<String> {
    if a.n_rows != b.n_rows {
        return vec![format!("{name}: {} rows, then {}", a.n_rows, b.n_rows)];
    }
    let mut found = other_columns(name, &names(a), &names(b));
    for (column, values) in &a.columns {
        let Some((_, others)) = b.columns.iter().find(|(other, _)| other == column) else {
            continue;
        };
        let tolerance = tolerances.of(name, column);
        let difference = match (values, others) {
            _ if tolerance.is_infinite() => None,
            (Values::Texts(a), Values::Texts(b)) => {
                let first = a.iter().zip(b).position(|(a, b)| a != b);
                first.map(|i| format!("first in row {i}: {:?}, then {:?}", a[i], b[i]))
            }
            (Values::Numbers(a), Values::Numbers(b)) => numbers(a, b, tolerance),
            _ => Some("of another type".to_owned()),
        };
        found.extend(difference.map(|text| format!("{name}.{column}: {text}")));
    }
    found
}

/// Returns how two columns of numbers differ; nothing where they agree within `tolerance` of their root mean square, or, where
/// that is 0, to the last bit.
fn numbers(a: &[Option<f64>], b: &[Option<f64>], tolerance: f64) -> Option<String> {
    let squares = a.iter().flatten().filter(|x| x.is_finite()).map(|x| x * x);
    let rms = (squares.sum::<f64>() / a.len().max(1) as f64).sqrt();
    let differs = |(a, b): (&Option<f64>, &Option<f64>)| match (a, b) {
        (Some(a), Some(b)) if a.is_finite() && b.is_finite() => {
            // Zeros of either sign lie 0 apart.
            let is_other = tolerance == 0.0 && a.to_bits() != b.to_bits();
            (is_other || (a - b).abs() > tolerance * rms).then_some((a - b).abs())
        }
        (Some(a), Some(b)) => (a.to_bits() != b.to_bits()).then_some(f64::INFINITY),
        (a, b) => (a != b).then_some(f64::INFINITY),
    };
    let differing: Vec<(usize, f64)> =
        a.iter().zip(b).enumerate().filter_map(|(i, pair)| Some((i, differs(pair)?))).collect();
    let &(worst, by) = differing.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(format!(
        "{} of {} rows, by up to {by:.3e} (root mean square {rms:.3e}): in row {worst} {:?}, then {:?}",
        differing.len(),
        a.len(),
        a[worst],
        b[worst]
    ))
}

/// Returns a sentence for each column of two digests that differs.
pub fn digests(
    name: &str,
    a: &TableDigest,
    b: &TableDigest,
    tolerances: &Tolerances,
) -> Vec<String> {
    if a.n_rows != b.n_rows {
        return vec![format!("{name}: {} rows, then {}", a.n_rows, b.n_rows)];
    }
    let known = |digest: &TableDigest| digest.columns.keys().cloned().collect::<Vec<_>>();
    let mut found = other_columns(name, &known(a), &known(b));
    for (column, a) in &a.columns {
        let Some(b) = b.columns.get(column) else { continue };
        let tolerance = tolerances.of(name, column);
        let difference = match (a, b) {
            _ if tolerance.is_infinite() => None,
            (ColumnDigest::Texts(a), ColumnDigest::Texts(b)) => {
                (a != b).then(|| format!("other text: {a:?}, then {b:?}"))
            }
            (ColumnDigest::Numbers(a), ColumnDigest::Numbers(b)) => {
                let most = tolerance * a.rms;
                let is_far = |a: f64, b: f64| (a - b).abs() > most;
                let differs = (a.n_null, a.n_not_finite) != (b.n_null, b.n_not_finite)
                    || is_far(a.min, b.min)
                    || is_far(a.max, b.max)
                    || is_far(a.mean, b.mean)
                    || is_far(a.rms, b.rms)
                    || is_far(a.weighted, b.weighted);
                differs.then(|| format!("{a:?}, then {b:?}"))
            }
            _ => Some("of another type".to_owned()),
        };
        found.extend(difference.map(|text| format!("{name}.{column}: {text}")));
    }
    found
}

fn names(table: &Table) -> Vec<String> {
    table.columns.iter().map(|(name, _)| name.clone()).collect()
}

/// Returns a sentence for each column that only one of two tables has.
fn other_columns(table: &str, a: &[String], b: &[String]) -> Vec<String> {
    let gone = a.iter().filter(|name| !b.contains(name));
    let new = b.iter().filter(|name| !a.contains(name));
    gone.map(|name| format!("{table}.{name}: is there no more"))
        .chain(new.map(|name| format!("{table}.{name}: is new")))
        .collect()
}
