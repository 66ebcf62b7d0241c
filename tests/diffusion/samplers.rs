//! Every sampler, with the exact denoiser of a Gaussian, samples that Gaussian.

use motiongen::autodiff::Stream;
use motiongen::diffusion::{
    BetaSchedule, DiffusionConfig, Level, Prediction, Sampler, SamplerConfig, SamplerStep,
    Schedule, Spacing, sample, steps,
};
use ndarray::{Array3, ArrayView3};

use super::gaussian::{D, Gaussian, Moments};
use super::propagation::{Axes, moments, propagate};

/// Stream of x_T; draw i of a sampler is stream i of the same seed.
const START: u64 = u64::MAX;

pub fn schedule(beta_schedule: BetaSchedule, prediction: Prediction) -> Schedule {
    let clip_range = None;
    let config =
        DiffusionConfig { beta_schedule, prediction, clip_range, ..DiffusionConfig::default() };
    Schedule::new(&config).expect("a schedule")
}

pub fn config(sampler: Sampler, n_steps: usize, spacing: Spacing) -> SamplerConfig {
    SamplerConfig { sampler, n_steps, spacing, clip: true }
}

pub fn start(seed: u64, n: usize) -> Array3<f32> {
    let mut x = Array3::zeros((n, 1, D));
    Stream::new(seed, START).normal(0, x.as_slice_mut().expect("standard order"));
    x
}

pub fn noise(seed: u64) -> impl FnMut(usize, &mut [f32]) {
    move |draw, z| Stream::new(seed, draw as u64).normal(0, z)
}

pub const DDIM: Sampler = Sampler::Ddim { eta: 0.0 };

#[rustfmt::skip]
const CASES: [(Sampler, usize, Spacing, BetaSchedule, Prediction); 18] = [
    (Sampler::Ddpm,               1000, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Epsilon),
    (Sampler::Ddpm,                250, Spacing::Trailing,  BetaSchedule::Linear, Prediction::Sample),
    (Sampler::Ddpm,                 50, Spacing::Linspace,  BetaSchedule::Cosine, Prediction::Velocity),
    (Sampler::Ddpm,                 40, Spacing::Leading,   BetaSchedule::Sqrt,   Prediction::Epsilon),
    (DDIM,                          20, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Epsilon),
    (DDIM,                          20, Spacing::Reference, BetaSchedule::Cosine, Prediction::Epsilon),
    (DDIM,                          50, Spacing::Leading,   BetaSchedule::Linear, Prediction::Sample),
    (DDIM,                         100, Spacing::Linspace,  BetaSchedule::Sqrt,   Prediction::Velocity),
    (Sampler::Ddim { eta: 0.5 },    50, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Sample),
    (Sampler::Ddim { eta: 0.5 },    20, Spacing::Reference, BetaSchedule::Linear, Prediction::Velocity),
    (Sampler::Ddim { eta: 1.0 },   100, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Epsilon),
    (Sampler::Ddim { eta: 1.0 },    30, Spacing::Leading,   BetaSchedule::Linear, Prediction::Velocity),
    (Sampler::DpmSolver,             8, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Epsilon),
    (Sampler::DpmSolver,            15, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Sample),
    (Sampler::DpmSolver,            20, Spacing::Trailing,  BetaSchedule::Cosine, Prediction::Velocity),
    (Sampler::DpmSolver,            15, Spacing::Linspace,  BetaSchedule::Linear, Prediction::Epsilon),
    (Sampler::DpmSolver,            20, Spacing::Leading,   BetaSchedule::Sqrt,   Prediction::Velocity),
    (Sampler::DpmSolver,            10, Spacing::Reference, BetaSchedule::Cosine, Prediction::Sample),
];

#[test]
fn samples_have_the_mean_and_covariance_that_follow_from_the_steps() {
    const N: usize = 4000;
    let gaussian = Gaussian::new();
    for (seed, (sampler, n_steps, spacing, beta_schedule, prediction)) in (40..).zip(CASES) {
        let schedule = schedule(beta_schedule, prediction);
        let config = config(sampler, n_steps, spacing);
        let x = start(seed, N);
        let denoise = |x: ArrayView3<'_, f32>, t| gaussian.denoise(&schedule, x, t);
        let x = sample(&config, &schedule, x, denoise, noise(seed), None).expect("samples");
        let case = format!("{config:?}, {beta_schedule:?}, {prediction:?}, seed {seed}");
        // Single precision is far below the standard errors, which are 0.003 at least.
        moments(&gaussian, &schedule, &config).assert_seen(&Moments::of(&x), N, 1e-3, &case);
    }
}

