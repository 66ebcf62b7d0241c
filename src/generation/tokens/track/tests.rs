use std::num::NonZeroUsize;

use ndarray::concatenate;

use super::*;
use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::autodiff::Parameters;
use crate::diffusion::{DiffusionConfig, Prediction};
use crate::generation::control::{Constraints, WantedValue};
use crate::model::{Planner, PlannerConfig, PlannerKind, Preset, Tokenizer, TokensConfig};
use crate::motion::{CLOCK_DIM, ChannelLimits, Normalizer};

const WINDOW_FRAMES: usize = 24;

struct Bench {
    tokens: TokenEngine,
    planner: PlannerEngine,
    plan: TokenSampling,
    sampler: SamplerConfig,
    schedule: Schedule,
}

impl Bench {
    fn new(kind: PlannerKind, n_workers: usize) -> Self {
        let sizes = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
        let workers = (NonZeroUsize::new(n_workers).expect("not 0"), NonZeroUsize::MIN);
        let (_, list) = Tokenizer::new(&sizes);
        let parameters = Parameters::new(list.without_zero_layers(), 3);
        let normalizer = Normalizer::identity();
        let tokens = TokenEngine::new(&sizes, parameters, &normalizer, WINDOW_FRAMES, workers)
            .expect("threads");
        let config = PlannerConfig::of(Preset::Tiny, kind, &sizes).expect("a preset");
        let parameters = Parameters::new(Planner::new(&config).1, 5);
        let scale = FeatureScale::identity(FEATURE_DIM);
        let planner = PlannerEngine::new(&config, parameters, &scale, workers).expect("threads");
        let diffusion = DiffusionConfig { prediction: Prediction::Sample, ..Default::default() };
        Self {
            tokens,
            planner,
            plan: TokenSampling { top_share: 1.0, ..TokenSampling::default() },
            sampler: SamplerConfig::fast27(),
            schedule: Schedule::new(&diffusion).expect("a schedule"),
        }
    }

    fn generator(&self, overlap_tokens: usize) -> TokenGenerator<'_> {
        TokenGenerator {
            tokens: &self.tokens,
            planner: &self.planner,
            plan: &self.plan,
            sampler: &self.sampler,
            schedule: &self.schedule,
            guidance: 1.5,
            overlap_tokens,
        }
    }

    fn motion(&self, n_frames: usize, phase: Option<&[f64]>, seed: u64) -> Array2<f32> {
        self.steered(n_frames, phase, None, seed)
    }

    fn steered(
        &self,
        n_frames: usize,
        phase: Option<&[f64]>,
        constraints: Option<&Constraints>,
        seed: u64,
    ) -> Array2<f32> {
        let condition = condition(n_frames);
        let constraints =
            constraints.map(|constraints| WeightedConstraints { constraints, strength: 1.0 });
        let condition = condition.view();
        let track = TokenTrack { condition, phase, style: None, constraints, seed };
        let mut parts: Vec<Array2<f32>> = Vec::new();
        let emit = |frames| -> Result<(), EngineError> {
            parts.push(frames);
            Ok(())
        };
        self.generator(2).run(&track, emit).expect("a motion");
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
        concatenate(Axis(0), &views).expect("of 25 channels")
    }
}

fn condition(n_frames: usize) -> Array2<f32> {
    Array2::from_shape_fn((n_frames, FEATURE_DIM + CLOCK_DIM), |(t, i)| {
        ((t * 7 + i * 13) as f32 * 0.1).sin()
    })
}

#[test]
fn windows_begin_with_tokens_and_cover_every_frame() {
    let bench = Bench::new(PlannerKind::Masked, 1);
    let generator = bench.generator(2);
    for n_frames in [1, 23, 24, 25, 61, 97, 240] {
        let windows = generator.windows(n_frames);
        let n = windows.of_tokens.len();
        assert_eq!(n, generator.n_windows(n_frames));
        assert_eq!((windows.frames(0).start, windows.frames(n - 1).end), (0, n_frames));
        for i in 1..n {
            let (before, here) = (windows.frames(i - 1), windows.frames(i));
            assert_eq!(here.start - before.start, windows.shift(i));
            assert!(here.start.is_multiple_of(4) && before.end - here.start >= 8, "{n_frames}");
            assert_eq!(before.len(), WINDOW_FRAMES, "only the last may be short");
        }
    }
}

#[test]
fn motion_is_as_long_as_the_music_and_the_same_by_any_number_of_workers() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let (one, three) = (Bench::new(kind, 1), Bench::new(kind, 3));
        for n_frames in [5, 24, 61] {
            let motion = one.motion(n_frames, None, 7);
            assert_eq!(motion.dim(), (n_frames, MOTION_DIM));
            assert!(motion.iter().all(|x| x.is_finite()));
            assert_eq!(motion, three.motion(n_frames, None, 7));
            assert_ne!(motion, one.motion(n_frames, None, 8));
        }
    }
}

#[test]
fn motion_has_the_phase_of_its_music() {
    let bench = Bench::new(PlannerKind::Masked, 1);
    let phase: Vec<f64> = (0..61).map(|t| f64::from(t) / 16.0 % 1.0).collect();
    let motion = bench.motion(61, Some(&phase), 7);
    let column = motion.column(Channel::Phase.range().start).to_vec();
    assert_eq!(column, phase.iter().map(|&x| x as f32).collect::<Vec<_>>());
}

#[test]
fn a_plan_keeps_what_is_given_and_hears_the_music() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let bench = Bench::new(kind, 1);
        let (here, mut elsewhere) = (condition(22), condition(22));
        elsewhere.mapv_inplace(|x| 1.0 - x);
        let plan = |condition: &Array2<f32>, given: &[u32], seed| {
            let request = PlanRequest {
                condition: condition.view(),
                style: None,
                given,
                guidance: 3.0,
                seed,
                window: 4,
            };
            bench.planner.plan(&bench.plan, &request)
        };
        let tokens = plan(&here, &[31, 7], 1).expect("tokens");
        assert_eq!((tokens.len(), &tokens[..2]), (6, &[31, 7][..]));
        assert_eq!(plan(&here, &[31, 7], 1).expect("tokens"), tokens);
        let plans = |condition: &Array2<f32>| -> Vec<Vec<u32>> {
            (0..5).map(|seed| plan(condition, &[], seed).expect("tokens")).collect()
        };
        assert_ne!(plans(&here), plans(&elsewhere), "{}", kind.name());
        let error = plan(&here, &[32], 1).expect_err("no such token").to_string();
        assert_eq!(
            error,
            "token 32 is none of the 32 that the planner knows, 0 to 31; give tokens of the tokenizer that it was \
             trained with"
        );
    }
}

#[test]
fn motion_goes_where_constraints_ask_it_to() {
    let bench = Bench::new(PlannerKind::Masked, 1);
    let value = |channel, value| WantedValue::Value { channel, value };
    let wanted =
        vec![(0, value(0, 1.5)), (0, value(2, -0.5)), (17, value(0, 2.0)), (50, value(2, 0.25))];
    let constraints = Constraints::new(wanted, 61, ChannelLimits::Wide).expect("sound constraints");
    let motion = bench.steered(61, None, Some(&constraints), 7);
    assert_eq!(motion, bench.steered(61, None, Some(&constraints), 7));
    for miss in constraints.errors(motion.view()) {
        // Windows are blended after they are made: frame 50 is of the last one, 17 of two that both meet it.
        assert!(miss.error < 5e-3, "{miss:?}");
    }
}
