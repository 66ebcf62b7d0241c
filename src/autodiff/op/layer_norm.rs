//! Layer normalisation.

use rayon::prelude::*;

use super::elementwise::CHUNK;
use crate::autodiff::element::Element;
use crate::autodiff::kernel::vectorized;
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

/// Rows whose sums are made side by side, each in the order of its channels.
const LANES: usize = 16;

/// Some channels of 16 rows, at most 16: the numbers of a channel lie together.
struct Turned<E>([E; LANES * LANES]);

impl<E: Element> Turned<E> {
    /// Takes channels from `first` on of rows that lie one behind the other.
    #[inline(always)]
    fn of(rows: &[E], channels: usize, first: usize) -> Self {
        let (mut square, mut turned) = ([E::ZERO; LANES * LANES], [E::ZERO; LANES * LANES]);
        let n = (channels - first).min(LANES);
        for (row, square) in rows.chunks_exact(channels).zip(square.chunks_exact_mut(LANES)) {
            square[..n].copy_from_slice(&row[first..first + n]);
        }
        E::transpose(&square, &mut turned);
        Self(turned)
    }

    /// Returns the numbers of the i-th of them.
    #[inline(always)]
    fn channel(&self, i: usize) -> [f64; LANES] {
        std::array::from_fn(|lane| self.0[i * LANES + lane].to_f64())
    }
}

vectorized! {
    /// Returns μ and 1/√(σ² + ε) of each of 16 rows.
    fn moments_of_16<E: Element>(rows: &[E], channels: usize, epsilon: f64) -> [[f64; 2]; LANES] {
        let n = channels as f64;
        let (mut mean, mut variance) = ([0.0; LANES], [0.0; LANES]);
        for first in (0..channels).step_by(LANES) {
            let turned = Turned::of(rows, channels, first);
            for i in 0..(channels - first).min(LANES) {
                let x = turned.channel(i);
                mean.iter_mut().zip(x).for_each(|(mean, x)| *mean += x);
            }
        }
        mean.iter_mut().for_each(|mean| *mean /= n);
        for first in (0..channels).step_by(LANES) {
            let turned = Turned::of(rows, channels, first);
            for i in 0..(channels - first).min(LANES) {
                let x = turned.channel(i);
                for ((variance, mean), x) in variance.iter_mut().zip(&mean).zip(x) {
                    *variance += (x - mean) * (x - mean);
                }
            }
        }
        std::array::from_fn(|i| [mean[i], 1.0 / (variance[i] / n + epsilon).sqrt()])
    }

    /// y = γ x̂ + β of one row.
    fn normalize_row<E: Element>(y: &mut [E], x: &[E], mean: f64, r: f64, affine: Option<[&[E]; 2]>) {
        for (y, &x) in y.iter_mut().zip(x) {
            *y = E::from_f64((x.to_f64() - mean) * r);
        }
        if let Some([gamma, beta]) = affine {
            for ((y, &gamma), &beta) in y.iter_mut().zip(gamma).zip(beta) {
                *y = gamma * *y + beta;
            }
        }
    }

    /// Adds a row's part to dγ and dβ.
    fn add_to_affine<E: Element>(d_gamma: &mut [f64], d_beta: &mut [f64], dy: &[E], x: &[E], mean: f64, r: f64) {
        let sums = d_gamma.iter_mut().zip(d_beta);
        for ((d_gamma, d_beta), (&d, &x)) in sums.zip(dy.iter().zip(x)) {
            *d_gamma += d.to_f64() * (x.to_f64() - mean) * r;
            *d_beta += d.to_f64();
        }
    }

    /// Returns mean(g) and mean(g x̂) of each of 16 rows, g = γ dy.
    fn means_of_16<E: Element>(dy: &[E], x: &[E], moments: &[[f64; 2]], gamma: &[f64]) -> [[f64; 2]; LANES] {
        let channels = gamma.len();
        let n = channels as f64;
        let mean: [f64; LANES] = std::array::from_fn(|i| moments[i][0]);
        let r: [f64; LANES] = std::array::from_fn(|i| moments[i][1]);
        // A product with a power of two is the quotient, to the bit.
        let inverse = channels.is_power_of_two().then_some(1.0 / n);
        let (mut m1, mut m2) = ([0.0; LANES], [0.0; LANES]);
        for first in (0..channels).step_by(LANES) {
            let (dy, x) = (Turned::of(dy, channels, first), Turned::of(x, channels, first));
            for i in 0..(channels - first).min(LANES) {
                let (dy, x) = (dy.channel(i), x.channel(i));
                let g: [f64; LANES] = std::array::from_fn(|lane| dy[lane] * gamma[first + i]);
                let gx: [f64; LANES] =
                    std::array::from_fn(|lane| g[lane] * ((x[lane] - mean[lane]) * r[lane]));
                if let Some(inverse) = inverse {
                    m1.iter_mut().zip(g).for_each(|(m, g)| *m += g * inverse);
                    m2.iter_mut().zip(gx).for_each(|(m, gx)| *m += gx * inverse);
                } else {
                    m1.iter_mut().zip(g).for_each(|(m, g)| *m += g / n);
                    m2.iter_mut().zip(gx).for_each(|(m, gx)| *m += gx / n);
                }
            }
        }
        std::array::from_fn(|i| [m1[i], m2[i]])
    }

    /// dx = r (g − mean(g) − x̂ mean(g x̂)) of one row, in place of dy.
    fn slope_of_row<E: Element>(dy: &mut [E], x: &[E], moments: [f64; 2], means: [f64; 2], gamma: &[f64]) {
        let ([mean, r], [m1, m2]) = (moments, means);
        for ((d, &x), gamma) in dy.iter_mut().zip(x).zip(gamma) {
            *d = E::from_f64(r * (d.to_f64() * gamma - m1 - (x.to_f64() - mean) * r * m2));
        }
    }
}

