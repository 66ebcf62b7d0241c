//! What a diffusion process is made of, and the errors of the room.

use serde::{Deserialize, Serialize};

/// Beyond this many steps a table of coefficients is a mistake, not a schedule.
pub const MAX_STEPS: usize = 1_000_000;

/// How β grows from the first step to the last.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Default, clap::ValueEnum, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum BetaSchedule {
    /// β linear in t (Ho et al. 2020).
    Linear,
    /// ᾱ a squared cosine of t (Nichol and Dhariwal 2021).
    #[default]
    Cosine,
    /// √β linear in t.
    Sqrt,
}

/// The prediction target of the network, given x_t = √ᾱ x0 + √(1−ᾱ) ε.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Default, clap::ValueEnum, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum Prediction {
    /// The noise ε.
    #[default]
    Epsilon,
    /// The clean sample x0.
    #[value(name = "x0")]
    #[serde(rename = "x0")]
    Sample,
    /// v = √ᾱ ε − √(1−ᾱ) x0.
    #[value(name = "v")]
    #[serde(rename = "v")]
    Velocity,
}

/// How the distance between a prediction and its target is measured.
///
/// A name only: the code that differentiates the loss implements it.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Default, clap::ValueEnum, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum LossType {
    /// Mean of the squared differences.
    #[default]
    Mse,
    /// Mean of the absolute differences.
    L1,
    /// Quadratic near zero, linear beyond.
    Huber,
}

/// A diffusion process: its schedule and what the network predicts of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffusionConfig {
    /// Number T of steps that a network is trained on, 1 to [`MAX_STEPS`].
    pub n_steps: usize,
    pub beta_schedule: BetaSchedule,
    /// β of the first step, in (0, 1); linear and sqrt schedules use it.
    pub beta_start: f64,
    /// β of the last step, in \[`beta_start`, 1); linear and sqrt schedules use it.
    pub beta_end: f64,
    pub prediction: Prediction,
    /// Estimates of x0 are kept within ± this, in units of the data (standard deviations, if it is
    /// normalized); `None` does not clip.
    pub clip_range: Option<f64>,
}

impl Default for DiffusionConfig {
    fn default() -> Self {
        Self {
            n_steps: 1000,
            beta_schedule: BetaSchedule::Cosine,
            beta_start: 1e-4,
            beta_end: 0.02,
            prediction: Prediction::Epsilon,
            clip_range: Some(5.0),
        }
    }
}

impl DiffusionConfig {
    /// Refuses numbers that make no process.
    ///
    /// # Errors
    /// The first field that is out of its range.
    pub fn check(&self) -> Result<(), DiffusionError> {
        if !(1..=MAX_STEPS).contains(&self.n_steps) {
            return Err(DiffusionError::StepCount { n_steps: self.n_steps });
        }
        let (start, end) = (self.beta_start, self.beta_end);
        // Written so that NaN fails.
        if !(0.0 < start && start <= end && end < 1.0) {
            return Err(DiffusionError::Betas { start, end });
        }
        match self.clip_range {
            Some(range) if !(range > 0.0 && range.is_finite()) => {
                Err(DiffusionError::ClipRange { range })
            }
            _ => Ok(()),
        }
    }
}

/// Why something cannot be diffused or sampled.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DiffusionError {
    #[error("n_steps is {n_steps}; a diffusion has 1 to {MAX_STEPS} steps, and 1000 are usual")]
    StepCount { n_steps: usize },
    #[error(
        "beta_start is {start} and beta_end is {end}; both must lie between 0 and 1, and the end \
         not below the start; 0.0001 and 0.02 are usual"
    )]
    Betas { start: f64, end: f64 },
    #[error(
        "clip_range is {range}; it must be a number above 0 (5 standard deviations are usual), \
         or be left out so that nothing is clipped"
    )]
    ClipRange { range: f64 },
    #[error(
        "the schedule leaves nothing of the data: alpha_bar is {alpha_bar:e} at step {t} of \
         {n_steps}, and must stay above {floor:e}; take fewer steps or a smaller beta_end"
    )]
    NoSignal { alpha_bar: f64, t: usize, n_steps: usize, floor: f64 },
    #[error(
        "n_steps of the sampler is {n_steps}; it must be 1 to {n_train}, the number of steps that \
         the network was trained on"
    )]
    SamplerSteps { n_steps: usize, n_train: usize },
    #[error(
        "the spacing fast27 takes 27 of at least 50 steps, and {n_steps} of {n_train} are asked for; \
         give the sampler 27 steps, or another spacing"
    )]
    Fast27 { n_steps: usize, n_train: usize },
    #[error(
        "eta is {eta}; it must be 0 (no noise is added while sampling) to 1 (as much as DDPM adds)"
    )]
    Eta { eta: f64 },
    #[error("gamma of min-SNR weighting is {gamma}; it must be a number above 0, and 5 is usual")]
    Gamma { gamma: f64 },
    #[error(
        "the guidance scale is {scale}; it must be a number of at least 0: 1 follows the \
         condition, above 1 exaggerates it, 0 ignores it"
    )]
    GuidanceScale { scale: f64 },
    #[error("{what} has shape {got:?}; {wanted:?} is needed, the shape of {like}")]
    Shape { what: &'static str, got: Vec<usize>, wanted: Vec<usize>, like: &'static str },
    #[error(
        "the known value at {index:?} is {value}; every value under the mask must be finite: \
         give it a number or take it out of the mask"
    )]
    KnownNotFinite { value: f32, index: [usize; 3] },
    #[error(
        "tokens are drawn in {n_iterations} iterations; it must be 1 to {most}, and 10 are usual"
    )]
    Iterations { n_iterations: usize, most: usize },
    #[error(
        "{what} is {temperature}; it must be a number of at least 0, and {} is usual",
        usual_temperature(.what)
    )]
    Temperature { what: &'static str, temperature: f64 },
    #[error(
        "the share of tokens that may be drawn is {top_share}; it must lie above 0 and not above 1, and 0.1 is usual"
    )]
    TopShare { top_share: f64 },
    #[error(
        "token {token} is none of the {n_codes} that the planner knows, 0 to {}; give tokens of the tokenizer that it \
         was trained with",
        .n_codes.saturating_sub(1)
    )]
    Token { token: u32, n_codes: usize },
    #[error(
        "a planner says of a token what is no number; its weights are damaged, or its training went wrong"
    )]
    Logits,
}

