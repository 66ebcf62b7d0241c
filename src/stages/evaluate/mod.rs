//! `evaluate`: generated motion becomes numbers that can be queried, beside those of what it is compared
//! with.

#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the evaluation that samples them is being written")
)]
mod baselines;
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the evaluation that reads them is being written")
)]
mod foreign;
mod measure;
mod motions;
mod page;
mod params;
mod rows;
mod subjects;
mod truth;

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context as _, bail};
use ndarray::Array2;

use super::{Contract, Progress, Stage, Summary};
use crate::report::{self, Report};
use crate::store::tables::{self, GenerationRow, MetricRow, SanityCheckRow};
use crate::store::{self, Location, Snapshot, StoreError, digest};
use crate::units::frames_to_s;

use measure::{MAX_KEPT_FRAMES, Measurer, Seen, kept_of, stride_for};
use motions::Phrases;
pub use params::Params;
use rows::Known;
use subjects::{ALL, Finding, HELD_OUT, Item, MAX_RETRIEVED, Subject, Subjects};

/// The name under which sanity checks are committed; metrics have the stage's.
const CHECKS: &str = "evaluate-checks";

/// The stage.
pub struct Evaluate;

impl Stage for Evaluate {
    const NAME: &'static str = "evaluate";
    const ABOUT: &'static str = "measure generated motion beside its baselines";
    const CONTRACT: Contract = Contract {
        reads: "generations, generated, phrases, beats, features, motion",
        writes: "sanity_checks, metrics, reference/, an HTML file with --report",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        params.check()?;
        let store = Location::open(&params.store, &params.client.options())?;
        let against = params.against.as_deref().map(|run| evaluated(&store, run)).transpose()?;
        let generations = motions::of_run(&store, &params.run, params.num_samples.map(Into::into))?;
        let phrases = Phrases::read(&store, |rows| {
            let with_motion = rows.values().filter(|row| row.has_motion);
            let truth = with_motion.map(|row| row.phrase_id.clone());
            generations.iter().map(|row| row.phrase_id.clone()).chain(truth).collect()
        })?;
        let data_hash = phrases.truth_digest();
        let known = Known {
            store: &store,
            run: &params.run,
            params_hash: &params.digest(params.quick),
            whole_hash: &params.digest(false),
            input_hash: &input_hash(&generations, &data_hash),
        };
        let n_wanted = if params.quick { 1 } else { rows::STAGES.len() };
        let mut is_up_to_date = !params.force;
        for stage in &rows::STAGES[..n_wanted] {
            is_up_to_date = is_up_to_date && known.is_up_to_date(stage)?;
        }
        let (checks, metrics) = if is_up_to_date {
            let metrics =
                if params.quick { Vec::new() } else { rows::metrics_of(&store, &params.run)? };
            (rows::checks_of(&store, &params.run)?, metrics)
        } else {
            store.sweep()?;
            let job = Job {
                params: &params,
                store: &store,
                generations: &generations,
                phrases: &phrases,
            };
            let (checks, metrics) = job.measure(&data_hash, progress)?;
            known.commit(CHECKS, &checks)?;
            if !params.quick {
                known.commit(Evaluate::NAME, &metrics)?;
            }
            (checks, metrics)
        };
        let n_frames: i64 = generations.iter().map(|row| row.n_frames).sum();
        let evaluated = page::Evaluated {
            store: &store,
            run: &params.run,
            generations: &generations,
            checks: &checks,
            metrics: &metrics,
            against,
            data_hash: &data_hash,
        };
        let report = evaluated.report(if params.report.is_some() { params.worst } else { 0 })?;
        if let Some(path) = &params.report {
            let text = report::page(&report);
            store::write_file(path, |out| out.write_all(text.as_bytes()))
                .with_context(|| format!("while writing {}", path.display()))?;
        }
        Ok(Box::new(Told {
            missed: missed(&params, &checks),
            store: store.to_string(),
            run: params.run,
            n_motions: generations.len(),
            length_s: frames_to_s(usize::try_from(n_frames).unwrap_or(0)),
            is_up_to_date,
            has_metrics: !metrics.is_empty(),
            page: params.report,
            report,
            took_s: started.elapsed().as_secs_f64(),
        }))
    }
}

