//! The tables of a schedule: β and ᾱ of every step, and what follows from them.

use super::config::{BetaSchedule, DiffusionConfig, DiffusionError, Prediction};
use super::ddpm::posterior;

/// Keeps the cosine schedule's ᾱ away from 1 at the first step.
const COSINE_OFFSET: f64 = 0.008;
/// Bounds of β of the cosine schedule.
const COSINE_BETAS: (f64, f64) = (1e-4, 0.9999);
/// Below this ᾱ, 1/√ᾱ is 1e15: the estimate of x0 is noise in any precision.
const SMALLEST_ALPHA_BAR: f64 = 1e-30;

/// A place between data and noise: x = signal · x0 + noise · ε.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// √ᾱ.
    pub signal: f64,
    /// √(1−ᾱ).
    pub noise: f64,
}

impl Level {
    /// Returns λ = ln(√ᾱ / √(1−ᾱ)), half the logarithm of the SNR; infinite for clean data.
    pub fn log_ratio(self) -> f64 {
        self.signal.ln() - self.noise.ln()
    }
}

/// β and ᾱ of every step of a diffusion, with what the network predicts and where x0 is clipped.
///
/// Steps are t = 0 .. `len() − 1`. Tables and coefficients are f64; what they make of tensors is f32.
///
/// # Panics
/// Methods that take a step panic where it is not below `len()`.
#[derive(Clone, Debug, PartialEq)]
pub struct Schedule {
    betas: Vec<f64>,
    alphas_cumprod: Vec<f64>,
    /// ln ᾱ = Σ ln(1−β): 1 − ᾱ and 1 − ᾱ_t/ᾱ_s are taken from it by expm1, since near 1 the
    /// product itself has lost the digits that they need.
    log_alphas_cumprod: Vec<f64>,
    prediction: Prediction,
    clip_range: Option<f64>,
}

/// Returns β of every step.
///
/// - linear: T numbers from `beta_start` to `beta_end` (Ho et al. 2020, section 4)
/// - sqrt: the squares of T numbers from √`beta_start` to √`beta_end`
/// - cosine: ᾱ(u) = cos²(π/2 · (u+s)/(1+s)) / cos²(π/2 · s/(1+s)), β_t = 1 − ᾱ((t+1)/T) / ᾱ(t/T),
///   kept within \[1e-4, 0.9999\] (Nichol and Dhariwal 2021, eq. 17; the paper clips at 0.999 only)
fn betas(config: &DiffusionConfig) -> Vec<f64> {
    let n = config.n_steps;
    match config.beta_schedule {
        BetaSchedule::Linear => evenly(config.beta_start, config.beta_end, n).collect(),
        BetaSchedule::Sqrt => evenly(config.beta_start.sqrt(), config.beta_end.sqrt(), n)
            .map(|root| root * root)
            .collect(),
        BetaSchedule::Cosine => {
            let angle = |step: usize| {
                let u = step as f64 / n as f64;
                (u + COSINE_OFFSET) / (1.0 + COSINE_OFFSET) * std::f64::consts::FRAC_PI_2
            };
            (0..n)
                .map(|t| {
                    // 1 − cos²b / cos²a without the subtraction that costs four digits at β = 1e-4:
                    // cos²a − cos²b = sin(b − a) sin(b + a).
                    let (a, b) = (angle(t), angle(t + 1));
                    let beta = (b - a).sin() * (b + a).sin() / a.cos().powi(2);
                    beta.clamp(COSINE_BETAS.0, COSINE_BETAS.1)
                })
                .collect()
        }
    }
}

/// Returns n numbers from `start` to `end`, equally far apart; one number is `start`.
fn evenly(start: f64, end: f64, n: usize) -> impl Iterator<Item = f64> {
    let step = if n > 1 { (end - start) / (n - 1) as f64 } else { 0.0 };
    (0..n).map(move |i| if i > 0 && i == n - 1 { end } else { start + i as f64 * step })
}

impl Schedule {
    /// Computes the tables.
    ///
    /// # Errors
    /// What [`DiffusionConfig::check`] refuses; a schedule whose last ᾱ is below 1e-30.
    pub fn new(config: &DiffusionConfig) -> Result<Self, DiffusionError> {
        config.check()?;
        let betas = betas(config);
        let (mut product, mut sum) = (1.0_f64, 0.0_f64);
        let alphas_cumprod: Vec<f64> = betas
            .iter()
            .map(|beta| {
                product *= 1.0 - beta;
                product
            })
            .collect();
        let log_alphas_cumprod = betas
            .iter()
            .map(|beta| {
                sum += (-beta).ln_1p();
                sum
            })
            .collect();
        if let Some(t) = alphas_cumprod.iter().position(|&a| a < SMALLEST_ALPHA_BAR) {
            return Err(DiffusionError::NoSignal {
                alpha_bar: alphas_cumprod[t],
                t,
                n_steps: config.n_steps,
                floor: SMALLEST_ALPHA_BAR,
            });
        }
        Ok(Self {
            betas,
            alphas_cumprod,
            log_alphas_cumprod,
            prediction: config.prediction,
            clip_range: config.clip_range,
        })
    }

    /// Returns the number T of steps, at least 1.
    #[allow(clippy::len_without_is_empty, reason = "a schedule is never empty")]
    pub fn len(&self) -> usize {
        self.betas.len()
    }

    /// Returns what the network predicts.
    pub fn prediction(&self) -> Prediction {
        self.prediction
    }

    /// Returns where estimates of x0 are clipped.
    pub fn clip_range(&self) -> Option<f64> {
        self.clip_range
    }

