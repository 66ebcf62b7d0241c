//! A tokenizer: how near motion that it did not learn from comes when it is written as tokens and made again.

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use anyhow::{Context as _, ensure};
use ndarray::Array2;

use super::Evaluate;
use super::measure::Measurer;
use super::metrics_summary::MetricsSummary;
use super::motions::{self, PhraseIndex, is_held_out};
use super::params::Params;
use super::rows::{EvaluationRows, RunIdentity, RunName};
use super::splits::MusicSplit;
use super::subjects::{Finding, MeasureSettings, MeasuredWindow, Subject};
use super::truth::{self, Truth, TruthPhrase};
use crate::autodiff::{Parameters, Stream};
use crate::diffusion::{SamplerConfig, Schedule};
use crate::evaluation::metrics::{
    CodeUse, PhaseOrigin, ReconstructedPhrase, reconstruction_numbers,
};
use crate::evaluation::reconstruction_error;
use crate::evaluation::window::window_starts;
use crate::generation::{Decoding, Reconstruction, TokenEngine, shuffle};
use crate::model::Tokenizer;
use crate::motion::Channel;
use crate::stages::generate::seed_of;
use crate::stages::pool::{self, lock};
use crate::stages::trained::TrainedTokenizer;
use crate::stages::{Progress, Stage as _, Summary, learned, lease};
use crate::store::{self, Location, StoreSnapshot, digest};
use crate::training::{Ensemble, perplexity};
use crate::units::frames_to_s;

/// Raised when this evaluation writes something else for the same weights and motion.
const OUTPUT_VERSION: u32 = 2;
/// Phrases of each split that are made again: those whose names have the smallest digests.
const MAX_PHRASES: usize = 400;
/// Seed of the noise that motion is made of again.
const SEED: u64 = 2026;

/// Metrics that people are shown; the table has all.
const SHOWN: [&str; 9] = [
    "reconstruction_position",
    "reconstruction_orientation",
    "code_perplexity",
    "tokens_per_frame",
    "fid_k",
    "fid_g",
    "position_jerk",
    "pass_rate",
    "locking_r2",
];

/// Which tokenizer motion is made again by.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Maker {
    Trained,
    /// The trained one, the tokens of each window in an order of chance.
    Shuffled,
    /// The trained one without its diffusion decoder.
    Draft,
    /// The networks and the codebook with their first weights.
    Untrained,
}

impl Maker {
    const ALL: [Self; 4] = [Self::Trained, Self::Shuffled, Self::Draft, Self::Untrained];

    fn subject(self) -> Subject {
        match self {
            Self::Trained => Subject::Reconstructed,
            Self::Shuffled => Subject::ShuffledPlan,
            Self::Draft => Subject::Draft,
            Self::Untrained => Subject::Untrained,
        }
    }
}

/// A phrase that is made again.
struct Original<'a> {
    split: MusicSplit,
    song: usize,
    phrase: &'a TruthPhrase,
}

