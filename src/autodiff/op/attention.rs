//! Scaled dot-product attention over several heads.

use rayon::prelude::*;

use crate::autodiff::element::Element;
use crate::autodiff::kernel::{Matrix, MatrixMut, matmul, vectorized};
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

/// Where queries, keys or values lie: which input, and from which channel on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InputChannels {
    pub input: usize,
    pub first: usize,
}

/// softmax(Q Kᵀ/√d + mask) V, head by head.
///
/// Queries, keys and values may be parts of one input, so that nothing is copied out of a joint
/// projection. A query all of whose keys are masked gets zeros. Vaswani et al., "Attention Is All You
/// Need", NIPS 2017, eq. 1. Where attention is causal, the last query stands at the place of the last key.
///
/// # Shapes
/// inputs: \[batch, queries, …\], \[batch, keys, …\]; mask: \[batch, keys\] → \[batch, queries, width\]
pub struct Attend<E: Element> {
    pub query: InputChannels,
    pub key: InputChannels,
    pub value: InputChannels,
    pub width: usize,
    pub heads: usize,
    pub causal: bool,
    /// Whether the last input is a mask of the keys.
    pub masked: bool,
    kept: Option<AttentionActivations<E>>,
}

struct AttentionActivations<E: Element> {
    inputs: Vec<Tensor<E>>,
    /// Softmax, \[batch, heads, queries, keys\].
    weights: Tensor<E>,
}

/// The sizes of one head.
#[derive(Clone, Copy)]
struct HeadShape {
    queries: usize,
    keys: usize,
    dim: usize,
}

impl<E: Element> Attend<E> {
    /// Returns the operation.
    pub fn new(
        [query, key, value]: [InputChannels; 3],
        width: usize,
        heads: usize,
        causal: bool,
    ) -> Self {
        Self { query, key, value, width, heads, causal, masked: false, kept: None }
    }

    /// Says that the last input is a mask of the keys.
    pub fn masked(mut self) -> Self {
        self.masked = true;
        self
    }

    fn check(&self, x: &[&Tensor<E>]) -> Result<HeadShape> {
        let label = "attention";
        for (what, place) in [("query", self.query), ("key", self.key), ("value", self.value)] {
            let input = x[place.input];
            expect_axes(label, what, input, 3, "[batch, frames, channels]")?;
            let end = place.first + self.width;
            if input.channels() < end {
                let problem =
                    format!("{what} has {} channels, expected {end} or more", input.channels());
                return Err(GraphError::shape(label, problem));
            }
            let batch = x[self.query.input].shape()[0];
            expect_size(label, what, "samples", input.shape()[0], "query", batch)?;
        }
        if self.heads == 0 || !self.width.is_multiple_of(self.heads) {
            let problem =
                format!("{} channels cannot be split into {} heads", self.width, self.heads);
            return Err(GraphError::shape(label, problem));
        }
        let keys = x[self.key.input].shape()[1];
        expect_size(label, "value", "frames", x[self.value.input].shape()[1], "key", keys)?;
        if self.masked {
            let mask = x[x.len() - 1];
            let wanted = [x[self.query.input].shape()[0], keys];
            if mask.shape() != wanted {
                let problem = format!("mask has shape {:?}, keys expect {wanted:?}", mask.shape());
                return Err(GraphError::shape(label, problem));
            }
        }
        let queries = x[self.query.input].shape()[1];
        Ok(HeadShape { queries, keys, dim: self.width / self.heads })
    }

    /// Returns one head of one sample of an input as a matrix \[frames, dim\].
    fn head<'a>(
        &self,
        x: &'a Tensor<E>,
        place: InputChannels,
        b: usize,
        h: usize,
    ) -> Matrix<'a, E> {
        let (frames, channels) = (x.shape()[1], x.channels());
        let first = b * frames * channels + place.first + h * self.width / self.heads;
        Matrix { data: &x.data()[first.min(x.len())..], strides: [channels, 1] }
    }
}

