//! `evaluate`: motion becomes numbers and verdicts that can be queried, beside those of what it is compared with.

mod baselines;
mod compared;
mod evaluand;
mod foreign;
mod group;
mod job;
mod making;
mod measure;
mod metrics_summary;
mod motions;
mod page;
mod params;
mod rows;
mod sampled;
mod splits;
mod subjects;
mod survey;
mod tokenizer;
mod truth;

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;

use super::failure::{failures_json, write_failures};
use super::{Contract, Progress, Stage, Summary, lease};
use crate::evaluation::verdict::Quality;
use crate::report::{self, Report};
use crate::store::tables::SanityCheckRow;
use crate::store::{self, Lease, Location};

use evaluand::Evaluand;
use foreign::RefusedFile;
use job::MotionStage;
pub use params::{Params, RequiredVerdict};
use rows::{EvaluationRows, RunIdentity};
pub(in crate::stages) use survey::{runs, survey};

/// The name under which sanity checks are committed; numbers and verdicts have the stage's.
const CHECKS: &str = "evaluate-checks";

/// The stage.
pub struct Evaluate;

impl Stage for Evaluate {
    const NAME: &'static str = "evaluate";
    const ABOUT: &'static str = "tell good motion from bad, beside its baselines";
    const CONTRACT: Contract = Contract {
        reads: "generations, generated, decoded, phrases, beats, features, motion, models/MODEL, runs/RUN",
        writes: "sanity_checks, metrics, verdicts, song_metrics, reference/, baselines/, an HTML file with \
                 --report",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        params.check()?;
        let store = Location::open(&params.store, &params.client.options())?;
        if let Some(run) = &params.tokenizer {
            return tokenizer::run(&params, &store, run, progress);
        }
        let against = params.against.as_deref().map(|run| page::OtherRun::read(&store, run));
        let against = against.transpose()?;
        let mut subject = Evaluand::read(&store, &params)?;
        let data_hash = subject.phrases.truth_digest();
        let run = subject.run.clone();
        let known = RunIdentity {
            store: &store,
            run: &run,
            params_hash: &params.digest(params.quick),
            whole_hash: &params.digest(false),
            input_hash: &subject.input_hash(&data_hash)?,
        };
        let n_wanted = if params.quick { 1 } else { rows::STAGES.len() };
        let look = || -> anyhow::Result<bool> {
            let mut is_up_to_date = !params.force;
            for stage in &rows::STAGES[..n_wanted] {
                is_up_to_date = is_up_to_date && known.is_up_to_date(stage)?;
            }
            Ok(is_up_to_date)
        };
        let mut is_up_to_date = look()?;
        if params.dry_run {
            let (n_motions, length_s) = (subject.n_items(), subject.length_s());
            let n_refused = subject.refused.len();
            return Ok(Box::new(EvaluateDryRun {
                store: store.to_string(),
                run,
                n_motions,
                n_refused,
                length_s,
                is_up_to_date,
            }));
        }
        let mut lease = None;
        if !is_up_to_date {
            let (name, what) = (format!("{}/{run}", Self::NAME), format!("evaluation of {run}"));
            let (taken, has_waited) =
                lease::take(&store, &name, &what, &|text| progress.note(text))?;
            lease = Some(taken);
            // The other process may have evaluated the same.
            is_up_to_date = has_waited && look()?;
        }
        let found = if is_up_to_date {
            EvaluationRows::read(&store, &run, params.quick)?
        } else {
            store.sweep();
            let found = subject.evaluate(&store, &params, &data_hash, progress)?;
            lease.as_ref().map_or(Ok(()), Lease::check)?;
            known.commit_checks(&found, &subject.refused)?;
            if !params.quick {
                known.commit_numbers(&found)?;
            }
            store::checkpoint(&store, &rows::STAGES);
            found
        };
        let report = page::Page {
            store: &store,
            subject: &subject,
            found: &found,
            against: against.as_ref(),
            data_hash: &data_hash,
        };
        let report = report.report(if params.report.is_some() { params.worst } else { 0 })?;
        if let Some(path) = &params.report {
            let text = report::page(&report);
            store::write_file(path, |out| out.write_all(text.as_bytes()))
                .with_context(|| format!("while writing {}", path.display()))?;
        }
        Ok(Box::new(EvaluateSummary {
            missed: missed(&params, &found.checks),
            not_won: not_won(&params, &report),
            store: store.to_string(),
            n_motions: subject.n_items(),
            length_s: subject.length_s(),
            refused: std::mem::take(&mut subject.refused),
            run,
            is_up_to_date,
            has_metrics: !found.metrics.is_empty(),
            page: params.report,
            report,
            took_s: started.elapsed().as_secs_f64(),
        }))
    }
}

/// A required verdict that was not won, and how it ended.
type UnwonVerdict = (String, report::Outcome);

/// Returns the required verdicts that were not won. One of which nothing was measured, for example because every motion
/// is shorter than a window, is open.
fn not_won(params: &Params, report: &Report) -> Vec<UnwonVerdict> {
    let is_required = |name: &str| params.require.iter().any(|asked| asked.asks_for(name));
    let told = report.verdicts.iter().map(|told| (told.verdict.clone(), told.outcome));
    let is_told = |name: &str| report.verdicts.iter().any(|told| told.verdict == name);
    let of_groups =
        params.require.contains(&RequiredVerdict::Together).then_some(Quality::Together);
    let untold = Quality::OF_SOLOISTS
        .into_iter()
        .chain(of_groups)
        .filter(|quality| !is_told(quality.name()))
        .map(|quality| (quality.name().to_owned(), report::Outcome::Open));
    told.chain(untold)
        .filter(|(name, outcome)| is_required(name) && *outcome != report::Outcome::Won)
        .collect()
}