/// Runs the stage on the tokenizer of a run.
///
/// # Errors
/// Errors of the store, a run without a tokenizer, and a store without real motion that it did not learn from.
pub fn run(
    params: &Params,
    store: &Location,
    run: &str,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let started = Instant::now();
    let name = params.name.as_deref().unwrap_or(run);
    crate::stages::train::session::check_run_name(name)
        .with_context(|| format!("--name {name}"))?;
    let trained = TrainedTokenizer::read(store, run)?;
    let snapshot = StoreSnapshot::take(store)?;
    ensure!(
        !motions::has_run(&snapshot, name)?,
        "store {store} has a run \"{name}\" of generate, whose evaluation this one would replace; give another --name"
    );
    let phrases = PhraseIndex::read(&snapshot, [])?;
    let data_hash = phrases.truth_digest();
    let network = trained.state.config.network.clone();
    let weights = crate::stages::export::weights_sha256(&trained.parameters);
    let settings = (params.num_samples, params.num_frames, params.limits, params.baseline_windows);
    let params_hash = digest(format!("tokenizer {OUTPUT_VERSION}\n{settings:?}").as_bytes());
    let learned_from = learned::listed(store, run)?;
    if learned_from.is_none() {
        progress.note(&format!(
            "run {run} does not tell what it learned from, so that nothing of its phrases is known to be held out"
        ));
    }
    let input_hash = digest(format!("{weights}\n{data_hash}\n{learned_from:?}").as_bytes());
    let identity = RunIdentity {
        store,
        run: name,
        params_hash: &params_hash,
        whole_hash: &params_hash,
        input_hash: &input_hash,
    };
    let is_up_to_date = !params.force && identity.is_up_to_date(Evaluate::NAME)?;
    let split_of = |id: &str| match (&learned_from, phrases.row(id)) {
        (Some(learned), Some(row)) => learned.split_of(row.song_hash.as_deref(), &row.content_hash),
        _ => MusicSplit::Unknown,
    };
    let mut summary = MetricsSummary {
        store: store.to_string(),
        run: name.to_owned(),
        items: "phrases",
        n_motions: 0,
        length_s: 0.0,
        is_up_to_date,
        dry_run: params.dry_run,
        metrics: Vec::new(),
        shown: &SHOWN,
        took_s: 0.0,
    };
    let nothing_to_compare = || {
        format!(
            "store {store} has too little real motion to hold that of a tokenizer against; build a library with \
             motiongen library first"
        )
    };
    let truth = truth::read(&snapshot, (&data_hash, Ensemble::Soloists), params.threads, progress)?;
    let truth = truth.with_context(nothing_to_compare)?;
    let originals = originals(&truth, &phrases, &split_of, params.num_samples);
    ensure!(
        !originals.is_empty(),
        "run {run} learned from every phrase with motion of store {store}; evaluate holds a tokenizer against motion \
         that it did not learn from, so build a library with other songs (motiongen library --test-songs)"
    );
    summary.n_motions = originals.len();
    let n_frames: usize = originals.iter().map(|original| original.phrase.motion.nrows()).sum();
    summary.length_s = frames_to_s(n_frames);
    if params.dry_run {
        return Ok(Box::new(summary));
    }
    if is_up_to_date {
        summary.metrics = EvaluationRows::read(store, name, false)?.metrics;
        summary.took_s = started.elapsed().as_secs_f64();
        return Ok(Box::new(summary));
    }
    let (lease_name, what) =
        (format!("{}/{name}", Evaluate::NAME), format!("evaluation of {name}"));
    let (lease, _) = lease::take(store, &lease_name, &what, &|text| progress.note(text))?;
    store.sweep();
    let engine = |parameters| {
        let threads = (params.threads, NonZeroUsize::MIN);
        let (sizes, normalizer) = (&network.tokens, &trained.state.scales.motion);
        TokenEngine::new(sizes, parameters, normalizer, network.window_frames, threads)
            .context("while starting threads")
    };
    let first = Parameters::new(Tokenizer::new(&network.tokens).1.without_zero_layers(), 0);
    let (of_run, untrained) = (engine(trained.parameters)?, engine(first)?);
    let schedule = Schedule::new(&network.diffusion)?;
    let job = TokenizerJob { params, truth: &truth, phrases: &phrases, schedule: &schedule };
    let mut findings = Vec::new();
    for maker in Maker::ALL {
        if maker == Maker::Draft && !network.tokens.draft {
            continue;
        }
        let engine = if maker == Maker::Untrained { &untrained } else { &of_run };
        let is_compared = matches!(maker, Maker::Trained | Maker::Draft);
        let n = if is_compared { originals.len() } else { params.baseline_windows };
        let chosen = &originals[..n.min(originals.len())];
        let made = job.made(maker, engine, chosen, progress)?;
        findings.extend(job.findings(maker, engine.sizes().codes, chosen, &made));
    }
    findings.extend(job.of_real_motion(&originals));
    findings.retain(|finding: &Finding| !finding.numbers.is_empty());
    let found = super::job::EvaluationFindings { findings, verdicts: Vec::new() };
    let mut rows = EvaluationRows::default();
    rows.add(RunName { run: name, model: run }, found, &|song| phrases.song_name(song));
    lease.check()?;
    identity.commit_numbers(&rows)?;
    store::checkpoint(store, &[Evaluate::NAME]);
    summary.metrics = rows.metrics;
    summary.took_s = started.elapsed().as_secs_f64();
    Ok(Box::new(summary))
}

