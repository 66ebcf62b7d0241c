use ndarray::{Array3, ArrayView3, concatenate};
use proptest::prelude::*;

use super::*;
use crate::diffusion::{DiffusionConfig, Prediction, Sampler, SamplerConfig, Schedule, Spacing};
use crate::generation::control::WantedValue;
use crate::generation::engine::EngineInputs;
use crate::generation::walk::walk;
use crate::motion::{Channel, ChannelLimits};

const N_FEATURES: usize = 163;

/// A model that knows one motion by heart: the first feature of a frame is its number.
struct ByHeart {
    track: Array2<f32>,
    /// How far every window's estimate lies beside the motion, by the number of its first frame, m.
    offset_m: fn(usize) -> f32,
    normalizer: Normalizer,
    /// From this frame of a window on, orientations are decoded with the other sign.
    other_sign_from: usize,
}

impl Engine for ByHeart {
    fn name(&self) -> &'static str {
        "by heart"
    }

    fn n_workers(&self) -> usize {
        1
    }

    fn predict(&self, inputs: &EngineInputs) -> Result<Array3<f32>, EngineError> {
        inputs.check(N_FEATURES)?;
        let mut predicted = Array3::zeros(inputs.x.raw_dim());
        for (mut window, audio) in predicted.outer_iter_mut().zip(inputs.audio.outer_iter()) {
            let first = audio[[0, 0]] as usize;
            let mut known = self.track.slice(s![first..first + audio.nrows(), ..]).to_owned();
            Placement::of_first(known.view()).expect("frames").remove(&mut known);
            known.column_mut(1).mapv_inplace(|y| y + (self.offset_m)(first));
            self.normalizer.normalize(known.view_mut());
            window.assign(&known);
        }
        Ok(predicted)
    }

    fn decode(&self, latent: ArrayView3<f32>) -> Result<Array3<f32>, EngineError> {
        let mut motion = latent.to_owned();
        motion.outer_iter_mut().for_each(|window| self.normalizer.denormalize(window));
        for ((_, t, i), x) in motion.indexed_iter_mut() {
            if t >= self.other_sign_from && Channel::Quaternion.range().contains(&i) {
                *x = -*x;
            }
        }
        Ok(motion)
    }
}

fn numbered(n: usize) -> Array2<f32> {
    let mut features = Array2::zeros((n, N_FEATURES));
    features.column_mut(0).assign(&ndarray::Array1::range(0.0, n as f32, 1.0));
    features
}

fn schedule() -> Schedule {
    let config = DiffusionConfig {
        n_steps: 50,
        prediction: Prediction::Sample,
        clip_range: None,
        ..DiffusionConfig::default()
    };
    Schedule::new(&config).expect("a schedule")
}

fn sampler() -> SamplerConfig {
    let sampler = Sampler::Ddim { eta: 0.5 };
    SamplerConfig { sampler, n_steps: 3, spacing: Spacing::Trailing, clip: true }
}

/// Returns the motion, and how many frames came at once.
fn run(
    engine: &ByHeart,
    seed: u64,
    constraints: Option<WeightedConstraints>,
    overlap: usize,
) -> (Array2<f32>, Vec<usize>) {
    run_at(engine, seed, constraints, overlap, None)
}

/// Returns the motion of a track whose music has a phase, and how many frames came at once.
fn run_at(
    engine: &ByHeart,
    seed: u64,
    constraints: Option<WeightedConstraints>,
    overlap: usize,
    phase: Option<&[f64]>,
) -> (Array2<f32>, Vec<usize>) {
    let (schedule, config) = (schedule(), sampler());
    let generator = Generator {
        engine,
        sampling: Sampling { config: &config, schedule: &schedule, guidance: 1.0 },
        normalizer: &engine.normalizer,
        window_frames: 40,
        overlap_frames: overlap,
    };
    let features = numbered(engine.track.nrows());
    let condition = features.view();
    let track = Track { condition, phase, seed, style: None, constraints, primed: None };
    let mut parts: Vec<Array2<f32>> = Vec::new();
    generator
        .run(&track, |frames| {
            parts.push(frames);
            Ok::<_, EngineError>(())
        })
        .expect("a motion");
    let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
    let sizes = parts.iter().map(Array2::nrows).collect();
    (concatenate(Axis(0), &views).expect("25 channels"), sizes)
}

fn by_heart(n: usize, offset_m: fn(usize) -> f32) -> ByHeart {
    let track = walk(n);
    let normalizer = Normalizer::fit(track.view()).0;
    ByHeart { track, offset_m, normalizer, other_sign_from: usize::MAX }
}

fn largest_difference(a: &Array2<f32>, b: &Array2<f32>) -> f32 {
    assert_eq!(a.dim(), b.dim());
    let quaternion = Channel::Quaternion.range();
    let off = |((t, i), x): ((usize, usize), &f32)| {
        // q and -q are one turn.
        let same = (x - b[[t, i]]).abs();
        if quaternion.contains(&i) { same.min((x + b[[t, i]]).abs()) } else { same }
    };
    a.indexed_iter().map(off).fold(0.0, f32::max)
}