/// Returns the temperature that most take.
fn usual_temperature(what: &str) -> u8 {
    u8::from(what == "temperature")
}

impl DiffusionError {
    /// Returns an error if `got` is not the shape that `like` has.
    pub(super) fn check_shape(
        what: &'static str,
        got: &[usize],
        like: &'static str,
        wanted: &[usize],
    ) -> Result<(), Self> {
        if got == wanted {
            return Ok(());
        }
        Err(Self::Shape { what, got: got.to_vec(), wanted: wanted.to_vec(), like })
    }
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::*;

    fn message(change: impl FnOnce(&mut DiffusionConfig)) -> String {
        let mut config = DiffusionConfig::default();
        change(&mut config);
        config.check().expect_err("a config out of range").to_string()
    }

    #[test]
    fn every_number_out_of_range_is_refused_with_the_way_out() {
        assert_eq!(DiffusionConfig::default().check(), Ok(()));
        let steps = |n: usize| {
            format!("n_steps is {n}; a diffusion has 1 to 1000000 steps, and 1000 are usual")
        };
        assert_eq!(message(|c| c.n_steps = 0), steps(0));
        assert_eq!(message(|c| c.n_steps = 1_000_001), steps(1_000_001));
        let betas = |start: &str, end: &str| {
            format!(
                "beta_start is {start} and beta_end is {end}; both must lie between 0 and 1, and \
                 the end not below the start; 0.0001 and 0.02 are usual"
            )
        };
        assert_eq!(message(|c| c.beta_start = 0.0), betas("0", "0.02"));
        assert_eq!(message(|c| c.beta_start = 0.03), betas("0.03", "0.02"));
        assert_eq!(message(|c| c.beta_end = 1.0), betas("0.0001", "1"));
        assert_eq!(message(|c| c.beta_end = f64::NAN), betas("0.0001", "NaN"));
        for (range, written) in [(0.0, "0"), (-1.0, "-1"), (f64::INFINITY, "inf")] {
            assert_eq!(
                message(|c| c.clip_range = Some(range)),
                format!(
                    "clip_range is {written}; it must be a number above 0 (5 standard deviations \
                     are usual), or be left out so that nothing is clipped"
                )
            );
        }
    }

    #[test]
    fn names_are_the_same_in_flags_and_files() {
        fn check<T: ValueEnum + Serialize>(names: &[&str]) {
            for (value, name) in T::value_variants().iter().zip(names) {
                let flag = value.to_possible_value().expect("no variant is hidden");
                assert_eq!(flag.get_name(), *name);
                assert_eq!(serde_json::to_value(value).expect("JSON"), *name);
            }
            assert_eq!(T::value_variants().len(), names.len());
        }
        check::<BetaSchedule>(&["linear", "cosine", "sqrt"]);
        check::<Prediction>(&["epsilon", "x0", "v"]);
        check::<LossType>(&["mse", "l1", "huber"]);
    }

    #[test]
    fn a_config_survives_a_file() {
        for clip_range in [None, Some(4.5)] {
            let config = DiffusionConfig { clip_range, ..DiffusionConfig::default() };
            let json = serde_json::to_string(&config).expect("JSON");
            assert_eq!(serde_json::from_str::<DiffusionConfig>(&json).expect("a config"), config);
        }
    }
}
