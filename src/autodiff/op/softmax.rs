//! Softmax, its logarithm, and cross-entropy.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// e^x / Σ e^x over the last axis. \[..., channels\] → the same
pub struct Softmax<E: Element> {
    y: Option<Vec<E>>,
}

impl<E: Element> Default for Softmax<E> {
    fn default() -> Self {
        Self { y: None }
    }
}

/// Returns the largest number and ln Σ e^(x − largest) of a row.
fn log_sum<E: Element>(row: &[E]) -> (E, E) {
    let largest = row.iter().copied().fold(row[0], E::larger);
    (largest, row.iter().map(|&x| (x - largest).exp()).sum::<E>().ln())
}

impl<E: Element> Operation<E> for Softmax<E> {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        let channels = x.channels().max(1);
        let y = run.tensor(x.shape(), |y| {
            for (y, x) in y.chunks_exact_mut(channels).zip(x.data().chunks_exact(channels)) {
                let (largest, _) = log_sum(x);
                y.iter_mut().zip(x).for_each(|(y, &x)| *y = (x - largest).exp());
                let sum = y.iter().copied().sum::<E>();
                y.iter_mut().for_each(|y| *y /= sum);
            }
        });
        self.y = run.recording.then(|| y.data().to_vec());
        Ok(y)
    }

    /// dx = y (dy − Σ y dy).
    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let y = self.y.take().expect("kept by the forward");
        let channels = dy.channels().max(1);
        at.only(|| {
            for (d, y) in dy.data_mut().chunks_exact_mut(channels).zip(y.chunks_exact(channels)) {
                let mean = d.iter().zip(y).map(|(&d, &y)| d * y).sum::<E>();
                d.iter_mut().zip(y).for_each(|(d, &y)| *d = y * (*d - mean));
            }
            dy
        })
    }
}

/// −Σ w ln softmax(x)\[label\] / Σ w: the mean over rows, or over those with weight.
///
/// # Shapes
/// inputs: logits \[..., classes\], labels \[...\], weights \[...\] if any → scalar
pub struct CrossEntropy<E: Element> {
    kept: Option<(Tensor<E>, Vec<usize>, Vec<f64>)>,
}

impl<E: Element> Default for CrossEntropy<E> {
    fn default() -> Self {
        Self { kept: None }
    }
}

impl<E: Element> Operation<E> for CrossEntropy<E> {
    fn name(&self) -> &'static str {
        "cross_entropy"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (logits, labels) = (x[0], x[1]);
        let classes = logits.channels().max(1);
        expect_size("cross_entropy", "labels", "rows", labels.len(), "logits", logits.rows())?;
        let mut weights = vec![1.0; logits.rows()];
        if let Some(given) = x.get(2) {
            expect_size("cross_entropy", "weights", "rows", given.len(), "logits", logits.rows())?;
            weights = given.data().iter().map(|w| w.to_f64()).collect();
        }
        let total: f64 = weights.iter().sum();
        let mut chosen = Vec::with_capacity(labels.len());
        let mut sum = 0.0;
        for ((row, &label), weight) in
            logits.data().chunks_exact(classes).zip(labels.data()).zip(&mut weights)
        {
            let label = label.to_f64();
            if !(label >= 0.0 && label < classes as f64 && label.fract() == 0.0) {
                let problem =
                    format!("label {label} is not a whole number below {classes}, the classes");
                return Err(GraphError::shape("cross_entropy", problem));
            }
            *weight /= total;
            let (largest, log_sum) = log_sum(row);
            sum += *weight * (log_sum + largest - row[label as usize]).to_f64();
            chosen.push(label as usize);
        }
        if run.recording {
            self.kept = Some((logits.clone(), chosen, weights));
        }
        Ok(run.tensor(&[], |y| y[0] = E::from_f64(sum)))
    }

    /// dx = w (softmax(x) − \[label\]) dy / Σ w.
    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let (logits, chosen, weights) = self.kept.take().expect("kept by the forward");
        let classes = logits.channels().max(1);
        let mut found = at.only(|| {
            at.tensor(logits.shape(), |d| {
                let rows = d.chunks_exact_mut(classes).zip(logits.data().chunks_exact(classes));
                for (((d, x), &label), &weight) in rows.zip(&chosen).zip(&weights) {
                    let (largest, log_sum) = log_sum(x);
                    let factor = dy.data()[0] * E::from_f64(weight);
                    for (i, (d, &x)) in d.iter_mut().zip(x).enumerate() {
                        let p = (x - largest - log_sum).exp();
                        *d = factor * if i == label { p - E::ONE } else { p };
                    }
                }
            })
        });
        found.resize_with(at.needs.len(), || None);
        found
    }
}
