//! Normalisation over the frames that count, means over them, and a scale and shift for each sample.

use rayon::prelude::*;

use super::binary::add_assign;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Refuses a mask that is not one number for each frame of `x`.
fn check_mask<E: Element>(operation: &'static str, x: &Tensor<E>, mask: &Tensor<E>) -> Result<()> {
    if mask.shape() == &x.shape()[..2] {
        return Ok(());
    }
    let problem = format!("mask has shape {:?}, input expects {:?}", mask.shape(), &x.shape()[..2]);
    Err(GraphError::shape(operation, problem))
}

/// y\[b, t\] = (bias + s\[b\]) x\[b, t\] + h\[b\], or with s\[b, t\] and h\[b, t\]: with bias 1 Perez et al., "FiLM", AAAI
/// 2018; with bias 0 the affine part of Huang and Belongie, "Arbitrary Style Transfer" (AdaIN), ICCV 2017, eq. 8.
///
/// # Shapes
/// x \[batch, frames, channels\], film \[batch, 2 channels\] or \[batch, frames, 2 channels\], s then h → as x
pub struct Modulate<E: Element> {
    bias: f64,
    kept: Option<[Tensor<E>; 2]>,
}

/// Returns how many numbers of `x` one scale and shift is for: those of a frame, or of a whole sample.
fn modulated_at_once<E: Element>(x: &Tensor<E>, film: &Tensor<E>) -> usize {
    let frames = if film.shape().len() == 3 { 1 } else { x.shape()[1] };
    (frames * x.channels()).max(1)
}

impl<E: Element> Modulate<E> {
    /// Returns the operation.
    pub fn new(bias: f64) -> Self {
        Self { bias, kept: None }
    }
}

impl<E: Element> Operation<E> for Modulate<E> {
    fn name(&self) -> &'static str {
        "modulate"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let [x, film] = [x[0], x[1]];
        expect_axes("modulate", "input", x, 3, "[batch, frames, channels]")?;
        let (batch, frames, channels) = (x.shape()[0], x.shape()[1], x.channels());
        let is_of_frames = film.shape() == [batch, frames, 2 * channels];
        if !is_of_frames && film.shape() != [batch, 2 * channels] {
            let wanted = [batch, 2 * channels];
            let problem =
                format!("scale and shift have shape {:?}, input expects {wanted:?}", film.shape());
            return Err(GraphError::shape("modulate", problem));
        }
        if run.recording {
            self.kept = Some([x.clone(), film.clone()]);
        }
        let (bias, sample) = (E::from_f64(self.bias), modulated_at_once(x, film));
        Ok(run.tensor(x.shape(), |y| {
            let samples = y.par_chunks_exact_mut(sample).zip(x.data().par_chunks_exact(sample));
            let films = film.data().par_chunks_exact(2 * channels);
            samples.zip(films).for_each(|((y, x), film)| {
                let (s, h) = film.split_at(channels);
                for (y, x) in y.chunks_exact_mut(channels).zip(x.chunks_exact(channels)) {
                    for (((y, &x), &s), &h) in y.iter_mut().zip(x).zip(s).zip(h) {
                        *y = (bias + s) * x + h;
                    }
                }
            });
        }))
    }

    /// dx = (bias + s) dy, ds = Σ_t x dy, dh = Σ_t dy.
    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let [x, film] = self.kept.take().expect("kept by the forward");
        let channels = x.channels();
        let sample = modulated_at_once(&x, &film);
        let d_film = at.needs[1].then(|| {
            at.tensor(film.shape(), |d| {
                d.fill(E::ZERO);
                let samples =
                    x.data().par_chunks_exact(sample).zip(dy.data().par_chunks_exact(sample));
                let films = d.par_chunks_exact_mut(2 * channels);
                films.zip(samples).for_each(|(d, (x, dy))| {
                    let (ds, dh) = d.split_at_mut(channels);
                    for (x, dy) in x.chunks_exact(channels).zip(dy.chunks_exact(channels)) {
                        for ((ds, &x), &dy) in ds.iter_mut().zip(x).zip(dy) {
                            *ds += x * dy;
                        }
                        add_assign(dh, dy);
                    }
                });
            })
        });
        let dx = at.needs[0].then(|| {
            let bias = E::from_f64(self.bias);
            let samples = dy.data_mut().par_chunks_exact_mut(sample);
            samples.zip(film.data().par_chunks_exact(2 * channels)).for_each(|(dy, film)| {
                for dy in dy.chunks_exact_mut(channels) {
                    for (dy, &s) in dy.iter_mut().zip(&film[..channels]) {
                        *dy *= bias + s;
                    }
                }
            });
            dy
        });
        vec![dx, d_film]
    }
}

