//! The engine of a planner: which tokens go with a window of music.

use std::num::NonZeroUsize;

use ndarray::{Array2, ArrayView2};

use super::eager::EagerPlanner;
use super::networks::{PlanWindow, PlannerNetworks, WithheldConditions};
use crate::audio::FeatureScale;
use crate::autodiff::{Parameters, Stream};
use crate::diffusion::{TokenSampling, sample_autoregressive, sample_masked};
use crate::generation::engine::EngineError;
use crate::model::{PlannerConfig, PlannerKind};
use crate::motion::style::STYLE_DIM;

/// Runs a planner.
pub struct PlannerEngine {
    config: PlannerConfig,
    networks: Box<dyn PlannerNetworks + Send>,
    /// Whether the tokens of a plan are shuffled.
    is_shuffled: bool,
}

/// A window to plan.
#[derive(Clone, Copy, Debug)]
pub struct PlanRequest<'a> {
    /// Features as the table has them, then the clock of a network that hears it, \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Normalised style, for a network that takes one.
    pub style: Option<[f32; STYLE_DIM]>,
    /// Constraints on the motion, \[T, 12\] (`PoseConstraint::channels`), of a planner that takes them; none where there
    /// are none.
    pub constraints: Option<ArrayView2<'a, f32>>,
    /// The tokens from the first on, where they are known.
    pub given: &'a [Option<u32>],
    /// 1 follows the music, more exaggerates it, 0 ignores it; of two conditions it is that of both.
    pub guidance: f64,
    pub seed: u64,
    /// Number of the window among those of the seed.
    pub window: u64,
}

/// Streams of random numbers of plans, apart from those of the noise that motion is made of; 2^20 draws for each window.
const PLANS: u64 = 1 << 62;
const DRAWS_OF_A_WINDOW: u64 = 1 << 20;
/// Draws of a window that choose what guidance withholds, behind those that choose tokens.
const PAIRS: usize = 1 << 19;

const NOTHING: WithheldConditions = WithheldConditions { music: false, constraints: false };
const MUSIC: WithheldConditions = WithheldConditions { music: true, constraints: false };
const CONSTRAINTS: WithheldConditions = WithheldConditions { music: false, constraints: true };

