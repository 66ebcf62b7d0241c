use ndarray::Array;

use super::*;
use crate::autodiff::Stream;
use crate::diffusion::{BetaSchedule, DiffusionConfig, Prediction};
use crate::model::Preset;
use crate::motion::MOTION_DIM;

/// Groups, dancers and frames, unequal so that no two axes can be mistaken for each other.
const N_GROUPS: usize = 2;
const N_DANCERS: usize = 3;
const N_FRAMES: usize = 9;

fn config() -> GroupConfig {
    GroupConfig { dropout: 0.0, ..GroupConfig::of(Preset::Tiny).expect("a preset of the family") }
}

/// Returns an engine whose weights are all drawn, since layers that begin at zero would hide every gradient.
fn engine() -> GroupEngine {
    let config = config();
    let mut parameters = Parameters::new(GroupNetworks::new(&config).1, 5);
    let mut drawn = vec![0.0_f32; parameters.all().len()];
    Stream::new(5, 0).normal(0, &mut drawn);
    parameters.all_mut().iter_mut().zip(&drawn).for_each(|(w, z)| *w += 0.05 * z);
    let one = NonZeroUsize::MIN;
    let scale = FeatureScale::identity(config.audio_cond_dim);
    GroupEngine::new(&config, parameters, &scale, (one, one)).expect("threads")
}

struct Case {
    n_dancers: usize,
    x: Array3<f32>,
    audio: Array3<f32>,
    z: Vec<f32>,
}

impl Case {
    fn new() -> Self {
        Self::of(N_DANCERS)
    }

    fn of(n_dancers: usize) -> Self {
        let config = config();
        let mut drawn = 0;
        let mut normal = |shape: (usize, usize, usize)| {
            let mut values = Array::zeros(shape);
            drawn += 1;
            let values_mut = values.as_slice_mut().expect("an array made in order");
            Stream::new(11, drawn).normal(0, values_mut);
            values
        };
        let x = normal((N_GROUPS * n_dancers, N_FRAMES, MOTION_DIM));
        let audio = normal((N_GROUPS, N_FRAMES, config.condition().dim()));
        let z = normal((1, 1, config.width)).into_raw_vec_and_offset().0;
        Self { n_dancers, x, audio, z }
    }

    fn inputs<'a>(
        &'a self,
        x: &'a Array3<f32>,
        consistency: (ConsistencyForm, f64),
    ) -> GroupEngineInputs<'a> {
        let (audio, z) = (self.audio.view(), &self.z[..]);
        let (t, n_dancers, guidance) = (400, self.n_dancers, 1.0);
        GroupEngineInputs { x: x.view(), t, audio, n_dancers, z, guidance, consistency }
    }
}

/// Returns the derivative of `f` along `direction` at `x`, by central differences.
fn along(x: &Array3<f32>, direction: &Array3<f32>, f: impl Fn(&Array3<f32>) -> f64) -> f64 {
    let h = 2e-2;
    (f(&(x + &(direction * h))) - f(&(x - &(direction * h)))) / (2.0 * f64::from(h))
}

/// Holds what γ added to the estimate against central differences of `f` at `x`, along the gradient and along
/// directions of chance.
fn assert_is_gradient(
    added: &Array3<f32>,
    factor: f64,
    x: &Array3<f32>,
    f: impl Fn(&Array3<f32>) -> f64,
) {
    let length = added.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
    assert!(length > 1e-3, "nothing was added: {length}");
    let gradient = added.mapv(|v| v / factor as f32);
    let norm = length / factor.abs();
    for draw in 0..4 {
        let mut direction = gradient.mapv(|v| v / norm as f32);
        if draw > 0 {
            Stream::new(23, draw).normal(0, direction.as_slice_mut().expect("in order"));
            let size = direction.iter().map(|v| v * v).sum::<f32>().sqrt();
            direction.mapv_inplace(|v| v / size);
        }
        let expected = along(x, &direction, &f);
        let products = gradient.iter().zip(&direction).map(|(g, d)| f64::from(*g) * f64::from(*d));
        let found: f64 = products.sum();
        // log f of f32 is known to 1e-6, differences over 0.04 to 3e-5; the third derivative adds some.
        let tolerance = 5e-3 * norm + 1e-4;
        assert!((found - expected).abs() < tolerance, "draw {draw}: {found}, {expected}");
    }
}

