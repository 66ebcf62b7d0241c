//! The report of an evaluation, from its rows.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::bail;

use super::rows::{self, EvaluationRows};
use super::splits::{ALL, SPLITS, telling};
use super::{Evaluand, motions};
use crate::evaluation::interval::{holm, paired_difference};
use crate::motion::Trajectory;
use crate::plot::{self, Format, MOTION_WIDTH_PX, MotionPanel, MotionPlot};
use crate::report::{
    self, CheckLine, ComparedRun, DialRun, Metric, Outcome, PairedNumber, Report, Verdict,
    VerdictTest, WorstMotion,
};
use crate::store::tables::{GenerationRow, MetricRow, SanityCheckRow, SongMetricRow, VerdictRow};
use crate::store::{Location, Row as _, StoreSnapshot};
use crate::training::TemporalConfig;
use crate::units::frames_to_s;

/// Another run that was evaluated.
pub struct OtherRun {
    run: String,
    metrics: Vec<MetricRow>,
    songs: Vec<SongMetricRow>,
    /// A motion of it; none for motions of another program.
    made: Option<GenerationRow>,
}

impl OtherRun {
    /// Reads the numbers of a run.
    ///
    /// # Errors
    /// One sentence where it was not evaluated.
    pub fn read(store: &Location, run: &str) -> anyhow::Result<Self> {
        let metrics = rows::metrics_of(store, run)?;
        if metrics.is_empty() {
            bail!(
                "run \"{run}\" has no metrics to compare with; run first: motiongen evaluate --store {store} \
                 --run {run}"
            );
        }
        let songs = rows::songs_of(store, run)?;
        let made = StoreSnapshot::take(store)
            .ok()
            .and_then(|snapshot| motions::of_run(&snapshot, run, Some(1)).ok())
            .and_then(|(mut rows, _)| rows.pop());
        Ok(Self { run: run.to_owned(), metrics, songs, made })
    }
}

/// The evaluation that a report presents.
pub struct Page<'a> {
    pub store: &'a Location,
    pub subject: &'a Evaluand,
    pub found: &'a EvaluationRows,
    pub against: Option<&'a OtherRun>,
    pub data_hash: &'a str,
}

