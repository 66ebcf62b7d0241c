//! `evaluate`: motion becomes numbers and verdicts that can be queried, beside those of what it is compared with.

mod baselines;
mod foreign;
mod job;
mod measure;
mod motions;
mod page;
mod params;
mod rows;
mod splits;
mod subjects;
mod truth;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context as _, bail};
use ndarray::Array2;

use super::motion_source::generated_frames;
use super::{Contract, Progress, Stage, Summary, learned};
use crate::evaluation::holds_by_construction;
use crate::evaluation::metrics::PhaseOrigin;
use crate::generation::LearnedFrom;
use crate::motion::postprocess::PostProcessConfig;
use crate::report::{self, Report};
use crate::store::tables::{self, GenerationRow, SanityCheckRow};
use crate::store::{self, Location, Snapshot, StoreError, digest};
use crate::units::frames_to_s;

use job::{Evaluated, Job, Motion, Stage as MadeAt};
use measure::{MAX_KEPT_FRAMES, MeasuredMotion, stride_for};
use motions::{Phrases, is_held_out};
pub use params::{Params, RequiredVerdict};
use rows::{Known, Rows, RunName};
use splits::MusicSplit;
use truth::Truth;

/// The name under which sanity checks are committed; numbers and verdicts have the stage's.
const CHECKS: &str = "evaluate-checks";

/// Songs whose activity is read; that of others counts as its mean.
const MAX_HEARD_SONGS: usize = 500;

/// The stage.
pub struct Evaluate;

impl Stage for Evaluate {
    const NAME: &'static str = "evaluate";
    const ABOUT: &'static str = "tell good motion from bad, beside its baselines";
    const CONTRACT: Contract = Contract {
        reads: "generations, generated, decoded, phrases, beats, features, motion, models/MODEL",
        writes: "sanity_checks, metrics, verdicts, song_metrics, reference/, baselines/, an HTML file with \
                 --report",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        params.check()?;
        let store = Location::open(&params.store, &params.client.options())?;
        let against = params.against.as_deref().map(|run| page::Other::read(&store, run));
        let against = against.transpose()?;
        let mut subject = Evaluand::read(&store, &params)?;
        let data_hash = subject.phrases.truth_digest();
        let run = subject.run.clone();
        let known = Known {
            store: &store,
            run: &run,
            params_hash: &params.digest(params.quick),
            whole_hash: &params.digest(false),
            input_hash: &subject.input_hash(&data_hash),
        };
        let n_wanted = if params.quick { 1 } else { rows::STAGES.len() };
        let mut is_up_to_date = !params.force;
        for stage in &rows::STAGES[..n_wanted] {
            is_up_to_date = is_up_to_date && known.is_up_to_date(stage)?;
        }
        let found = if is_up_to_date {
            Rows::read(&store, &run, params.quick)?
        } else {
            store.sweep()?;
            let found = subject.evaluate(&store, &params, &data_hash, progress)?;
            known.commit_checks(&found)?;
            if !params.quick {
                known.commit_numbers(&found)?;
            }
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
            n_motions: subject.motions.len(),
            length_s: subject.length_s(),
            run,
            is_up_to_date,
            has_metrics: !found.metrics.is_empty(),
            page: params.report,
            report,
            took_s: started.elapsed().as_secs_f64(),
        }))
    }
}

/// What is evaluated.
struct Evaluand {
    run: String,
    model: String,
    phrases: Phrases,
    motions: Vec<Motion>,
    /// What generate said of them, in the same order.
    generations: Vec<GenerationRow>,
    /// How they were processed; of 0.1 what was the default.
    postprocess: PostProcessConfig,
    /// Candidates that each motion was chosen from, at most.
    n_candidates: usize,
    /// What is to be known beside the numbers.
    notes: Vec<String>,
}

impl Evaluand {
    /// Reads what the user wants to be evaluated.
    fn read(store: &Location, params: &Params) -> anyhow::Result<Self> {
        let Some(run) = &params.run else { bail!("give --run NAME or --motions DIR") };
        let generations = motions::of_run(store, run, params.num_samples.map(Into::into))?;
        let phrases = Phrases::read(store, |rows| {
            let with_motion = rows.values().filter(|row| row.has_motion);
            let truth = with_motion.map(|row| row.phrase_id.clone());
            generations.iter().map(|row| row.phrase_id.clone()).chain(truth).collect()
        })?;
        let (splits, notes) = splits_of(store, &phrases, &generations)?;
        let motions = generations
            .iter()
            .zip(splits)
            .map(|(row, split)| Motion {
                phrase_id: row.phrase_id.clone(),
                sample: row.sample,
                split,
                misses: [row.control_error_mm, row.control_error_deg],
            })
            .collect();
        Ok(Self {
            run: run.clone(),
            model: generations[0].model.clone(),
            phrases,
            motions,
            generations,
            postprocess: PostProcessConfig::default(),
            n_candidates: 1,
            notes,
        })
    }

