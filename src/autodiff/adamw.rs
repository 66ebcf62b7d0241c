//! AdamW with clipping, in one pass over the parameters.

use ndarray::Array1;
use rayon::prelude::*;

use crate::model::{Parameter, Role};

use super::arena::Arena;
use super::element::Element;
use super::kernel::vectorized;
use super::parameters::{Gradients, Parameters};
use super::shard::{SHARD_CHUNK, Shard, chunk_range};

/// Elements of a chunk: four streams of it (1 MB of `f32`) stay in the second cache.
const CHUNK: usize = SHARD_CHUNK;
/// The number that PyTorch adds to the norm before it divides by it.
const CLIP_EPSILON: f64 = 1e-6;

/// The settings of [`AdamW`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamWConfig {
    /// Decay of the averages of the gradient and of its square.
    pub betas: [f64; 2],
    pub epsilon: f64,
    /// Decay of weights and tables; biases, norms and single vectors do not decay.
    pub weight_decay: f64,
    /// Largest norm of the gradient, all parameters together; `None` for no limit.
    pub max_norm: Option<f64>,
}

impl Default for AdamWConfig {
    fn default() -> Self {
        Self { betas: [0.9, 0.999], epsilon: 1e-8, weight_decay: 1e-4, max_norm: Some(1.0) }
    }
}

/// The moments of AdamW, which lie as the parameters do.
///
/// Loshchilov and Hutter, "Decoupled Weight Decay Regularization", ICLR 2019, alg. 2, as PyTorch
/// computes it.
#[derive(Clone, Debug)]
pub struct AdamW<E: Element> {
    config: AdamWConfig,
    moments: [Array1<E>; 2],
    n_steps: u64,
}

/// The coefficients of an update, the same for every element.
#[derive(Clone, Copy)]
struct Update<E> {
    clip: E,
    keep: E,
    betas: [E; 2],
    rest: [E; 2],
    /// lr / (1 − β₁ⁿ)
    rate: E,
    /// 1 / √(1 − β₂ⁿ)
    correction: E,
    epsilon: E,
}

vectorized! {
    /// p ← keep p, m ← β₁ m + (1 − β₁) g, v ← β₂ v + (1 − β₂) g², p ← p − rate m / (√v correction + ε).
    fn update_chunk<E: Element>(p: &mut [E], g: &[E], m: &mut [E], v: &mut [E], by: &Update<E>) {
        let Update { clip, keep, betas, rest, rate, correction, epsilon } = *by;
        for (((p, &g), m), v) in p.iter_mut().zip(g).zip(m.iter_mut()).zip(v.iter_mut()) {
            let g = clip * g;
            *m = betas[0] * *m + rest[0] * g;
            *v = betas[1] * *v + rest[1] * g * g;
            *p = keep * *p - rate * *m / (v.sqrt() * correction + epsilon);
        }
    }

    /// Σ x², in sixteen lanes.
    fn square_lanes<E: Element>(x: &[E], lanes: &mut [E]) {
        for x in x.chunks_exact(lanes.len()) {
            for (lane, &x) in lanes.iter_mut().zip(x) {
                *lane += x * x;
            }
        }
    }
}

/// Returns Σ x² of each chunk of a process's share, in order, in f64.
///
/// The norm of all is √Σ of the sums of all chunks in their order, see [`norm_of`], and does not depend on which process computed them.
pub fn squares<E: Element>(x: &[E], shard: Shard) -> Vec<f64> {
    let part = |x: &[E]| {
        // Lanes join the f64 sum every 1,024 numbers, so that their rounding stays small.
        let run = |x: &[E]| {
            let mut lanes = [E::ZERO; 16];
            square_lanes(x, &mut lanes);
            lanes.iter().map(|x| x.to_f64()).sum::<f64>()
        };
        x.chunks(1024).map(run).sum::<f64>()
    };
    let ranges: Vec<_> = shard.ranges(x.len()).collect();
    ranges.into_par_iter().map(|range| part(&x[range])).collect()
}

/// Returns √Σ of the squares of chunks in their order.
pub fn norm_of(squares: &[f64]) -> f64 {
    squares.iter().sum::<f64>().sqrt()
}

impl<E: Element> AdamW<E> {
    /// Begins with moments of zero.
    pub fn new(config: AdamWConfig, parameters: &Parameters<E>) -> Self {
        let moments = [0, 1].map(|_| Arena::aligned(parameters.plan().len()));
        Self { config, moments, n_steps: 0 }
    }

    /// Returns both moments and how many steps they have seen, for a checkpoint.
    pub fn state(&self) -> ([&[E]; 2], u64) {
        let [m, v] = &self.moments;
        ([m, v].map(|x| x.as_slice().expect("one run of memory")), self.n_steps)
    }