/// Returns the phrases with real motion that a tokenizer did not learn from, at most [`MAX_PHRASES`] of each split, and
/// `most` in all, in order of the digests of their names.
fn originals<'a>(
    truth: &'a Truth,
    phrases: &PhraseIndex,
    split_of: &dyn Fn(&str) -> MusicSplit,
    most: Option<NonZeroUsize>,
) -> Vec<Original<'a>> {
    let mut all: Vec<&TruthPhrase> = truth.phrases.iter().collect();
    all.sort_by_cached_key(|phrase| digest(phrase.id.as_bytes()));
    let mut n_of_split: BTreeMap<&str, usize> = BTreeMap::new();
    let chosen = all.into_iter().filter_map(|phrase| {
        let split = split_of(&phrase.id);
        // Where nobody knows, the split of the store is the best guess of what was not learned from.
        let is_learned = match split {
            MusicSplit::TrainedOn => true,
            MusicSplit::Unknown => !is_held_out(phrase.split),
            MusicSplit::HeldOut | MusicSplit::Validation => false,
        };
        let n = n_of_split.entry(split.name()).or_default();
        if is_learned || *n == MAX_PHRASES {
            return None;
        }
        *n += 1;
        Some(Original { split, song: phrases.song(&phrase.id), phrase })
    });
    chosen.take(most.map_or(usize::MAX, Into::into)).collect()
}

/// What originals are made again and measured with.
struct TokenizerJob<'a> {
    params: &'a Params,
    truth: &'a Truth,
    phrases: &'a PhraseIndex,
    schedule: &'a Schedule,
}

