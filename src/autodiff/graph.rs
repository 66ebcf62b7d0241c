//! Every interpreter of operations is a graph that networks can be written over.

use std::ops::Range;
use std::sync::Arc;

use ndarray::Array2;

use crate::model::{
    Activation, Attention, Convolution, Graph, GroupNormalization, Mirror, ParameterId, Result,
};

use super::op::activation::Activate;
use super::op::attention::{Attend, InputChannels};
use super::op::binary::{AddToFrames, Binary, Pair};
use super::op::channels::{Concat, TakeChannels};
use super::op::conv::Product;
use super::op::dancers::{MeanDancers, Rebatch, RepeatBatch};
use super::op::dropout::Dropout;
use super::op::elementwise::{Function, Map};
use super::op::filter::FilterFrames;
use super::op::frames::{FrameMask, ReplaceEnds, StrideMask, TakeFrames};
use super::op::group_norm::NormFilmActivate;
use super::op::layer_norm::LayerNormalize;
use super::op::lookup::{Embed, Gather, NearestRow, StraightThrough};
use super::op::modulation::{MeanFrames, Modulate, NormalizeFrames};
use super::op::normalize::Normalize;
use super::op::parameter::Take;
use super::op::reduce::{Over, Reduce};
use super::op::rotary::Rotary;
use super::op::select::Select;
use super::op::tokens::{ConcatFrames, TokenMask};
use super::operation::Interpreter;
use super::tensor::Tensor;

/// The inputs and the optional ones behind them.
fn with<'a, T>(inputs: &[&'a T], more: Option<&'a T>) -> Vec<&'a T> {
    inputs.iter().copied().chain(more).collect()
}

impl<I: Interpreter> Graph for I {
    type Tensor = Tensor<I::Element>;

    fn parameter(&mut self, id: ParameterId) -> Result<Self::Tensor> {
        self.apply(Take(id), &[])
    }

    fn linear(
        &mut self,
        x: &Self::Tensor,
        weight: ParameterId,
        bias: Option<ParameterId>,
    ) -> Result<Self::Tensor> {
        self.apply(Product::linear(weight, bias), &[x])
    }

    fn conv1d(
        &mut self,
        x: &Self::Tensor,
        weight: ParameterId,
        bias: Option<ParameterId>,
        convolution: Convolution,
    ) -> Result<Self::Tensor> {
        self.apply(Product::convolution(weight, bias, convolution), &[x])
    }

    fn group_norm(
        &mut self,
        x: &Self::Tensor,
        norm: GroupNormalization,
        film: Option<&Self::Tensor>,
        activation: Activation,
    ) -> Result<Self::Tensor> {
        let inputs = with(&[x], film);
        if matches!(activation, Activation::Identity | Activation::Silu) {
            return self.apply(NormFilmActivate::new(norm, activation), &inputs);
        }
        let y = self.apply(NormFilmActivate::new(norm, Activation::Identity), &inputs)?;
        self.apply(Activate::new(activation), &[&y])
    }

    fn layer_norm(
        &mut self,
        x: &Self::Tensor,
        affine: Option<[ParameterId; 2]>,
        epsilon: f64,
    ) -> Result<Self::Tensor> {
        self.apply(LayerNormalize::new(affine, epsilon), &[x])
    }

    fn activation(&mut self, x: &Self::Tensor, activation: Activation) -> Result<Self::Tensor> {
        self.apply(Activate::new(activation), &[x])
    }

    fn attention(&mut self, attention: Attention<Self::Tensor>) -> Result<Self::Tensor> {
        let Attention { query, key, value, width, heads, key_mask, causal } = attention;
        // A tensor that serves twice is one input, so that its gradient is written once.
        let mut inputs: Vec<&Self::Tensor> = Vec::new();
        let places = [query, key, value].map(|part| {
            let known = inputs.iter().position(|&x| std::ptr::eq(x, part.tensor));
            let input = known.unwrap_or_else(|| {
                inputs.push(part.tensor);
                inputs.len() - 1
            });
            InputChannels { input, first: part.first }
        });
        let attend = Attend::new(places, width, heads, causal);
        match key_mask {
            Some(mask) => self.apply(attend.masked(), &with(&inputs, Some(mask))),
            None => self.apply(attend, &inputs),
        }
    }

    fn add(&mut self, a: &Self::Tensor, b: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(Binary::new(Pair::Add), &[a, b])
    }

    fn mul(&mut self, a: &Self::Tensor, b: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(Binary::new(Pair::Multiply), &[a, b])
    }

    fn add_to_frames(&mut self, x: &Self::Tensor, v: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(AddToFrames::default(), &[x, v])
    }

    fn scale(&mut self, x: &Self::Tensor, factor: f64) -> Result<Self::Tensor> {
        self.apply(Map::new(Function::Affine { scale: factor, shift: 0.0 }), &[x])
    }

    fn concat(&mut self, parts: &[&Self::Tensor]) -> Result<Self::Tensor> {
        self.apply(Concat::default(), parts)
    }

    fn channels(&mut self, x: &Self::Tensor, range: Range<usize>) -> Result<Self::Tensor> {
        self.apply(TakeChannels::new(range), &[x])
    }

    fn upsample(&mut self, x: &Self::Tensor, factor: usize) -> Result<Self::Tensor> {
        self.apply(TakeFrames::repeat(factor), &[x])
    }

    fn gather(&mut self, table: &Arc<Array2<f64>>, index: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(Gather(Arc::clone(table)), &[index])
    }

    fn embedding(&mut self, table: ParameterId, index: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(Embed::new(table), &[index])
    }

    fn nearest_row(&mut self, x: &Self::Tensor, table: ParameterId) -> Result<Self::Tensor> {
        self.apply(NearestRow(table), &[x])
    }

