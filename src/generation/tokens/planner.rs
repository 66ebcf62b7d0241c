//! The engine of a planner: which tokens go with a window of music.

use std::num::NonZeroUsize;

use ndarray::{Array2, ArrayView2};

use super::eager::EagerPlanner;
use super::networks::{PlanWindow, PlannerNetworks};
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
}

/// A window whose tokens are asked for.
#[derive(Clone, Copy, Debug)]
pub struct PlanRequest<'a> {
    /// Features as the table has them, then the clock of a network that hears it, \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Normalised style, for a network that takes one.
    pub style: Option<[f32; STYLE_DIM]>,
    /// The first tokens, where they are known.
    pub given: &'a [u32],
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    pub seed: u64,
    /// Number of the window among those of the seed.
    pub window: u64,
}

/// Streams of random numbers of plans, apart from those of the noise that motion is made of; 2^20 draws for each window.
const PLANS: u64 = 1 << 62;
const DRAWS_OF_A_WINDOW: u64 = 1 << 20;

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
        Self { config: config.clone(), networks }
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
        let PlanRequest { condition, style, guidance: s, .. } = *request;
        let (codes, n) = (self.config.codes, self.config.n_tokens(condition.nrows()));
        let first = PLANS + request.window * DRAWS_OF_A_WINDOW;
        let stream = |draw: usize| Stream::new(request.seed, first + draw as u64);
        // With the music, without it, or both: u + s (c − u).
        let without_music: &[bool] = match s {
            1.0 => &[false],
            0.0 => &[true],
            _ => &[false, true],
        };
        let mut plan = self.networks.begin(&PlanWindow { condition, style, without_music })?;
        let mut logits = |tokens: &[u32]| -> Result<Vec<f32>, EngineError> {
            let mut found = plan.logits(tokens)?;
            if without_music.len() == 2 {
                let without = found.split_off(found.len() / 2);
                let (to, away) = (s as f32, (1.0 - s) as f32);
                found.iter_mut().zip(without).for_each(|(c, u)| *c = *c * to + u * away);
            }
            Ok(found)
        };
        match self.config.kind {
            PlannerKind::Masked => {
                let mut given: Vec<Option<u32>> = request.given.iter().copied().map(Some).collect();
                given.resize(n, None);
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
                sample_autoregressive(sampling, request.given, n, codes, logits, uniform)
            }
        }
    }
}
