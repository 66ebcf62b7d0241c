//! What planning and decoding cost, and that what is kept of a plan changes nothing.

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use ndarray::{Array2, Array3, ArrayView3};

use super::eager::{EagerPlanner, EagerTokenizer};
use super::networks::{
    PlanWindow, PlannerNetworks, TokenizerNetworks, WindowPlan, WithheldConditions,
};
use super::*;
use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::autodiff::{Arena, Eager, Interpreter as _, Parameters};
use crate::diffusion::{DiffusionConfig, Prediction, SamplerConfig, Schedule, TokenSampling};
use crate::generation::engine::EngineError;
use crate::model::{
    CONSTRAINT_DIM, Planner, PlannerConfig, PlannerInputs, PlannerKind, Preset, Tokenizer,
    TokensConfig,
};
use crate::motion::style::STYLE_DIM;
use crate::motion::{CLOCK_DIM, Normalizer};

const WINDOW_FRAMES: usize = 24;
const ONE: (NonZeroUsize, NonZeroUsize) = (NonZeroUsize::MIN, NonZeroUsize::MIN);

/// How often networks were run.
#[derive(Default)]
struct Counts {
    plans: AtomicUsize,
    /// Answers that plans gave.
    answers: AtomicUsize,
    encoded: AtomicUsize,
    signals: AtomicUsize,
    estimates: AtomicUsize,
}

fn count(of: &AtomicUsize) {
    of.fetch_add(1, Ordering::Relaxed);
}

struct CountedTokenizer(EagerTokenizer, Arc<Counts>);

impl TokenizerNetworks for CountedTokenizer {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn n_workers(&self) -> usize {
        self.0.n_workers()
    }

    fn encode(&self, motion: ArrayView3<f32>) -> Result<Vec<u32>, EngineError> {
        count(&self.1.encoded);
        self.0.encode(motion)
    }

    fn signal(&self, tokens: &[u32], windows: (usize, usize)) -> Result<Array3<f32>, EngineError> {
        count(&self.1.signals);
        self.0.signal(tokens, windows)
    }

    fn denoise(
        &self,
        x: ArrayView3<f32>,
        t: usize,
        signal: ArrayView3<f32>,
    ) -> Result<Array3<f32>, EngineError> {
        count(&self.1.estimates);
        self.0.denoise(x, t, signal)
    }
}

struct CountedPlanner(EagerPlanner, Arc<Counts>);

struct CountedPlan<'a>(Box<dyn WindowPlan + 'a>, &'a Counts);

impl PlannerNetworks for CountedPlanner {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn begin<'a>(&'a self, window: &PlanWindow) -> Result<Box<dyn WindowPlan + 'a>, EngineError> {
        count(&self.1.plans);
        Ok(Box::new(CountedPlan(self.0.begin(window)?, &self.1)))
    }
}

impl WindowPlan for CountedPlan<'_> {
    fn logits(&mut self, tokens: &[u32]) -> Result<Vec<f32>, EngineError> {
        count(&self.1.answers);
        self.0.logits(tokens)
    }
}

fn sizes() -> TokensConfig {
    TokensConfig::of(Preset::Tiny).expect("a preset of the family")
}

fn planner_config(kind: PlannerKind, style_dim: usize) -> PlannerConfig {
    let tiny = PlannerConfig::of(Preset::Tiny, kind, &sizes()).expect("a preset of the family");
    PlannerConfig { style_dim, ..tiny }
}

fn planner_parameters(config: &PlannerConfig) -> Parameters<f32> {
    Parameters::new(Planner::new(config).1, 5)
}

fn eager_planner(config: &PlannerConfig, n_threads: usize) -> EagerPlanner {
    let scale = FeatureScale::identity(FEATURE_DIM);
    let workers = (NonZeroUsize::MIN, NonZeroUsize::new(n_threads).expect("not 0"));
    EagerPlanner::new(config, planner_parameters(config), &scale, workers).expect("threads")
}

fn condition(n_frames: usize) -> Array2<f32> {
    Array2::from_shape_fn((n_frames, FEATURE_DIM + CLOCK_DIM), |(t, i)| {
        ((t * 7 + i * 13) as f32 * 0.1).sin()
    })
}

/// The whole network for every token, over a window whose other tokens are 0: what is kept is held against it.
struct WholePlanner {
    config: PlannerConfig,
    planner: Planner,
    parameters: Parameters<f32>,
}

