use std::num::NonZeroUsize;

use ndarray::concatenate;

use super::*;
use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::autodiff::Parameters;
use crate::diffusion::{DiffusionConfig, Prediction};
use crate::generation::control::{Constraints, WantedValue, orientation};
use crate::generation::tokens::kept_of;
use crate::generation::walk::walk;
use crate::model::{Planner, PlannerConfig, PlannerKind, Preset, Tokenizer, TokensConfig};
use crate::motion::postprocess::{PostProcessConfig, process};
use crate::motion::{CLOCK_DIM, ChannelLimits, Normalizer};
use crate::units::FPS;

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
        constraints: Option<(&Constraints, Control)>,
        seed: u64,
    ) -> Array2<f32> {
        let control = constraints.map_or(Control::None, |(_, control)| control);
        let constraints = constraints.map(|(constraints, _)| constraints);
        let condition = condition(n_frames);
        let constraints =
            constraints.map(|constraints| WeightedConstraints { constraints, strength: 1.0 });
        let condition = condition.view();
        let track = TokenTrack { phase, constraints, control, ..TokenTrack::new(condition, seed) };
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
fn a_dancer_keeps_tokens_of_another_in_every_window() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let bench = Bench::new(kind, 1);
        let condition = condition(61);
        let plans = |kept: &[Vec<Option<u32>>], seed| -> Vec<Vec<u32>> {
            let track = TokenTrack { kept, ..TokenTrack::new(condition.view(), seed) };
            let emit = |_| Ok::<_, EngineError>(());
            bench.generator(2).run(&track, emit).expect("a motion")
        };
        let first = plans(&[], 7);
        assert_eq!(first.iter().map(Vec::len).collect::<Vec<_>>(), [6, 6, 6, 6]);
        // The first tokens of a window go on from the window before.
        let generator = bench.generator(2);
        let windows = generator.windows(61);
        let n_shared = |i: usize| if i == 0 { 0 } else { 6 - windows.shift(i) / 4 };
        assert_eq!((0..4).map(n_shared).collect::<Vec<_>>(), [0, 3, 3, 2]);
        let own = |plans: &[Vec<u32>]| -> Vec<u32> {
            let behind = plans.iter().enumerate().flat_map(|(i, plan)| &plan[n_shared(i)..]);
            behind.copied().collect()
        };
        let kept = kept_of(&first, 0.5, 8);
        let shared = plans(&kept, 8);
        for (i, (kept, plan)) in kept.iter().zip(&shared).enumerate() {
            for (kept, token) in kept.iter().zip(plan).skip(n_shared(i)) {
                assert!(kept.is_none_or(|kept| kept == *token), "{}, window {i}", kind.name());
            }
        }
        assert_eq!(own(&plans(&kept_of(&first, 1.0, 8), 8)), own(&first), "{}", kind.name());
        assert_ne!(own(&shared), own(&first));
        assert_eq!(plans(&kept_of(&first, 0.0, 8), 8), plans(&[], 8));
    }
}

#[test]
fn a_plan_keeps_what_is_given_and_hears_the_music() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let bench = Bench::new(kind, 1);
        let (here, mut elsewhere) = (condition(22), condition(22));
        elsewhere.mapv_inplace(|x| 1.0 - x);
        let plan = |condition: &Array2<f32>, given: &[Option<u32>], seed| {
            let request = PlanRequest {
                condition: condition.view(),
                style: None,
                constraints: None,
                given,
                guidance: 3.0,
                seed,
                window: 4,
            };
            bench.planner.plan(&bench.plan, &request)
        };
        let given = [Some(31), Some(7), None, Some(2)];
        let tokens = plan(&here, &given, 1).expect("tokens");
        assert_eq!((tokens.len(), &tokens[..2], tokens[3]), (6, &[31, 7][..], 2));
        assert_eq!(plan(&here, &given, 1).expect("tokens"), tokens);
        let plans = |condition: &Array2<f32>| -> Vec<Vec<u32>> {
            (0..5).map(|seed| plan(condition, &[], seed).expect("tokens")).collect()
        };
        assert_ne!(plans(&here), plans(&elsewhere), "{}", kind.name());
        let error = plan(&here, &[None, Some(32)], 1).expect_err("no such token").to_string();
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
    let made = |control| bench.steered(61, None, Some((&constraints, control)), 7);
    let worst = |motion: &Array2<f32>| {
        constraints.errors(motion.view()).iter().map(|miss| miss.error).fold(0.0, f64::max)
    };
    // What has learned nothing goes where chance takes it.
    let free = worst(&made(Control::None));
    assert!(free > 0.1 && worst(&made(Control::Plan)) > 0.1, "{free}");
    for control in [Control::Decode, Control::Both] {
        let mut motion = made(control);
        assert_eq!(motion, made(control));
        // Windows are short here, so that a smooth correction has few frames to get there.
        assert!(worst(&motion) < 0.5 * free, "{} of {free}", worst(&motion));
        steer(&constraints, &mut motion, 0, Steering::Finish);
        assert!(worst(&motion) < 1e-6, "{}", worst(&motion));
    }
    assert_ne!(made(Control::Plan), made(Control::None), "the plan hears of them");
    assert_ne!(made(Control::Both), made(Control::Decode));
}

