//! What was found, as rows of tables, and the tables' commits.

use super::subjects::{Finding, Item};
use super::{CHECKS, Evaluate};
use crate::evaluation::{Check, CheckSet};
use crate::stages::Stage as _;
use crate::store::tables::{GenerationRow, MetricRow, SanityCheckRow};
use crate::store::{
    Commit, Item as Settled, Ledger, Location, Row, Snapshot, StoreError, TimestampUs,
};

/// Where the items of this stage come from, as its commits name it.
const ITEMS_FROM: &str = "generations";

/// The names under which the two tables are committed.
pub const STAGES: [&str; 2] = [CHECKS, Evaluate::NAME];

/// Returns the name of a set of checks, as tables spell it.
pub fn set_name(set: CheckSet) -> &'static str {
    match set {
        CheckSet::Reference => "reference",
        CheckSet::Strict => "strict",
    }
}

/// Returns a row for every check of every motion.
pub fn checks(rows: &[GenerationRow], items: &[Item]) -> Vec<SanityCheckRow> {
    let of = |row: &GenerationRow, check: &Check| SanityCheckRow {
        run: row.run.clone(),
        model: row.model.clone(),
        phrase_id: row.phrase_id.clone(),
        sample: row.sample,
        check_set: set_name(check.set).to_owned(),
        check_name: check.name.to_owned(),
        value: Some(check.value).filter(|value| value.is_finite()),
        threshold: check.threshold,
        passed: check.passed,
        message: check.message.clone(),
    };
    let of_motion = |(row, item): (_, &Item)| -> Vec<SanityCheckRow> {
        item.seen.measured.checks.iter().map(|check| of(row, check)).collect()
    };
    rows.iter().zip(items).flat_map(of_motion).collect()
}

/// Returns a row for every number.
pub fn metrics(run: &str, model: &str, findings: Vec<Finding>) -> Vec<MetricRow> {
    let time = TimestampUs::now();
    let of = |Finding { subject, split, number }: Finding| MetricRow {
        run: run.to_owned(),
        model: model.to_owned(),
        subject: subject.name().to_owned(),
        split: split.to_owned(),
        metric: number.metric.to_owned(),
        variant: number.variant,
        unit: number.unit.to_owned(),
        value: number.estimate.value,
        ci_low: number.estimate.ci_low,
        ci_high: number.estimate.ci_high,
        n: number.estimate.n as i64,
        protocol: number.protocol,
        time,
    };
    let mut rows: Vec<MetricRow> = findings.into_iter().map(of).collect();
    let key =
        |row: &MetricRow| [&row.metric, &row.variant, &row.split, &row.subject].map(String::clone);
    rows.sort_by_cached_key(key);
    rows
}

/// What the tables of a store know of a run.
pub struct Known<'a> {
    pub store: &'a Location,
    pub run: &'a str,
    pub params_hash: &'a str,
    /// The same of a whole evaluation, which is good for a quick one too.
    pub whole_hash: &'a str,
    /// Digest of the motions and of the ground truth.
    pub input_hash: &'a str,
}

impl Known<'_> {
    /// Returns whether a part of the evaluation was done with the same settings on the same motions.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn is_up_to_date(&self, stage: &str) -> Result<bool, StoreError> {
        let ledger = Ledger::read(self.store, stage)?;
        Ok(ledger.get(self.run).is_some_and(|known| {
            [self.params_hash, self.whole_hash].contains(&known.params_hash.as_str())
                && known.item.succeeded()
                && known.item.input_hash == self.input_hash
        }))
    }

    /// Writes the rows of one table, in the place of those that it has of the run. Checks and metrics are
    /// commits of their own, so that a quick evaluation leaves the metrics of a whole one.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn commit<R: Row>(&self, stage: &'static str, rows: &[R]) -> Result<(), StoreError> {
        let ledger = Ledger::read(self.store, stage)?;
        let mut commit = Commit::new(self.store, stage, self.params_hash, ITEMS_FROM);
        if !rows.is_empty() {
            commit.part(R::schema().name, R::schema)?.write_rows(rows)?;
        }
        let item = Settled {
            id: self.run.to_owned(),
            fingerprint: self.input_hash.to_owned(),
            input_hash: self.input_hash.to_owned(),
            failure: None,
        };
        commit.settle(item, &ledger);
        commit.publish()?;
        Ok(())
    }
}

/// Reads the checks of a run.
///
/// # Errors
/// [`StoreError`].
pub fn checks_of(store: &Location, run: &str) -> Result<Vec<SanityCheckRow>, StoreError> {
    Snapshot::take(store, SanityCheckRow::schema())?
        .rows_where(|row: &SanityCheckRow| row.run == run)
}

/// Reads the metrics of a run.
///
/// # Errors
/// [`StoreError`].
pub fn metrics_of(store: &Location, run: &str) -> Result<Vec<MetricRow>, StoreError> {
    Snapshot::take(store, MetricRow::schema())?.rows_where(|row: &MetricRow| row.run == run)
}
