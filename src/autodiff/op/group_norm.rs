//! Group normalisation, the time's scale and shift, and the activation, in one.

use rayon::prelude::*;

use super::activation::{silu, silu_slope};
use crate::autodiff::element::Element;
use crate::autodiff::kernel::vectorized;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{Activation, GraphError, GroupNormalization, ParameterId, Result};

/// act((γ x̂ + β)(1 + s) + h), x̂ = (x − μ) r, r = 1/√(σ² + ε), μ and σ² over a group and all frames.
///
/// Per sample and channel this is act(a x + b) with a = r γ (1 + s), b = (β − μ r γ)(1 + s) + h: one
/// pass for the mean, one for the variance, one to write. Wu and He, "Group Normalization", ECCV 2018,
/// eq. 2 to 7; scale and shift: Perez et al., "FiLM", AAAI 2018.
///
/// # Shapes
/// `x`: \[batch, frames, channels\]; `film`: \[batch, 2 channels\], s then h
pub struct NormFilmActivate<E: Element> {
    norm: GroupNormalization,
    activation: Activation,
    kept: Option<NormActivations<E>>,
}

struct NormActivations<E: Element> {
    x: Tensor<E>,
    film: Option<Tensor<E>>,
    /// μ and r of each sample and group.
    moments: Vec<[f64; 2]>,
}

impl<E: Element> NormFilmActivate<E> {
    /// Returns the operation; the activation is SiLU or none.
    pub fn new(norm: GroupNormalization, activation: Activation) -> Self {
        Self { norm, activation, kept: None }
    }
}

/// Rows whose sums are kept in the tensor's own precision before they join the f64 ones.
const RUN: usize = 64;

vectorized! {
    /// sums\[c\] = Σ x\[t\]\[c\] over the rows.
    fn column_sums<E: Element>(x: &[E], sums: &mut [E]) {
        sums.fill(E::ZERO);
        for row in x.chunks_exact(sums.len()) {
            for (sum, &x) in sums.iter_mut().zip(row) {
                *sum += x;
            }
        }
    }

    /// sums\[c\] = Σ (x\[t\]\[c\] − center\[c\])².
    fn column_squares<E: Element>(x: &[E], center: &[E], sums: &mut [E]) {
        sums.fill(E::ZERO);
        for row in x.chunks_exact(sums.len()) {
            for ((sum, &x), &c) in sums.iter_mut().zip(row).zip(center) {
                let d = x - c;
                *sum += d * d;
            }
        }
    }

    /// y = a x + b, channel by channel.
    fn scale_shift<E: Element>(x: &[E], a: &[E], b: &[E], y: &mut [E]) {
        for (y, x) in y.chunks_exact_mut(a.len()).zip(x.chunks_exact(a.len())) {
            for (((y, &x), &a), &b) in y.iter_mut().zip(x).zip(a).zip(b) {
                *y = a * x + b;
            }
        }
    }

    /// y = silu(a x + b), channel by channel.
    fn scale_shift_silu<E: Element>(x: &[E], a: &[E], b: &[E], y: &mut [E]) {
        for (y, x) in y.chunks_exact_mut(a.len()).zip(x.chunks_exact(a.len())) {
            for (((y, &x), &a), &b) in y.iter_mut().zip(x).zip(a).zip(b) {
                *y = silu(a * x + b);
            }
        }
    }

    /// dz = dy · silu'(a x + b), in place of dy.
    fn slope_silu<E: Element>(x: &[E], a: &[E], b: &[E], dz: &mut [E]) {
        for (dz, x) in dz.chunks_exact_mut(a.len()).zip(x.chunks_exact(a.len())) {
            for (((dz, &x), &a), &b) in dz.iter_mut().zip(x).zip(a).zip(b) {
                *dz *= silu_slope(a * x + b);
            }
        }
    }

    /// sums\[c\] = Σ dz\[t\]\[c\], products\[c\] = Σ dz\[t\]\[c\] (x\[t\]\[c\] − center\[c\]).
    fn column_products<E: Element>(
        dz: &[E], x: &[E], center: &[E], sums: &mut [E], products: &mut [E],
    ) {
        sums.fill(E::ZERO);
        products.fill(E::ZERO);
        for (dz, x) in dz.chunks_exact(center.len()).zip(x.chunks_exact(center.len())) {
            let sums = sums.iter_mut().zip(products.iter_mut());
            for ((((s, p), &dz), &x), &c) in sums.zip(dz).zip(x).zip(center) {
                *s += dz;
                *p += dz * (x - c);
            }
        }
    }

    /// dz = p dz − q − r x, channel by channel.
    fn input_slope<E: Element>(dz: &mut [E], x: &[E], p: &[E], q: &[E], r: &[E]) {
        for (dz, x) in dz.chunks_exact_mut(p.len()).zip(x.chunks_exact(p.len())) {
            for ((((dz, &x), &p), &q), &r) in dz.iter_mut().zip(x).zip(p).zip(q).zip(r) {
                *dz = p * *dz - q - r * x;
            }
        }
    }
}

