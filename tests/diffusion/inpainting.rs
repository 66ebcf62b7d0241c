//! In-painting with the exact denoiser of a Gaussian.

use motiongen::diffusion::{
    BetaSchedule, KnownValues, Prediction, Sampler, Spacing, sample, steps,
};
use ndarray::{Array3, ArrayView3};

use super::gaussian::{D, Gaussian, Moments, PAIR};
use super::propagation::{moments, published};
use super::samplers::{DDIM, config, noise, schedule, start};

#[test]
fn known_values_stay_and_the_rest_follows_them() {
    const N: usize = 4000;
    const VALUE: f64 = 2.6;
    let gaussian = Gaussian::new();
    let (free, fixed) = PAIR;
    let covariance = gaussian.covariance();
    // E[x_free | x_fixed] = μ_free + Σ_free,fixed / Σ_fixed,fixed (x_fixed − μ_fixed).
    let (mean, mean_fixed) = (gaussian.mean[free], gaussian.mean[fixed]);
    let slope = covariance[[free, fixed]] / covariance[[fixed, fixed]];
    let conditional = slope * (VALUE - mean_fixed);
    let values = Array3::from_elem((N, 1, D), VALUE as f32);
    let mask = Array3::from_shape_fn((N, 1, D), |(_, _, k)| k == fixed);
    let known = KnownValues::new(values, mask).expect("known values");
    for (seed, (sampler, n_steps, prediction)) in (70..).zip([
        (Sampler::Ddpm, 250, Prediction::Epsilon),
        (Sampler::Ddpm, 50, Prediction::Velocity),
        (Sampler::Ddim { eta: 0.5 }, 50, Prediction::Sample),
        (DDIM, 20, Prediction::Epsilon),
        (DDIM, 100, Prediction::Velocity),
    ]) {
        let schedule = schedule(BetaSchedule::Cosine, prediction);
        let config = config(sampler, n_steps, Spacing::Trailing);
        let denoise = |x: ArrayView3<'_, f32>, t| gaussian.denoise(&schedule, x, t);
        let x = sample(&config, &schedule, start(seed, N), denoise, noise(seed), Some(&known))
            .expect("samples");
        let case = format!("{config:?}, {prediction:?}, seed {seed}");
        assert!(x.rows().into_iter().all(|row| row[fixed] == VALUE as f32), "{case}");

        // x_fixed is √ᾱ value + √(1−ᾱ) z with a new z at every step, and
        // x̂0_free = μ_free + P_ff (x_free − √ᾱ μ_free) + P_fx (x_fixed − √ᾱ μ_fixed), P = U p Uᵀ.
        let steps = steps(schedule.len(), n_steps, Spacing::Trailing).expect("steps");
        let (mut m, mut variance) = (0.0, 1.0);
        for (i, step) in steps.iter().enumerate() {
            let level = schedule.level(Some(step.t));
            let p = gaussian.covariance_of(gaussian.estimate(level).0);
            let (p_free, p_fixed) = (p[[free, free]], p[[free, fixed]]);
            let w = published(sampler, &schedule, &steps, i);
            let shift = p_fixed * level.signal * (VALUE - mean_fixed);
            m = w.x * m + w.x0 * (mean + p_free * (m - level.signal * mean) + shift);
            variance = (w.x + w.x0 * p_free).powi(2) * variance
                + (w.x0 * p_fixed * level.noise).powi(2)
                + w.deviation.powi(2);
        }
        let mut expected = moments(&gaussian, &schedule, &config);
        expected.mean[free] = m;
        expected.mean[fixed] = f64::from(VALUE as f32);
        expected.covariance[[free, free]] = variance;
        for k in 0..D {
            expected.covariance[[fixed, k]] = 0.0;
            expected.covariance[[k, fixed]] = 0.0;
        }
        expected.assert_seen(&Moments::of(&x), N, 1e-3, &case);

        // How far towards the conditional mean that is: 0.51, 0.50, 0.38, 0.33, 0.33. The network sees
        // the known value under the noise of the step, so the early steps do not know it yet.
        let followed = (m - mean) / conditional;
        let least = if sampler == Sampler::Ddpm { 0.45 } else { 0.3 };
        assert!(followed > least && followed < 1.0, "{case}: {followed} of the way");
    }
}