#[test]
fn what_a_model_knows_comes_out_at_any_length() {
    for n in [1, 7, 40, 41, 173, 401] {
        let engine = by_heart(n, |_| 0.0);
        let (motion, sizes) = run(&engine, 3, None, 10);
        assert_eq!(sizes.iter().sum::<usize>(), n);
        // Placed anew at up to 13 seams, of accelerations up to 5 m/s² and positions up to 10 m.
        let off = largest_difference(&motion, &engine.track);
        assert!(off < 2e-4, "{n} frames: {off:e}");
    }
}

#[test]
fn motion_is_sampled_with_the_phase_of_its_music() {
    // One window, and several that meet.
    for n in [33, 173] {
        let engine = by_heart(n, |_| 0.0);
        let phase: Vec<f64> = (0..n).map(|t| (0.37 + t as f64 / 47.0).fract()).collect();
        let (motion, _) = run_at(&engine, 3, None, 10, Some(&phase));
        let column = Channel::Phase.range().start;
        for (t, phase) in phase.iter().enumerate() {
            let off = (f64::from(motion[[t, column]]) - phase).abs();
            // Normalised and back; where windows are faded the shorter way round the bar is taken.
            assert!(off.min(1.0 - off) < 1e-5, "{t} of {n}: {} for {phase}", motion[[t, column]]);
        }
        let (without, _) = run(&engine, 3, None, 10);
        assert!((f64::from(without[[20, column]]) - phase[20]).abs() > 0.05);
        let others = |i: usize| {
            largest_difference(
                &motion.slice(s![.., i..i + 1]).to_owned(),
                &without.slice(s![.., i..i + 1]).to_owned(),
            )
        };
        assert!(others(0) < 1e-5 && others(9) < 1e-5, "nothing but the phase is given");
    }
}

#[test]
fn orientations_keep_their_sign_from_frame_to_frame() {
    for n in [33, 173] {
        let plain = by_heart(n, |_| 0.0);
        let engine = ByHeart { other_sign_from: 25, ..by_heart(n, |_| 0.0) };
        let (motion, _) = run(&engine, 3, None, 10);
        assert!(largest_difference(&motion, &plain.track) < 2e-4);
        for t in 1..n {
            let columns = Channel::Quaternion.range();
            let dot: f32 = columns.map(|i| motion[[t - 1, i]] * motion[[t, i]]).sum();
            assert!(dot > 0.9, "frame {t} of {n}: {dot}");
        }
    }
}

#[test]
fn frames_come_as_their_windows_are_final() {
    let (_, sizes) = run(&by_heart(401, |_| 0.0), 3, None, 10);
    // 401 frames are 14 windows of 40, the last of which comes at once.
    assert_eq!(sizes.len(), 14, "{sizes:?}");
    assert!(sizes[..13].iter().all(|n| (27..=28).contains(n)) && sizes[13] == 40, "{sizes:?}");
}

#[test]
fn windows_that_disagree_are_joined_smoothly() {
    // Every other window believes that the floor is 20 cm higher.
    let engine = by_heart(173, |first| if first % 2 == 0 { 0.2 } else { 0.0 });
    let (motion, _) = run(&engine, 3, None, 20);
    let step = |frames: &Array2<f32>, t: usize| (frames[[t + 1, 1]] - frames[[t, 1]]).abs();
    let most = |frames: &Array2<f32>| (0..172).map(|t| step(frames, t)).fold(0.0, f32::max);
    // 20 cm over 20 frames by 3u² − 2u³ are at most 1.5 cm a frame; the walk itself moves as much.
    assert!(most(&motion) < most(&engine.track) + 0.0151, "{}", most(&motion));
}

#[test]
fn a_track_passes_its_constraints() {
    let engine = by_heart(173, |_| 0.0);
    let wanted = vec![
        (0, WantedValue::Value { channel: 0, value: 1.5 }),
        (80, WantedValue::Value { channel: 1, value: 1.2 }),
        (150, WantedValue::Value { channel: 1, value: 0.5 }),
    ];
    let constraints = Constraints::new(wanted, 173, ChannelLimits::Wide).expect("constraints");
    let constrained = WeightedConstraints { constraints: &constraints, strength: 1.0 };
    let (motion, _) = run(&engine, 3, Some(constrained), 10);
    for miss in constraints.errors(motion.view()) {
        // The windows are placed one after another, and neighbours that share a frame are faded.
        assert!(miss.error < 1e-4, "{miss:?}");
    }
    assert!((motion[[0, 0]] - 1.5).abs() < 1e-6);
    // Far from any constraint it is the motion that the model knows, 1.5 m to the side.
    assert!((motion[[40, 0]] - engine.track[[40, 0]] - 1.5).abs() < 1e-4);
    assert!((motion[[110, 1]] - engine.track[[110, 1]]).abs() < 1e-4);
}