impl Page<'_> {
    /// Puts the report together, with pictures of `n_worst` motions.
    ///
    /// # Errors
    /// When frames cannot be read or drawn.
    pub fn report(&self, n_worst: usize) -> anyhow::Result<Report> {
        let Self { subject, found, .. } = self;
        let made = subject.generations.first();
        let length_s = subject.length_s();
        let n = subject.n_items();
        let n_dancers = subject.motions.len();
        let mut facts = vec![
            ("run".to_owned(), subject.run.clone()),
            (
                "motions".to_owned(),
                match subject.is_of_groups {
                    true => format!("{n} groups, {n_dancers} dancers, {length_s:.1} s in all"),
                    false => format!("{n}, {length_s:.1} s in all"),
                },
            ),
            ("real motion".to_owned(), self.data_hash[..16.min(self.data_hash.len())].to_owned()),
        ];
        let own_settings = made.map(settings);
        facts.extend(
            own_settings.iter().flatten().map(|(name, value)| ((*name).to_owned(), value.clone())),
        );
        Ok(Report {
            title: format!("Evaluation of {}", subject.run),
            facts,
            verdicts: verdicts(&found.verdicts),
            notes: self.notes(),
            checks: lines(&found.checks),
            metrics: shown(&found.metrics),
            worst: self.worst(n_worst)?,
            against: self.against.map(|other| self.compared(other)),
            dial: self.dial()?,
        })
    }

    /// Returns the evaluated runs of groups of the same weights and number of dancers, this one among them, in order of
    /// γ; none for soloists.
    fn dial(&self) -> anyhow::Result<Vec<DialRun>> {
        let own = self.subject.generations.first().filter(|_| self.subject.is_of_groups);
        let Some(own) = own else { return Ok(Vec::new()) };
        let mut known: BTreeMap<String, f64> = BTreeMap::new();
        self.subject.snapshot.table(GenerationRow::schema())?.rows_where(
            |row: &GenerationRow| {
                if row.weights == own.weights && row.count_dancers() == own.count_dancers() {
                    known.insert(row.run.clone(), row.consistency.unwrap_or(0.0));
                }
                false
            },
        )?;
        let mut runs = Vec::new();
        for (run, consistency) in known {
            let is_this = run == self.subject.run;
            let metrics = match is_this {
                true => shown(&self.found.metrics),
                false => shown(&rows::metrics_of(self.store, &run)?),
            };
            if !metrics.is_empty() {
                runs.push(DialRun { run, consistency, is_this, metrics });
            }
        }
        runs.sort_by(|a, b| a.consistency.total_cmp(&b.consistency).then(a.run.cmp(&b.run)));
        Ok(runs)
    }

    /// Compares the run with another one.
    fn compared(&self, other: &OtherRun) -> ComparedRun {
        let here = self.subject.generations.first().map(settings);
        let there = other.made.as_ref().map(settings);
        let pairs = there.into_iter().flatten().zip(here.into_iter().flatten());
        ComparedRun {
            run: other.run.clone(),
            metrics: shown(&other.metrics),
            paired: paired(&other.songs, &self.found.songs),
            settings: pairs
                .filter(|(there, here)| there != here)
                .map(|((name, there), (_, here))| (name.to_owned(), there, here))
                .collect(),
        }
    }

    /// Returns what is to be known beside verdicts and numbers.
    fn notes(&self) -> Vec<String> {
        let mut notes = self.subject.notes.clone();
        let split = telling_split(&self.found.verdicts);
        let value = |subject: &str, metric: &str| {
            let is_it = |row: &&MetricRow| {
                row.subject == subject && row.metric == metric && row.split == split
            };
            self.found.metrics.iter().find(is_it).and_then(|row| row.value)
        };
        let truth = self
            .found
            .metrics
            .iter()
            .find(|row| row.subject == "held_out_truth" && row.metric == "locking_r2");
        let real = truth.and_then(|row| row.value);
        if let (Some(own), Some(real)) = (value("generated", "locking_r2"), real)
            && own > real
        {
            notes.push(format!(
                "Over-locking: free harmonics of the bar explain R² {own:.3} of the vertical velocity, more than the \
                 {real:.3} of real motion."
            ));
        }
        if let Some(ratio) = value("generated", "coupling_ratio")
            && ratio > 1.25
        {
            notes.push(format!(
                "Over-locking: the amplitude locked to the bar is {ratio:.2} times that of real motion; lower \
                 --guidance."
            ));
        }
        let n_candidates = self.subject.n_candidates;
        if n_candidates > 1 {
            notes.push(format!(
                "Each motion is the best of {n_candidates} candidates, chosen among other things by R² of free \
                 harmonics of the bar: R² is that of the chosen ones. The verdict on following the music does not \
                 rest on it."
            ));
        }
        notes
    }

    /// Returns the motions that fail the most checks; among equal counts those with the lowest score.
    fn worst(&self, n: usize) -> anyhow::Result<Vec<WorstMotion>> {
        let mut failed: BTreeMap<(&str, i32), Vec<&SanityCheckRow>> = BTreeMap::new();
        let is_final = |row: &&SanityCheckRow| row.stage.as_deref() != Some("raw");
        for row in self.found.checks.iter().filter(is_final).filter(|row| !row.passed) {
            failed.entry((&row.phrase_id, row.sample)).or_default().push(row);
        }
        let motions = &self.subject.motions;
        let n_failed = |i: &usize| {
            failed.get(&(motions[*i].phrase_id.as_str(), motions[*i].sample)).map_or(0, Vec::len)
        };
        let score = |i: &usize| {
            let row = self.subject.generations.get(motions[*i].item);
            row.and_then(|row| row.score).unwrap_or(f64::NEG_INFINITY)
        };
        // A group is one motion, of which the first dancer is drawn.
        let mut order: Vec<usize> =
            (0..motions.len()).filter(|&i| motions[i].dancer == 0).collect();
        order.sort_by(|a, b| n_failed(b).cmp(&n_failed(a)).then(score(a).total_cmp(&score(b))));
        order.into_iter().take(n).map(|i| self.card(i, &failed)).collect()
    }

    fn card(
        &self,
        i: usize,
        failed: &BTreeMap<(&str, i32), Vec<&SanityCheckRow>>,
    ) -> anyhow::Result<WorstMotion> {
        let looked_at = &self.subject.motions[i];
        let phrase_id = looked_at.phrase_id.as_str();
        let motion = Trajectory::new(self.subject.frames(self.store, i)?)?;
        let dancer = if self.subject.is_of_groups { ", dancer 0" } else { "" };
        let name = format!("{phrase_id}, sample {}{dancer}", looked_at.sample);
        let plotted = MotionPlot {
            title: &name,
            motion: &motion,
            beat_times_s: &[],
            first_frame: 0,
            jerk_limit_m_s3: TemporalConfig::default().target_jerk,
        };
        let picture = plot::motion(&plotted, &MotionPanel::USUAL, MOTION_WIDTH_PX, Format::Svg)?;
        let messages = failed.get(&(phrase_id, looked_at.sample));
        let seconds = frames_to_s(motion.n_frames());
        let mut facts = vec![("length".to_owned(), format!("{seconds:.1} s"))];
        if let Some(row) = self.subject.generations.get(looked_at.item) {
            facts.extend(row.score.map(|score| ("score".to_owned(), format!("{score:.3}"))));
            facts.push(("seed".to_owned(), (row.seed as u64).to_string()));
        }
        Ok(WorstMotion {
            facts,
            failed: messages.into_iter().flatten().map(|row| row.message.clone()).collect(),
            svg: String::from_utf8_lossy(&picture.bytes).into_owned(),
            name,
        })
    }
}

