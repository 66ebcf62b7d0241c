//! The engine of a planner: which tokens go with a window of music.

use std::num::NonZeroUsize;

use ndarray::{Array2, ArrayView2, Axis};

use crate::audio::FeatureScale;
use crate::autodiff::{Arena, Eager, Interpreter as _, Parameters, Stream, Threads};
use crate::diffusion::{TokenSampling, sample_autoregressive, sample_masked};
use crate::generation::engine::EngineError;
use crate::generation::pool::Pool;
use crate::model::{Planner, PlannerConfig, PlannerInputs, PlannerKind, condition_scale};
use crate::motion::style::STYLE_DIM;

/// Runs a planner by the interpreter that trains it.
pub struct PlannerEngine {
    config: PlannerConfig,
    planner: Planner,
    parameters: Parameters<f32>,
    /// Of the condition.
    scale: FeatureScale,
    /// Whether the tokens of a plan come in an order of chance.
    is_shuffled: bool,
    workers: Pool<PlannerWorker>,
}

struct PlannerWorker {
    threads: Threads,
    arena: Arena<f32>,
}

/// A window whose tokens are asked for.
#[derive(Clone, Copy, Debug)]
pub struct PlanRequest<'a> {
    /// Features as the table has them, then the clock of a network that hears it, \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Normalised style, for a network that takes one.
    pub style: Option<[f32; STYLE_DIM]>,
    /// What is asked of the motion, \[T, 12\] (`AskedPose::channels`), of a planner that takes it; none where nothing
    /// is asked.
    pub constraints: Option<ArrayView2<'a, f32>>,
    /// The first tokens, where they are known.
    pub given: &'a [u32],
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

/// The condition without which a prediction is that guidance leads away from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Withheld {
    Music,
    Constraints,
}

impl PlannerEngine {
    /// Makes an engine of so many workers of so many threads each; `parameters` are those of [`Planner`].
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        config: &PlannerConfig,
        parameters: Parameters<f32>,
        feature_scale: &FeatureScale,
        (n_workers, n_threads): (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        let worker =
            |_| Ok(PlannerWorker { threads: Threads::start(n_threads)?, arena: Arena::default() });
        let workers = (0..n_workers.get()).map(worker).collect::<std::io::Result<Vec<_>>>()?;
        Ok(Self {
            config: config.clone(),
            planner: Planner::new(config).0,
            parameters,
            scale: condition_scale(config.condition(), feature_scale),
            is_shuffled: false,
            workers: Pool::new(workers),
        })
    }