    /// Reads the frames of a motion.
    fn frames(&self, store: &Location, i: usize) -> anyhow::Result<Array2<f32>> {
        let motion = &self.motions[i];
        let sample = usize::try_from(motion.sample).unwrap_or(0);
        generated_frames(store, &self.run, &motion.phrase_id, sample)
    }

    fn length_s(&self) -> f64 {
        let n_frames: i64 = self.generations.iter().map(|row| row.n_frames).sum();
        frames_to_s(usize::try_from(n_frames).unwrap_or(0))
    }

    /// Returns a digest of the motions, of the splits that they are in, and of real motion.
    fn input_hash(&self, data_hash: &str) -> String {
        let mut text = data_hash.to_owned();
        for (row, motion) in self.generations.iter().zip(&self.motions) {
            text.push_str(&format!(
                "\n{} {} {} {} {}",
                row.generation,
                row.candidate,
                row.weights,
                row.time.0,
                motion.split.name()
            ));
        }
        digest(text.as_bytes())
    }

    /// Measures the motions, and all that they are compared with.
    fn evaluate(
        &mut self,
        store: &Location,
        params: &Params,
        data_hash: &str,
        progress: &dyn Progress,
    ) -> anyhow::Result<Rows> {
        let truth = match params.quick {
            true => None,
            false => truth::read(store, data_hash, params.threads, progress)?,
        };
        if let Some(truth) = &truth {
            self.hear(store, truth)?;
        }
        let has_phase = self.phrases.has_beats();
        let holds = |check: &str| holds_by_construction(check, &self.postprocess, has_phase);
        let job = Job {
            params,
            store,
            motions: &self.motions,
            phrases: &self.phrases,
            truth: truth.as_ref(),
            holds: &holds,
            phase: if self.postprocess.relock_phase {
                PhaseOrigin::Relocked
            } else {
                PhaseOrigin::Own
            },
            has_raw: true,
            has_network: params.baseline_windows > 0,
            sampled_split: None,
        };
        let evaluated = self.measured(store, &job, progress)?;
        let name = RunName { run: &self.run, model: &self.model };
        let mut rows = Rows::default();
        for (motion, found) in self.motions.iter().zip(&evaluated) {
            let (id, sample) = (motion.phrase_id.as_str(), motion.sample);
            if let Some(decoded) = &found.decoded {
                let none = |_: &str| false;
                let raw = rows::checks(name, id, sample, MadeAt::Raw, &decoded.checks, &none);
                rows.checks.extend(raw);
            }
            let is = rows::checks(name, id, sample, MadeAt::Final, &found.is.checks, &holds);
            rows.checks.extend(is);
        }
        if !params.quick {
            let found = job.numbers(&evaluated, &[], progress)?;
            rows.add(name, found, &|song| self.phrases.song_name(song));
        }
        Ok(rows)
    }

    /// Reads the activity of the songs that were danced to, and of those with held-out real motion.
    fn hear(&mut self, store: &Location, truth: &Truth) -> Result<(), StoreError> {
        let held_out = truth.phrases.iter().filter(|phrase| is_held_out(phrase.split));
        let ids = self.motions.iter().map(|motion| motion.phrase_id.as_str());
        let songs = self.phrases.songs_of(ids.chain(held_out.map(|phrase| phrase.id.as_str())));
        let songs: BTreeSet<String> = songs.into_iter().take(MAX_HEARD_SONGS).collect();
        let mut heard: Vec<(String, Array2<f32>)> = Vec::new();
        Snapshot::take(store, tables::features())?.visit_items(&songs, |id, features| {
            heard.push((id.to_owned(), features));
            Ok::<_, StoreError>(())
        })?;
        for (id, features) in heard {
            self.phrases.add_features(&id, features.view());
        }
        Ok(())
    }

