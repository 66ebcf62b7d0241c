//! The operations that a network may use, the same for every interpreter and exporter.
//!
//! A network is written once over [`Graph`]. One interpreter runs it, one also differentiates it,
//! one writes it down as ONNX, one counts what it costs. Sizes of batch and frames are the business
//! of the interpreter: a network never reads them, so that they may stay open in an exported file.
//!
//! Tensors are channels-last: \[batch, frames, channels\] or \[batch, channels\].

use std::ops::Range;
use std::sync::Arc;

use ndarray::Array2;

use super::parameter::ParameterId;

/// Why an operation could not be carried out.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GraphError {
    /// Sizes do not fit: the operation, and what it has and expects.
    #[error("{operation}: {problem}")]
    Shape { operation: &'static str, problem: String },
    /// The first operation whose result is not finite, in an interpreter that looks.
    #[error("{operation}: {what} has {value} at {index:?} of {shape:?}")]
    NonFinite {
        operation: String,
        what: &'static str,
        value: String,
        index: Vec<usize>,
        shape: Vec<usize>,
    },
}

impl GraphError {
    /// Returns the error of an operation whose sizes do not fit.
    pub fn shape(operation: &'static str, problem: impl Into<String>) -> Self {
        Self::Shape { operation, problem: problem.into() }
    }
}

pub type Result<T, E = GraphError> = std::result::Result<T, E>;

/// A function of one number, applied to each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Activation {
    Identity,
    /// x σ(x), σ(x) = 1 / (1 + e^-x).
    Silu,
    /// x Φ(x), Φ the normal distribution: the exact form, by the error function.
    Gelu,
    /// max(x, 0).
    Relu,
    /// x where x > 0, else slope · x.
    LeakyRelu {
        slope: f64,
    },
    /// x tanh(ln(1 + e^x)).
    Mish,
    Tanh,
    Sigmoid,
}

/// How a convolution over frames steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Convolution {
    pub taps: usize,
    pub stride: usize,
    /// Frames of zeros at either end.
    pub padding: usize,
    pub dilation: usize,
}

/// Normalisation over groups of channels and all frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupNormalization {
    pub groups: usize,
    pub epsilon: f64,
    /// Scale γ and shift β, one for each channel.
    pub weight: ParameterId,
    pub bias: ParameterId,
}

/// Some channels of a tensor, from `first` on.
#[derive(Clone, Copy, Debug)]
pub struct Channels<'a, T> {
    pub tensor: &'a T,
    pub first: usize,
}

/// Scaled dot-product attention over several heads.
///
/// softmax(Q Kᵀ / √d + mask) V, head by head, d the channels of a head. A query none of whose keys counts gets zeros, and
/// gives no gradient.
///
/// # Shapes
/// - `query`: \[batch, queries, …\]; `key`, `value`: \[batch, keys, …\], `width` channels of each
/// - `key_mask`: \[batch, keys\], 1 for keys that count and 0 for those that do not
pub struct Attention<'a, T> {
    pub query: Channels<'a, T>,
    pub key: Channels<'a, T>,
    pub value: Channels<'a, T>,
    pub width: usize,
    pub heads: usize,
    pub key_mask: Option<&'a T>,
    /// Whether a query sees only keys up to its own place; queries stand at the places of the last keys.
    pub causal: bool,
}

/// How frames go on beyond the ends of a signal of N frames, with a period of 2N.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mirror {
    /// x\[−1 − t\] = x\[t\], x\[N + t\] = x\[N − 1 − t\]: what second differences do where a signal is mirrored.
    Even,
    /// x\[−1\] = 0, x\[−2 − t\] = −x\[t\]; x\[N − 1\] counts as 0, x\[N + t\] = −x\[N − 2 − t\]: what forward
    /// differences do where a signal is mirrored.
    Odd,
}

impl Mirror {
    /// Returns the frame that stands at place t of a mirrored signal, and its sign; none where the signal is 0.
    pub fn frame(self, t: isize, n_frames: usize) -> Option<(usize, f64)> {
        let n = n_frames;
        let t = t.rem_euclid(2 * n.max(1) as isize) as usize;
        match self {
            Self::Even => Some((t.min(2 * n - 1 - t), 1.0)),
            Self::Odd if t + 1 == n || t + 1 == 2 * n => None,
            Self::Odd if t < n => Some((t, 1.0)),
            Self::Odd => Some((2 * n - 2 - t, -1.0)),
        }
    }
}

