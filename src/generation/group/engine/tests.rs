use ndarray::Array;

use super::*;
use crate::autodiff::Stream;
use crate::diffusion::{BetaSchedule, DiffusionConfig};
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
    x: Array3<f32>,
    audio: Array3<f32>,
    z: Vec<f32>,
}

impl Case {
    fn new() -> Self {
        let config = config();
        let mut drawn = 0;
        let mut normal = |shape: (usize, usize, usize)| {
            let mut values = Array::zeros(shape);
            drawn += 1;
            let values_mut = values.as_slice_mut().expect("an array made in order");
            Stream::new(11, drawn).normal(0, values_mut);
            values
        };
        let x = normal((N_GROUPS * N_DANCERS, N_FRAMES, MOTION_DIM));
        let audio = normal((N_GROUPS, N_FRAMES, config.condition().dim()));
        let z = normal((1, 1, config.width)).into_raw_vec_and_offset().0;
        Self { x, audio, z }
    }

    fn inputs<'a>(
        &'a self,
        x: &'a Array3<f32>,
        consistency: (ConsistencyForm, f64),
    ) -> GroupEngineInputs<'a> {
        let (audio, z) = (self.audio.view(), &self.z[..]);
        let (t, n_dancers, guidance) = (400, N_DANCERS, 1.0);
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
