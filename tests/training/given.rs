//! Inputs of the golden files of `tests/golden/training`: the rules of its `given.py`.

use std::collections::BTreeMap;
use std::sync::Arc;

use motiongen::autodiff::Parameters;
use motiongen::motion::{MOTION_DIM, Normalizer};
use motiongen::training::{
    Augmentation, Batch, Chances, Dataset, Learner, LearningRate, LearningRateSchedule, Progress,
    Windows,
};
use motiongen::weights::{Archive, Precision, Section, save_to_file};

use crate::engine::golden::{Golden, uniform};

pub fn open(name: &str) -> Golden {
    Golden::open_in("training", &format!("{name}.safetensors"))
}

/// scale · u of a name, rounded to f32.
pub fn drawn(name: &str, scale: f64, n: usize) -> Vec<f32> {
    uniform(name, n).into_iter().map(|u| (scale * u) as f32).collect()
}

pub fn single(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&x| x as f32).collect()
}

/// Normalized motion: 1.5 u rounded to 1/256.
pub fn motion(name: &str, n: usize) -> Vec<f32> {
    let rounded = |u: f64| (256.0 * 1.5 * u).round_ties_even() / 256.0;
    uniform(name, n).into_iter().map(|u| rounded(u) as f32).collect()
}

/// Centres of multiples of 1/64, scales of powers of two.
pub fn normalizer() -> Normalizer {
    let mut normalizer = Normalizer::identity();
    let centre = uniform("normalizer.centre", MOTION_DIM);
    let scale = uniform("normalizer.scale", MOTION_DIM);
    for i in 0..MOTION_DIM {
        let is_quaternion = (9..13).contains(&i);
        let centre = (16.0 * centre[i]).round_ties_even() / 64.0;
        let scale = (1.5 * scale[i]).round_ties_even().exp2();
        normalizer.centre[i] = if is_quaternion { 0.0 } else { centre as f32 };
        normalizer.scale[i] = if is_quaternion { 0.5 } else { scale as f32 };
    }
    normalizer
}

/// The stored steps and mask, and inputs as they are given; nothing is withheld.
pub fn batch(golden: &Golden, x0: Vec<f32>, noise: Vec<f32>, audio: Vec<f32>) -> Batch {
    let &[n_windows, n_frames] = golden.shape("mask") else { panic!("[batch, frames]") };
    // In the middle of the step's share of the chances.
    let chance =
        |t: f64| Chances { step: (t + 0.5) / 1000.0, no_audio: 1.0, no_style: 1.0, no_clock: 1.0 };
    Batch {
        n_windows,
        n_frames,
        n_slots: 1,
        n_dancers: vec![1; n_windows],
        motion: x0,
        audio,
        mask: single(golden.values("mask")),
        style: vec![0.0; n_windows * 8],
        noise,
        chances: golden.values("t").iter().map(|&t| chance(t)).collect(),
        phrase_ids: (0..n_windows).map(|i| format!("phrase-{i}").into()).collect(),
    }
}

/// Windows of nothing, for learners that are given their batches.
pub fn windows(normalizer: Normalizer, n_frames: usize) -> Arc<Windows> {
    let dataset = Arc::new(Dataset::in_memory([]).expect("nothing to keep"));
    Arc::new(Windows::new(dataset, normalizer, Augmentation::default(), n_frames, 0))
}

pub fn constant_rate(peak: f64) -> LearningRate {
    LearningRate { peak, course: LearningRateSchedule::Constant, warmup_steps: 0 }
}

/// Gives a learner its weights, and an optimizer that has seen nothing.
pub fn begin_with(learner: &mut impl Learner, weights: &Parameters<f32>) {
    let zeros = vec![0.0; weights.all().len()];
    let values = |prefix: &str| if prefix.starts_with("adam.") { &zeros } else { weights.all() };
    let sections: Vec<_> = learner
        .sections()
        .into_iter()
        .map(|section| Section { values: values(section.prefix), ..section })
        .collect();
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    let file = save_to_file(&sections, Precision::F32, &BTreeMap::new(), file).expect("written");
    let bytes = std::fs::read(file.path()).expect("what was written");
    let archive = Archive::open(&bytes).expect("a safetensors file");
    learner.restore(&archive, "here", &Progress::default()).expect("weights that fit");
}

/// Returns a section of a learner, by name and in PyTorch's order.
pub fn section(learner: &impl Learner, prefix: &str) -> BTreeMap<String, Vec<f64>> {
    let sections = learner.sections();
    let section = sections.iter().find(|section| section.prefix == prefix).expect("a section");
    let values = |id| section.plan.unpack(id, section.values).into_iter().map(f64::from).collect();
    section.plan.list().iter().map(|(id, parameter)| (parameter.name.clone(), values(id))).collect()
}

/// Returns the gradient of a first step, which clipped to a norm of 1 is ten times the first moment.
pub fn first_gradient(learner: &impl Learner, norm: f64) -> BTreeMap<String, Vec<f64>> {
    let clip = (1.0 / (norm + 1e-6)).min(1.0);
    let mut moments = section(learner, "adam.m.");
    for m in moments.values_mut().flatten() {
        *m *= 10.0 / clip;
    }
    moments
}
