//! What was found, as rows of tables, and the tables' commits.

use super::foreign::RefusedFile;
use super::job::{EvaluationFindings, MotionStage};
use super::subjects::Subject;
use super::{CHECKS, Evaluate};
use crate::evaluation::{Check, CheckSet};
use crate::stages::Stage as _;
use crate::store::tables::{FailureRow, MetricRow, SanityCheckRow, SongMetricRow, VerdictRow};
use crate::store::{
    Commit, Item as Settled, Ledger, Location, Row, Snapshot, StoreError, TimestampUs,
};

/// Where the items of this stage come from, as its commits name it.
const ITEMS_FROM: &str = "generations";

/// The names under which checks and numbers are committed.
pub const STAGES: [&str; 2] = [CHECKS, Evaluate::NAME];

/// The results of an evaluation, as rows.
#[derive(Clone, Debug, Default)]
pub struct EvaluationRows {
    pub checks: Vec<SanityCheckRow>,
    pub metrics: Vec<MetricRow>,
    pub verdicts: Vec<VerdictRow>,
    pub songs: Vec<SongMetricRow>,
}

/// The run and evaluation that rows belong to.
#[derive(Clone, Copy, Debug)]
pub struct RunName<'a> {
    pub run: &'a str,
    pub model: &'a str,
}

/// Returns the name of a set of checks, as tables spell it.
fn set_name(set: CheckSet) -> &'static str {
    match set {
        CheckSet::Reference => "reference",
        CheckSet::Strict => "strict",
    }
}

/// Returns a row for every check of a motion at one stage of its making.
pub fn checks<'a>(
    name: RunName<'a>,
    phrase_id: &'a str,
    sample: i32,
    stage: MotionStage,
    checks: &'a [Check],
    holds: &'a dyn Fn(&str) -> bool,
) -> impl Iterator<Item = SanityCheckRow> + 'a {
    checks.iter().map(move |check| SanityCheckRow {
        run: name.run.to_owned(),
        model: name.model.to_owned(),
        phrase_id: phrase_id.to_owned(),
        sample,
        stage: Some(stage.name().to_owned()),
        check_set: set_name(check.set).to_owned(),
        check_name: check.name.to_owned(),
        by_construction: Some(holds(check.name)),
        value: Some(check.value).filter(|value| value.is_finite()),
        threshold: check.threshold,
        passed: check.passed,
        message: check.message.clone(),
    })
}

impl EvaluationRows {
    /// Adds numbers, those of songs, and verdicts.
    pub fn add(
        &mut self,
        name: RunName,
        found: EvaluationFindings,
        song_name: &dyn Fn(usize) -> String,
    ) {
        let time = TimestampUs::now();
        for finding in &found.findings {
            for number in &finding.numbers {
                self.metrics.push(MetricRow {
                    run: name.run.to_owned(),
                    model: name.model.to_owned(),
                    subject: finding.subject.name().to_owned(),
                    split: finding.split.to_owned(),
                    metric: number.metric.to_owned(),
                    variant: number.variant.clone(),
                    unit: number.unit.to_owned(),
                    value: number.estimate.value,
                    ci_low: number.estimate.ci_low,
                    ci_high: number.estimate.ci_high,
                    n: number.estimate.n as i64,
                    protocol: number.protocol.clone(),
                    time,
                });
                if ![Subject::Generated, Subject::Reconstructed].contains(&finding.subject) {
                    continue;
                }
                let rows = number.by_song.iter().filter(|(_, value)| value.is_finite());
                self.songs.extend(rows.map(|(song, value)| SongMetricRow {
                    run: name.run.to_owned(),
                    song: song_name(*song),
                    split: finding.split.to_owned(),
                    metric: number.metric.to_owned(),
                    variant: number.variant.clone(),
                    value: *value,
                }));
            }
        }
        for (split, verdict) in &found.verdicts {
            for test in &verdict.tests {
                self.verdicts.push(VerdictRow {
                    run: name.run.to_owned(),
                    model: name.model.to_owned(),
                    split: split.name().to_owned(),
                    verdict: verdict.quality.name().to_owned(),
                    verdict_outcome: verdict.outcome.name().to_owned(),
                    test: test.name.to_owned(),
                    outcome: test.outcome.name().to_owned(),
                    statistic: test.statistic.clone(),
                    value: test.estimate.value,
                    ci_low: test.estimate.ci_low,
                    ci_high: test.estimate.ci_high,
                    unit: test.unit.to_owned(),
                    rule: test.rule.words(),
                    threshold: test.rule.limit(),
                    against: test.against.clone(),
                    p: test.p,
                    p_holm: test.p_holm,
                    message: test.message(),
                    time,
                });
            }
        }
        self.metrics.sort_by_cached_key(|row| {
            [&row.metric, &row.variant, &row.split, &row.subject].map(String::clone)
        });
        self.songs.sort_by_cached_key(|row| {
            [&row.song, &row.metric, &row.variant, &row.split].map(String::clone)
        });
        self.verdicts
            .sort_by_cached_key(|row| [&row.split, &row.verdict, &row.test].map(String::clone));
    }