/// (x − μ) / √(σ² + ε), μ and σ² of each channel over the frames of a sample that count.
///
/// Frames that do not count are normalised by the same numbers. Of a sample in which none counts, μ = σ² = 0.
/// Ulyanov et al., "Instance Normalization", arXiv 1607.08022, 2016.
///
/// # Shapes
/// x \[batch, frames, channels\], mask \[batch, frames\] if any → as x
pub struct NormalizeFrames<E: Element> {
    epsilon: f64,
    kept: Option<(Tensor<E>, Vec<f64>)>,
    weights: Vec<Vec<f64>>,
}

impl<E: Element> NormalizeFrames<E> {
    /// Returns the operation.
    pub fn new(epsilon: f64) -> Self {
        Self { epsilon, kept: None, weights: Vec::new() }
    }
}

/// Returns the share of every frame of each sample in its mean; all zero where none counts.
fn shares<E: Element>(x: &Tensor<E>, mask: Option<&&Tensor<E>>) -> Vec<Vec<f64>> {
    let (batch, frames) = (x.shape()[0], x.shape()[1]);
    let share = |b: usize| {
        let weights: Vec<f64> = match mask {
            Some(mask) => mask.data()[b * frames..][..frames].iter().map(|w| w.to_f64()).collect(),
            None => vec![1.0; frames],
        };
        let total: f64 = weights.iter().sum();
        let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
        weights.into_iter().map(|w| w * scale).collect()
    };
    (0..batch).map(share).collect()
}

/// Returns Σ_t w\[t\] f(x\[t, c\], c) of one sample, channel by channel.
fn weighted_sums<E: Element>(
    x: &[E],
    channels: usize,
    weights: &[f64],
    f: impl Fn(f64, usize) -> f64,
) -> Vec<f64> {
    let mut sums = vec![0.0; channels];
    for (x, &w) in x.chunks_exact(channels).zip(weights).filter(|(_, w)| **w != 0.0) {
        for (c, (sum, &x)) in sums.iter_mut().zip(x).enumerate() {
            *sum += w * f(x.to_f64(), c);
        }
    }
    sums
}