#[test]
fn every_form_has_the_factor_of_its_formula() {
    for beta_schedule in [BetaSchedule::Linear, BetaSchedule::Cosine] {
        let config = DiffusionConfig { beta_schedule, n_steps: 137, ..Default::default() };
        let schedule = Schedule::new(&config).expect("a schedule");
        for (t, gamma) in [(0, 0.7), (1, -0.3), (60, 1.0), (135, 0.5)] {
            let alpha_bar = |t: usize| schedule.alpha_bar(t);
            let before = if t == 0 { 1.0 } else { alpha_bar(t - 1) };
            for (form, expected) in [
                (ConsistencyForm::Direction, (1.0 - alpha_bar(t)).sqrt()),
                (ConsistencyForm::Estimate, 1.0 - alpha_bar(t)),
                (ConsistencyForm::Noise, (1.0 - alpha_bar(t)) / alpha_bar(t).sqrt()),
                (ConsistencyForm::Mean, (1.0 - before) / before.sqrt()),
            ] {
                let found = form.factor(&schedule, t, gamma);
                let expected = gamma * expected;
                assert!(
                    (found - expected).abs() <= 1e-9 * expected.abs(),
                    "{form:?} at {t}: {found}, {expected}"
                );
            }
        }
    }
}

#[test]
fn the_estimate_moves_along_the_gradient_of_the_score_at_the_estimate() {
    let (engine, case) = (engine(), Case::new());
    let none = engine.predict(&case.inputs(&case.x, (ConsistencyForm::Estimate, 0.0)));
    let x0 = none.expect("shapes fit");
    for factor in [1.0, -0.5] {
        let moved = engine.predict(&case.inputs(&case.x, (ConsistencyForm::Estimate, factor)));
        let added = moved.expect("shapes fit") - &x0;
        // The group embedding does not hear the motion, so it is the same at every point.
        assert_is_gradient(&added, factor, &x0, |x0| {
            let scores = engine.score(&case.inputs(x0, (ConsistencyForm::Estimate, 0.0)));
            scores.expect("shapes fit").iter().map(|s| f64::from(s.agreement)).sum()
        });
    }
}

#[test]
fn a_direction_is_that_of_the_estimate_and_has_the_same_length_for_every_group() {
    let (engine, case) = (engine(), Case::new());
    let predict =
        |form, factor| engine.predict(&case.inputs(&case.x, (form, factor))).expect("shapes fit");
    let x0 = predict(ConsistencyForm::Estimate, 0.0);
    let by_gradient = predict(ConsistencyForm::Estimate, 1.0) - &x0;
    for factor in [0.5, -0.25] {
        let added = predict(ConsistencyForm::Direction, factor) - &x0;
        for group in 0..N_GROUPS {
            let rows = ndarray::s![group * N_DANCERS..(group + 1) * N_DANCERS, .., ..];
            let (added, gradient) = (added.slice(rows), by_gradient.slice(rows));
            let dot = |a: ndarray::ArrayView3<f32>, b: ndarray::ArrayView3<f32>| -> f64 {
                a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
            };
            let rms = (dot(added, added) / added.len() as f64).sqrt();
            assert!((rms - factor.abs()).abs() < 1e-3, "group {group}: {rms}");
            let cosine =
                dot(added, gradient) / (dot(added, added) * dot(gradient, gradient)).sqrt();
            // A difference of estimates near 1 keeps five digits of a gradient of 1e-3.
            assert!((cosine - factor.signum()).abs() < 1e-3, "group {group}: {cosine}");
        }
    }
}

#[test]
fn the_other_forms_move_along_the_gradient_by_the_noisy_motion() {
    let (engine, case) = (engine(), Case::new());
    let plain = |x: &Array3<f32>| {
        engine.predict(&case.inputs(x, (ConsistencyForm::Noise, 0.0))).expect("shapes fit")
    };
    let x0 = plain(&case.x);
    for form in [ConsistencyForm::Noise, ConsistencyForm::Mean] {
        let moved = engine.predict(&case.inputs(&case.x, (form, 2.0))).expect("shapes fit");
        assert_is_gradient(&(moved - &x0), 2.0, &case.x, |x| {
            let scores = engine.score(&case.inputs(&plain(x), (form, 0.0)));
            scores.expect("shapes fit").iter().map(|s| f64::from(s.agreement)).sum()
        });
    }
}