vectorized! {
    /// Turns a row of products into weights; keys that are not kept, 0 rather than 1, get none.
    fn softmax_row<E: Element>(row: &mut [E], keep: &[E]) {
        const LANES: usize = 16;
        let lowest = E::from_f64(f64::NEG_INFINITY);
        let kept = |x: E, keep: E| if keep > E::ZERO { x } else { lowest };
        let mut lanes = [lowest; LANES];
        for (row, keep) in row.chunks(LANES).zip(keep.chunks(LANES)) {
            for ((lane, &x), &keep) in lanes.iter_mut().zip(row).zip(keep) {
                *lane = lane.larger(kept(x, keep));
            }
        }
        let largest = lanes.into_iter().fold(lowest, E::larger);
        if largest == lowest {
            return row.fill(E::ZERO);
        }
        let mut lanes = [E::ZERO; LANES];
        for (row, keep) in row.chunks_mut(LANES).zip(keep.chunks(LANES)) {
            for ((lane, x), &keep) in lanes.iter_mut().zip(row).zip(keep) {
                *x = keep * (kept(*x, keep) - largest).exp();
                *lane += *x;
            }
        }
        let scale = E::ONE / lanes.into_iter().sum::<E>();
        row.iter_mut().for_each(|x| *x *= scale);
    }

    /// d = α w (d − Σ d w), the gradient of a softmax.
    fn softmax_slope<E: Element>(d: &mut [E], w: &[E], alpha: E) {
        const LANES: usize = 16;
        let mut lanes = [E::ZERO; LANES];
        for (d, w) in d.chunks(LANES).zip(w.chunks(LANES)) {
            for ((lane, &d), &w) in lanes.iter_mut().zip(d).zip(w) {
                *lane += d * w;
            }
        }
        let mean = lanes.into_iter().sum::<E>();
        for (d, &w) in d.iter_mut().zip(w) {
            *d = alpha * (w * (*d - mean));
        }
    }
}