/// Returns the split whose verdicts are told.
fn telling_split(rows: &[VerdictRow]) -> &'static str {
    let there: BTreeSet<&str> = rows.iter().map(|row| row.split.as_str()).collect();
    let splits = SPLITS.into_iter().filter(|split| there.contains(split.name()));
    telling(splits).map_or(ALL, |split| split.name())
}

/// Returns the verdicts of the split that tells most.
fn verdicts(rows: &[VerdictRow]) -> Vec<Verdict> {
    let split = telling_split(rows);
    let outcome = |name: &str| match name {
        "won" => Outcome::Won,
        "lost" => Outcome::Lost,
        _ => Outcome::Open,
    };
    let mut found: Vec<Verdict> = Vec::new();
    for row in rows.iter().filter(|row| row.split == split) {
        let test = VerdictTest {
            test: row.test.clone(),
            outcome: outcome(&row.outcome),
            statistic: row.statistic.clone(),
            value: row.value,
            ci_low: row.ci_low,
            ci_high: row.ci_high,
            unit: row.unit.clone(),
            rule: row.rule.clone(),
            limit: Some(row.threshold),
            against: row.against.clone(),
            message: row.message.clone(),
        };
        match found.iter_mut().find(|verdict| verdict.verdict == row.verdict) {
            Some(verdict) => verdict.tests.push(test),
            None => found.push(Verdict {
                verdict: row.verdict.clone(),
                split: row.split.clone(),
                outcome: outcome(&row.verdict_outcome),
                tests: vec![test],
            }),
        }
    }
    found
}

/// Pairs the numbers of songs that both runs have, and adjusts the probabilities for their number.
fn paired(there: &[SongMetricRow], here: &[SongMetricRow]) -> Vec<PairedNumber> {
    let key =
        |row: &SongMetricRow| [&row.metric, &row.variant, &row.split, &row.song].map(String::clone);
    let known: BTreeMap<[String; 4], f64> = there.iter().map(|row| (key(row), row.value)).collect();
    let mut pairs: BTreeMap<[String; 3], Vec<f64>> = BTreeMap::new();
    for row in here {
        let [metric, variant, split, song] = key(row);
        let key_of_song = [metric.clone(), variant.clone(), split.clone(), song];
        if let Some(other) = known.get(&key_of_song) {
            pairs.entry([metric, variant, split]).or_default().push(row.value - other);
        }
    }
    let found: Vec<_> = pairs
        .into_iter()
        .map(|(key, differences)| (key, paired_difference(&differences)))
        .collect();
    let p: Vec<f64> = found.iter().filter_map(|(_, pair)| pair.p_either()).collect();
    let mut adjusted = holm(&p).into_iter();
    found
        .into_iter()
        .filter_map(|([metric, variant, split], pair)| {
            let p_holm = pair.p_either().and_then(|_| adjusted.next());
            Some(PairedNumber {
                metric,
                variant,
                split,
                difference: pair.estimate.value?,
                ci_low: pair.estimate.ci_low,
                ci_high: pair.estimate.ci_high,
                p_holm,
                n_songs: pair.estimate.n,
            })
        })
        .collect()
}

