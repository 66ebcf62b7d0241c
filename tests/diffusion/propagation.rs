//! What a sampler does to a Gaussian, exactly: with its denoiser every step is affine along each axis.
//!
//! The samplers are stated here once more, from their papers and in plain ᾱ.

use motiongen::diffusion::{Sampler, SamplerConfig, SamplerStep, Schedule, steps};

use super::gaussian::{D, Gaussian, Moments};

/// A step as x' = `x` x + `x0` x̂0 + `before` x̂0_before + `deviation` z.
#[derive(Clone, Copy, Debug)]
pub struct Weights {
    pub x: f64,
    pub x0: f64,
    pub before: f64,
    pub deviation: f64,
}

/// Returns step i as its paper has it.
pub fn published(
    sampler: Sampler,
    schedule: &Schedule,
    steps: &[SamplerStep],
    i: usize,
) -> Weights {
    let alpha_bar = |t: Option<usize>| t.map_or(1.0, |t| schedule.alpha_bar(t));
    let lambda = |t: Option<usize>| 0.5 * (alpha_bar(t) / (1.0 - alpha_bar(t))).ln();
    let SamplerStep { t, next } = steps[i];
    let (from, to) = (alpha_bar(Some(t)), alpha_bar(next));
    match sampler {
        // Ho et al. 2020, eq. 7, with β of the respaced steps.
        Sampler::Ddpm => {
            let beta = 1.0 - from / to;
            Weights {
                x: (1.0 - beta).sqrt() * (1.0 - to) / (1.0 - from),
                x0: to.sqrt() * beta / (1.0 - from),
                before: 0.0,
                deviation: (beta * (1.0 - to) / (1.0 - from)).sqrt(),
            }
        }
        // Song et al. 2021, eqs. 12 and 16, with ε̂ = (x − √ᾱ x̂0) / √(1−ᾱ).
        Sampler::Ddim { eta } => {
            let sigma = eta * ((1.0 - to) / (1.0 - from)).sqrt() * (1.0 - from / to).sqrt();
            let x = (1.0 - to - sigma * sigma).max(0.0).sqrt() / (1.0 - from).sqrt();
            Weights { x, x0: to.sqrt() - from.sqrt() * x, before: 0.0, deviation: sigma }
        }
        Sampler::DpmSolver if next.is_none() => {
            Weights { x: 0.0, x0: 1.0, before: 0.0, deviation: 0.0 }
        }
        // Lu et al. 2022, algorithm 2; of fewer than 15 steps the last in first order.
        Sampler::DpmSolver => {
            let h = lambda(next) - lambda(Some(t));
            let x0 = to.sqrt() * (1.0 - (-h).exp());
            let is_first_order = i == 0 || (i + 1 == steps.len() && steps.len() < 15);
            let inverse_2r = if is_first_order {
                0.0
            } else {
                h / (2.0 * (lambda(Some(t)) - lambda(Some(steps[i - 1].t))))
            };
            Weights {
                x: ((1.0 - to) / (1.0 - from)).sqrt(),
                x0: x0 * (1.0 + inverse_2r),
                before: -x0 * inverse_2r,
                deviation: 0.0,
            }
        }
    }
}

/// Mean and variance along each axis.
#[derive(Clone, Copy, Debug)]
pub struct Axes {
    pub mean: [f64; D],
    pub variance: [f64; D],
}

/// Along one axis: x = `mean` + `gain` · ξ + noise, ξ what x_T had, the noise what steps have added.
#[derive(Clone, Copy)]
struct Affine {
    mean: f64,
    gain: f64,
    noise_variance: f64,
}

/// Returns what `steps` make of x_T ~ N(`start`); nothing is clipped.
pub fn propagate(
    gaussian: &Gaussian,
    schedule: &Schedule,
    sampler: Sampler,
    steps: &[SamplerStep],
    start: Axes,
) -> Axes {
    let mut end = start;
    for k in 0..D {
        let gain = start.variance[k].sqrt();
        let mut x = Affine { mean: start.mean[k], gain, noise_variance: 0.0 };
        let mut before = Affine { mean: 0.0, gain: 0.0, noise_variance: 0.0 };
        for (i, step) in steps.iter().enumerate() {
            let (p, q) = gaussian.estimate(schedule.level(Some(step.t)));
            let x0 = Affine { mean: p[k] * x.mean + q[k], gain: p[k] * x.gain, ..x };
            let w = published(sampler, schedule, steps, i);
            x = Affine {
                mean: w.x * x.mean + w.x0 * x0.mean + w.before * before.mean,
                gain: w.x * x.gain + w.x0 * x0.gain + w.before * before.gain,
                // Samplers that add noise have no memory, so that one variance is enough.
                noise_variance: (w.x + w.x0 * p[k]).powi(2) * x.noise_variance
                    + w.deviation.powi(2),
            };
            before = x0;
        }
        end.mean[k] = x.mean;
        end.variance[k] = x.gain * x.gain + x.noise_variance;
    }
    end
}

/// Returns the moments that samples from x_T ~ N(0, I) have.
pub fn moments(gaussian: &Gaussian, schedule: &Schedule, config: &SamplerConfig) -> Moments {
    let steps = steps(schedule.len(), config.n_steps, config.spacing).expect("steps");
    let start = Axes { mean: [0.0; D], variance: [1.0; D] };
    let end = propagate(gaussian, schedule, config.sampler, &steps, start);
    Moments { mean: gaussian.off_axes(end.mean), covariance: gaussian.covariance_of(end.variance) }
}