/// The operations that a network may use.
///
/// Every operation fails if the sizes of its inputs do not fit.
pub trait Graph: Sized {
    type Tensor: Clone;

    /// Returns a parameter as a tensor.
    fn parameter(&mut self, id: ParameterId) -> Result<Self::Tensor>;

    /// x Wᵀ + b over the last axis.
    ///
    /// \[..., in\] → \[..., out\]
    fn linear(
        &mut self,
        x: &Self::Tensor,
        weight: ParameterId,
        bias: Option<ParameterId>,
    ) -> Result<Self::Tensor>;

    /// y\[t\] = b + Σ_j W_j x\[t · stride + j · dilation − padding\], zero beyond either end.
    ///
    /// \[batch, frames, in\] → \[batch, ⌊(frames + 2 padding − span) / stride⌋ + 1, out\]
    fn conv1d(
        &mut self,
        x: &Self::Tensor,
        weight: ParameterId,
        bias: Option<ParameterId>,
        convolution: Convolution,
    ) -> Result<Self::Tensor>;

    /// act((γ x̂ + β) (1 + s) + h), x̂ normalised over each group's channels and all frames.
    ///
    /// `film`, \[batch, 2 channels\], holds the scales s and then the shifts h (Perez et al., "FiLM",
    /// AAAI 2018); without it s = h = 0. Wu and He, "Group Normalization", ECCV 2018.
    fn group_norm(
        &mut self,
        x: &Self::Tensor,
        norm: GroupNormalization,
        film: Option<&Self::Tensor>,
        activation: Activation,
    ) -> Result<Self::Tensor>;

    /// γ (x − μ) / √(σ² + ε) + β over the last axis; without `affine` γ = 1 and β = 0.
    ///
    /// Ba, Kiros and Hinton, "Layer Normalization", arXiv 1607.06450, 2016.
    fn layer_norm(
        &mut self,
        x: &Self::Tensor,
        affine: Option<[ParameterId; 2]>,
        epsilon: f64,
    ) -> Result<Self::Tensor>;

    /// Applies a function to each number.
    fn activation(&mut self, x: &Self::Tensor, activation: Activation) -> Result<Self::Tensor>;

    /// Attention; see [`Attention`]. → \[batch, queries, width\]
    fn attention(&mut self, attention: Attention<Self::Tensor>) -> Result<Self::Tensor>;

    /// a + b, where axes of size 1, and missing leading axes, are repeated.
    fn add(&mut self, a: &Self::Tensor, b: &Self::Tensor) -> Result<Self::Tensor>;

    /// a b, element by element; axes are repeated as for [`Graph::add`].
    fn mul(&mut self, a: &Self::Tensor, b: &Self::Tensor) -> Result<Self::Tensor>;

    /// x\[b, t\] + v\[b\]: a vector for each sample, added to all its frames.
    ///
    /// `x`: \[batch, frames, channels\]; `v`: \[batch, channels\]
    fn add_to_frames(&mut self, x: &Self::Tensor, v: &Self::Tensor) -> Result<Self::Tensor>;

    /// factor · x.
    fn scale(&mut self, x: &Self::Tensor, factor: f64) -> Result<Self::Tensor>;

    /// Puts tensors side by side along the last axis.
    fn concat(&mut self, parts: &[&Self::Tensor]) -> Result<Self::Tensor>;

    /// Takes a range of the last axis.
    fn channels(&mut self, x: &Self::Tensor, range: Range<usize>) -> Result<Self::Tensor>;

    /// Repeats each frame `factor` times: nearest neighbour.
    fn upsample(&mut self, x: &Self::Tensor, factor: usize) -> Result<Self::Tensor>;

    /// Takes rows of a fixed table by index; indices are whole numbers in a tensor of any shape.
    fn gather(&mut self, table: &Arc<Array2<f64>>, index: &Self::Tensor) -> Result<Self::Tensor>;

    /// Takes rows of a learned table, \[rows, channels\], by index.
    fn embedding(&mut self, table: ParameterId, index: &Self::Tensor) -> Result<Self::Tensor>;

