use std::sync::Mutex;

use ndarray::{Array2, concatenate};

use super::*;
use crate::diffusion::{DiffusionConfig, Prediction, Sampler, Spacing};
use crate::motion::MOTION_DIM;

const N_FEATURES: usize = 163;
const WINDOW_FRAMES: usize = 60;
const OVERLAP_FRAMES: usize = 15;
const N_STEPS: usize = 5;

/// What an estimator was asked for: rows of motion, and numbers of them.
#[derive(Clone, Copy, Debug, PartialEq)]
struct EstimatorCall {
    rows: usize,
    numbers: usize,
}

/// A model that knows the dance of a group by heart, and names its dancers anew in every window: the first feature of a
/// frame is its number.
struct ByHeart {
    normalizer: Normalizer,
    asked: Mutex<Vec<EstimatorCall>>,
    /// How far the estimate of a window lies above the dance, m, by the number of its first frame.
    offset_m: fn(usize) -> f32,
}

/// Where a dancer is at a frame: they stand 0.9 m apart and go about, each in a way of its own.
fn pose(dancer: usize, t: usize) -> [f32; MOTION_DIM] {
    let (k, s) = (dancer as f32, t as f32 / 30.0);
    let mut pose = [0.0; MOTION_DIM];
    pose[0] = 0.9 * k + 0.1 * (s * (0.7 + 0.1 * k)).sin();
    pose[1] = 1.0 + 0.05 * (s * 3.0 + k).sin();
    pose[2] = 0.4 * (s * 0.3 + k).cos();
    let half = 0.5 * (0.4 * s + k);
    (pose[9], pose[11]) = (half.cos(), half.sin());
    pose
}

fn dance(n_dancers: usize, frames: std::ops::Range<usize>) -> Array3<f32> {
    let first = frames.start;
    Array3::from_shape_fn((n_dancers, frames.len(), MOTION_DIM), |(k, t, c)| pose(k, first + t)[c])
}

impl GroupEstimator for ByHeart {
    fn name(&self) -> &'static str {
        "by heart"
    }

    fn embedding_dim(&self) -> usize {
        3
    }

    fn predict(&self, inputs: &GroupEngineInputs) -> Result<Array3<f32>, EngineError> {
        let asked = EstimatorCall { rows: inputs.x.dim().0, numbers: inputs.x.len() };
        self.asked.lock().expect("no panic before").push(asked);
        let mut predicted = Array3::zeros(inputs.x.raw_dim());
        for (i, audio) in inputs.audio.outer_iter().enumerate() {
            let first = audio[[0, 0]] as usize;
            let n = inputs.n_dancers;
            let known = dance(n, first..first + audio.nrows());
            for k in 0..n {
                // Another order in every window: turned by as many places as windows went before, and back to front.
                let named = (n - 1 - k + first / 7) % n;
                let mut dancer = known.index_axis(Axis(0), named).to_owned();
                dancer.column_mut(1).mapv_inplace(|y| y + (self.offset_m)(first));
                self.normalizer.normalize(dancer.view_mut());
                predicted.index_axis_mut(Axis(0), i * n + k).assign(&dancer);
            }
        }
        Ok(predicted)
    }
}

/// Generates for `n_frames` frames; returns the parts as they were given out, and what was asked.
fn generated(
    n_dancers: usize,
    n_frames: usize,
    offset_m: fn(usize) -> f32,
) -> (Vec<Array3<f32>>, Vec<EstimatorCall>) {
    let normalizer = Normalizer::identity();
    let engine = ByHeart { normalizer: normalizer.clone(), asked: Mutex::default(), offset_m };
    let schedule = Schedule::new(&DiffusionConfig {
        n_steps: 50,
        prediction: Prediction::Sample,
        clip_range: None,
        ..DiffusionConfig::default()
    });
    let generator = GroupGenerator {
        engine: &engine,
        sampler: &SamplerConfig {
            sampler: Sampler::DpmSolver,
            n_steps: N_STEPS,
            spacing: Spacing::Trailing,
            clip: false,
        },
        schedule: &schedule.expect("a schedule"),
        guidance: 1.0,
        consistency: 0.0,
        form: ConsistencyForm::Direction,
        normalizer: &normalizer,
        window_frames: WINDOW_FRAMES,
        overlap_frames: OVERLAP_FRAMES,
    };
    let mut features = Array2::zeros((n_frames, N_FEATURES));
    features.column_mut(0).assign(&ndarray::Array1::range(0.0, n_frames as f32, 1.0));
    let track = GroupTrack { condition: features.view(), phase: None, seed: 3, n_dancers };
    let mut parts = Vec::new();
    let emit = |part| -> Result<(), EngineError> {
        parts.push(part);
        Ok(())
    };
    generator.run(&track, emit).expect("a dance");
    let asked = engine.asked.into_inner().expect("no panic before");
    (parts, asked)
}

