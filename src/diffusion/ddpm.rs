//! Denoising diffusion probabilistic models: the ancestral sampler.
//!
//! J. Ho, A. Jain and P. Abbeel, "Denoising Diffusion Probabilistic Models", NeurIPS 2020,
//! arXiv 2006.11239.

use super::schedule::Schedule;

/// q(x_next | x_t, x0) = N(`x0` · x0 + `x_t` · x_t, `variance`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Posterior {
    pub x0: f64,
    pub x_t: f64,
    pub variance: f64,
}

/// Returns the posterior of a step from t to `next`; `None` is clean data.
///
/// With ᾱ at t, ᾱ' at `next` and the respaced β = 1 − ᾱ/ᾱ' (Nichol and Dhariwal 2021, eq. 19):
///
/// mean √ᾱ' β/(1−ᾱ) x0 + √(1−β) (1−ᾱ')/(1−ᾱ) x_t,   variance β (1−ᾱ')/(1−ᾱ)
///
/// (Ho et al. 2020, eqs. 6 and 7). Where `next` is t − 1 they are those of the schedule itself.
///
/// - `t` and `next`: below `schedule.len()`, `next` at most t
pub fn posterior(schedule: &Schedule, t: usize, next: Option<usize>) -> Posterior {
    let beta = schedule.beta_between(t, next);
    let shrink = schedule.variance(next) / schedule.variance(Some(t));
    Posterior {
        x0: schedule.level(next).signal * beta / schedule.variance(Some(t)),
        x_t: schedule.signal_between(t, next) * shrink,
        variance: beta * shrink,
    }
}
