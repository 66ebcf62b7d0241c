//! Denoising diffusion implicit models.
//!
//! J. Song, C. Meng and S. Ermon, "Denoising Diffusion Implicit Models", ICLR 2021, arXiv 2010.02502.

use super::process::inversion;
use super::schedule::Schedule;

/// The factors of x_next = `x0` · x̂0 + `epsilon` · ε̂ + `sigma` · z, z standard normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DdimCoefficients {
    pub x0: f64,
    pub epsilon: f64,
    pub sigma: f64,
}

/// Returns the step of DDIM from t to `next`; `None` is clean data.
///
/// With ᾱ at t and ᾱ' at `next`:
///
/// x_next = √ᾱ' x̂0 + √(1−ᾱ'−σ²) ε̂ + σ z,   σ² = η² (1−ᾱ')/(1−ᾱ) (1−ᾱ/ᾱ')
///
/// (eqs. 12 and 16). η = 0 adds no noise; η = 1 is DDPM on the same steps.
///
/// - `t` and `next`: below `schedule.len()`, `next` at most t
/// - `eta`: 0 to 1
pub fn ddim_update(
    schedule: &Schedule,
    t: usize,
    next: Option<usize>,
    eta: f64,
) -> DdimCoefficients {
    let variance = schedule.variance(next);
    // The share of the variance at `next` that is drawn afresh: (1−ᾱ/ᾱ')/(1−ᾱ), at most 1.
    let renewed = eta * eta * schedule.beta_between(t, next) / schedule.variance(Some(t));
    DdimCoefficients {
        x0: schedule.level(next).signal,
        epsilon: (variance * (1.0 - renewed).max(0.0)).sqrt(),
        sigma: (variance * renewed).max(0.0).sqrt(),
    }
}

/// Returns the deterministic step of DDIM as x_next = a x_t + b p, p what the network predicts.
///
/// √ᾱ' x̂0 + √(1−ᾱ') ε̂ with x̂0 and ε̂ written in x_t and p; nothing is clipped, so that the step is
/// linear, which fine-tuning through the sampler needs. For ε it is
///
/// a = √(ᾱ'/ᾱ),   b = √(1−ᾱ') − √(1−ᾱ) √(ᾱ'/ᾱ).
///
/// - `t` and `next`: below `schedule.len()`; `None` is clean data
pub fn ddim_linear(schedule: &Schedule, t: usize, next: Option<usize>) -> (f64, f64) {
    let update = ddim_update(schedule, t, next, 0.0);
    let inversion = inversion(schedule.prediction(), schedule.level(Some(t)));
    (
        update.x0 * inversion.x0.0 + update.epsilon * inversion.epsilon.0,
        update.x0 * inversion.x0.1 + update.epsilon * inversion.epsilon.1,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::ddpm::posterior;
    use crate::diffusion::{DiffusionConfig, Prediction};

    fn schedule(prediction: Prediction) -> Schedule {
        Schedule::new(&DiffusionConfig { prediction, ..Default::default() }).expect("a schedule")
    }

    #[test]
    fn the_last_step_is_the_estimate() {
        for eta in [0.0, 0.5, 1.0] {
            let update = ddim_update(&schedule(Prediction::Epsilon), 99, None, eta);
            assert_eq!(update, DdimCoefficients { x0: 1.0, epsilon: 0.0, sigma: 0.0 });
        }
    }

    #[test]
    fn with_eta_one_it_is_ddpm() {
        let schedule = schedule(Prediction::Epsilon);
        for (t, next) in [(999, Some(949)), (500, Some(499)), (49, Some(0)), (1, Some(0))] {
            let update = ddim_update(&schedule, t, next, 1.0);
            let posterior = posterior(&schedule, t, next);
            // The posterior's mean b x0 + a x_t with x_t = √ᾱ x0 + √(1−ᾱ) ε.
            let level = schedule.level(Some(t));
            let x0 = posterior.x0 + posterior.x_t * level.signal;
            let epsilon = posterior.x_t * level.noise;
            for (name, got, want) in [
                ("x0", update.x0, x0),
                ("epsilon", update.epsilon, epsilon),
                ("sigma", update.sigma, posterior.variance.sqrt()),
            ] {
                assert!((got - want).abs() < 1e-12, "{t} to {next:?}: {name} {got}, {want}");
            }
        }
    }

    #[test]
    fn the_linear_form_is_the_published_one_for_each_prediction() {
        for (t, next) in [(999, Some(799)), (400, Some(399)), (99, None)] {
            let linear_for = |prediction| ddim_linear(&schedule(prediction), t, next);
            let (from, to) = {
                let schedule = schedule(Prediction::Epsilon);
                (schedule.level(Some(t)), schedule.level(next))
            };
            // Song et al. 2021, eq. 12; Salimans and Ho 2022, appendix D: a turn by an angle.
            let (phi, phi_next) = (from.noise.atan2(from.signal), to.noise.atan2(to.signal));
            let ratio = to.signal / from.signal;
            let expected = [
                (linear_for(Prediction::Epsilon), (ratio, to.noise - from.noise * ratio)),
                (
                    linear_for(Prediction::Sample),
                    (to.noise / from.noise, to.signal - from.signal * to.noise / from.noise),
                ),
                (
                    linear_for(Prediction::Velocity),
                    ((phi - phi_next).cos(), -(phi - phi_next).sin()),
                ),
            ];
            for ((a, b), (want_a, want_b)) in expected {
                assert!((a - want_a).abs() < 1e-12 * ratio, "{t} to {next:?}: {a}, {want_a}");
                assert!((b - want_b).abs() < 1e-12 * ratio, "{t} to {next:?}: {b}, {want_b}");
            }
        }
    }
}