    fn straight_through(&mut self, x: &Self::Tensor, value: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(StraightThrough, &[x, value])
    }

    fn dropout(&mut self, x: &Self::Tensor, probability: f64) -> Result<Self::Tensor> {
        if !self.is_training() || probability == 0.0 {
            return Ok(x.clone());
        }
        self.apply(Dropout::new(probability), &[x])
    }

    fn select(
        &mut self,
        choice: &Self::Tensor,
        other: &Self::Tensor,
        x: &Self::Tensor,
    ) -> Result<Self::Tensor> {
        self.apply(Select::default(), &[choice, other, x])
    }

    fn normalize(&mut self, x: &Self::Tensor, epsilon: f64) -> Result<Self::Tensor> {
        self.apply(Normalize::new(epsilon), &[x])
    }

    fn rotary(
        &mut self,
        x: &Self::Tensor,
        heads: usize,
        past: Option<&Self::Tensor>,
    ) -> Result<Self::Tensor> {
        self.apply(Rotary::new(heads), &with(&[x], past))
    }

    fn rotary_first(
        &mut self,
        x: &Self::Tensor,
        heads: usize,
        [turned, _]: [usize; 2],
    ) -> Result<Self::Tensor> {
        self.apply(Rotary::of_first(heads, turned), &[x])
    }

    fn hold_frames(&mut self, x: &Self::Tensor, multiple: usize) -> Result<Self::Tensor> {
        let held =
            x.shape().len() == 3 && x.shape()[1] > 0 && x.shape()[1].is_multiple_of(multiple);
        if held { Ok(x.clone()) } else { self.apply(TakeFrames::hold(multiple), &[x]) }
    }

    fn crop_frames(&mut self, x: &Self::Tensor, like: &Self::Tensor) -> Result<Self::Tensor> {
        let alike = x.shape().len() == 3 && x.shape().get(1) == like.shape().get(1);
        if alike { Ok(x.clone()) } else { self.apply(TakeFrames::crop(), &[x, like]) }
    }

    fn frames_behind(&mut self, x: &Self::Tensor, past: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(TakeFrames::behind(), &[x, past])
    }

    fn shift_frames(
        &mut self,
        x: &Self::Tensor,
        shift: isize,
        spare: usize,
    ) -> Result<Self::Tensor> {
        self.apply(TakeFrames::shifted(shift, spare), &[x])
    }

    fn replace_ends(
        &mut self,
        x: &Self::Tensor,
        first: &Self::Tensor,
        last: &Self::Tensor,
    ) -> Result<Self::Tensor> {
        self.apply(ReplaceEnds, &[x, first, last])
    }

    fn filter_frames(
        &mut self,
        x: &Self::Tensor,
        kernel: &Arc<Array2<f64>>,
        mirror: Mirror,
    ) -> Result<Self::Tensor> {
        self.apply(FilterFrames { kernel: Arc::clone(kernel), mirror }, &[x])
    }

    fn frame_mask(
        &mut self,
        x: &Self::Tensor,
        mask: Option<&Self::Tensor>,
        multiple: usize,
    ) -> Result<Self::Tensor> {
        self.apply(FrameMask { multiple }, &with(&[x], mask))
    }

    fn stride_mask(&mut self, mask: &Self::Tensor, stride: usize) -> Result<Self::Tensor> {
        self.apply(StrideMask { stride }, &[mask])
    }

    fn rebatch(&mut self, x: &Self::Tensor, like: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(Rebatch::default(), &[x, like])
    }

    fn repeat_batch(&mut self, x: &Self::Tensor, like: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(RepeatBatch::default(), &[x, like])
    }

    fn mean_dancers(
        &mut self,
        x: &Self::Tensor,
        like: &Self::Tensor,
        mask: Option<&Self::Tensor>,
    ) -> Result<Self::Tensor> {
        self.apply(MeanDancers::default(), &with(&[x, like], mask))
    }

    fn mean_channels(&mut self, x: &Self::Tensor) -> Result<Self::Tensor> {
        self.apply(Reduce::mean(Over::Axis(1)), &[x])
    }

    fn concat_frames(&mut self, parts: &[&Self::Tensor]) -> Result<Self::Tensor> {
        self.apply(ConcatFrames::default(), parts)
    }

    fn frames(&mut self, x: &Self::Tensor, first: usize, n: Option<usize>) -> Result<Self::Tensor> {
        self.apply(TakeFrames::from(first, n), &[x])
    }

    fn token_mask(&mut self, mask: &Self::Tensor, n: usize) -> Result<Self::Tensor> {
        self.apply(TokenMask { n }, &[mask])
    }

    fn modulate(
        &mut self,
        x: &Self::Tensor,
        film: &Self::Tensor,
        bias: f64,
    ) -> Result<Self::Tensor> {
        self.apply(Modulate::new(bias), &[x, film])
    }

    fn normalize_frames(
        &mut self,
        x: &Self::Tensor,
        mask: Option<&Self::Tensor>,
        epsilon: f64,
    ) -> Result<Self::Tensor> {
        self.apply(NormalizeFrames::new(epsilon), &with(&[x], mask))
    }

    fn mean_frames(
        &mut self,
        x: &Self::Tensor,
        mask: Option<&Self::Tensor>,
    ) -> Result<Self::Tensor> {
        self.apply(MeanFrames::default(), &with(&[x], mask))
    }

    fn checkpoint<F>(&mut self, inputs: &[&Self::Tensor], part: F) -> Result<Self::Tensor>
    where
        F: Fn(&mut Self, &[Self::Tensor]) -> Result<Self::Tensor> + Send + 'static,
    {
        self.run_part(inputs, part)
    }
}