/// Returns the settings that determine the motions of a run.
fn settings(row: &GenerationRow) -> [(&'static str, String); 9] {
    [
        ("model", row.model.clone()),
        ("weights", row.weights[..16.min(row.weights.len())].to_owned()),
        ("engine", row.engine.clone()),
        ("sampler", row.sampler.clone()),
        ("steps", row.n_steps.to_string()),
        ("guidance", row.guidance.to_string()),
        ("eta", row.eta.map_or("–".to_owned(), |eta| eta.to_string())),
        ("dancers", row.count_dancers().to_string()),
        ("consistency", row.consistency.map_or("–".to_owned(), |gamma| gamma.to_string())),
    ]
}

/// Counts who passed each check, and keeps the worst of all answers.
fn lines(rows: &[SanityCheckRow]) -> Vec<CheckLine> {
    let mut lines: Vec<(CheckLine, Badness)> = Vec::new();
    for row in rows {
        let (value, badness) = (row.value.unwrap_or(f64::NAN), Badness::of(row));
        let is_it = |(line, _): &&mut (CheckLine, Badness)| {
            line.set == row.check_set
                && line.check == row.check_name
                && Some(line.stage.as_str()) == row.stage.as_deref()
        };
        if let Some((line, worst)) = lines.iter_mut().find(is_it) {
            line.n += 1;
            line.n_passed += usize::from(row.passed);
            if badness > *worst {
                *worst = badness;
                line.worst_value = value;
                line.worst_message.clone_from(&row.message);
            }
            continue;
        }
        let line = CheckLine {
            set: row.check_set.clone(),
            stage: row.stage.clone().unwrap_or_default(),
            by_construction: row.by_construction == Some(true),
            check: row.check_name.clone(),
            threshold: row.threshold,
            n: 1,
            n_passed: usize::from(row.passed),
            worst_value: value,
            worst_message: row.message.clone(),
        };
        lines.push((line, badness));
    }
    lines.into_iter().map(|(line, _)| line).collect()
}

/// How bad the answer of a check is: failures before passes, the former the farther and the latter the
/// nearer to the threshold.
#[derive(PartialEq, PartialOrd)]
struct Badness(bool, f64);

impl Badness {
    fn of(row: &SanityCheckRow) -> Self {
        let distance = row.value.map_or(f64::INFINITY, |value| (value - row.threshold).abs());
        Self(!row.passed, if row.passed { -distance } else { distance })
    }
}

/// Returns the rows as a report takes them.
fn shown(rows: &[MetricRow]) -> Vec<Metric> {
    let to_metric = |row: &MetricRow| Metric {
        subject: row.subject.clone(),
        split: row.split.clone(),
        metric: row.metric.clone(),
        variant: row.variant.clone(),
        unit: row.unit.clone(),
        value: row.value,
        ci_low: row.ci_low,
        ci_high: row.ci_high,
        n: row.n,
        protocol: row.protocol.clone(),
        better: report::better(&row.metric),
    };
    rows.iter().map(to_metric).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(check: &str, value: Option<f64>, passed: bool) -> SanityCheckRow {
        SanityCheckRow {
            run: "r".to_owned(),
            model: "m".to_owned(),
            phrase_id: "p".to_owned(),
            sample: 0,
            stage: Some("final".to_owned()),
            check_set: "strict".to_owned(),
            check_name: check.to_owned(),
            by_construction: Some(false),
            value,
            threshold: 1.0,
            passed,
            message: format!("{check} {value:?}"),
        }
    }

    #[test]
    fn the_worst_answer_is_the_farthest_failure_or_the_nearest_pass() {
        let rows = [
            row("a", Some(0.3), true),
            row("b", Some(0.2), true),
            row("a", Some(0.9), true),
            row("b", Some(1.5), false),
            row("a", Some(0.1), true),
            row("b", Some(4.0), false),
            row("b", Some(0.99), true),
            row("c", Some(9.0), false),
            row("c", None, false),
        ];
        let told: Vec<(String, usize, usize, String)> = lines(&rows)
            .into_iter()
            .map(|line| (line.check, line.n_passed, line.n, line.worst_message))
            .collect();
        let summary = |check: &str, n_passed, n, message: &str| {
            (check.to_owned(), n_passed, n, message.to_owned())
        };
        assert_eq!(
            told,
            [
                summary("a", 3, 3, "a Some(0.9)"),
                summary("b", 2, 4, "b Some(4.0)"),
                summary("c", 0, 2, "c None"),
            ]
        );
        assert!(lines(&rows)[2].worst_value.is_nan());
    }
}