/// A model that hears no noise, so that what it is given is what it says.
struct Silent<'a>(&'a Normalizer);

impl Engine for Silent<'_> {
    fn name(&self) -> &'static str {
        "silent"
    }

    fn n_workers(&self) -> usize {
        1
    }

    fn predict(&self, inputs: &EngineInputs) -> Result<Array3<f32>, EngineError> {
        Ok(Array3::zeros(inputs.x.raw_dim()))
    }

    fn decode(&self, latent: ArrayView3<f32>) -> Result<Array3<f32>, EngineError> {
        let mut motion = latent.to_owned();
        motion.outer_iter_mut().for_each(|window| self.0.denormalize(window));
        Ok(motion)
    }
}

#[test]
fn a_track_begins_from_the_motion_of_its_windows_each_in_its_own_place() {
    let track = walk(173);
    let normalizer = Normalizer::fit(track.view()).0;
    let config = DiffusionConfig {
        n_steps: 50,
        prediction: Prediction::Epsilon,
        clip_range: None,
        ..DiffusionConfig::default()
    };
    let schedule = Schedule::new(&config).expect("a schedule");
    let sampler = Sampler::Ddim { eta: 0.0 };
    let config = SamplerConfig { sampler, n_steps: 1, spacing: Spacing::Trailing, clip: true };
    let engine = Silent(&normalizer);
    let generator = Generator {
        engine: &engine,
        sampling: Sampling { config: &config, schedule: &schedule, guidance: 1.0 },
        normalizer: &normalizer,
        window_frames: 40,
        overlap_frames: 10,
    };
    let windows = generator.windows(173);
    let mut own = Array2::zeros((0, MOTION_DIM));
    for i in 0..windows.len() {
        let mut window = track.slice(s![windows.frames(i), ..]).to_owned();
        Placement::of_first(window.view()).expect("frames").remove(&mut window);
        own.append(Axis(0), window.view()).expect("25 channels");
    }
    let features = numbered(173);
    // How far the motion is from the walk, in units of its spread.
    let off = |n_left: Option<usize>| {
        let primed = n_left.map(|n_left| PrimingMotion { motion: own.view(), n_left });
        let track_of = Track {
            condition: features.view(),
            phase: None,
            seed: 5,
            style: None,
            constraints: None,
            primed,
        };
        let mut motion = Array2::zeros((0, MOTION_DIM));
        let take = |frames: Array2<f32>| {
            motion.append(Axis(0), frames.view()).expect("25 channels");
            Ok::<_, EngineError>(())
        };
        generator.run(&track_of, take).expect("a motion");
        assert_eq!(motion.dim(), track.dim());
        let quaternion = Channel::Quaternion.range();
        let square = |((t, i), x): ((usize, usize), &f32)| {
            let (a, b) = (f64::from(*x), f64::from(track[[t, i]]));
            let off =
                if quaternion.contains(&i) { (a - b).abs().min((a + b).abs()) } else { a - b };
            (off / f64::from(normalizer.scale[i])).powi(2)
        };
        (motion.indexed_iter().map(square).sum::<f64>() / track.len() as f64).sqrt()
    };
    let (one, some, all) = (off(Some(1)), off(Some(9)), off(None));
    // At its first step the schedule has a deviation of 0.042; headings that are as wrong add up over the
    // six windows.
    assert!(one < 0.2, "{one}");
    assert!(2.0 * one < some && 2.0 * some < all, "{one}, {some}, {all}");
    assert_eq!(off(Some(0)), one, "a step is left at least");
}

#[test]
fn noise_belongs_to_frames_and_seeds() {
    let windows = Windows::new(101, 40, 10);
    let place = Placement::default();
    let fill = |range: std::ops::Range<usize>, seed, draw| {
        let mut z = vec![0.0_f32; range.len() * 40 * MOTION_DIM];
        Run { windows: &windows, range, before: None, first: place }.fill(seed, draw, &mut z);
        z
    };
    let all = fill(0..windows.len(), 5, 0);
    let shift = windows.shift(1);
    let window = 40 * MOTION_DIM;
    // Frames that two windows share have one noise, and a window has the same in any run.
    assert_eq!(all[shift * MOTION_DIM..window], all[window..window + (40 - shift) * MOTION_DIM]);
    assert_eq!(fill(1..2, 5, 0), all[window..2 * window]);
    assert!(fill(1..2, 5, 1) != fill(1..2, 5, 0) && fill(1..2, 6, 0) != fill(1..2, 5, 0));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn the_same_seed_gives_the_same_bits(n in 1usize..250, seed in any::<u64>()) {
        let engine = by_heart(n, |first| (first % 5) as f32 * 0.01);
        let bits = |motion: Array2<f32>| motion.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        prop_assert_eq!(bits(run(&engine, seed, None, 10).0), bits(run(&engine, seed, None, 10).0));
    }
}