    /// Reads the rows of a run; of a quick evaluation its checks alone.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read(store: &Location, run: &str, quick: bool) -> Result<Self, StoreError> {
        let checks = Snapshot::take(store, SanityCheckRow::schema())?
            .rows_where(|row: &SanityCheckRow| row.run == run)?;
        if quick {
            return Ok(Self { checks, ..Self::default() });
        }
        Ok(Self {
            checks,
            metrics: metrics_of(store, run)?,
            verdicts: Snapshot::take(store, VerdictRow::schema())?
                .rows_where(|row: &VerdictRow| row.run == run)?,
            songs: songs_of(store, run)?,
        })
    }
}

/// Reads the metrics of a run.
///
/// # Errors
/// [`StoreError`].
pub fn metrics_of(store: &Location, run: &str) -> Result<Vec<MetricRow>, StoreError> {
    Snapshot::take(store, MetricRow::schema())?.rows_where(|row: &MetricRow| row.run == run)
}

/// Reads the numbers of a run's songs.
///
/// # Errors
/// [`StoreError`].
pub fn songs_of(store: &Location, run: &str) -> Result<Vec<SongMetricRow>, StoreError> {
    Snapshot::take(store, SongMetricRow::schema())?.rows_where(|row: &SongMetricRow| row.run == run)
}

/// What identifies an evaluation of a run in the tables of a store.
pub struct RunIdentity<'a> {
    pub store: &'a Location,
    pub run: &'a str,
    pub params_hash: &'a str,
    /// The same of a whole evaluation, which is good for a quick one too.
    pub whole_hash: &'a str,
    /// Digest of the motions, of what is known of their model, and of real motion.
    pub input_hash: &'a str,
}

impl RunIdentity<'_> {
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

    /// Writes the checks of a run, in the place of those that its table has of the run. Checks and numbers are commits
    /// of their own, so that a quick evaluation leaves the numbers of a whole one.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn commit_checks(
        &self,
        rows: &EvaluationRows,
        refused: &[RefusedFile],
    ) -> Result<(), StoreError> {
        self.commit(CHECKS, |commit, ledger| {
            write(commit, &rows.checks)?;
            let item = |refused: &RefusedFile| format!("{}/{}", self.run, refused.name);
            let mut failures: Vec<FailureRow> = Vec::new();
            for refused in refused {
                let failure = Some(refused.failure.digest());
                let id = item(refused);
                failures.push(FailureRow {
                    stage: Evaluate::NAME.to_owned(),
                    phrase_id: id.clone(),
                    source: refused.failure.path.clone(),
                    kind: refused.failure.kind.name().to_owned(),
                    message: refused.failure.message.clone(),
                    time: TimestampUs::now(),
                });
                let (fingerprint, input_hash) = (String::new(), self.input_hash.to_owned());
                commit.settle(Settled { id, fingerprint, input_hash, failure }, ledger);
            }
            failures.sort_by(|a, b| a.phrase_id.cmp(&b.phrase_id));
            // Files that were refused before and are sound now, or gone, leave the table.
            let prefix = format!("{}/", self.run);
            let gone = ledger.failed(ITEMS_FROM).into_iter().filter(|id| {
                id.starts_with(&prefix) && failures.iter().all(|row| row.phrase_id != **id)
            });
            for id in gone {
                commit.settle(Settled::forgotten(id), ledger);
            }
            write(commit, &failures)
        })
    }

    /// Writes numbers and verdicts, in one commit.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn commit_numbers(&self, rows: &EvaluationRows) -> Result<(), StoreError> {
        self.commit(Evaluate::NAME, |commit, _| {
            write(commit, &rows.metrics)?;
            write(commit, &rows.verdicts)?;
            write(commit, &rows.songs)
        })
    }

    fn commit(
        &self,
        stage: &'static str,
        write: impl FnOnce(&mut Commit, &Ledger) -> Result<(), StoreError>,
    ) -> Result<(), StoreError> {
        let ledger = Ledger::read(self.store, stage)?;
        let mut commit = Commit::new(self.store, stage, self.params_hash, ITEMS_FROM);
        write(&mut commit, &ledger)?;
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

fn write<R: Row>(commit: &mut Commit, rows: &[R]) -> Result<(), StoreError> {
    if !rows.is_empty() {
        commit.part(R::schema().name, R::schema)?.write_rows(rows)?;
    }
    Ok(())
}