    /// Returns β_t, the share of variance that step t replaces by noise.
    pub fn beta(&self, t: usize) -> f64 {
        self.betas[t]
    }

    /// Returns ᾱ_t = Π (1−β_s), s ≤ t: the share of the data's variance left after step t.
    pub fn alpha_bar(&self, t: usize) -> f64 {
        self.alphas_cumprod[t]
    }

    /// Returns ᾱ before step t: ᾱ_{t−1}, and 1 before step 0.
    pub fn alpha_bar_prev(&self, t: usize) -> f64 {
        assert!(t < self.len(), "step {t} of a schedule of {} steps", self.len());
        t.checked_sub(1).map_or(1.0, |t| self.alphas_cumprod[t])
    }

    /// Returns SNR = ᾱ_t / (1−ᾱ_t), the ratio of the powers of data and noise.
    pub fn snr(&self, t: usize) -> f64 {
        self.alphas_cumprod[t] / self.variance(Some(t))
    }

    /// Returns the variance of q(x_{t−1} | x_t, x0), β_t (1−ᾱ_{t−1}) / (1−ᾱ_t); 0 at step 0.
    ///
    /// Ho et al. 2020, eq. 7.
    pub fn posterior_variance(&self, t: usize) -> f64 {
        posterior(self, t, t.checked_sub(1)).variance
    }

    /// Returns the factors of x0 and of x_t in the mean of q(x_{t−1} | x_t, x0).
    ///
    /// √ᾱ_{t−1} β_t / (1−ᾱ_t) and √α_t (1−ᾱ_{t−1}) / (1−ᾱ_t) (Ho et al. 2020, eq. 7).
    pub fn posterior_mean_coefficients(&self, t: usize) -> (f64, f64) {
        let posterior = posterior(self, t, t.checked_sub(1));
        (posterior.x0, posterior.x_t)
    }

    /// Returns √ᾱ and √(1−ᾱ) after step t; `None` is clean data, ᾱ = 1.
    pub fn level(&self, t: Option<usize>) -> Level {
        Level { signal: (self.log(t) / 2.0).exp(), noise: self.variance(t).sqrt() }
    }

    /// Returns 1 − ᾱ_t; 0 for clean data.
    pub(super) fn variance(&self, t: Option<usize>) -> f64 {
        // Not −expm1, which is −0 for clean data.
        0.0 - self.log(t).exp_m1()
    }

    /// Returns 1 − ᾱ_t/ᾱ_next: β of the one step that leads from `next` to t.
    pub(super) fn beta_between(&self, t: usize, next: Option<usize>) -> f64 {
        0.0 - (self.log(Some(t)) - self.log(next)).exp_m1()
    }

    /// Returns √(ᾱ_t/ᾱ_next), what that step leaves of the signal.
    pub(super) fn signal_between(&self, t: usize, next: Option<usize>) -> f64 {
        ((self.log(Some(t)) - self.log(next)) / 2.0).exp()
    }

    /// Returns ln ᾱ_t; 0 for clean data.
    fn log(&self, t: Option<usize>) -> f64 {
        t.map_or(0.0, |t| self.log_alphas_cumprod[t])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_keep_the_variance_and_run_from_data_to_noise() {
        for beta_schedule in [BetaSchedule::Linear, BetaSchedule::Cosine, BetaSchedule::Sqrt] {
            let config = DiffusionConfig { beta_schedule, n_steps: 137, ..Default::default() };
            let schedule = Schedule::new(&config).expect("a schedule");
            assert_eq!(schedule.level(None), Level { signal: 1.0, noise: 0.0 });
            assert_eq!(schedule.level(None).log_ratio(), f64::INFINITY);
            let mut before = f64::INFINITY;
            for t in 0..schedule.len() {
                let level = schedule.level(Some(t));
                let sum = level.signal.powi(2) + level.noise.powi(2);
                assert!((sum - 1.0).abs() < 1e-14, "{beta_schedule:?} {t}: {sum}");
                let relative = level.signal.powi(2) / schedule.alpha_bar(t) - 1.0;
                assert!(relative.abs() < 1e-13, "{beta_schedule:?} {t}: {relative}");
                assert!(level.log_ratio() < before, "{beta_schedule:?} {t}");
                before = level.log_ratio();
            }
        }
    }

    #[test]
    fn a_schedule_of_one_step_is_a_schedule() {
        for beta_schedule in [BetaSchedule::Linear, BetaSchedule::Cosine, BetaSchedule::Sqrt] {
            let config = DiffusionConfig { beta_schedule, n_steps: 1, ..Default::default() };
            let schedule = Schedule::new(&config).expect("a schedule");
            assert_eq!(schedule.posterior_variance(0), 0.0);
            assert_eq!(schedule.alpha_bar_prev(0), 1.0);
            let (x0, x_t) = schedule.posterior_mean_coefficients(0);
            assert!((x0 - 1.0).abs() < 1e-15 && x_t == 0.0, "{beta_schedule:?}: {x0}, {x_t}");
        }
    }

    #[test]
    fn a_schedule_without_signal_is_refused() {
        let config = DiffusionConfig {
            beta_schedule: BetaSchedule::Linear,
            beta_start: 0.5,
            beta_end: 0.5,
            ..Default::default()
        };
        assert_eq!(
            Schedule::new(&config).expect_err("no signal").to_string(),
            "the schedule leaves nothing of the data: alpha_bar is 7.888609052210118e-31 at step 99 \
             of 1000, and must stay above 1e-30; take fewer steps or a smaller beta_end"
        );
        let config = DiffusionConfig { n_steps: 0, ..Default::default() };
        assert_eq!(Schedule::new(&config), Err(DiffusionError::StepCount { n_steps: 0 }));
    }
}
