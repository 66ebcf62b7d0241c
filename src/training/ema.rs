//! The average of the weights over training, which predicts better than any of them.

use serde::{Deserialize, Serialize};

use crate::autodiff::{Element, Parameters, Shard};

/// The settings of an [`Ema`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EmaConfig {
    /// Share of the average that stays at an update, once warmed up.
    pub decay: f64,
    /// Steps between two updates.
    pub every: u64,
}

impl Default for EmaConfig {
    fn default() -> Self {
        Self { decay: 0.9999, every: 10 }
    }
}

/// Exponential moving average of parameters.
///
/// θ̄ ← d θ̄ + (1 − d) θ with d = min(decay, (1 + n) / (10 + n)) at update n = 0, 1, …: early on it forgets
/// fast, so that the first weights leave no trace (TensorFlow's `ExponentialMovingAverage`).
#[derive(Clone, Debug)]
pub struct Ema<E: Element> {
    config: EmaConfig,
    average: Parameters<E>,
    n_updates: u64,
    /// What of the average this process keeps.
    shard: Shard,
}

impl<E: Element> Ema<E> {
    /// Begins with the parameters as they are.
    pub fn new(config: EmaConfig, parameters: &Parameters<E>) -> Self {
        Self { config, average: parameters.clone(), n_updates: 0, shard: Shard::WHOLE }
    }

    /// Keeps a share of the average alone.
    pub fn shared(self, shard: Shard) -> Self {
        Self { average: self.average.part(shard), shard, ..self }
    }

    /// Goes on from an average that has seen `n_updates`.
    pub fn resume(config: EmaConfig, average: Parameters<E>, n_updates: u64) -> Self {
        Self { config, average, n_updates, shard: Shard::WHOLE }
    }

    pub fn average(&self) -> &Parameters<E> {
        &self.average
    }

    /// Returns the average for writing, to put together what several processes keep.
    pub fn average_mut(&mut self) -> &mut Parameters<E> {
        &mut self.average
    }

    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// Takes up the parameters after `step`, counted from 1, if it is an update's turn.
    pub fn after_step(&mut self, step: u64, parameters: &Parameters<E>) {
        if !step.is_multiple_of(self.config.every) {
            return;
        }
        let n = self.n_updates as f64;
        let decay = self.config.decay.min((1.0 + n) / (10.0 + n));
        self.average.approach(parameters, 1.0 - decay, self.shard);
        self.n_updates += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Init, ParameterList, Role, Scope};

    fn one(value: f64) -> Parameters<f64> {
        let mut list = ParameterList::default();
        Scope::root(&mut list).parameter("x", &[3], Init::Zeros, Role::Vector);
        Parameters::from_fn(list, |_| vec![value; 3])
    }

    #[test]
    fn the_average_follows_its_recursion() {
        let mut ema = Ema::new(EmaConfig { decay: 0.5, every: 2 }, &one(1.0));
        let mut wanted = 1.0;
        for step in 1..=40_u64 {
            ema.after_step(step, &one(step as f64));
            if step % 2 == 0 {
                let n = (step / 2 - 1) as f64;
                let d = f64::min(0.5, (1.0 + n) / (10.0 + n));
                wanted = d * wanted + (1.0 - d) * step as f64;
            }
            let id = ema.average().list().by_name()["x"];
            let got = ema.average().get(id)[0];
            assert!((got - wanted).abs() < 1e-12, "{step}: {got} against {wanted}");
        }
        assert_eq!(ema.n_updates(), 20);
    }
}
