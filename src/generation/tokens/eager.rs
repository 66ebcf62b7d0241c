//! The networks of a model of tokens by the interpreter that trains them.

use std::num::NonZeroUsize;

use ndarray::{Array3, ArrayView3};

use super::networks::{PlanWindow, PlannerNetworks, TokenizerNetworks, WindowPlan};
use crate::audio::FeatureScale;
use crate::autodiff::{Eager, Interpreter as _, Parameters, Tensor};
use crate::generation::engine::EngineError;
use crate::generation::interpreter::{EAGER, EagerWorkers, to_array};
use crate::model::{
    ConditionInputs, KeysAndValues, PlanConditions, Planner, PlannerConfig, PlannerKind,
    PlannerStepInputs, Tokenizer, TokensConfig, condition_scale,
};
use crate::motion::MOTION_DIM;
use crate::motion::style::STYLE_DIM;

/// Weights of a network, and the workers that run it.
struct EagerNetwork {
    parameters: Parameters<f32>,
    workers: EagerWorkers,
}

impl EagerNetwork {
    /// Starts so many workers of so many threads each.
    fn start(
        parameters: Parameters<f32>,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        Ok(Self { parameters, workers: EagerWorkers::start(workers)? })
    }

    fn run<R: Send>(
        &self,
        forward: impl FnOnce(&mut Eager<f32>) -> Result<R, EngineError> + Send,
    ) -> Result<R, EngineError> {
        self.workers.run(|arena| forward(&mut Eager::new(&self.parameters, arena)))
    }
}

/// The networks of a tokenizer.
pub struct EagerTokenizer {
    config: TokensConfig,
    tokenizer: Tokenizer,
    network: EagerNetwork,
}

impl EagerTokenizer {
    /// Takes the parameters of a [`Tokenizer`].
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        config: &TokensConfig,
        parameters: Parameters<f32>,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        Ok(Self {
            config: config.clone(),
            tokenizer: Tokenizer::new(config).0,
            network: EagerNetwork::start(parameters, workers)?,
        })
    }
}

impl TokenizerNetworks for EagerTokenizer {
    fn name(&self) -> &'static str {
        EAGER
    }

    fn n_workers(&self) -> usize {
        self.network.workers.n_workers()
    }

    fn encode(&self, motion: ArrayView3<f32>) -> Result<Vec<u32>, EngineError> {
        self.network.run(|g| {
            let motion = constant(g, motion);
            let tokens = self.tokenizer.tokens(g, &motion)?;
            Ok(tokens.data().iter().map(|&token| token as u32).collect())
        })
    }

    fn signal(
        &self,
        tokens: &[u32],
        (n, frames): (usize, usize),
    ) -> Result<Array3<f32>, EngineError> {
        let tokens: Vec<f32> = tokens.iter().map(|&token| token as f32).collect();
        self.network.run(|g| {
            let like = g.constant(&[n, frames, MOTION_DIM], &vec![0.0; n * frames * MOTION_DIM]);
            let tokens = g.constant(&[n, self.config.n_tokens(frames)], &tokens);
            let q = self.tokenizer.codes(g, &tokens)?;
            Ok(to_array(&self.tokenizer.signal(g, &q, &like)?))
        })
    }

    fn denoise(
        &self,
        x: ArrayView3<f32>,
        t: usize,
        signal: ArrayView3<f32>,
    ) -> Result<Array3<f32>, EngineError> {
        self.network.run(|g| {
            let n = x.dim().0;
            let t = g.constant(&[n], &vec![t as f32; n]);
            let (x, s) = (constant(g, x), constant(g, signal));
            Ok(to_array(&self.tokenizer.denoise(g, &x, &t, &s)?))
        })
    }

    fn draft(&self, signal: ArrayView3<f32>) -> Result<Option<Array3<f32>>, EngineError> {
        self.network.run(|g| {
            let s = constant(g, signal);
            Ok(self.tokenizer.draft(g, &s)?.as_ref().map(to_array))
        })
    }
}

/// A planner.
pub struct EagerPlanner {
    config: PlannerConfig,
    planner: Planner,
    /// Scale of the condition.
    scale: FeatureScale,
    network: EagerNetwork,
}

