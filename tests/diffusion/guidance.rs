//! Guidance between two Gaussians of one covariance is sampling of a third.

use motiongen::diffusion::{
    BetaSchedule, DiffusionError, Prediction, Sampler, Spacing, denoise_guided, sample,
};
use ndarray::{Array3, ArrayView3, Axis};

use super::gaussian::Gaussian;
use super::samplers::{DDIM, config, noise, schedule, start};

#[test]
fn guidance_moves_the_mean_along_the_condition() {
    const N: usize = 37;
    // With one covariance for both, E[x0 | x_t] is affine in the mean, so that
    // u + s (c − u) is the denoiser of N(μ_u + s (μ_c − μ_u), Σ): the runs agree sample by sample.
    let conditional = Gaussian::new();
    let unconditional = Gaussian { mean: [-0.3, 0.4, 0.0, 1.0, -0.5], ..Gaussian::new() };
    for (scale, evaluated) in [(0.0, N), (1.0, N), (2.5, 2 * N)] {
        let mean = std::array::from_fn(|k| {
            unconditional.mean[k] + scale * (conditional.mean[k] - unconditional.mean[k])
        });
        let third = Gaussian { mean, ..Gaussian::new() };
        for (sampler, prediction) in [
            (DDIM, Prediction::Epsilon),
            (Sampler::DpmSolver, Prediction::Velocity),
            (Sampler::Ddpm, Prediction::Sample),
        ] {
            let schedule = schedule(BetaSchedule::Linear, prediction);
            let config = config(sampler, 10, Spacing::Trailing);
            let mut n_evaluated = Vec::new();
            let guided = |x: ArrayView3<'_, f32>, t: usize| {
                denoise_guided(scale, x, t, |x, t, dropped| {
                    n_evaluated.push(x.len_of(Axis(0)));
                    let mut predicted = Array3::zeros(x.raw_dim());
                    for (i, &dropped) in dropped.iter().enumerate() {
                        let gaussian = if dropped { &unconditional } else { &conditional };
                        let row = x.slice_axis(Axis(0), (i..=i).into());
                        let row = gaussian.denoise(&schedule, row, t)?;
                        predicted.slice_axis_mut(Axis(0), (i..=i).into()).assign(&row);
                    }
                    Ok::<_, DiffusionError>(predicted)
                })
            };
            let got =
                sample(&config, &schedule, start(5, N), guided, noise(5), None).expect("samples");
            assert_eq!(n_evaluated, [evaluated; 10], "{sampler:?}, scale {scale}");
            let direct = |x: ArrayView3<'_, f32>, t| third.denoise(&schedule, x, t);
            let want =
                sample(&config, &schedule, start(5, N), direct, noise(5), None).expect("samples");
            for ((i, &got), &want) in got.indexed_iter().zip(&want) {
                // Predictions up to 10, rounded four times (two, their products, the sum); the steps
                // together multiply what ε has lost by at most 1/√ᾱ_T = 157.
                let bound = 4.0 * 10.0 * 2.0_f32.powi(-24) * 157.0;
                assert!(
                    (got - want).abs() < bound,
                    "{sampler:?}, {prediction:?}, scale {scale}, {i:?}: got {got}, wanted {want}"
                );
            }
        }
    }
}