#[test]
fn groups_of_a_call_do_not_move_each_other() {
    let (engine, case) = (engine(), Case::new());
    let form = (ConsistencyForm::Estimate, 1.0);
    let both = engine.predict(&case.inputs(&case.x, form)).expect("shapes fit");
    let second = Case {
        n_dancers: N_DANCERS,
        x: case.x.slice(ndarray::s![N_DANCERS.., .., ..]).to_owned(),
        audio: case.audio.slice(ndarray::s![1.., .., ..]).to_owned(),
        z: case.z.clone(),
    };
    let alone = engine.predict(&second.inputs(&second.x, form)).expect("shapes fit");
    let worst = (&both.slice(ndarray::s![N_DANCERS.., .., ..]) - &alone)
        .iter()
        .fold(0.0_f32, |worst, d| worst.max(d.abs()));
    assert!(worst < 1e-5, "{worst}");
}

/// Of one dancer there is no agreement with others: γ moves along the whole of log f, which tells the phrase.
#[test]
fn a_soloist_moves_along_log_f() {
    let (engine, case) = (engine(), Case::of(1));
    let form = ConsistencyForm::Estimate;
    let x0 = engine.predict(&case.inputs(&case.x, (form, 0.0))).expect("shapes fit");
    let moved = engine.predict(&case.inputs(&case.x, (form, 1.0))).expect("shapes fit");
    assert_is_gradient(&(moved - &x0), 1.0, &x0, |x0| {
        let scores = engine.score(&case.inputs(x0, (form, 0.0))).expect("shapes fit");
        scores.iter().map(|score| f64::from(score.log_ratio)).sum()
    });
}

/// A whole sampling with γ ends where what γ moves along is greater, and with -γ where it is less: of a soloist log f,
/// how well the dance fits its phrase; of a group the agreement of its dancers.
#[test]
fn sampling_ends_farther_along_the_score_the_greater_gamma_is() {
    use crate::diffusion::{SamplerConfig, Schedule};
    use crate::generation::{GroupGenerator, GroupTrack};
    use crate::motion::Normalizer;

    let (engine, normalizer) = (engine(), Normalizer::identity());
    let diffusion = DiffusionConfig {
        n_steps: config().n_steps,
        prediction: Prediction::Sample,
        clip_range: None,
        ..Default::default()
    };
    let schedule = Schedule::new(&diffusion).expect("a schedule");
    let case = Case::of(1);
    let sampler = SamplerConfig { n_steps: 6, clip: false, ..SamplerConfig::default() };
    for n_dancers in [1, 3] {
        for seed in 0..4 {
            let along = |gamma: f64| {
                let generator = GroupGenerator {
                    engine: &engine,
                    sampler: &sampler,
                    schedule: &schedule,
                    guidance: 1.0,
                    consistency: gamma,
                    form: ConsistencyForm::Direction,
                    normalizer: &normalizer,
                    window_frames: N_FRAMES,
                    overlap_frames: 2,
                };
                let condition = case.audio.index_axis(ndarray::Axis(0), 0);
                let track = GroupTrack { condition, phase: None, seed, n_dancers };
                let mut found = None;
                let emit = |part| -> Result<(), EngineError> {
                    found = Some(part);
                    Ok(())
                };
                generator.run(&track, emit).expect("a dance");
                let found: Array3<f32> = found.expect("one window");
                // The embedding that it was sampled with.
                let mut z = vec![0.0; engine.embedding_dim()];
                Stream::new(seed, u64::MAX).normal(0, &mut z);
                let inputs = GroupEngineInputs {
                    x: found.view(),
                    t: 0,
                    audio: case.audio.slice(ndarray::s![..1, .., ..]),
                    n_dancers,
                    z: &z,
                    guidance: 1.0,
                    consistency: (ConsistencyForm::Direction, 0.0),
                };
                let score = engine.score(&inputs).expect("shapes fit")[0].clone();
                if n_dancers == 1 { score.log_ratio } else { score.agreement }
            };
            let [low, middle, high] = [-1.0, 0.0, 1.0].map(along);
            // Dancers who agree already, 8 of the 10 that agreement can be, may end a little lower with γ = 1.
            let is_ordered = low < middle && low < high && (n_dancers > 1 || middle < high);
            assert!(is_ordered, "{n_dancers}, {seed}: {low} {middle} {high}");
        }
    }
}
