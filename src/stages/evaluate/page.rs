//! The report of an evaluation, from its rows.

use std::collections::BTreeMap;

use crate::motion::Trajectory;
use crate::plot::{self, Format, MOTION_WIDTH_PX, MotionPanel, MotionPlot};
use crate::report::{self, Against, CheckLine, Metric, Report, Worst};
use crate::stages::motion_source::generated_frames;
use crate::store::Location;
use crate::store::tables::{GenerationRow, MetricRow, SanityCheckRow};
use crate::training::TemporalConfig;
use crate::units::frames_to_s;

/// What a report tells of.
pub struct Evaluated<'a> {
    pub store: &'a Location,
    pub run: &'a str,
    pub generations: &'a [GenerationRow],
    pub checks: &'a [SanityCheckRow],
    pub metrics: &'a [MetricRow],
    /// Metrics of another run, and a motion of it.
    pub against: Option<(Vec<MetricRow>, GenerationRow)>,
    pub data_hash: &'a str,
}

impl Evaluated<'_> {
    /// Puts the report together, with pictures of `n_worst` motions.
    ///
    /// # Errors
    /// When frames cannot be read or drawn.
    pub fn report(&self, n_worst: usize) -> anyhow::Result<Report> {
        let first = &self.generations[0];
        let n_frames: i64 = self.generations.iter().map(|row| row.n_frames).sum();
        let length_s = frames_to_s(usize::try_from(n_frames).unwrap_or(0));
        let mut facts = vec![
            ("run".to_owned(), self.run.to_owned()),
            ("motions".to_owned(), format!("{}, {length_s:.1} s in all", self.generations.len())),
            ("ground truth".to_owned(), self.data_hash[..16.min(self.data_hash.len())].to_owned()),
        ];
        facts.extend(settings(first).map(|(name, value)| (name.to_owned(), value)));
        let against = self.against.as_ref().map(|(metrics, there)| Against {
            run: there.run.clone(),
            metrics: shown(metrics),
            paired: Vec::new(),
            settings: settings(there)
                .into_iter()
                .zip(settings(first))
                .filter(|(there, here)| there != here)
                .map(|((name, there), (_, here))| (name.to_owned(), there, here))
                .collect(),
        });
        Ok(Report {
            title: format!("Evaluation of {}", self.run),
            facts,
            verdicts: Vec::new(),
            notes: Vec::new(),
            checks: lines(self.checks),
            metrics: shown(self.metrics),
            worst: self.worst(n_worst)?,
            against,
        })
    }

    /// Returns the motions that fail the most checks; of equals those with the lowest score.
    fn worst(&self, n: usize) -> anyhow::Result<Vec<Worst>> {
        let mut failed: BTreeMap<(&str, i32), Vec<&SanityCheckRow>> = BTreeMap::new();
        for row in self.checks.iter().filter(|row| !row.passed) {
            failed.entry((&row.phrase_id, row.sample)).or_default().push(row);
        }
        let n_failed = |row: &GenerationRow| {
            failed.get(&(row.phrase_id.as_str(), row.sample)).map_or(0, Vec::len)
        };
        let mut order: Vec<&GenerationRow> = self.generations.iter().collect();
        order.sort_by(|a, b| {
            let score = |row: &GenerationRow| row.score.unwrap_or(f64::NEG_INFINITY);
            n_failed(b).cmp(&n_failed(a)).then(score(a).total_cmp(&score(b)))
        });
        order.into_iter().take(n).map(|row| self.card(row, &failed)).collect()
    }

    fn card(
        &self,
        row: &GenerationRow,
        failed: &BTreeMap<(&str, i32), Vec<&SanityCheckRow>>,
    ) -> anyhow::Result<Worst> {
        let sample = usize::try_from(row.sample).unwrap_or(0);
        let motion =
            Trajectory::new(generated_frames(self.store, self.run, &row.phrase_id, sample)?)?;
        let name = format!("{}, sample {sample}", row.phrase_id);
        let plotted = MotionPlot {
            title: &name,
            motion: &motion,
            beat_times_s: &[],
            first_frame: 0,
            jerk_limit_m_s3: TemporalConfig::default().target_jerk,
        };
        let picture = plot::motion(&plotted, &MotionPanel::USUAL, MOTION_WIDTH_PX, Format::Svg)?;
        let messages = failed.get(&(row.phrase_id.as_str(), row.sample));
        let seconds = frames_to_s(usize::try_from(row.n_frames).unwrap_or(0));
        let mut facts = vec![("length".to_owned(), format!("{seconds:.1} s"))];
        facts.extend(row.score.map(|score| ("score".to_owned(), format!("{score:.3}"))));
        facts.push(("seed".to_owned(), (row.seed as u64).to_string()));
        Ok(Worst {
            facts,
            failed: messages.into_iter().flatten().map(|row| row.message.clone()).collect(),
            svg: String::from_utf8_lossy(&picture.bytes).into_owned(),
            name,
        })
    }
}

/// What determines the motions of a run.
fn settings(row: &GenerationRow) -> [(&'static str, String); 7] {
    [
        ("model", row.model.clone()),
        ("weights", row.weights[..16.min(row.weights.len())].to_owned()),
        ("engine", row.engine.clone()),
        ("sampler", row.sampler.clone()),
        ("steps", row.n_steps.to_string()),
        ("guidance", row.guidance.to_string()),
        ("eta", row.eta.map_or("–".to_owned(), |eta| eta.to_string())),
    ]
}

/// Counts who passed each check, and keeps the worst of all answers.
fn lines(rows: &[SanityCheckRow]) -> Vec<CheckLine> {
    let mut lines: Vec<(CheckLine, Badness)> = Vec::new();
    for row in rows {
        let (value, badness) = (row.value.unwrap_or(f64::NAN), Badness::of(row));
        let is_it = |(line, _): &&mut (CheckLine, Badness)| {
            line.set == row.check_set && line.check == row.check_name
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
            stage: "final".to_owned(),
            by_construction: false,
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
    let of = |row: &MetricRow| Metric {
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
    rows.iter().map(of).collect()
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
            check_set: "strict".to_owned(),
            check_name: check.to_owned(),
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
        let of = |check: &str, n_passed, n, message: &str| {
            (check.to_owned(), n_passed, n, message.to_owned())
        };
        assert_eq!(
            told,
            [of("a", 3, 3, "a Some(0.9)"), of("b", 2, 4, "b Some(4.0)"), of("c", 0, 2, "c None"),]
        );
        assert!(lines(&rows)[2].worst_value.is_nan());
    }
}
