//! Schedules, weights, spacings and whole runs against `tests/golden/diffusion/make.py`.

use clap::ValueEnum;
use motiongen::diffusion::{
    DiffusionConfig, DiffusionError, Prediction, Sampler, SamplerConfig, Schedule, Spacing,
    min_snr_weights, sample, steps, timesteps,
};
use ndarray::{Array3, ArrayView3};
use serde::Deserialize;

/// Of every number of a schedule; the golden values are exact to 1e-16.
const TOLERANCE: f64 = 1e-12;

#[derive(Deserialize)]
struct Golden {
    schedules: Vec<ScheduleRow>,
    weights: Vec<WeightRow>,
    spacings: Vec<SpacingRow>,
    runs: Vec<RunRow>,
}

#[derive(Deserialize)]
struct ScheduleRow {
    schedule: String,
    n_steps: usize,
    t: Vec<usize>,
    beta: Vec<f64>,
    alpha_bar: Vec<f64>,
    alpha_bar_prev: Vec<f64>,
    snr: Vec<f64>,
    posterior_variance: Vec<f64>,
    posterior_mean_x0: Vec<f64>,
    posterior_mean_x_t: Vec<f64>,
}

#[derive(Deserialize)]
struct WeightRow {
    schedule: String,
    prediction: String,
    gamma: f64,
    t: Vec<usize>,
    weight: Vec<f64>,
}

#[derive(Deserialize)]
struct SpacingRow {
    n_train: usize,
    n_steps: usize,
    spacing: String,
    t: Vec<usize>,
}

#[derive(Deserialize)]
struct RunRow {
    sampler: String,
    eta: f64,
    schedule: String,
    n_train: usize,
    prediction: String,
    n_steps: usize,
    spacing: String,
    clip: Option<f64>,
    x: Vec<f64>,
}

fn golden() -> Golden {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/diffusion/schedules.json");
    let text = std::fs::read_to_string(path).expect("the golden file");
    serde_json::from_str(&text).expect("what make.py writes")
}

fn named<T: ValueEnum>(name: &str) -> T {
    T::from_str(name, false).expect("a name that make.py and the flags share")
}

fn schedule(
    name: &str,
    n_steps: usize,
    prediction: Prediction,
    clip_range: Option<f64>,
) -> Schedule {
    let beta_schedule = named(name);
    let config =
        DiffusionConfig { n_steps, beta_schedule, prediction, clip_range, ..Default::default() };
    Schedule::new(&config).expect("a schedule")
}

fn assert_near(got: f64, want: f64, place: &str) {
    let error = (got - want).abs();
    assert!(error <= TOLERANCE * want.abs(), "{place}: got {got}, wanted {want}");
}

#[test]
fn schedules_are_those_published() {
    let mut n_values = 0;
    for row in golden().schedules {
        let s = schedule(&row.schedule, row.n_steps, Prediction::Epsilon, None);
        assert_eq!(s.len(), row.n_steps);
        for (i, &t) in row.t.iter().enumerate() {
            let (x0, x_t) = s.posterior_mean_coefficients(t);
            for (what, got, want) in [
                ("beta", s.beta(t), row.beta[i]),
                ("alpha_bar", s.alpha_bar(t), row.alpha_bar[i]),
                ("alpha_bar_prev", s.alpha_bar_prev(t), row.alpha_bar_prev[i]),
                ("snr", s.snr(t), row.snr[i]),
                ("posterior_variance", s.posterior_variance(t), row.posterior_variance[i]),
                ("posterior mean of x0", x0, row.posterior_mean_x0[i]),
                ("posterior mean of x_t", x_t, row.posterior_mean_x_t[i]),
            ] {
                let place = format!("{} of {}, step {t}: {what}", row.schedule, row.n_steps);
                assert_near(got, want, &place);
                n_values += 1;
            }
        }
    }
    assert!(n_values > 1500, "only {n_values} values were compared");
}