/// Fills 16 rows with those that there are and with the last for the others, so that all have numbers.
fn filled_up<'a, E: Element>(rows: &'a [E], channels: usize, buffer: &'a mut Vec<E>) -> &'a [E] {
    if rows.len() == LANES * channels {
        return rows;
    }
    buffer.clear();
    buffer.extend_from_slice(rows);
    while buffer.len() < LANES * channels {
        buffer.extend_from_within(..channels);
    }
    buffer
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
        let run_rows = rows_of_run(channels);
        let mut moments = vec![[0.0; 2]; x.rows()];
        let y = run.tensor(x.shape(), |y| {
            let runs = y.par_chunks_mut(run_rows * channels);
            let runs = runs.zip(x.data().par_chunks(run_rows * channels));
            runs.zip(moments.par_chunks_mut(run_rows)).for_each(|((y, x), moments)| {
                let mut buffer = Vec::new();
                let parts = x.chunks(LANES * channels).zip(moments.chunks_mut(LANES));
                for (x, moments) in parts {
                    let rows = filled_up(x, channels, &mut buffer);
                    let found = moments_of_16(rows, channels, self.epsilon);
                    moments.copy_from_slice(&found[..moments.len()]);
                }
                let rows = y.chunks_exact_mut(channels).zip(x.chunks_exact(channels));
                for ((y, x), &[mean, r]) in rows.zip(&*moments) {
                    normalize_row(y, x, mean, r, affine);
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
        let gamma = self.affine.map(|[weight, _]| at.parameters.get(weight));
        if let Some([weight, bias]) = self.affine {
            // Fixed runs of rows, summed in their order, so that threads do not change the sum.
            let run = (CHUNK / channels).max(1) * channels;
            let parts = dy.data().par_chunks(run).zip(x.data().par_chunks(run)).enumerate();
            let parts: Vec<_> = parts
                .map(|(i, (dy, x))| {
                    let mut sums = [vec![0.0; channels], vec![0.0; channels]];
                    let [d_gamma, d_beta] = &mut sums;
                    let rows = dy.chunks_exact(channels).zip(x.chunks_exact(channels));
                    for ((dy, x), &[mean, r]) in rows.zip(&moments[i * run / channels..]) {
                        add_to_affine(d_gamma, d_beta, dy, x, mean, r);
                    }
                    sums
                })
                .collect();
            for (i, id) in [weight, bias].into_iter().enumerate() {
                let sum = |c: usize| parts.iter().map(|part| part[i][c]).sum::<f64>();
                let d: Vec<_> = (0..channels).map(|c| E::from_f64(sum(c))).collect();
                at.gradients.add(id, &d);
            }
        }
        at.only(|| {
            let gamma: Vec<f64> = match gamma {
                Some(gamma) => gamma.iter().map(|x| x.to_f64()).collect(),
                None => vec![1.0; channels],
            };
            let run_rows = rows_of_run(channels);
            let runs = dy.data_mut().par_chunks_mut(run_rows * channels);
            let runs = runs.zip(x.data().par_chunks(run_rows * channels));
            runs.zip(moments.par_chunks(run_rows)).for_each(|((dy, x), moments)| {
                let mut buffers = [Vec::new(), Vec::new()];
                let parts = dy.chunks_mut(LANES * channels).zip(x.chunks(LANES * channels));
                for ((dy, x), moments) in parts.zip(moments.chunks(LANES)) {
                    let mut padded = [[0.0; 2]; LANES];
                    padded[..moments.len()].copy_from_slice(moments);
                    let [of_dy, of_x] = &mut buffers;
                    let rows = filled_up(dy, channels, of_dy);
                    let means = means_of_16(rows, filled_up(x, channels, of_x), &padded, &gamma);
                    let rows = dy.chunks_exact_mut(channels).zip(x.chunks_exact(channels));
                    for ((dy, x), (&moments, means)) in rows.zip(moments.iter().zip(means)) {
                        slope_of_row(dy, x, moments, means, &gamma);
                    }
                }
            });
            dy
        })
    }
}

/// Returns how many rows a task does, a multiple of those that are done side by side.
fn rows_of_run(channels: usize) -> usize {
    (CHUNK / channels).next_multiple_of(LANES).max(LANES)
}
