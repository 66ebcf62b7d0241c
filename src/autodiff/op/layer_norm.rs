//! Layer normalisation.

use rayon::prelude::*;

use super::elementwise::CHUNK;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{ParameterId, Result};

/// γ x̂ + β, x̂ = (x − μ)/√(σ² + ε), μ and σ² over the last axis of each row.
///
/// Ba, Kiros and Hinton, "Layer Normalization", arXiv 1607.06450, eq. 3. \[..., channels\] → the same
pub struct LayerNormalize<E: Element> {
    affine: Option<[ParameterId; 2]>,
    epsilon: f64,
    kept: Option<(Tensor<E>, Vec<[f64; 2]>)>,
}

impl<E: Element> LayerNormalize<E> {
    /// Returns the operation; `affine` holds γ and β.
    pub fn new(affine: Option<[ParameterId; 2]>, epsilon: f64) -> Self {
        Self { affine, epsilon, kept: None }
    }
}

/// Returns μ and 1/√(σ² + ε) of a row.
fn moments<E: Element>(row: &[E], epsilon: f64) -> [f64; 2] {
    let n = row.len() as f64;
    let mean = row.iter().map(|x| x.to_f64()).sum::<f64>() / n;
    let variance = row.iter().map(|x| (x.to_f64() - mean).powi(2)).sum::<f64>() / n;
    [mean, 1.0 / (variance + epsilon).sqrt()]
}

impl<E: Element> Operation<E> for LayerNormalize<E> {
    fn name(&self) -> &'static str {
        "layer_norm"
    }

    fn parameter(&self) -> Option<ParameterId> {
        self.affine.map(|[weight, _]| weight)
    }

    fn parameters(&self) -> [Option<ParameterId>; 2] {
        [self.affine.map(|[weight, _]| weight), self.affine.map(|[_, bias]| bias)]
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let x = x[0];
        let channels = x.channels().max(1);
        let affine = self.affine.map(|ids| ids.map(|id| run.parameters.get(id)));
        if let Some([gamma, _]) = affine {
            expect_size("layer_norm", "input", "channels", channels, "weight", gamma.len())?;
        }
        let moments: Vec<_> =
            x.data().par_chunks(channels).map(|row| moments(row, self.epsilon)).collect();
        let y = run.tensor(x.shape(), |y| {
            let rows = y.par_chunks_mut(channels).zip(x.data().par_chunks(channels));
            rows.zip(&moments).for_each(|((y, x), &[mean, r])| {
                for (c, (y, &x)) in y.iter_mut().zip(x).enumerate() {
                    let normal = E::from_f64((x.to_f64() - mean) * r);
                    *y = affine.map_or(normal, |[gamma, beta]| gamma[c] * normal + beta[c]);
                }
            });
        });
        if run.recording {
            self.kept = Some((x.clone(), moments));
        }
        Ok(y)
    }

    /// dx = r (g − mean(g) − x̂ mean(g x̂)), g = γ dy; dγ = Σ dy x̂, dβ = Σ dy over rows.
    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let (x, moments) = self.kept.take().expect("kept by the forward");
        let channels = x.channels().max(1);
        let n = channels as f64;
        let gamma = self.affine.map(|[weight, _]| at.parameters.get(weight));
        if let Some([weight, bias]) = self.affine {
            // Fixed runs of rows, summed in their order, so that threads do not change the sum.
            let run = (CHUNK / channels).max(1) * channels;
            let parts = dy.data().par_chunks(run).zip(x.data().par_chunks(run)).enumerate();
            let parts: Vec<_> = parts
                .map(|(i, (dy, x))| {
                    let mut sums = vec![[0.0; 2]; channels];
                    let rows = dy.chunks_exact(channels).zip(x.chunks_exact(channels));
                    for ((dy, x), &[mean, r]) in rows.zip(&moments[i * run / channels..]) {
                        for ((sum, &d), &x) in sums.iter_mut().zip(dy).zip(x) {
                            sum[0] += d.to_f64() * (x.to_f64() - mean) * r;
                            sum[1] += d.to_f64();
                        }
                    }
                    sums
                })
                .collect();
            for (i, id) in [weight, bias].into_iter().enumerate() {
                let sum = |c: usize| parts.iter().map(|part| part[c][i]).sum::<f64>();
                let d: Vec<_> = (0..channels).map(|c| E::from_f64(sum(c))).collect();
                at.gradients.add(id, &d);
            }
        }
        at.only(|| {
            let rows = dy.data_mut().par_chunks_mut(channels).zip(x.data().par_chunks(channels));
            rows.zip(&moments).for_each(|((dy, x), &[mean, r])| {
                let g = |c: usize, d: E| d.to_f64() * gamma.map_or(1.0, |gamma| gamma[c].to_f64());
                let normal = |x: E| (x.to_f64() - mean) * r;
                let (mut m1, mut m2) = (0.0, 0.0);
                for (c, (&d, &x)) in dy.iter().zip(x).enumerate() {
                    m1 += g(c, d) / n;
                    m2 += g(c, d) * normal(x) / n;
                }
                for (c, (d, &x)) in dy.iter_mut().zip(x).enumerate() {
                    *d = E::from_f64(r * (g(c, *d) - m1 - normal(x) * m2));
                }
            });
            dy
        })
    }
}
