//! The samplers, and what they have in common.

use serde::{Deserialize, Serialize};

use super::config::DiffusionError;
use super::ddim::ddim_update;
use super::ddpm::posterior;
use super::dpm_solver::dpm_solver_update;
use super::schedule::Schedule;
use super::spacing::{N_FAST27, SamplerStep, Spacing, steps};

/// DPM-Solver++ takes its last step in first order below this many steps, as diffusers does.
const LOWER_ORDER_FINAL_BELOW: usize = 15;

/// How a step leads from x_t to the next x.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "name", rename_all = "snake_case", deny_unknown_fields)]
pub enum Sampler {
    /// Draws from the posterior (Ho et al. 2020); for as many steps as were trained.
    Ddpm,
    /// Follows the estimate of the noise, and renews η of it (Song et al. 2021); for 20 to 100 steps.
    Ddim {
        /// 0, deterministic, to 1, DDPM.
        eta: f64,
    },
    /// DPM-Solver++(2M), deterministic, of second order (Lu et al. 2022); for 8 to 20 steps.
    DpmSolver,
}

impl Sampler {
    /// Returns how many of `n_train` steps are visited where nothing is said: all of them by DDPM.
    pub fn usual_steps(self, n_train: usize) -> usize {
        match self {
            Self::Ddpm => n_train,
            Self::Ddim { .. } | Self::DpmSolver => USUAL_STEPS.min(n_train),
        }
    }

    /// Returns η, of DDIM.
    pub fn eta(self) -> Option<f64> {
        match self {
            Self::Ddim { eta } => Some(eta),
            Self::Ddpm | Self::DpmSolver => None,
        }
    }

    /// Returns the name that people know it by.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ddpm => "DDPM",
            Self::Ddim { .. } => "DDIM",
            Self::DpmSolver => "DPM-Solver++",
        }
    }
}

impl Default for Sampler {
    fn default() -> Self {
        Self::Ddim { eta: 0.0 }
    }
}

/// Steps that [`Sampler::usual_steps`] gives DDIM and DPM-Solver++, where ten of the latter gave motion of less
/// variety: fid_k 4.5 for 2.5 after 1,500 steps of training, 1.6 for 1.1 after 6,000 (docs/training.md).
const USUAL_STEPS: usize = 20;

/// How to sample: the sampler, and which steps it visits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplerConfig {
    pub sampler: Sampler,
    /// 1 to the number of steps that the network was trained on.
    pub n_steps: usize,
    pub spacing: Spacing,
    /// Whether estimates of x0 are kept within the diffusion's `clip_range`.
    pub clip: bool,
}

impl Default for SamplerConfig {
    /// The reference's 20 steps of DDIM with η = 0, from pure noise to clean data.
    fn default() -> Self {
        Self {
            sampler: Sampler::default(),
            n_steps: USUAL_STEPS,
            spacing: Spacing::default(),
            clip: true,
        }
    }
}

impl SamplerConfig {
    /// Draws from the posterior at the 27 steps of GLIDE, as MoTok decodes tokens.
    pub fn fast27() -> Self {
        let (sampler, spacing) = (Sampler::Ddpm, Spacing::Fast27);
        Self { sampler, n_steps: N_FAST27, spacing, clip: true }
    }

    /// Refuses what cannot be sampled with a diffusion of `n_train` steps.
    ///
    /// # Errors
    /// An η outside \[0, 1\]; an `n_steps` of 0 or above `n_train`.
    pub fn check(&self, n_train: usize) -> Result<(), DiffusionError> {
        match self.sampler {
            Sampler::Ddim { eta } if !(0.0..=1.0).contains(&eta) => {
                Err(DiffusionError::Eta { eta })
            }
            _ => steps(n_train, self.n_steps, self.spacing).map(drop),
        }
    }
}

/// x_next = `x_t` · x_t + `x0` · x̂0 + `epsilon` · ε̂ + `previous` · (x̂0 of the step before) +
/// `sigma` · z: what all samplers have in common.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Update {
    pub x_t: f64,
    pub x0: f64,
    pub epsilon: f64,
    pub previous: f64,
    pub sigma: f64,
}

impl SamplerConfig {
    /// Returns the update of step i of `steps`.
    pub(super) fn update(&self, schedule: &Schedule, steps: &[SamplerStep], i: usize) -> Update {
        let SamplerStep { t, next } = steps[i];
        match self.sampler {
            Sampler::Ddpm => {
                let posterior = posterior(schedule, t, next);
                let sigma = posterior.variance.sqrt();
                Update { x_t: posterior.x_t, x0: posterior.x0, sigma, ..Update::default() }
            }
            Sampler::Ddim { eta } => {
                let ddim = ddim_update(schedule, t, next, eta);
                Update {
                    x0: ddim.x0,
                    epsilon: ddim.epsilon,
                    sigma: ddim.sigma,
                    ..Update::default()
                }
            }
            Sampler::DpmSolver => {
                // Of few steps the last is long, and extrapolating over it does harm.
                let is_last = i + 1 == steps.len();
                let is_first_order = is_last && steps.len() < LOWER_ORDER_FINAL_BELOW;
                let previous = if is_first_order { None } else { i.checked_sub(1) };
                let dpm = dpm_solver_update(schedule, t, next, previous.map(|i| steps[i].t));
                Update { x_t: dpm.x_t, x0: dpm.x0, previous: dpm.previous, ..Update::default() }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_config_is_read_from_toml_and_survives_json() {
        let text = r#"
            sampler = { name = "ddim", eta = 0.5 }
            n_steps = 50
            spacing = "leading"
            clip = false
        "#;
        let config = SamplerConfig {
            sampler: Sampler::Ddim { eta: 0.5 },
            n_steps: 50,
            spacing: Spacing::Leading,
            clip: false,
        };
        assert_eq!(toml::from_str::<SamplerConfig>(text).expect("a config"), config);
        for sampler in [Sampler::Ddpm, Sampler::Ddim { eta: 0.5 }, Sampler::DpmSolver] {
            let config = SamplerConfig { sampler, ..Default::default() };
            let json = serde_json::to_string(&config).expect("JSON");
            assert_eq!(serde_json::from_str::<SamplerConfig>(&json).expect("a config"), config);
        }
    }
}