/// Returns the largest error, over the axes, of the deviation that `steps` leave of x_t distributed
/// exactly as it is at the first of them.
fn deviation_error(schedule: &Schedule, sampler: Sampler, steps: &[SamplerStep]) -> f64 {
    let gaussian = Gaussian::new();
    let exact = |t| {
        let Level { signal, noise } = schedule.level(t);
        Axes {
            mean: gaussian.on_axes(gaussian.mean).map(|m| signal * m),
            variance: gaussian.variances.map(|s| signal * signal * s + noise * noise),
        }
    };
    let got = propagate(&gaussian, schedule, sampler, steps, exact(Some(steps[0].t)));
    let want = exact(steps[steps.len() - 1].next);
    let mut largest = 0.0_f64;
    for k in 0..D {
        // x̂0 of the mean is the mean: no sampler moves it, with however few steps.
        assert!((got.mean[k] - want.mean[k]).abs() < 1e-9, "{sampler:?}, axis {k}: {got:?}");
        largest = largest.max((got.variance[k].sqrt() - want.variance[k].sqrt()).abs());
    }
    largest
}

#[test]
fn samples_approach_the_gaussian_with_more_steps() {
    // Deviations are 0.2 to 1.38. Bounds are a tenth above what the recursion gives; statistics do
    // not enter.
    #[rustfmt::skip]
    let cases = [
        (Sampler::Ddpm,              BetaSchedule::Cosine, [(20, 0.142), (100, 0.0316), (1000, 0.00332)]),
        (Sampler::Ddpm,              BetaSchedule::Linear, [(20, 0.214), (100, 0.0516), (1000, 0.00560)]),
        (Sampler::Ddim { eta: 0.5 }, BetaSchedule::Cosine, [(20, 0.102), (100, 0.0216), (1000, 0.00222)]),
        (DDIM,                       BetaSchedule::Cosine, [(20, 0.096), (100, 0.0196), (1000, 0.00200)]),
        (DDIM,                       BetaSchedule::Linear, [(20, 0.119), (100, 0.0246), (1000, 0.00250)]),
        (Sampler::DpmSolver,         BetaSchedule::Cosine, [(8, 0.085), (20, 0.0191), (50, 0.00371)]),
        (Sampler::DpmSolver,         BetaSchedule::Linear, [(8, 0.149), (20, 0.0560), (50, 0.0123)]),
    ];
    for (sampler, beta_schedule, bounds) in cases {
        let schedule = schedule(beta_schedule, Prediction::Epsilon);
        for (n_steps, bound) in bounds {
            let steps = steps(schedule.len(), n_steps, Spacing::Trailing).expect("steps");
            let error = deviation_error(&schedule, sampler, &steps);
            assert!(
                error < bound,
                "{sampler:?}, {beta_schedule:?}, {n_steps} steps: {error} is not below {bound}"
            );
        }
    }
}

#[test]
fn ddim_is_of_first_order_and_dpm_solver_of_second() {
    // 40, 80 and 160 steps from t = 900 to 100; the second order is 1.87, then 1.94, and its error 30 to
    // 56 times smaller. The jump to clean data and the first step out of almost nothing but noise are
    // left out: they are of first order whatever the solver.
    let schedule = schedule(BetaSchedule::Cosine, Prediction::Epsilon);
    let error = |sampler, width: usize| {
        let t: Vec<usize> = (100..=900).rev().step_by(width).collect();
        let steps: Vec<SamplerStep> =
            t.windows(2).map(|pair| SamplerStep { t: pair[0], next: Some(pair[1]) }).collect();
        deviation_error(&schedule, sampler, &steps)
    };
    for (sampler, order) in [(DDIM, 1.0), (Sampler::DpmSolver, 2.0)] {
        for width in [20, 10] {
            let got = (error(sampler, width) / error(sampler, width / 2)).log2();
            assert!((got - order).abs() < 0.15, "{sampler:?}, steps of {width}: order {got}");
        }
    }
}