/// Returns the metrics of another run that was evaluated, with what made its motions.
fn evaluated(store: &Location, run: &str) -> anyhow::Result<(Vec<MetricRow>, GenerationRow)> {
    let metrics = rows::metrics_of(store, run)?;
    if metrics.is_empty() {
        bail!(
            "run \"{run}\" has no metrics to compare with; run first: motiongen evaluate --store {store} \
             --run {run}"
        );
    }
    Ok((metrics, motions::of_run(store, run, Some(1))?.swap_remove(0)))
}

/// Returns a digest of the motions and of the ground truth.
fn input_hash(generations: &[GenerationRow], data_hash: &str) -> String {
    let mut text = data_hash.to_owned();
    for row in generations {
        text.push_str(&format!(
            "\n{} {} {} {}",
            row.generation, row.candidate, row.weights, row.time.0
        ));
    }
    digest(text.as_bytes())
}

/// A check set of which too few motions pass all: its name, the share, the share that was asked for, and how
/// many failed.
type Missed = (&'static str, f64, f64, usize);

fn missed(params: &Params, checks: &[SanityCheckRow]) -> Vec<Missed> {
    let wanted = [("reference", params.min_pass_rate), ("strict", params.min_strict_pass_rate)];
    let of = |(set, least): (&'static str, Option<f64>)| {
        let least = least?;
        let of_set = || checks.iter().filter(|row| row.check_set == set);
        let motion = |row: &SanityCheckRow| (row.phrase_id.clone(), row.sample);
        let all: BTreeSet<_> = of_set().map(motion).collect();
        let failed: BTreeSet<_> = of_set().filter(|row| !row.passed).map(motion).collect();
        let share = 1.0 - failed.len() as f64 / all.len().max(1) as f64;
        (share < least).then_some((set, share, least, failed.len()))
    };
    wanted.into_iter().filter_map(of).collect()
}

/// The work.
struct Job<'a> {
    params: &'a Params,
    store: &'a Location,
    generations: &'a [GenerationRow],
    phrases: &'a Phrases,
}