/// Parts of a walk, position and orientation, at every so many frames.
fn of_walk(frames: impl Iterator<Item = usize>) -> Vec<(usize, WantedValue)> {
    let path = walk(121);
    let asked = frames.flat_map(|t| {
        let axes = (0..3).map(move |axis| (t, axis));
        let axes = axes.map(|(t, axis)| {
            (t, WantedValue::Value { channel: axis, value: f64::from(path[[t, axis]]) })
        });
        let q = orientation(path.view(), t);
        axes.chain([(t, WantedValue::Orientation(q))]).collect::<Vec<_>>()
    });
    asked.collect()
}

/// Mean length of third differences of positions, m/s³.
fn jerk(motion: &Array2<f32>) -> f64 {
    let at = |t: usize, axis: usize| f64::from(motion[[t, axis]]);
    let of_frame = |t: usize| {
        let d =
            [0, 1, 2].map(|i| at(t + 3, i) - 3.0 * at(t + 2, i) + 3.0 * at(t + 1, i) - at(t, i));
        d.iter().map(|x| x * x).sum::<f64>().sqrt() * FPS.powi(3)
    };
    let n = motion.nrows() - 3;
    (0..n).map(of_frame).sum::<f64>() / n as f64
}

/// Motion as generate finishes it.
fn finished(mut motion: Array2<f32>, constraints: Option<&Constraints>) -> Array2<f32> {
    let config = PostProcessConfig::default();
    process(&config, &mut motion, None);
    if let Some(constraints) = constraints {
        steer(constraints, &mut motion, 0, Steering::Finish);
        process(&config.without_smoothing(), &mut motion, None);
    }
    motion
}

#[test]
fn keyframes_and_whole_paths_are_met_below_a_millimetre_without_spikes_whatever_the_model() {
    let bench = Bench::new(PlannerKind::Masked, 1);
    let free = jerk(&finished(bench.motion(121, None, 7), None));
    // 1, 5 and 20 % of the frames, and all: of a walk that a model without training knows nothing of.
    for (every, first) in [(100, 60), (20, 7), (5, 2), (1, 0)] {
        let asked = of_walk((first..121).step_by(every));
        let constraints = Constraints::new(asked, 121, ChannelLimits::Wide).expect("sound");
        let steered = bench.steered(121, None, Some((&constraints, Control::Both)), 7);
        let motion = finished(steered, Some(&constraints));
        let misses = constraints.errors(motion.view());
        let worst = |what: &str| {
            let misses = misses.iter().filter(|miss| miss.what.starts_with(what));
            misses.map(|miss| miss.error).fold(0.0, f64::max)
        };
        let (mm, deg) = (1e3 * worst("position"), worst("quaternion").to_degrees());
        let ratio = jerk(&motion) / free;
        assert!(mm < 0.01 && deg < 0.01, "every {every}: {mm} mm, {deg}°");
        assert!(ratio < 1.3, "every {every}: jerk × {ratio}");
    }
}

#[test]
fn with_two_conditions_guidance_leads_away_from_either_in_turns() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let bench = Bench::new(kind, 1);
        let here = condition(22);
        let mut asked = Array2::zeros((22, 12));
        asked
            .row_mut(9)
            .assign(&ndarray::arr1(&[2.0, -1.0, 0.5, 0., 0., 1., 0., 1., 0., 1., 1., 1.]));
        let plans = |guidance, asked: Option<&Array2<f32>>| -> Vec<Vec<u32>> {
            let plan = |seed| {
                let request = PlanRequest {
                    condition: here.view(),
                    style: None,
                    constraints: asked.map(|asked| asked.view()),
                    given: &[],
                    guidance,
                    seed,
                    window: 0,
                };
                bench.planner.plan(&bench.plan, &request).expect("tokens")
            };
            (0..12).map(plan).collect()
        };
        let name = kind.name();
        assert_eq!(plans(4.0, Some(&asked)), plans(4.0, Some(&asked)), "{name}");
        assert_ne!(plans(4.0, Some(&asked)), plans(4.0, None), "{name}: constraints are heard");
        assert_ne!(plans(4.0, Some(&asked)), plans(1.0, Some(&asked)), "{name}: guidance counts");
        assert_ne!(plans(1.0, Some(&asked)), plans(1.0, None), "{name}: they are, unguided");
    }
}