    /// Takes up a state, which must lie as the parameters do.
    pub fn restore(&mut self, moments: [&[E]; 2], n_steps: u64) {
        self.restore_shard(moments, n_steps, Shard::WHOLE);
    }

    /// Takes up a process's share of a state.
    pub fn restore_shard(&mut self, moments: [&[E]; 2], n_steps: u64, shard: Shard) {
        for (own, given) in self.moments.iter_mut().zip(moments) {
            let own = own.as_slice_mut().expect("one run of memory");
            for range in shard.ranges(given.len()) {
                own[range.clone()].copy_from_slice(&given[range]);
            }
        }
        self.n_steps = n_steps;
    }

    /// Takes one step, and returns the norm of the gradient before it was clipped.
    ///
    /// Where the norm is not finite nothing changes, and the step does not count.
    pub fn step(
        &mut self,
        parameters: &mut Parameters<E>,
        gradients: &mut Gradients<E>,
        learning_rate: f64,
    ) -> f64 {
        self.step_by(parameters, gradients, |_| learning_rate)
    }

    /// Takes one step with a learning rate for each parameter; otherwise as [`AdamW::step`].
    pub fn step_by(
        &mut self,
        parameters: &mut Parameters<E>,
        gradients: &mut Gradients<E>,
        learning_rate: impl Fn(&Parameter) -> f64,
    ) -> f64 {
        let norm = norm_of(&squares(gradients.all(), Shard::WHOLE));
        self.step_shard(parameters, gradients, norm, Shard::WHOLE, learning_rate);
        norm
    }

    /// Takes one step of a process's share of the parameters, given the norm of the whole gradient.
    ///
    /// Where the norm is not finite nothing changes, and the step does not count.
    pub fn step_shard(
        &mut self,
        parameters: &mut Parameters<E>,
        gradients: &mut Gradients<E>,
        norm: f64,
        shard: Shard,
        learning_rate: impl Fn(&Parameter) -> f64,
    ) {
        if !norm.is_finite() {
            return;
        }
        let gradients = &*gradients.all();
        self.n_steps += 1;
        let AdamWConfig { betas, epsilon, weight_decay, max_norm } = self.config;
        let n = self.n_steps as f64;
        let clip = max_norm.map_or(1.0, |limit| (limit / (norm + CLIP_EPSILON)).min(1.0));
        let update = |learning_rate: f64, decay: f64| Update {
            clip: E::from_f64(clip),
            keep: E::from_f64(1.0 - learning_rate * decay),
            betas: betas.map(E::from_f64),
            rest: betas.map(|beta| E::from_f64(1.0 - beta)),
            rate: E::from_f64(learning_rate / (1.0 - betas[0].powf(n))),
            correction: E::from_f64(1.0 / (1.0 - betas[1].powf(n)).sqrt()),
            epsilon: E::from_f64(epsilon),
        };

        let plan = std::sync::Arc::clone(parameters.plan());
        let [m, v] = self.moments.each_mut().map(|x| x.as_slice_mut().expect("one run of memory"));
        let mut rest = (parameters.all_mut(), gradients, m, v);
        let mut done = 0;
        let mut chunks = Vec::new();
        for (id, parameter) in plan.list().iter() {
            let decays = matches!(parameter.role, Role::Weight | Role::Table);
            let decay = if decays { weight_decay } else { 0.0 };
            let by = update(learning_rate(parameter), decay);
            let range = plan.range(id);
            for chunk in range.start / CHUNK..range.end.div_ceil(CHUNK) {
                if !shard.owns(chunk) {
                    continue;
                }
                let whole = chunk_range(chunk, plan.len());
                let own = whole.start.max(range.start)..whole.end.min(range.end);
                skip(&mut rest, own.start - done);
                chunks.push((skip(&mut rest, own.len()), by));
                done = own.end;
            }
        }
        chunks.into_par_iter().for_each(|((p, g, m, v), by)| update_chunk(p, g, m, v, &by));
    }

    /// Returns both moments for writing.
    pub fn moments_mut(&mut self) -> [&mut Array1<E>; 2] {
        self.moments.each_mut()
    }
}

/// Parameters, gradients and both moments, from one element on.
type Streams<'a, E> = (&'a mut [E], &'a [E], &'a mut [E], &'a mut [E]);

/// Splits the first `n` elements off.
fn skip<'a, E>(rest: &mut Streams<'a, E>, n: usize) -> Streams<'a, E> {
    let (p, g, m, v) = std::mem::take(rest);
    let ((p, p_rest), (g, g_rest)) = (p.split_at_mut(n), g.split_at(n));
    let ((m, m_rest), (v, v_rest)) = (m.split_at_mut(n), v.split_at_mut(n));
    *rest = (p_rest, g_rest, m_rest, v_rest);
    (p, g, m, v)
}