    /// Puts the tokens of every plan, but for those that are given, in an order of chance: what such motion still has
    /// is owed to which tokens there are, and not to where they stand.
    #[must_use]
    pub fn with_shuffled_plans(self) -> Self {
        Self { is_shuffled: true, ..self }
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
            let n_given = request.given.len().min(tokens.len());
            shuffle(&mut tokens[n_given..], Stream::new(request.seed, draw));
        }
        Ok(tokens)
    }

    fn drawn(
        &self,
        sampling: &TokenSampling,
        request: &PlanRequest,
    ) -> Result<Vec<u32>, EngineError> {
        let mut condition = request.condition.to_owned();
        self.scale.apply(condition.view_mut());
        let (codes, n) = (self.config.codes, self.config.n_tokens(condition.nrows()));
        let first = PLANS + request.window * DRAWS_OF_A_WINDOW;
        let stream = |draw: usize| Stream::new(request.seed, first + draw as u64);
        // With two conditions the pairs {both, constraints alone} and {both, music alone} take turns by chance, each as
        // often (paper, eq. 10 and 11); with one there is one pair.
        let is_constrained = request.constraints.is_some() && self.config.constraint_dim > 0;
        let mut n_asked = 0;
        let mut withheld = || {
            let mut number = [0.0_f64];
            stream(PAIRS + n_asked).uniform(0, &mut number);
            n_asked += 1;
            match is_constrained && number[0] >= 0.5 {
                true => Withheld::Constraints,
                false => Withheld::Music,
            }
        };
        match self.config.kind {
            PlannerKind::Masked => {
                let mut given: Vec<Option<u32>> = request.given.iter().copied().map(Some).collect();
                given.resize(n, None);
                let logits = |tokens: &[u32]| self.logits(tokens, &condition, request, withheld());
                let uniform = |draw: usize, numbers: &mut [f64]| stream(draw).uniform(0, numbers);
                sample_masked(sampling, &given, codes, logits, uniform)
            }
            PlannerKind::Autoregressive => {
                // The network is run over the whole window for every token: no state is kept from one to the next.
                let logits = |tokens: &[u32]| {
                    let mut padded = tokens.to_vec();
                    padded.resize(n, 0);
                    let logits = self.logits(&padded, &condition, request, withheld())?;
                    Ok(logits.row(tokens.len()).to_vec())
                };
                let uniform = |draw: usize| {
                    let mut number = [0.0_f64];
                    stream(draw).uniform(0, &mut number);
                    number[0]
                };
                sample_autoregressive(sampling, request.given, n, codes, logits, uniform)
            }
        }
    }

    /// Returns what the planner says of each position, guided: u + s (c − u), \[N, K\], u that without one condition.
    ///
    /// `condition`: in units of its spread
    ///
    /// # Errors
    /// Shapes that do not fit.
    fn logits(
        &self,
        tokens: &[u32],
        condition: &Array2<f32>,
        request: &PlanRequest,
        withheld: Withheld,
    ) -> Result<Array2<f32>, EngineError> {
        let s = request.guidance;
        let dropped: &[f32] = match s {
            1.0 => &[0.0],
            0.0 => &[1.0],
            _ => &[0.0, 1.0],
        };
        let n = dropped.len();
        let nothing = [0.0; 2];
        let [no_music, no_constraints] = match withheld {
            Withheld::Music => [dropped, &nothing[..n]],
            Withheld::Constraints => [&nothing[..n], dropped],
        };
        let repeated = |values: &mut dyn Iterator<Item = f32>| -> Vec<f32> {
            let one: Vec<f32> = values.collect();
            one.repeat(n)
        };
        let tokens_of = repeated(&mut tokens.iter().map(|&token| token as f32));
        let audio = repeated(&mut condition.iter().copied());
        let style = (self.config.style_dim > 0)
            .then(|| repeated(&mut request.style.unwrap_or_default().into_iter()));
        let asked = request
            .constraints
            .filter(|_| self.config.constraint_dim > 0)
            .map(|asked| (asked.dim(), repeated(&mut asked.iter().copied())));
        let logits = self.workers.with(|PlannerWorker { threads, arena }| {
            threads.run(|| {
                let mut g = Eager::new(&self.parameters, arena);
                let tokens = g.constant(&[n, tokens.len()], &tokens_of);
                let audio = g.constant(&[n, condition.nrows(), condition.ncols()], &audio);
                let drop_audio = g.constant(&[n], no_music);
                let style = style.as_ref().map(|style| g.constant(&[n, STYLE_DIM], style));
                let asked = asked
                    .as_ref()
                    .map(|((frames, width), asked)| g.constant(&[n, *frames, *width], asked));
                let drop_constraints = g.constant(&[n], no_constraints);
                let inputs = PlannerInputs {
                    tokens: &tokens,
                    audio: &audio,
                    drop_audio: Some(&drop_audio),
                    style: style.as_ref(),
                    constraints: asked.as_ref(),
                    drop_constraints: asked.is_some().then_some(&drop_constraints),
                    mask: None,
                };
                let logits = self.planner.forward(&mut g, &inputs)?;
                Ok::<_, EngineError>(logits.data().to_vec())
            })
        })?;
        let shape = (n * tokens.len(), self.config.codes);
        let all = Array2::from_shape_vec(shape, logits)
            .expect("invariant: a row of codes for each token");
        let (with, without) = all.view().split_at(Axis(0), tokens.len());
        if n == 1 {
            return Ok(with.to_owned());
        }
        let (to, away) = (s as f32, (1.0 - s) as f32);
        Ok(&with * to + &without * away)
    }
}

/// Puts tokens in an order of chance, each as likely (Fisher and Yates).
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