fn joined(parts: &[Array3<f32>]) -> Array3<f32> {
    let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
    concatenate(Axis(1), &views).expect("parts of one group")
}

#[test]
fn three_minutes_of_five_dancers_have_no_identity_swap_and_no_seam() {
    let n_frames = 3 * 60 * 30;
    let (parts, _) = generated(5, n_frames, |_| 0.0);
    let found = joined(&parts);
    assert_eq!(found.dim(), (5, n_frames, MOTION_DIM));
    // The names of the first window stay to the end.
    let known = dance(5, 0..n_frames);
    for dancer in found.outer_iter() {
        let distance = |k: usize| {
            let other = known.index_axis(Axis(0), k);
            (&dancer - &other).iter().fold(0.0_f32, |worst, d| worst.max(d.abs()))
        };
        let nearest = (0..5).map(distance).fold(f32::INFINITY, f32::min);
        // f32 of positions up to 4 m, through a normaliser and five steps.
        assert!(nearest < 1e-3, "{nearest}");
    }
}

#[test]
fn windows_that_disagree_meet_no_faster_than_motion_moves_elsewhere() {
    // Windows lie up to 5 cm above each other: the blend hands over within the shared frames.
    let (parts, _) = generated(3, 1200, |first| 0.05 * ((first / 45) % 2) as f32);
    let found = joined(&parts);
    let mut elsewhere: Vec<f32> = Vec::new();
    let mut seams: Vec<f32> = Vec::new();
    let hop = WINDOW_FRAMES - OVERLAP_FRAMES;
    for dancer in found.outer_iter() {
        for t in 1..dancer.nrows() {
            let step: f32 = (0..3).map(|c| (dancer[[t, c]] - dancer[[t - 1, c]]).powi(2)).sum();
            // Where a part ends and the next begins.
            if t % hop == 0 { seams.push(step.sqrt()) } else { elsewhere.push(step.sqrt()) }
        }
    }
    elsewhere.sort_by(f32::total_cmp);
    let limit = elsewhere[elsewhere.len() * 95 / 100];
    let above = seams.iter().filter(|step| **step > limit).count();
    // Of 78 seams 4 would lie above the 95th percentile; 5 cm that are blended over the shared frames make 8 of them.
    // Were they not blended, every second seam would be a step of 5 cm.
    assert!(above <= 12, "{above} of {} above {limit}", seams.len());
}

#[test]
fn twice_the_length_costs_twice_the_calls_and_no_more_memory() {
    let cost = |n_dancers, n_windows: usize| {
        let hop = WINDOW_FRAMES - OVERLAP_FRAMES;
        let (parts, asked) = generated(n_dancers, OVERLAP_FRAMES + n_windows * hop, |_| 0.0);
        let rows: usize = asked.iter().map(|asked| asked.rows).sum();
        let largest = asked.iter().map(|asked| asked.numbers).max().expect("calls");
        let part = parts.iter().map(Array3::len).max().expect("parts");
        (asked.len(), rows, largest, part)
    };
    let (calls, rows, largest, part) = cost(3, 8);
    // Four windows are sampled at a time.
    assert_eq!((calls, rows), (2 * N_STEPS, 8 * 3 * N_STEPS));
    assert_eq!(largest, 4 * 3 * WINDOW_FRAMES * MOTION_DIM);
    assert_eq!(part, 3 * WINDOW_FRAMES * MOTION_DIM);
    assert_eq!(cost(3, 16), (2 * calls, 2 * rows, largest, part), "twice the length");
    assert_eq!(cost(6, 8), (calls, 2 * rows, 2 * largest, 2 * part), "twice the dancers");
}