/// Returns μ and r of each group of one sample, \[frames, channels\].
fn moments<E: Element>(x: &[E], channels: usize, norm: &GroupNormalization) -> Vec<[f64; 2]> {
    let width = channels / norm.groups;
    let n = (x.len() / norm.groups) as f64;
    let mut lanes = vec![E::ZERO; channels];
    let mut totals = vec![0.0; norm.groups];
    let gather = |totals: &mut [f64], lanes: &[E]| {
        for (total, lanes) in totals.iter_mut().zip(lanes.chunks_exact(width)) {
            *total += lanes.iter().map(|x| x.to_f64()).sum::<f64>();
        }
    };
    for run in x.chunks(RUN * channels) {
        column_sums(run, &mut lanes);
        gather(&mut totals, &lanes);
    }
    let means: Vec<_> = totals.iter().map(|total| total / n).collect();
    let center: Vec<_> = (0..channels).map(|c| E::from_f64(means[c / width])).collect();
    totals.fill(0.0);
    for run in x.chunks(RUN * channels) {
        column_squares(run, &center, &mut lanes);
        gather(&mut totals, &lanes);
    }
    let moment = |(mean, total): (&f64, &f64)| [*mean, 1.0 / (total / n + norm.epsilon).sqrt()];
    means.iter().zip(&totals).map(moment).collect()
}

/// Returns a and b of one sample.
fn coefficients<E: Element>(
    moments: &[[f64; 2]],
    gamma: &[E],
    beta: &[E],
    film: Option<&[E]>,
) -> [Vec<E>; 2] {
    let channels = gamma.len();
    let width = channels / moments.len();
    let ab = |c: usize| {
        let [mean, r] = moments[c / width];
        let (gamma, beta) = (gamma[c].to_f64(), beta[c].to_f64());
        let (s, h) = film.map_or((0.0, 0.0), |f| (f[c].to_f64(), f[channels + c].to_f64()));
        let a = r * gamma * (1.0 + s);
        [a, (beta - mean * r * gamma) * (1.0 + s) + h].map(E::from_f64)
    };
    let pairs: Vec<_> = (0..channels).map(ab).collect();
    [0, 1].map(|i| pairs.iter().map(|pair| pair[i]).collect())
}