impl EagerPlanner {
    /// Takes the parameters of a [`Planner`] and the scale of features.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        config: &PlannerConfig,
        parameters: Parameters<f32>,
        feature_scale: &FeatureScale,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        Ok(Self {
            config: config.clone(),
            planner: Planner::new(config).0,
            scale: condition_scale(config.condition(), feature_scale),
            network: EagerNetwork::start(parameters, workers)?,
        })
    }
}

impl PlannerNetworks for EagerPlanner {
    fn name(&self) -> &'static str {
        EAGER
    }

    fn begin<'a>(&'a self, window: &PlanWindow) -> Result<Box<dyn WindowPlan + 'a>, EngineError> {
        let n = window.withheld.len();
        let mut condition = window.condition.to_owned();
        self.scale.apply(condition.view_mut());
        let [frames, channels] = [condition.nrows(), condition.ncols()];
        let condition = condition.into_iter().collect::<Vec<f32>>().repeat(n);
        let dropped = window.drops(|withheld| withheld.music);
        let style = window.style.unwrap_or_default().repeat(n);
        let asked = window.constraints.filter(|_| self.config.constraint_dim > 0).map(|asked| {
            let values: Vec<f32> = asked.iter().copied().collect();
            ([n, asked.nrows(), asked.ncols()], values.repeat(n))
        });
        let without = window.drops(|withheld| withheld.constraints);
        let conditions = self.network.run(|g| {
            let audio = g.constant(&[n, frames, channels], &condition);
            let drop_audio = g.constant(&[n], &dropped);
            let style = (self.config.style_dim > 0).then(|| g.constant(&[n, STYLE_DIM], &style));
            let asked = asked.as_ref().map(|(shape, values)| g.constant(shape, values));
            let drop_constraints = asked.is_some().then(|| g.constant(&[n], &without));
            let inputs = ConditionInputs {
                audio: &audio,
                drop_audio: Some(&drop_audio),
                style: style.as_ref(),
                constraints: asked.as_ref(),
                drop_constraints: drop_constraints.as_ref(),
                mask: None,
            };
            Ok(self.planner.conditions(g, &inputs)?)
        })?;
        Ok(Box::new(EagerPlan { of: self, n_answers: n, conditions, past: None }))
    }
}

/// A window that is being planned.
struct EagerPlan<'a> {
    of: &'a EagerPlanner,
    n_answers: usize,
    conditions: PlanConditions<Tensor<f32>>,
    /// Keys and values of the positions that are done, of the autoregressive kind.
    past: Option<Vec<KeysAndValues<Tensor<f32>>>>,
}

impl WindowPlan for EagerPlan<'_> {
    fn logits(&mut self, tokens: &[u32]) -> Result<Vec<f32>, EngineError> {
        let EagerPlanner { planner, config, .. } = self.of;
        let (n, conditions, past) = (self.n_answers, &self.conditions, self.past.as_deref());
        let mut seen: Vec<f32> = tokens.iter().map(|&token| token as f32).collect();
        match config.kind {
            PlannerKind::Masked => self.of.network.run(|g| {
                let tokens = g.constant(&[n, seen.len()], &seen.repeat(n));
                Ok(planner.forward_under(g, &tokens, conditions, None)?.data().to_vec())
            }),
            PlannerKind::Autoregressive => {
                // The next token stands behind those that are known; its value is not read.
                seen.push(0.0);
                let (logits, present) = self.of.network.run(|g| {
                    let tokens = g.constant(&[n, seen.len()], &seen.repeat(n));
                    let inputs = PlannerStepInputs { tokens: &tokens, conditions, past };
                    let step = planner.step(g, &inputs)?;
                    let of_window = step.logits.len() / n.max(1);
                    let answers = step.logits.data().chunks_exact(of_window.max(1));
                    let last = |answer: &[f32]| answer[of_window - config.codes..].to_vec();
                    Ok((answers.flat_map(last).collect(), step.present))
                })?;
                self.past = Some(present);
                Ok(logits)
            }
        }
    }
}

fn constant(g: &mut Eager<f32>, x: ArrayView3<f32>) -> Tensor<f32> {
    let x = x.as_standard_layout();
    g.constant(x.shape(), x.as_slice().expect("in order"))
}