impl<E: Element> Operation<E> for NormalizeFrames<E> {
    fn name(&self) -> &'static str {
        "normalize_frames"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, mask) = (x[0], x.get(1));
        expect_axes("normalize_frames", "input", x, 3, "[batch, frames, channels]")?;
        if let Some(mask) = mask {
            check_mask("normalize_frames", x, mask)?;
        }
        let channels = x.channels();
        expect_size("normalize_frames", "input", "channels", channels.min(1), "a norm", 1)?;
        let sample = (x.shape()[1] * channels).max(1);
        let weights = shares(x, mask);
        let mut rates = vec![0.0; weights.len() * channels];
        let y = run.tensor(x.shape(), |y| {
            let samples = y.par_chunks_exact_mut(sample).zip(x.data().par_chunks_exact(sample));
            let samples = samples.zip(rates.par_chunks_exact_mut(channels));
            samples.zip(&weights).for_each(|(((y, x), rates), weights)| {
                let mean = weighted_sums(x, channels, weights, |x, _| x);
                let variance =
                    weighted_sums(x, channels, weights, |x, c| (x - mean[c]) * (x - mean[c]));
                for (rate, v) in rates.iter_mut().zip(&variance) {
                    *rate = 1.0 / (v + self.epsilon).sqrt();
                }
                for (y, x) in y.chunks_exact_mut(channels).zip(x.chunks_exact(channels)) {
                    for (((y, &x), mean), rate) in y.iter_mut().zip(x).zip(&mean).zip(&*rates) {
                        *y = E::from_f64((x.to_f64() - mean) * rate);
                    }
                }
            });
        });
        if run.recording {
            self.kept = Some((y.clone(), rates));
            self.weights = weights;
        }
        Ok(y)
    }

    /// With D\[t\] = dy\[t\], r the rate and p\[t\] the share of a frame in the mean:
    /// dx\[t\] = r (D\[t\] − p\[t\] Σ D − p\[t\] y\[t\] Σ D y).
    fn backward(&mut self, mut dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let (y, rates) = self.kept.take().expect("kept by the forward");
        let channels = y.channels();
        let sample = (y.shape()[1] * channels).max(1);
        let dx = at.needs[0].then(|| {
            let samples = dy.data_mut().par_chunks_exact_mut(sample);
            let samples = samples.zip(y.data().par_chunks_exact(sample));
            let numbers = self.weights.par_iter().zip(rates.par_chunks_exact(channels));
            samples.zip(numbers).for_each(|((dy, y), (weights, rates))| {
                let mut sums = vec![[0.0; 2]; channels];
                for (dy, y) in dy.chunks_exact(channels).zip(y.chunks_exact(channels)) {
                    for ((sums, &dy), &y) in sums.iter_mut().zip(dy).zip(y) {
                        sums[0] += dy.to_f64();
                        sums[1] += dy.to_f64() * y.to_f64();
                    }
                }
                let rows = dy.chunks_exact_mut(channels).zip(y.chunks_exact(channels));
                for ((dy, y), &p) in rows.zip(weights) {
                    for (((dy, &y), sums), rate) in dy.iter_mut().zip(y).zip(&sums).zip(rates) {
                        let of_moments = p * (sums[0] + y.to_f64() * sums[1]);
                        *dy = E::from_f64(rate * (dy.to_f64() - of_moments));
                    }
                }
            });
            dy
        });
        let mut found = vec![dx];
        found.resize_with(at.needs.len(), || None);
        found
    }
}

/// Σ_t w\[t\] x\[t\] / Σ w: the mean over the frames that count; 0 where none does.
///
/// # Shapes
/// x \[batch, frames, channels\], mask \[batch, frames\] if any → \[batch, channels\]
#[derive(Default)]
pub struct MeanFrames {
    weights: Vec<Vec<f64>>,
}

impl<E: Element> Operation<E> for MeanFrames {
    fn name(&self) -> &'static str {
        "mean_frames"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let (x, mask) = (x[0], x.get(1));
        expect_axes("mean_frames", "input", x, 3, "[batch, frames, channels]")?;
        if let Some(mask) = mask {
            check_mask("mean_frames", x, mask)?;
        }
        let (batch, channels) = (x.shape()[0], x.channels());
        expect_size("mean_frames", "input", "channels", channels.min(1), "a mean", 1)?;
        let sample = (x.shape()[1] * channels).max(1);
        self.weights = shares(x, mask);
        Ok(run.tensor(&[batch, channels], |y| {
            y.fill(E::ZERO);
            let samples = y.par_chunks_exact_mut(channels).zip(x.data().par_chunks_exact(sample));
            samples.zip(&self.weights).for_each(|((y, x), weights)| {
                let sums = weighted_sums(x, channels, weights, |x, _| x);
                y.iter_mut().zip(sums).for_each(|(y, sum)| *y = E::from_f64(sum));
            });
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let channels = dy.channels();
        let frames = self.weights.first().map_or(0, Vec::len);
        let dx = at.needs[0].then(|| {
            at.tensor(&[dy.shape()[0], frames, channels], |dx| {
                let samples = dx.par_chunks_exact_mut((frames * channels).max(1));
                let vectors = dy.data().par_chunks_exact(channels).zip(&self.weights);
                samples.zip(vectors).for_each(|(dx, (dy, weights))| {
                    for (dx, &w) in dx.chunks_exact_mut(channels).zip(weights) {
                        let w = E::from_f64(w);
                        dx.iter_mut().zip(dy).for_each(|(dx, &dy)| *dx = w * dy);
                    }
                });
            })
        });
        let mut found = vec![dx];
        found.resize_with(at.needs.len(), || None);
        found
    }
}