impl Job<'_> {
    fn measure(
        &self,
        data_hash: &str,
        progress: &dyn Progress,
    ) -> anyhow::Result<(Vec<SanityCheckRow>, Vec<MetricRow>)> {
        let Self { params, store, generations, phrases } = self;
        let truth = match params.quick {
            true => None,
            false => truth::read(store, data_hash, params.threads, progress)?,
        };
        let n_frames: i64 = generations.iter().map(|row| row.n_frames).sum();
        let measurer = Measurer {
            limits: params.limits,
            reference: truth.as_ref().map(|truth| &truth.statistics),
            num_frames: params.num_frames.map(Into::into),
            stride: stride_for(usize::try_from(n_frames).unwrap_or(MAX_KEPT_FRAMES)),
            threads: params.threads,
        };
        let subjects = Subjects {
            phrases,
            truth: truth.as_ref(),
            measurer: &measurer,
            threads: params.threads,
        };
        progress.start("evaluate", "motions", generations.len() as u64);
        let seen = self.generated(&measurer, progress)?;
        progress.finish();
        let missing = generations.iter().zip(&seen).find(|(_, seen)| seen.is_none());
        if let Some((row, _)) = missing {
            bail!(
                "store {store} has no frames of {}, though it lists the motion; run motiongen generate \
                 again with --force",
                row.generation
            );
        }
        let generated = subjects.generated(generations, seen);
        let checks = rows::checks(generations, &generated);
        if params.quick {
            return Ok((checks, Vec::new()));
        }
        progress.say("measuring what it is compared with");
        let retrieved = self.retrieved(&subjects, &generated)?;
        let constant = subjects.mean_motion(&generated);
        let truth = subjects.truth();
        progress.say("resampling");
        let findings = self.findings(&subjects, &generated, &retrieved, &constant, &truth);
        let model = &generations[0].model;
        Ok((checks, rows::metrics(&params.run, model, findings)))
    }

    fn generated(
        &self,
        measurer: &Measurer,
        progress: &dyn Progress,
    ) -> Result<Vec<Option<Seen>>, StoreError> {
        let names: BTreeSet<String> =
            self.generations.iter().map(|row| row.generation.clone()).collect();
        let table = Snapshot::take(self.store, tables::generated())?;
        measurer.run(self.generations.len(), |give| {
            table.visit_items(&names, |name, frames| {
                let place =
                    self.generations.binary_search_by(|row| row.generation.as_str().cmp(name));
                if let Ok(i) = place {
                    give(i, frames);
                    progress.advance(1);
                }
                Ok::<_, StoreError>(())
            })
        })
    }

    /// Asks the library for the nearest phrases, of one motion for each phrase.
    fn retrieved(&self, subjects: &Subjects, generated: &[Item]) -> Result<Vec<Item>, StoreError> {
        let mut wanted: Vec<&Item> = Vec::new();
        let mut names = BTreeSet::new();
        for item in generated {
            if names.insert(item.phrase_id.clone()) {
                wanted.push(item);
            }
        }
        // A song here and there, where there are more than are asked for.
        wanted.sort_by_cached_key(|item| digest(item.phrase_id.as_bytes()));
        wanted.truncate(MAX_RETRIEVED);
        let names: BTreeSet<String> = wanted.iter().map(|item| item.phrase_id.clone()).collect();
        let most = MAX_RETRIEVED.div_ceil(wanted.len().max(1));
        let mut found: Vec<(String, Vec<Item>)> = Vec::new();
        Snapshot::take(self.store, tables::features())?.visit_items(
            &names,
            |id, features: Array2<f32>| {
                if let Some(item) = wanted.iter().find(|item| item.phrase_id == id) {
                    found.push((id.to_owned(), subjects.retrieved(item, features.view(), most)));
                }
                Ok::<_, StoreError>(())
            },
        )?;
        found.sort_by(|a, b| a.0.cmp(&b.0));
        Ok(found.into_iter().flat_map(|(_, items)| items).collect())
    }

    fn findings(
        &self,
        subjects: &Subjects,
        generated: &[Item],
        retrieved: &[Item],
        constant: &[Item],
        truth: &[Item],
    ) -> Vec<Finding> {
        let kept_truth = kept_of(truth.iter().map(|item| &item.seen));
        let n_held_out = generated.iter().filter(|item| item.is_held_out).count();
        let mut findings = Vec::new();
        for split in [ALL, HELD_OUT] {
            // Where nothing was held out, or everything, there is one split.
            let is_told = match split {
                HELD_OUT => n_held_out > 0,
                _ => n_held_out < generated.len(),
            };
            let of = |items: &'_ [Item]| -> Vec<usize> {
                let is_of = |i: &usize| split == ALL || items[*i].is_held_out;
                (0..items.len()).filter(is_of).collect()
            };
            let true_subject =
                if split == ALL { Subject::GroundTruth } else { Subject::HeldOutTruth };
            let sets = [
                (Subject::Generated, generated, is_told),
                (Subject::Retrieval, retrieved, is_told),
                (Subject::MeanMotion, constant, is_told),
                (true_subject, truth, true),
            ];
            for (subject, items, is_told) in sets {
                let chosen: Vec<&Item> = of(items).into_iter().map(|i| &items[i]).collect();
                if !is_told || chosen.is_empty() {
                    continue;
                }
                findings.extend(subjects.numbers(subject, split, &chosen));
                if subject == Subject::Generated {
                    findings.extend(subjects.shuffled(split, &chosen));
                    let rows: Vec<&GenerationRow> =
                        of(items).into_iter().map(|i| &self.generations[i]).collect();
                    findings.extend(subjects::control(split, &rows, self.phrases));
                }
                if subject != Subject::GroundTruth && kept_truth.nrows() > 0 {
                    findings.extend(subjects::channels(subject, split, &chosen, &kept_truth));
                }
            }
        }
        findings
    }
}

/// What was measured.
struct Told {
    store: String,
    run: String,
    n_motions: usize,
    length_s: f64,
    is_up_to_date: bool,
    has_metrics: bool,
    missed: Vec<Missed>,
    report: Report,
    page: Option<PathBuf>,
    took_s: f64,
}

impl Summary for Told {
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
        for (set, share, least, _) in &self.missed {
            writeln!(out, "  {set} checks: {share:.3} of the motions pass all, below {least}")?;
        }
        if let Some(page) = &self.page {
            writeln!(out, "  report {}", page.display())?;
        }
        if self.has_metrics {
            writeln!(
                out,
                "  motiongen query --store {store} \"select model, subject, metric, variant, value, ci_low, \
                 ci_high from metrics where run = '{run}'\""
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        self.missed.iter().map(|(.., n)| *n as u64).sum()
    }
}