impl TokenizerJob<'_> {
    /// Makes phrases again, in order.
    fn made(
        &self,
        maker: Maker,
        engine: &TokenEngine,
        originals: &[Original],
        progress: &dyn Progress,
    ) -> anyhow::Result<Vec<Reconstruction>> {
        progress.start("reconstruct", "phrases", originals.len() as u64);
        let sampler = SamplerConfig::fast27();
        let made: Mutex<BTreeMap<usize, Reconstruction>> = Mutex::new(BTreeMap::new());
        let mut queue = originals.iter().enumerate();
        pool::run(
            self.params.threads,
            || queue.next(),
            |(i, original): (usize, &Original)| -> anyhow::Result<()> {
                let id = &original.phrase.id;
                let seed = seed_of(SEED, id, 0, 0);
                let change = |tokens: &mut [u32]| {
                    if maker == Maker::Shuffled {
                        shuffle(tokens, Stream::new(seed, u64::MAX));
                    }
                };
                let decoding = match maker {
                    Maker::Draft => Decoding::Draft,
                    _ => Decoding::Diffusion { sampler: &sampler, schedule: self.schedule },
                };
                let motion = original.phrase.motion.view();
                let found = engine.reconstruct(motion, decoding, seed, change);
                let found = found.with_context(|| format!("while reconstructing phrase {id}"))?;
                lock(&made).insert(i, found);
                progress.advance(1);
                Ok(())
            },
        )?;
        progress.finish();
        let made = made.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        Ok(made.into_values().collect())
    }

    /// Measures what was made again, split by split.
    fn findings(
        &self,
        maker: Maker,
        n_codes: usize,
        originals: &[Original],
        made: &[Reconstruction],
    ) -> Vec<Finding> {
        let splits: BTreeSet<&'static str> =
            originals.iter().map(|original| original.split.name()).collect();
        let finding = |split: &'static str| {
            let of_split: Vec<(&Original, &Reconstruction)> = originals
                .iter()
                .zip(made)
                .filter(|(original, _)| original.split.name() == split)
                .collect();
            let mut counts: BTreeMap<u32, u64> = BTreeMap::new();
            for token in of_split.iter().flat_map(|(_, made)| &made.tokens) {
                *counts.entry(*token).or_default() += 1;
            }
            let phrases: Vec<ReconstructedPhrase> = of_split
                .iter()
                .filter_map(|(original, made)| {
                    let pair = (original.phrase.motion.view(), made.motion.view());
                    let error = reconstruction_error([pair])?;
                    Some(ReconstructedPhrase { song: original.song, error })
                })
                .collect();
            let counts: Vec<u64> = counts.into_values().collect();
            let codes = CodeUse {
                n_codes,
                perplexity: perplexity(&counts),
                n_tokens: of_split.iter().map(|(_, made)| made.tokens.len()).sum(),
                n_frames: of_split.iter().map(|(_, made)| made.motion.nrows()).sum(),
            };
            let mut numbers = reconstruction_numbers(&phrases, codes);
            let motions = of_split.iter().map(|(original, made)| (*original, &made.motion));
            numbers.extend(self.numbers(split, motions));
            Finding { subject: maker.subject(), split, numbers }
        };
        splits.into_iter().map(finding).collect()
    }

    /// Measures the phrases themselves.
    fn of_real_motion(&self, originals: &[Original]) -> Vec<Finding> {
        let splits: BTreeSet<&'static str> =
            originals.iter().map(|original| original.split.name()).collect();
        let finding = |split: &'static str| {
            let of_split = originals.iter().filter(|original| original.split.name() == split);
            let motions = of_split.map(|original| (original, &original.phrase.motion));
            Finding { subject: Subject::HeldOutTruth, split, numbers: self.numbers(split, motions) }
        };
        splits.into_iter().map(finding).collect()
    }

    /// Measures motions by their windows as those of generate are, each with the music of its phrase.
    fn numbers<'b>(
        &self,
        split: &'static str,
        motions: impl Iterator<Item = (&'b Original<'b>, &'b Array2<f32>)>,
    ) -> Vec<crate::evaluation::metrics::Number> {
        let measurer = Measurer {
            limits: self.params.limits,
            reference: Some(&self.truth.statistics),
            window_frames: self.truth.statistics.window_frames,
            num_frames: self.params.num_frames.map(Into::into),
            // Values of channels are not compared.
            stride: 1 << 20,
            threads: self.params.threads,
        };
        let motions: Vec<(&Original, &Array2<f32>)> = motions.collect();
        let feed = |give: &mut dyn FnMut(usize, Array2<f32>)| {
            for (i, (_, motion)) in motions.iter().enumerate() {
                give(i, (*motion).clone());
            }
            Ok::<_, std::convert::Infallible>(())
        };
        let Ok(measured) = measurer.run(motions.len(), feed);
        let mut items = Vec::new();
        for (number, ((original, _), measured)) in motions.iter().zip(measured).enumerate() {
            let Some(measured) = measured else { continue };
            // The bars of what was made again are those of the motion that it was.
            let phase = original.phrase.motion.column(Channel::Phase.range().start);
            let phase: Vec<f64> = phase.iter().map(|&x| f64::from(x)).collect();
            let music = self.phrases.music_of_real(&original.phrase.id, &phase).map(Arc::new);
            let firsts = window_starts(measured.n_frames, measurer.window_frames);
            items.extend(firsts.zip(measured.windows).map(|(first_frame, window)| {
                MeasuredWindow {
                    song: original.song,
                    phrase: number,
                    first_frame,
                    split: original.split,
                    measured: Arc::new(window),
                    decoded: None,
                    music: music.clone(),
                }
            }));
        }
        let items: Vec<&MeasuredWindow> = items.iter().collect();
        let settings = MeasureSettings {
            reference: Some(&self.truth.statistics),
            coupling: None,
            n_frechet: items.len(),
            threads: self.params.threads,
        };
        settings.numbers(split, &items, PhaseOrigin::Own)
    }
}