#[test]
fn weights_are_those_published() {
    for row in golden().weights {
        let s = schedule(&row.schedule, 1000, named(&row.prediction), None);
        let weights = min_snr_weights(&s, &row.t, row.gamma).expect("weights");
        for ((&t, &got), &want) in row.t.iter().zip(&weights).zip(&row.weight) {
            assert_near(got, want, &format!("{} of {}, step {t}", row.prediction, row.schedule));
        }
    }
}

#[test]
fn spacings_are_those_of_diffusers_and_of_the_reference() {
    for row in golden().spacings {
        let got = timesteps(row.n_train, row.n_steps, named::<Spacing>(&row.spacing));
        assert_eq!(got, Ok(row.t), "{} of {}, {}", row.n_steps, row.n_train, row.spacing);
    }
}

/// The network of make.py: x0 = √ᾱ x − √(1−ᾱ) sin(x)/10, as any of the three predictions.
fn network(s: &Schedule, x: ArrayView3<'_, f32>, t: usize) -> Array3<f32> {
    let level = s.level(Some(t));
    x.mapv(|x| {
        let x = f64::from(x);
        let x0 = level.signal * x - level.noise * x.sin() / 10.0;
        let epsilon = (x - level.signal * x0) / level.noise;
        let prediction = match s.prediction() {
            Prediction::Epsilon => epsilon,
            Prediction::Sample => x0,
            Prediction::Velocity => level.signal * epsilon - level.noise * x0,
        };
        prediction as f32
    })
}

#[test]
fn runs_are_those_of_the_published_samplers() {
    for row in golden().runs {
        let s = schedule(&row.schedule, row.n_train, named(&row.prediction), row.clip);
        let sampler = match row.sampler.as_str() {
            "ddpm" => Sampler::Ddpm,
            "ddim" => Sampler::Ddim { eta: row.eta },
            _ => Sampler::DpmSolver,
        };
        let spacing = named(&row.spacing);
        let config = SamplerConfig { sampler, n_steps: row.n_steps, spacing, clip: true };
        let start = |i: usize| (1.5 * (5.0 * i as f64 + 2.0).sin()) as f32;
        let x = Array3::from_shape_fn((1, 3, 5), |(_, i, j)| start(5 * i + j));
        let noise = |draw: usize, z: &mut [f32]| {
            for (i, z) in z.iter_mut().enumerate() {
                *z = (1.5 * (7.0 * draw as f64 + 3.0 * i as f64 + 1.0).sin()) as f32;
            }
        };
        let denoise = |x: ArrayView3<'_, f32>, t| Ok::<_, DiffusionError>(network(&s, x, t));
        let got = sample(&config, &s, x, denoise, noise, None).expect("a sample");
        let case = format!(
            "{sampler:?}, {} steps of {} {}, {} spacing, clip {:?}",
            row.n_steps, row.n_train, row.schedule, row.spacing, row.clip
        );
        // An ε up to 1.5 in single precision is wrong by 2^-24 · 1.5; the first step, from ᾱ to ᾱ',
        // multiplies that by up to √(ᾱ'/ᾱ), 7000 where the cosine schedule ends. Later steps of this
        // network do not double it. 2e-6: the roundings of all other sums.
        let first = steps(row.n_train, row.n_steps, spacing).expect("steps")[0];
        let growth = match s.prediction() {
            Prediction::Epsilon => s.level(first.next).signal / s.level(Some(first.t)).signal,
            Prediction::Sample | Prediction::Velocity => 0.0,
        };
        let tolerance = 2.0 * 1.5 * 2.0_f64.powi(-24) * growth + 2e-6;
        for (i, (&got, &want)) in got.iter().zip(&row.x).enumerate() {
            let error = (f64::from(got) - want).abs();
            assert!(error < tolerance, "{case}, value {i}: got {got}, wanted {want}");
        }
    }
}