struct WholePlan<'a> {
    of: &'a WholePlanner,
    condition: Array2<f32>,
    style: [f32; STYLE_DIM],
    asked: Option<Array2<f32>>,
    dropped: Vec<f32>,
    without: Vec<f32>,
}

impl PlannerNetworks for WholePlanner {
    fn name(&self) -> &'static str {
        "whole"
    }

    fn begin<'a>(&'a self, window: &PlanWindow) -> Result<Box<dyn WindowPlan + 'a>, EngineError> {
        Ok(Box::new(WholePlan {
            of: self,
            condition: window.condition.to_owned(),
            style: window.style.unwrap_or_default(),
            asked: window.constraints.map(|asked| asked.to_owned()),
            dropped: window.drops(|withheld| withheld.music),
            without: window.drops(|withheld| withheld.constraints),
        }))
    }
}

impl WindowPlan for WholePlan<'_> {
    fn logits(&mut self, tokens: &[u32]) -> Result<Vec<f32>, EngineError> {
        let WholePlanner { config, planner, parameters } = self.of;
        let (n, frames) = (self.dropped.len(), self.condition.nrows());
        let n_tokens = config.n_tokens(frames);
        let mut seen: Vec<f32> = tokens.iter().map(|&token| token as f32).collect();
        seen.resize(n_tokens, 0.0);
        let audio: Vec<f32> = self.condition.iter().copied().collect();
        let arena = Arena::default();
        let mut g = Eager::new(parameters, &arena);
        let seen = g.constant(&[n, n_tokens], &seen.repeat(n));
        let audio = g.constant(&[n, frames, self.condition.ncols()], &audio.repeat(n));
        let dropped = g.constant(&[n], &self.dropped);
        let style = g.constant(&[n, STYLE_DIM], &self.style.repeat(n));
        let asked = self.asked.as_ref().map(|asked| {
            let values: Vec<f32> = asked.iter().copied().collect();
            g.constant(&[n, frames, asked.ncols()], &values.repeat(n))
        });
        let without = asked.is_some().then(|| g.constant(&[n], &self.without));
        let inputs = PlannerInputs {
            tokens: &seen,
            audio: &audio,
            drop_audio: Some(&dropped),
            style: (config.style_dim > 0).then_some(&style),
            constraints: asked.as_ref(),
            drop_constraints: without.as_ref(),
            mask: None,
        };
        let logits = planner.forward(&mut g, &inputs)?;
        let answers = logits.data().chunks_exact(n_tokens * config.codes);
        let next = tokens.len() * config.codes;
        Ok(answers.flat_map(|answer| &answer[next..][..config.codes]).copied().collect())
    }
}

#[test]
fn what_is_kept_of_a_plan_changes_no_bit() {
    let asked = Array2::from_shape_fn((39, CONSTRAINT_DIM), |(t, i)| ((t + i * 5) as f32).cos());
    for (style_dim, n_threads, asked) in
        [(0, 1, None), (STYLE_DIM, 3, None), (0, 2, Some(asked.view()))]
    {
        let config = planner_config(PlannerKind::Autoregressive, style_dim);
        let whole = WholePlanner {
            planner: Planner::new(&config).0,
            parameters: planner_parameters(&config),
            config: config.clone(),
        };
        let kept = eager_planner(&config, n_threads);
        let condition = condition(39);
        let style = (style_dim > 0).then_some([0.5, -1.0, 0.25, 0.0, 1.0, -0.5, 0.75, 0.1]);
        let window = PlanWindow {
            condition: condition.view(),
            style,
            constraints: asked,
            withheld: &[
                WithheldConditions::default(),
                WithheldConditions { music: true, constraints: false },
                WithheldConditions { music: false, constraints: true },
            ],
        };
        let tokens: Vec<u32> = (0..10).map(|i| i * 7 % 32).collect();
        // From nothing token by token, and from several at once that are given.
        for first in [0, 1, 4] {
            let mut kept = kept.begin(&window).expect("a plan");
            let mut whole = whole.begin(&window).expect("a plan");
            for n in first..tokens.len() {
                let found = kept.logits(&tokens[..n]).expect("logits");
                assert_eq!(found.len(), 3 * 32);
                assert_ne!(found[..32], found[32..64], "music is heard");
                // Where nothing is asked, nothing can be withheld.
                let is_heard = found[..32] != found[64..];
                assert_eq!(is_heard, asked.is_some(), "constraints");
                assert_eq!(found, whole.logits(&tokens[..n]).expect("logits"), "token {n}");
            }
        }
        let kept = PlannerEngine::with(&config, Box::new(kept));
        let whole = PlannerEngine::with(&config, Box::new(whole));
        let middle = [Some(3), None, None, Some(30), Some(2)];
        let beginning = [Some(31), Some(7), Some(7)];
        for (given, guidance) in [(&[][..], 1.0), (&beginning, 2.5), (&middle, 0.0)] {
            let request = PlanRequest {
                condition: condition.view(),
                style,
                constraints: asked,
                given,
                guidance,
                seed: 11,
                window: 3,
            };
            let plan = TokenSampling { top_share: 1.0, ..TokenSampling::default() };
            let found = kept.plan(&plan, &request).expect("tokens");
            assert_eq!(found.len(), 10);
            let is_kept =
                given.iter().zip(&found).all(|(given, found)| given.is_none_or(|x| x == *found));
            assert!(is_kept, "{given:?}: {found:?}");
            assert_eq!(found, whole.plan(&plan, &request).expect("tokens"), "{given:?}");
        }
    }
}