impl PlannerEngine {
    /// Makes an engine of the interpreter that trains, of so many workers of so many threads each; `parameters` are those
    /// of [`Planner`](crate::model::Planner).
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        config: &PlannerConfig,
        parameters: Parameters<f32>,
        feature_scale: &FeatureScale,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        let networks = EagerPlanner::new(config, parameters, feature_scale, workers)?;
        Ok(Self::with(config, Box::new(networks)))
    }

    /// Makes an engine of networks, whatever runs them.
    pub fn with(config: &PlannerConfig, networks: Box<dyn PlannerNetworks + Send>) -> Self {
        Self { config: config.clone(), networks, is_shuffled: false }
    }

    /// Shuffles the tokens of every plan, but for those that are given: a baseline that keeps which tokens there are, and
    /// loses their order.
    #[must_use]
    pub fn with_shuffled_plans(self) -> Self {
        Self { is_shuffled: true, ..self }
    }

    /// Returns the name that flags and tables use of what runs the network.
    pub fn name(&self) -> &'static str {
        self.networks.name()
    }

    /// Returns the sizes of the planner.
    pub fn config(&self) -> &PlannerConfig {
        &self.config
    }

    /// Draws the tokens of a window; same request, same tokens.
    ///
    /// # Errors
    /// Shapes that do not fit, a token that is given and does not exist, and settings that nothing can be drawn by.
    pub fn plan(
        &self,
        sampling: &TokenSampling,
        request: &PlanRequest,
    ) -> Result<Vec<u32>, EngineError> {
        let mut tokens = self.drawn(sampling, request)?;
        if self.is_shuffled {
            // The last draw of the window, which no plan reaches.
            let draw = PLANS + (request.window + 1) * DRAWS_OF_A_WINDOW - 1;
            let given = &request.given[..request.given.len().min(tokens.len())];
            let n_given = given.iter().take_while(|token| token.is_some()).count();
            shuffle(&mut tokens[n_given..], Stream::new(request.seed, draw));
        }
        Ok(tokens)
    }

    fn drawn(
        &self,
        sampling: &TokenSampling,
        request: &PlanRequest,
    ) -> Result<Vec<u32>, EngineError> {
        let PlanRequest { condition, style, guidance: s, .. } = *request;
        let (codes, n) = (self.config.codes, self.config.n_tokens(condition.nrows()));
        let first = PLANS + request.window * DRAWS_OF_A_WINDOW;
        let stream = |draw: usize| Stream::new(request.seed, first + draw as u64);
        // The guided logits are u + s (c − u), c with all conditions and u without one of them. With two
        // conditions either is withheld by chance, each as often (paper, eq. 10 and 11); with one it is the music.
        let constraints = request.constraints.filter(|_| self.config.constraint_dim > 0);
        let is_constrained = constraints.is_some();
        let withheld: &[WithheldConditions] = match (s, is_constrained) {
            (1.0, _) => &[NOTHING],
            (0.0, false) => &[MUSIC],
            (0.0, true) => &[MUSIC, CONSTRAINTS],
            (_, false) => &[NOTHING, MUSIC],
            (_, true) => &[NOTHING, MUSIC, CONSTRAINTS],
        };
        let mut plan =
            self.networks.begin(&PlanWindow { condition, style, constraints, withheld })?;
        let mut n_asked = 0;
        let mut logits = |tokens: &[u32]| -> Result<Vec<f32>, EngineError> {
            let mut number = [0.0_f64];
            stream(PAIRS + n_asked).uniform(0, &mut number);
            n_asked += 1;
            let without = if is_constrained && number[0] >= 0.5 { CONSTRAINTS } else { MUSIC };
            let found = plan.logits(tokens)?;
            let of_answer = found.len() / withheld.len();
            let said = |answer: WithheldConditions| {
                let place = withheld.iter().position(|known| *known == answer)?;
                Some(&found[place * of_answer..][..of_answer])
            };
            let (to, away) = (s as f32, (1.0 - s) as f32);
            Ok(match (said(NOTHING), said(without)) {
                (Some(c), Some(u)) => c.iter().zip(u).map(|(c, u)| *c * to + u * away).collect(),
                (Some(only), None) | (None, Some(only)) => only.to_vec(),
                (None, None) => Vec::new(),
            })
        };
        let mut given = request.given.to_vec();
        given.resize(n, None);
        match self.config.kind {
            PlannerKind::Masked => {
                let logits = |tokens: &[u32]| -> Result<Array2<f32>, EngineError> {
                    let (found, what) = (logits(tokens)?, "what the planner says");
                    let found_len = found.len();
                    Array2::from_shape_vec((n, codes), found).map_err(|_| EngineError::Shape {
                        what,
                        found: vec![found_len],
                        expected: vec![n, codes],
                    })
                };
                let uniform = |draw: usize, numbers: &mut [f64]| stream(draw).uniform(0, numbers);
                sample_masked(sampling, &given, codes, logits, uniform)
            }
            PlannerKind::Autoregressive => {
                let uniform = |draw: usize| {
                    let mut number = [0.0_f64];
                    stream(draw).uniform(0, &mut number);
                    number[0]
                };
                sample_autoregressive(sampling, &given, codes, logits, uniform)
            }
        }
    }
}

/// Shuffles tokens, every order as likely (Fisher and Yates).
pub fn shuffle(tokens: &mut [u32], stream: Stream) {
    let mut numbers = vec![0.0_f64; tokens.len()];
    stream.uniform(0, &mut numbers);
    for (i, number) in numbers.iter().enumerate().skip(1) {
        tokens.swap(i, ((number * (i + 1) as f64) as usize).min(i));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_order_of_tokens_is_as_likely() {
        let mut counts = std::collections::BTreeMap::new();
        for seed in 0..6000 {
            let mut tokens = [7, 8, 9];
            shuffle(&mut tokens, Stream::new(seed, 1));
            *counts.entry(tokens).or_insert(0_i32) += 1;
        }
        // Of 6000 draws each of six orders has 1000, with a deviation of 29.
        assert_eq!(counts.len(), 6);
        assert!(counts.values().all(|n| (n - 1000).abs() < 130), "{counts:?}");
    }
}