    /// argmin_k ‖x − c_k‖²: the number of the nearest row of a table, \[rows, channels\], of ties the first.
    ///
    /// A whole number has no gradient, so neither has the table. \[..., channels\] → \[...\]
    fn nearest_row(&mut self, x: &Self::Tensor, table: ParameterId) -> Result<Self::Tensor>;

    /// `value`, whose gradient goes to x: x + sg(value − x), where sg stops the gradient.
    ///
    /// van den Oord et al., "Neural Discrete Representation Learning", NIPS 2017, section 3.2.
    fn straight_through(&mut self, x: &Self::Tensor, value: &Self::Tensor) -> Result<Self::Tensor>;

    /// In training sets each number to zero with the probability, and divides the rest by 1 − it.
    ///
    /// Srivastava et al., "Dropout", JMLR 15, 2014.
    fn dropout(&mut self, x: &Self::Tensor, probability: f64) -> Result<Self::Tensor>;

    /// x where `choice` is 0 and `other` where it is 1, for each sample.
    ///
    /// `x`: \[batch, frames, channels\]; `choice`: \[batch\]; `other`: \[channels\]
    fn select(
        &mut self,
        choice: &Self::Tensor,
        other: &Self::Tensor,
        x: &Self::Tensor,
    ) -> Result<Self::Tensor>;

    /// x / max(‖x‖, ε) over the last axis.
    fn normalize(&mut self, x: &Self::Tensor, epsilon: f64) -> Result<Self::Tensor>;

    /// Turns pairs of channels by angles that grow with the frame: rotary position embedding.
    ///
    /// Su et al., "RoFormer", arXiv 2104.09864, 2021, eq. 34; channels 2i and 2i + 1 of each head are
    /// a pair, turned by frame · 10000^(−2i / d). Frames are counted from those of `past` on, where there are any.
    fn rotary(
        &mut self,
        x: &Self::Tensor,
        heads: usize,
        past: Option<&Self::Tensor>,
    ) -> Result<Self::Tensor>;

    /// Turns the first `turned` of `channels` channels as [`Graph::rotary`] does, `heads` heads, and leaves the others.
    fn rotary_first(
        &mut self,
        x: &Self::Tensor,
        heads: usize,
        [turned, channels]: [usize; 2],
    ) -> Result<Self::Tensor> {
        let first = self.channels(x, 0..turned)?;
        let first = self.rotary(&first, heads, None)?;
        let others = self.channels(x, turned..channels)?;
        self.concat(&[&first, &others])
    }

    /// Repeats the last frame until their number is a multiple.
    fn hold_frames(&mut self, x: &Self::Tensor, multiple: usize) -> Result<Self::Tensor>;

    /// Drops frames beyond those that `like` has.
    fn crop_frames(&mut self, x: &Self::Tensor, like: &Self::Tensor) -> Result<Self::Tensor>;

    /// Drops as many of the first frames as `past` has.
    fn frames_behind(&mut self, x: &Self::Tensor, past: &Self::Tensor) -> Result<Self::Tensor>;

    /// y\[t\] = x\[clamp(t + shift, 0, frames − 1 − spare)\]: frames that come later, or earlier; the first, and the
    /// last of those that are not spared, are held.
    ///
    /// \[batch, frames, channels\] → the same
    fn shift_frames(
        &mut self,
        x: &Self::Tensor,
        shift: isize,
        spare: usize,
    ) -> Result<Self::Tensor>;

    /// Replaces the first frame by that of `first`, then the last by that of `last`.
    ///
    /// All \[batch, frames, channels\] → the same
    fn replace_ends(
        &mut self,
        x: &Self::Tensor,
        first: &Self::Tensor,
        last: &Self::Tensor,
    ) -> Result<Self::Tensor>;

    /// y\[t, c\] = Σ_j h\[c, j\] x\[t + j − ⌊taps / 2⌋, c\], a fixed filter for each channel; beyond its ends x is
    /// mirrored.
    ///
    /// `kernel`: h, \[channels, taps\], an odd number of taps. \[batch, frames, channels\] → the same
    fn filter_frames(
        &mut self,
        x: &Self::Tensor,
        kernel: &Arc<Array2<f64>>,
        mirror: Mirror,
    ) -> Result<Self::Tensor>;