/// Generates a track of so many frames; returns how often networks were run, and how many plans had begun when the first
/// frames came.
fn run(kind: PlannerKind, n_frames: usize) -> ([usize; 5], usize) {
    let counts = Arc::new(Counts::default());
    let config = planner_config(kind, 0);
    let (_, list) = Tokenizer::new(&sizes());
    let parameters = Parameters::new(list.without_zero_layers(), 3);
    let tokenizer = EagerTokenizer::new(&sizes(), parameters, ONE).expect("threads");
    let tokenizer = CountedTokenizer(tokenizer, Arc::clone(&counts));
    let normalizer = Normalizer::identity();
    let tokens = TokenEngine::with(&sizes(), Box::new(tokenizer), &normalizer, WINDOW_FRAMES);
    let planner = CountedPlanner(eager_planner(&config, 1), Arc::clone(&counts));
    let planner = PlannerEngine::with(&config, Box::new(planner));
    let diffusion = DiffusionConfig { prediction: Prediction::Sample, ..Default::default() };
    let generator = TokenGenerator {
        tokens: &tokens,
        planner: &planner,
        plan: &TokenSampling::default(),
        sampler: &SamplerConfig::fast27(),
        schedule: &Schedule::new(&diffusion).expect("a schedule"),
        guidance: 2.0,
        overlap_tokens: 2,
    };
    let condition = condition(n_frames);
    let track = TokenTrack::new(condition.view(), 7);
    let (mut n_given, mut begun_at_first) = (0, 0);
    let emit = |frames: Array2<f32>| -> Result<(), EngineError> {
        if n_given == 0 {
            begun_at_first = counts.plans.load(Ordering::Relaxed);
        }
        n_given += frames.nrows();
        Ok(())
    };
    generator.run(&track, emit).expect("a motion");
    assert_eq!(n_given, n_frames);
    let Counts { plans, answers, encoded, signals, estimates } = &*counts;
    let all = [plans, answers, encoded, signals, estimates];
    (all.map(|count| count.load(Ordering::Relaxed)), begun_at_first)
}

#[test]
fn a_track_of_twice_the_windows_runs_every_network_twice_as_often() {
    // Windows of 6 tokens that share 2: 3 of them in 14 tokens, 6 in 26, the last frame missing.
    for (kind, per_window) in [(PlannerKind::Masked, 10), (PlannerKind::Autoregressive, 4)] {
        let (once, twice) = (run(kind, 55).0, run(kind, 103).0);
        let name = kind.name();
        // The autoregressive kind has two tokens more to draw in the first window, which is given none.
        let first = if kind == PlannerKind::Autoregressive { 2 } else { 0 };
        assert_eq!(once, [3, 3 * per_window + first, 2, 3, 3 * 27], "{name}");
        assert_eq!(twice, [6, 6 * per_window + first, 5, 6, 6 * 27], "{name}");
    }
}

#[test]
fn frames_come_when_the_first_window_is_there() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        for n_frames in [9, 55, 103] {
            assert_eq!(run(kind, n_frames).1, 1, "{} {n_frames}", kind.name());
        }
    }
}
