//! An autoregressive planner position by position: the conditions of a window are computed once, and the keys and
//! values of the positions that are done are kept. N tokens thus take N positions of the transformer, instead of N (N + 1) / 2.

use super::Planner;
use super::layer::KeysAndValues;
use crate::model::graph::{Graph, Result};

/// The conditions of the positions of a window, beside its tokens.
#[derive(Clone, Debug)]
pub struct PlanConditions<T> {
    /// Music and constraints at each token, \[B, N, d\].
    pub local: T,
    /// That of the window as a whole, \[B, d\].
    pub global: T,
}

/// The inputs of a step: B windows of which P positions are done.
pub struct PlannerStepInputs<'a, T> {
    /// The first M tokens of each window, P < M ≤ N, \[B, M\]; position n sees those before it, so that the last is
    /// not looked at.
    pub tokens: &'a T,
    pub conditions: &'a PlanConditions<T>,
    /// Keys and values of each layer at the positions that are done; none at the first step.
    pub past: Option<&'a [KeysAndValues<T>]>,
}

/// The outputs of a step.
#[derive(Clone, Debug)]
pub struct PlannerStep<T> {
    /// ln p of each token at the positions P + 1 to M, up to a constant, \[B, M − P, K\].
    pub logits: T,
    /// Keys and values of each layer at all positions up to M: the past of the next step.
    pub present: Vec<KeysAndValues<T>>,
}

impl Planner {
    /// Returns the outputs of [`Planner::forward`] at the positions P + 1 to M, of a network whose positions see none behind them.
    ///
    /// # Shapes
    /// See [`PlannerStepInputs`] and [`PlannerStep`].
    pub fn step<G: Graph>(
        &self,
        g: &mut G,
        inputs: &PlannerStepInputs<G::Tensor>,
    ) -> Result<PlannerStep<G::Tensor>> {
        let PlanConditions { local, global } = inputs.conditions;
        let tokens = g.embedding(self.table, inputs.tokens)?;
        let before = g.concat_frames(&[global, &tokens])?;
        let before = g.crop_frames(&before, &tokens)?;
        let local = g.crop_frames(local, &tokens)?;
        let mut h = g.add(&before, &local)?;
        if let Some(first) = inputs.past.and_then(<[_]>::first) {
            h = g.frames_behind(&h, &first.keys)?;
        }
        let mut present = Vec::with_capacity(self.layers.len());
        for (i, layer) in self.layers.iter().enumerate() {
            let past = inputs.past.and_then(|past| past.get(i));
            let (next, known) = layer.step(g, &h, past)?;
            h = next;
            present.push(known);
        }
        let h = self.norm.forward(g, &h)?;
        Ok(PlannerStep { logits: self.out.forward(g, &h)?, present })
    }
}