/// A check set of which too few motions pass all: its name, the share, the share that was asked for, and how
/// many failed.
type CheckShortfall = (&'static str, f64, f64, usize);

fn missed(params: &Params, checks: &[SanityCheckRow]) -> Vec<CheckShortfall> {
    let wanted = [("reference", params.min_pass_rate), ("strict", params.min_strict_pass_rate)];
    let missed = |(set, least): (&'static str, Option<f64>)| {
        let least = least?;
        let is_of_set = |row: &&SanityCheckRow| {
            row.check_set == set && row.stage.as_deref() != Some(MotionStage::Raw.name())
        };
        let checks_in_set = || checks.iter().filter(is_of_set);
        let motion = |row: &SanityCheckRow| (row.phrase_id.clone(), row.sample);
        let all: BTreeSet<_> = checks_in_set().map(motion).collect();
        let failed: BTreeSet<_> = checks_in_set().filter(|row| !row.passed).map(motion).collect();
        let share = 1.0 - failed.len() as f64 / all.len().max(1) as f64;
        (share < least).then_some((set, share, least, failed.len()))
    };
    wanted.into_iter().filter_map(missed).collect()
}

/// The summary of an evaluation.
struct EvaluateSummary {
    store: String,
    run: String,
    n_motions: usize,
    length_s: f64,
    is_up_to_date: bool,
    has_metrics: bool,
    /// Files that hold no motion, and why.
    refused: Vec<RefusedFile>,
    missed: Vec<CheckShortfall>,
    not_won: Vec<UnwonVerdict>,
    report: Report,
    page: Option<PathBuf>,
    took_s: f64,
}

impl Summary for EvaluateSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { store, run, n_motions, length_s, took_s, .. } = self;
        writeln!(out, "evaluate {run} → {store}")?;
        if self.is_up_to_date {
            writeln!(out, "  {n_motions} motions ({length_s:.1} s), evaluated before")?;
        } else {
            writeln!(out, "  {n_motions} motions ({length_s:.1} s) evaluated; {took_s:.1} s")?;
        }
        writeln!(out)?;
        out.write_all(report::terminal(&self.report).as_bytes())?;
        writeln!(out)?;
        for (verdict, outcome) in &self.not_won {
            writeln!(out, "  required verdict {verdict} is {}", outcome.name())?;
        }
        for (set, share, least, _) in &self.missed {
            writeln!(out, "  {set} checks: {share:.3} of the motions pass all, below {least}")?;
        }
        let refused = self.refused.iter().map(|refused| (&refused.name, &refused.failure));
        write_failures(out, refused, Some(store))?;
        if let Some(page) = &self.page {
            writeln!(out, "  report {}", page.display())?;
        }
        if self.has_metrics {
            writeln!(
                out,
                "  motiongen query --store {store} \"select verdict, test, outcome, message from verdicts where \
                 run = '{run}'\""
            )?;
            writeln!(
                out,
                "  motiongen query --store {store} \"select model, subject, metric, variant, value, ci_low, \
                 ci_high from metrics where run = '{run}'\""
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        self.missed.iter().map(|(.., n)| *n as u64).sum::<u64>()
            + self.not_won.len() as u64
            + self.refused.len() as u64
    }

    fn figures(&mut self) -> serde_json::Value {
        let verdicts: serde_json::Map<String, serde_json::Value> = self
            .report
            .verdicts
            .iter()
            .map(|told| (told.verdict.clone(), told.outcome.name().into()))
            .collect();
        let refused = self.refused.iter().map(|refused| (&refused.name, &refused.failure));
        serde_json::json!({
            "store": self.store,
            "run": self.run,
            "n_motions": self.n_motions,
            "length_s": self.length_s,
            "is_up_to_date": self.is_up_to_date,
            "verdicts": verdicts,
            "not_won": self.not_won.iter().map(|(verdict, _)| verdict).collect::<Vec<_>>(),
            "report": self.page,
            "failures": failures_json(refused),
            "took_s": self.took_s,
        })
    }
}

/// The summary of a dry run.
struct EvaluateDryRun {
    store: String,
    run: String,
    n_motions: usize,
    /// Files that hold no motion.
    n_refused: usize,
    length_s: f64,
    is_up_to_date: bool,
}

impl Summary for EvaluateDryRun {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { store, run, n_motions, n_refused, length_s, is_up_to_date } = self;
        writeln!(out, "evaluate {run} → {store}")?;
        let what = if *is_up_to_date { "nothing to do for" } else { "would evaluate" };
        writeln!(
            out,
            "  {what} {n_motions} motions ({length_s:.1} s), {n_refused} files hold no motion"
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        serde_json::json!({
            "store": self.store,
            "run": self.run,
            "dry_run": true,
            "n_motions": self.n_motions,
            "n_refused": self.n_refused,
            "length_s": self.length_s,
            "is_up_to_date": self.is_up_to_date,
        })
    }
}