impl<E: Element> Operation<E> for NormFilmActivate<E> {
    fn name(&self) -> &'static str {
        "group_norm"
    }

    fn parameter(&self) -> Option<ParameterId> {
        Some(self.norm.weight)
    }

    fn parameters(&self) -> [Option<ParameterId>; 2] {
        [self.norm.weight, self.norm.bias].map(Some)
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, film) = (x[0], x.get(1).copied());
        let norm = self.norm;
        expect_axes("group_norm", "input", x, 3, "[batch, frames, channels]")?;
        let [gamma, beta] = [norm.weight, norm.bias].map(|id| run.parameters.get(id));
        let channels = x.channels();
        expect_size("group_norm", "input", "channels", channels, "weight", gamma.len())?;
        if norm.groups == 0 || !channels.is_multiple_of(norm.groups) {
            let problem =
                format!("{channels} channels cannot be split into {} groups", norm.groups);
            return Err(GraphError::shape("group_norm", problem));
        }
        if let Some(film) = film
            && film.shape() != [x.shape()[0], 2 * channels]
        {
            let wanted = [x.shape()[0], 2 * channels];
            let problem =
                format!("scale and shift have shape {:?}, input expects {wanted:?}", film.shape());
            return Err(GraphError::shape("group_norm", problem));
        }
        if !matches!(self.activation, Activation::Identity | Activation::Silu) {
            let problem = format!("{:?} is not fused; apply it on its own", self.activation);
            return Err(GraphError::shape("group_norm", problem));
        }
        let sample = (x.len() / x.shape()[0].max(1)).max(1);
        let mut all = Vec::new();
        let y = run.tensor(x.shape(), |y| {
            let samples = y.par_chunks_mut(sample).zip(x.data().par_chunks(sample)).enumerate();
            let moments = samples.map(|(b, (y, x))| {
                let moments = moments(x, channels, &norm);
                let film = film.map(|f| &f.data()[b * 2 * channels..][..2 * channels]);
                let [a, b] = coefficients(&moments, gamma, beta, film);
                match self.activation {
                    Activation::Silu => scale_shift_silu(x, &a, &b, y),
                    _ => scale_shift(x, &a, &b, y),
                }
                moments
            });
            all = moments.collect::<Vec<_>>().concat();
        });
        if run.recording {
            self.kept = Some(NormActivations { x: x.clone(), film: film.cloned(), moments: all });
        }
        Ok(y)
    }

    /// With dz = dy act'(a x + b) and per channel S₁ = Σ dz, S₂ = Σ dz x̂:
    /// ds = γ S₂ + β S₁, dh = S₁, dγ = Σ_b (1 + s) S₂, dβ = Σ_b (1 + s) S₁, and with g = γ (1 + s),
    /// m₁ and m₂ the means of g dz and g dz x̂ over the group, dx = r (g dz − m₁ − x̂ m₂).
    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let NormActivations { x, film, moments } = self.kept.take().expect("kept by the forward");
        let norm = self.norm;
        let channels = x.channels();
        let width = channels / norm.groups;
        let [gamma, beta] = [norm.weight, norm.bias].map(|id| at.parameters.get(id));
        let sample = (x.len() / x.shape()[0].max(1)).max(1);
        let group_len = (sample / norm.groups) as f64;
        let samples = dy.data_mut().par_chunks_mut(sample).zip(x.data().par_chunks(sample));
        let sums: Vec<[Vec<f64>; 2]> = samples
            .enumerate()
            .map(|(b, (dz, x))| {
                let moments = &moments[b * norm.groups..][..norm.groups];
                let film = film.as_ref().map(|f| &f.data()[b * 2 * channels..][..2 * channels]);
                if self.activation == Activation::Silu {
                    let [a, b] = coefficients(moments, gamma, beta, film);
                    slope_silu(x, &a, &b, dz);
                }
                let center: Vec<_> =
                    (0..channels).map(|c| E::from_f64(moments[c / width][0])).collect();
                let mut totals = [vec![0.0; channels], vec![0.0; channels]];
                let mut lanes = [vec![E::ZERO; channels], vec![E::ZERO; channels]];
                let runs = dz.chunks(RUN * channels).zip(x.chunks(RUN * channels));
                for (dz, x) in runs {
                    let [s, p] = &mut lanes;
                    column_products(dz, x, &center, s, p);
                    for (totals, lanes) in totals.iter_mut().zip(&lanes) {
                        for (total, lane) in totals.iter_mut().zip(lanes) {
                            *total += lane.to_f64();
                        }
                    }
                }
                let [s1, s2] = &mut totals;
                for (c, s2) in s2.iter_mut().enumerate() {
                    *s2 *= moments[c / width][1];
                }
                let scale = |c: usize| film.map_or(1.0, |f| 1.0 + f[c].to_f64());
                let g: Vec<_> = (0..channels).map(|c| gamma[c].to_f64() * scale(c)).collect();
                let mean = |s: &[f64], group: usize| {
                    let range = group * width..(group + 1) * width;
                    range.map(|c| g[c] * s[c]).sum::<f64>() / group_len
                };
                let means: Vec<_> = (0..norm.groups).map(|i| [mean(s1, i), mean(s2, i)]).collect();
                let pqr: Vec<_> = (0..channels)
                    .map(|c| {
                        let [mu, r] = moments[c / width];
                        let [m1, m2] = means[c / width];
                        [r * g[c], r * (m1 - mu * r * m2), r * r * m2].map(E::from_f64)
                    })
                    .collect();
                let [p, q, r] = [0, 1, 2].map(|i| pqr.iter().map(|x| x[i]).collect::<Vec<_>>());
                input_slope(dz, x, &p, &q, &r);
                totals
            })
            .collect();

        let mut d_gamma = vec![0.0; channels];
        let mut d_beta = vec![0.0; channels];
        for (b, [s1, s2]) in sums.iter().enumerate() {
            for c in 0..channels {
                let scale =
                    film.as_ref().map_or(1.0, |f| 1.0 + f.data()[b * 2 * channels + c].to_f64());
                d_gamma[c] += scale * s2[c];
                d_beta[c] += scale * s1[c];
            }
        }
        let single = |d: Vec<f64>| d.into_iter().map(E::from_f64).collect::<Vec<_>>();
        at.gradients.add(norm.weight, &single(d_gamma));
        at.gradients.add(norm.bias, &single(d_beta));

        let d_film = film.as_ref().filter(|_| at.needs[1]).map(|film| {
            at.tensor(film.shape(), |d| {
                for (d, [s1, s2]) in d.chunks_exact_mut(2 * channels).zip(&sums) {
                    for c in 0..channels {
                        let ds = gamma[c].to_f64() * s2[c] + beta[c].to_f64() * s1[c];
                        d[c] = E::from_f64(ds);
                        d[channels + c] = E::from_f64(s1[c]);
                    }
                }
            })
        });
        let mut found = vec![at.needs[0].then_some(dy)];
        if film.is_some() {
            found.push(d_film);
        }
        found
    }
}
