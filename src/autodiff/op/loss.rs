//! Losses: how far a prediction is from its target.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// The cost of one difference d.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cost {
    /// d².
    Squared,
    /// |d|.
    Absolute,
    /// d²/2 where |d| ≤ δ, else δ (|d| − δ/2): Huber, "Robust Estimation of a Location Parameter", 1964.
    Huber { delta: f64 },
    /// Huber's divided by δ, here β: PyTorch's smooth L1.
    SmoothL1 { beta: f64 },
}

impl Cost {
    /// Returns the cost of a difference, and its derivative.
    fn of(self, d: f64) -> [f64; 2] {
        match self {
            Self::Squared => [d * d, 2.0 * d],
            Self::Absolute => [d.abs(), if d == 0.0 { 0.0 } else { d.signum() }],
            Self::Huber { delta } if d.abs() <= delta => [0.5 * d * d, d],
            Self::Huber { delta } => [delta * (d.abs() - 0.5 * delta), delta * d.signum()],
            Self::SmoothL1 { beta } => Self::Huber { delta: beta }.of(d).map(|x| x / beta),
        }
    }
}

/// Σ w cost(prediction − target) / Σ w, a weight for each row of the last axis.
///
/// Rows of weight 0 count nowhere, so that padding stays out of a loss. Summed in f64, in order.
///
/// # Shapes
/// inputs: prediction \[..., channels\], target the same, weights \[...\] if any → scalar
pub struct Loss<E: Element> {
    cost: Cost,
    kept: Option<(Tensor<E>, Tensor<E>, Vec<f64>)>,
}

impl<E: Element> Loss<E> {
    /// Returns the operation.
    pub fn new(cost: Cost) -> Self {
        Self { cost, kept: None }
    }
}

impl<E: Element> Operation<E> for Loss<E> {
    fn name(&self) -> &'static str {
        match self.cost {
            Cost::Squared => "mse_loss",
            Cost::Absolute => "l1_loss",
            Cost::Huber { .. } => "huber_loss",
            Cost::SmoothL1 { .. } => "smooth_l1_loss",
        }
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (prediction, target) = (x[0], x[1]);
        if prediction.shape() != target.shape() {
            let problem = format!(
                "prediction has shape {:?}, target {:?}",
                prediction.shape(),
                target.shape()
            );
            return Err(GraphError::shape(self.name(), problem));
        }
        let channels = prediction.channels().max(1);
        let mut weights = vec![1.0; prediction.rows()];
        if let Some(given) = x.get(2) {
            if given.len() != weights.len() {
                let problem = format!(
                    "weights have shape {:?}, prediction {:?} expects one for each row",
                    given.shape(),
                    prediction.shape()
                );
                return Err(GraphError::shape(self.name(), problem));
            }
            weights = given.data().iter().map(|w| w.to_f64()).collect();
        }
        let total = weights.iter().sum::<f64>() * channels as f64;
        let factor = if total > 0.0 { 1.0 / total } else { 0.0 };
        let mut sum = 0.0;
        let rows =
            prediction.data().chunks_exact(channels).zip(target.data().chunks_exact(channels));
        for ((p, t), weight) in rows.zip(&mut weights) {
            *weight *= factor;
            if *weight != 0.0 {
                let costs = p.iter().zip(t).map(|(p, t)| self.cost.of(p.to_f64() - t.to_f64())[0]);
                sum += *weight * costs.sum::<f64>();
            }
        }
        if run.recording {
            self.kept = Some((prediction.clone(), target.clone(), weights));
        }
        Ok(run.tensor(&[], |y| y[0] = E::from_f64(sum)))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let (prediction, target, weights) = self.kept.take().expect("kept by the forward");
        let channels = prediction.channels().max(1);
        let dy = dy.data()[0].to_f64();
        let gradient = |sign: f64| {
            at.tensor(prediction.shape(), |d| {
                let rows = prediction
                    .data()
                    .chunks_exact(channels)
                    .zip(target.data().chunks_exact(channels));
                for ((d, (p, t)), &weight) in d.chunks_exact_mut(channels).zip(rows).zip(&weights) {
                    for ((d, p), t) in d.iter_mut().zip(p).zip(t) {
                        let slope = self.cost.of(p.to_f64() - t.to_f64())[1];
                        let masked = weight == 0.0;
                        *d = if masked { E::ZERO } else { E::from_f64(sign * dy * weight * slope) };
                    }
                }
            })
        };
        let mut found =
            vec![at.needs[0].then(|| gradient(1.0)), at.needs[1].then(|| gradient(-1.0))];
        found.resize_with(at.needs.len(), || None);
        found
    }
}