    /// Reads and measures the motions of a run.
    fn measured(
        &self,
        store: &Location,
        job: &Job,
        progress: &dyn Progress,
    ) -> anyhow::Result<Vec<Evaluated>> {
        let n_frames: i64 = self.generations.iter().map(|row| row.n_frames).sum();
        let stride = stride_for(usize::try_from(n_frames).unwrap_or(MAX_KEPT_FRAMES));
        let measurer = job.measurer(stride);
        let places: BTreeMap<&str, usize> =
            self.generations.iter().map(|row| row.generation.as_str()).zip(0..).collect();
        let names: BTreeSet<String> =
            self.generations.iter().map(|row| row.generation.clone()).collect();
        progress.start("evaluate", "motions", self.motions.len() as u64);
        let read = |schema| -> Result<Vec<Option<MeasuredMotion>>, StoreError> {
            let table = Snapshot::take(store, schema)?;
            measurer.run(self.motions.len(), |give| {
                table.visit_items(&names, |name, frames: Array2<f32>| {
                    if let Some(&i) = places.get(name) {
                        give(i, frames);
                        progress.advance(1);
                    }
                    Ok::<_, StoreError>(())
                })
            })
        };
        let is = read(tables::generated())?;
        progress.finish();
        let missing = self.generations.iter().zip(&is).find(|(_, found)| found.is_none());
        if let Some((row, _)) = missing {
            bail!(
                "store {store} has no frames of {}, though it lists the motion; run motiongen generate \
                 again with --force",
                row.generation
            );
        }
        let evaluated =
            is.into_iter().flatten().map(|is| Evaluated { is, decoded: None }).collect();
        Ok(evaluated)
    }
}

/// Returns what the model that made each motion had to do with its music, as the card says, and a note where that is
/// not known.
fn splits_of(
    store: &Location,
    phrases: &Phrases,
    generations: &[GenerationRow],
) -> anyhow::Result<(Vec<MusicSplit>, Vec<String>)> {
    let mut models: BTreeMap<(&str, &str), Option<LearnedFrom>> = BTreeMap::new();
    let mut notes = Vec::new();
    for row in generations {
        let key = (row.model.as_str(), row.weights.as_str());
        if models.contains_key(&key) {
            continue;
        }
        let learned_from = match learned::of_model(store, key.0, key.1)? {
            Ok(learned_from) => Some(learned_from),
            Err(why) => {
                notes.push(format!(
                    "Nobody knows which of these songs model {} learned from: {why}.",
                    row.model
                ));
                None
            }
        };
        models.insert(key, learned_from);
    }
    let split = |row: &GenerationRow| -> MusicSplit {
        let learned_from = models.get(&(row.model.as_str(), row.weights.as_str()));
        match (learned_from, phrases.row(&row.phrase_id)) {
            (Some(Some(learned_from)), Some(phrase)) => {
                learned_from.split_of(phrase.song_hash.as_deref(), &phrase.content_hash)
            }
            _ => MusicSplit::Unknown,
        }
    };
    Ok((generations.iter().map(split).collect(), notes))
}

/// A required verdict that was not won, and how it ended.
type NotWon = (String, report::Outcome);

fn not_won(params: &Params, report: &Report) -> Vec<NotWon> {
    report
        .verdicts
        .iter()
        .filter(|verdict| params.require.iter().any(|asked| asked.asks_for(&verdict.verdict)))
        .filter(|verdict| verdict.outcome != report::Outcome::Won)
        .map(|verdict| (verdict.verdict.clone(), verdict.outcome))
        .collect()
}

/// A check set of which too few motions pass all: its name, the share, the share that was asked for, and how
/// many failed.
type Missed = (&'static str, f64, f64, usize);

fn missed(params: &Params, checks: &[SanityCheckRow]) -> Vec<Missed> {
    let wanted = [("reference", params.min_pass_rate), ("strict", params.min_strict_pass_rate)];
    let of = |(set, least): (&'static str, Option<f64>)| {
        let least = least?;
        let is_of_set = |row: &&SanityCheckRow| {
            row.check_set == set && row.stage.as_deref() != Some(MadeAt::Raw.name())
        };
        let of_set = || checks.iter().filter(is_of_set);
        let motion = |row: &SanityCheckRow| (row.phrase_id.clone(), row.sample);
        let all: BTreeSet<_> = of_set().map(motion).collect();
        let failed: BTreeSet<_> = of_set().filter(|row| !row.passed).map(motion).collect();
        let share = 1.0 - failed.len() as f64 / all.len().max(1) as f64;
        (share < least).then_some((set, share, least, failed.len()))
    };
    wanted.into_iter().filter_map(of).collect()
}

/// What was measured.
struct EvaluateSummary {
    store: String,
    run: String,
    n_motions: usize,
    length_s: f64,
    is_up_to_date: bool,
    has_metrics: bool,
    missed: Vec<Missed>,
    not_won: Vec<NotWon>,
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
        self.missed.iter().map(|(.., n)| *n as u64).sum::<u64>() + self.not_won.len() as u64
    }
}