    /// Says which frames of [`Graph::hold_frames`] count: 1 where `mask`, or all of x, has one, else 0.
    ///
    /// `x`: \[batch, frames, …\]; `mask`: \[batch, frames\] → \[batch, frames held\]
    fn frame_mask(
        &mut self,
        x: &Self::Tensor,
        mask: Option<&Self::Tensor>,
        multiple: usize,
    ) -> Result<Self::Tensor>;

    /// Takes every `stride`-th frame of a mask, from the first on.
    fn stride_mask(&mut self, mask: &Self::Tensor, stride: usize) -> Result<Self::Tensor>;

    /// The same numbers in the same order, in as many samples as `like` has: folds the dancers of a group from the
    /// batch into the frames, and unfolds them.
    ///
    /// \[rows, frames, …\], like \[batch, …\] → \[batch, rows · frames / batch, …\]
    fn rebatch(&mut self, x: &Self::Tensor, like: &Self::Tensor) -> Result<Self::Tensor>;

    /// Each sample repeated, one after the other, to as many as `like` has.
    ///
    /// \[batch, …\], like \[rows, …\], rows a multiple of batch → \[rows, …\]
    fn repeat_batch(&mut self, x: &Self::Tensor, like: &Self::Tensor) -> Result<Self::Tensor>;

    /// Mean over the dancers of a group that are there, frame by frame.
    ///
    /// `x`: \[batch · dancers, frames, channels\]; `like`: \[batch, …\]; `mask`: \[batch, dancers\], all where absent →
    /// \[batch, frames, channels\]
    fn mean_dancers(
        &mut self,
        x: &Self::Tensor,
        like: &Self::Tensor,
        mask: Option<&Self::Tensor>,
    ) -> Result<Self::Tensor>;

    /// Mean over the channels of each sample: \[batch, channels\] → \[batch, 1\].
    fn mean_channels(&mut self, x: &Self::Tensor) -> Result<Self::Tensor>;

    /// Puts frames one after the other; a vector, \[batch, channels\], is one frame.
    fn concat_frames(&mut self, parts: &[&Self::Tensor]) -> Result<Self::Tensor>;

    /// Takes `n` frames from the frame `first` on, or all behind it.
    fn frames(&mut self, x: &Self::Tensor, first: usize, n: Option<usize>) -> Result<Self::Tensor>;

    /// Puts `n` tokens, which count, before the frames of a mask: \[batch, frames\] → \[batch, n + frames\].
    fn token_mask(&mut self, mask: &Self::Tensor, n: usize) -> Result<Self::Tensor>;

    /// (bias + s) x + h, a scale and a shift for each sample, or for each of its frames.
    ///
    /// `x`: \[batch, frames, channels\]; `film`: \[batch, 2 channels\] or \[batch, frames, 2 channels\], s then h. With bias 1 Perez et al., "FiLM",
    /// AAAI 2018; with bias 0 the affine part of AdaIN (Huang and Belongie, ICCV 2017, eq. 8).
    fn modulate(
        &mut self,
        x: &Self::Tensor,
        film: &Self::Tensor,
        bias: f64,
    ) -> Result<Self::Tensor>;

    /// (x − μ) / √(σ² + ε), μ and σ² of each channel over the frames of a sample that count, \[batch, frames\].
    fn normalize_frames(
        &mut self,
        x: &Self::Tensor,
        mask: Option<&Self::Tensor>,
        epsilon: f64,
    ) -> Result<Self::Tensor>;

    /// Mean over the frames of a sample that count: \[batch, frames, channels\] → \[batch, channels\].
    fn mean_frames(
        &mut self,
        x: &Self::Tensor,
        mask: Option<&Self::Tensor>,
    ) -> Result<Self::Tensor>;

    /// Runs a part of the network whose inner values need not be kept for its gradient.
    ///
    /// An interpreter that differentiates runs the part again when its gradient is due (Chen et al.,
    /// "Training Deep Nets with Sublinear Memory Cost", arXiv 1604.06174, 2016); others just run it.
    fn checkpoint<F>(&mut self, inputs: &[&Self::Tensor], part: F) -> Result<Self::Tensor>
    where
        F: Fn(&mut Self, &[Self::Tensor]) -> Result<Self::Tensor> + Send + 'static,
    {
        let inputs: Vec<_> = inputs.iter().map(|&x| x.clone()).collect();
        part(self, &inputs)
    }
}