impl<E: Element> Operation<E> for Attend<E> {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let HeadShape { queries, keys, dim } = self.check(x)?;
        let batch = x[self.query.input].shape()[0];
        let mask = self.masked.then(|| x[x.len() - 1]);
        let all_kept = vec![E::ONE; keys];
        let scale = E::from_f64(1.0 / (dim as f64).sqrt());
        let [query, key, value] = [self.query, self.key, self.value].map(|p| x[p.input]);
        let mut weights = run.tensor(&[batch, self.heads, queries, keys], |_| {});
        // Heads side by side in memory first: [batch, heads, queries, dim].
        let mut heads = run.tensor(&[batch, self.heads, queries, dim], |_| {});
        let (w_len, o_len) = ((queries * keys).max(1), (queries * dim).max(1));
        let parts =
            weights.data_mut().par_chunks_mut(w_len).zip(heads.data_mut().par_chunks_mut(o_len));
        parts.enumerate().for_each_init(Vec::new, |scratch, (i, (w, o))| {
            let (b, h) = (i / self.heads, i % self.heads);
            let q = self.head(query, self.query, b, h);
            let k = self.head(key, self.key, b, h);
            let v = self.head(value, self.value, b, h);
            let into = MatrixMut { data: &mut *w, row_stride: keys };
            matmul([queries, dim, keys], scale, q, k.t(), into, false, scratch);
            let keep = mask.map_or(&all_kept[..], |mask| &mask.data()[b * keys..][..keys]);
            for (t, row) in w.chunks_exact_mut(keys).enumerate() {
                // The last query stands at the place of the last key.
                let n_seen =
                    if self.causal { (t + 1 + keys).saturating_sub(queries) } else { keys };
                let (seen, unseen) = row.split_at_mut(n_seen);
                softmax_row(seen, &keep[..seen.len()]);
                unseen.fill(E::ZERO);
            }
            let w = Matrix { data: w, strides: [keys, 1] };
            let into = MatrixMut { data: o, row_stride: dim };
            matmul([queries, keys, dim], E::ONE, w, v, into, false, scratch);
        });
        let y = run.tensor(&[batch, queries, self.width], |y| {
            interleave(heads.data(), y, self.heads, queries, dim);
        });
        if run.recording {
            let inputs = x.iter().map(|&x| x.clone()).collect();
            self.kept = Some(AttentionActivations { inputs, weights });
        }
        Ok(y)
    }

    /// With P the weights: dV = Pᵀ dO, dP = dO Vᵀ, dS = P ∘ (dP − Σ_j dP P)/√d, dQ = dS K, dK = dSᵀ Q.
    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let AttentionActivations { inputs, weights } =
            self.kept.take().expect("kept by the forward");
        let [batch, heads, queries, keys] = *weights.shape() else { unreachable!("its own shape") };
        let dim = self.width / heads;
        let scale = E::from_f64(1.0 / (dim as f64).sqrt());
        let [query, key, value] = [self.query, self.key, self.value].map(|p| &inputs[p.input]);
        let tensor = |frames: usize| at.tensor(&[batch, heads, frames, dim], |_| {});
        let [mut dq, mut dk, mut dv] = [tensor(queries), tensor(keys), tensor(keys)];
        let all = InputChannels { input: 0, first: 0 };
        let parts = (dq.data_mut().par_chunks_mut((queries * dim).max(1)))
            .zip(dk.data_mut().par_chunks_mut((keys * dim).max(1)))
            .zip(dv.data_mut().par_chunks_mut((keys * dim).max(1)));
        let buffers = || (Vec::new(), vec![E::ZERO; queries * keys]);
        parts.enumerate().for_each_init(buffers, |(scratch, ds), (i, ((dq, dk), dv))| {
            let (b, h) = (i / heads, i % heads);
            let q = self.head(query, self.query, b, h);
            let k = self.head(key, self.key, b, h);
            let v = self.head(value, self.value, b, h);
            let d_o = self.head(&dy, all, b, h);
            let w = &weights.data()[i * queries * keys..][..queries * keys];
            let p = Matrix { data: w, strides: [keys, 1] };
            let rows = |data| MatrixMut { data, row_stride: dim };
            matmul([keys, queries, dim], E::ONE, p.t(), d_o, rows(dv), false, scratch);
            let into = MatrixMut { data: &mut *ds, row_stride: keys };
            matmul([queries, dim, keys], E::ONE, d_o, v.t(), into, false, scratch);
            for (ds, w) in ds.chunks_exact_mut(keys).zip(w.chunks_exact(keys)) {
                softmax_slope(ds, w, scale);
            }
            let ds = Matrix { data: &*ds, strides: [keys, 1] };
            matmul([queries, keys, dim], E::ONE, ds, k, rows(dq), false, scratch);
            matmul([keys, queries, dim], E::ONE, ds.t(), q, rows(dk), false, scratch);
        });
        drop(weights);
        let mut found = Vec::with_capacity(inputs.len());
        for (input, (x, &needed)) in inputs.iter().zip(at.needs).enumerate() {
            let is_mask = self.masked && input + 1 == inputs.len();
            if !needed || is_mask {
                found.push(None);
                continue;
            }
            let channels = x.channels();
            let mine: Vec<_> = [(self.query, &dq), (self.key, &dk), (self.value, &dv)]
                .into_iter()
                .filter(|(place, _)| place.input == input)
                .collect();
            let apart = mine.len() * self.width == channels
                && mine.iter().enumerate().all(|(i, (place, _))| {
                    mine[..i]
                        .iter()
                        .all(|(other, _)| other.first.abs_diff(place.first) >= self.width)
                });
            found.push(Some(at.tensor(x.shape(), |d| {
                if !apart {
                    d.fill(E::ZERO);
                }
                let frames = x.shape()[1];
                let samples = d.par_chunks_exact_mut((frames * channels).max(1)).enumerate();
                samples.for_each(|(b, d)| {
                    for (place, part) in &mine {
                        for h in 0..heads {
                            let source =
                                part.data()[(b * heads + h) * frames * dim..].chunks_exact(dim);
                            for (target, source) in d.chunks_exact_mut(channels).zip(source) {
                                let target = &mut target[place.first + h * dim..][..dim];
                                if apart {
                                    target.copy_from_slice(source);
                                } else {
                                    target.iter_mut().zip(source).for_each(|(d, &x)| *d += x);
                                }
                            }
                        }
                    }
                });
            })));
        }
        found
    }
}

/// \[batch, heads, frames, dim\] → \[batch, frames, heads · dim\]
fn interleave<E: Element>(source: &[E], target: &mut [E], heads: usize, frames: usize, dim: usize) {
    let sample = (heads * frames * dim).max(1);
    let samples = target.par_chunks_exact_mut(sample).zip(source.par_chunks_exact(sample));
    samples.for_each(|(target, source)| {
        for (t, target) in target.chunks_exact_mut(heads * dim).enumerate() {
            for (h, target) in target.chunks_exact_mut(dim).enumerate() {
                target.copy_from_slice(&source[(h * frames + t) * dim..][..dim]);
            }
        }
    });
}
