//! What a network costs: an interpreter that follows shapes and counts, and computes nothing.

use std::ops::Range;
use std::sync::Arc;

use ndarray::Array2;

use super::graph::{
    Activation, Attention, Convolution, Graph, GraphError, GroupNormalization, Mirror, Result,
};
use super::parameter::{ParameterId, ParameterList};

/// A layer with parameters, or an attention, as it was met.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// The name of its parameters without the last part; of an attention, the operation's.
    pub name: String,
    pub operation: &'static str,
    /// Shape of its result.
    pub shape: Vec<usize>,
    pub n_parameters: usize,
    /// Multiplications and additions of its products; those of single numbers are not counted.
    pub flops: u64,
}

/// Follows shapes through a network.
#[derive(Debug)]
pub struct Outline<'p> {
    list: &'p ParameterList,
    layers: Vec<Layer>,
    /// Numbers that a tape would keep for the backward.
    kept: usize,
    /// The most numbers within one part that is run again for its gradient.
    within_part: usize,
    /// How many parts are open.
    depth: usize,
}

/// Numbers of the activations that training keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActivationCounts {
    /// Over the whole network.
    pub numbers: usize,
    /// At most within a part that is run again, on top of the others; 0 without checkpoints.
    pub within_part: usize,
}

impl<'p> Outline<'p> {
    /// Begins with a network's parameters.
    pub fn new(list: &'p ParameterList) -> Self {
        Self { list, layers: Vec::new(), kept: 0, within_part: 0, depth: 0 }
    }

    /// Returns the layers in the order in which they run.
    pub fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Returns the multiplications and additions of all products.
    pub fn flops(&self) -> u64 {
        self.layers.iter().map(|layer| layer.flops).sum()
    }

    /// Returns what training keeps of activations.
    pub fn kept(&self) -> ActivationCounts {
        ActivationCounts { numbers: self.kept, within_part: self.within_part }
    }

    /// An input of a shape.
    pub fn input(&self, shape: &[usize]) -> Vec<usize> {
        shape.to_vec()
    }

    /// Notes the result of an operation.
    fn result(&mut self, shape: Vec<usize>) -> Vec<usize> {
        self.kept += shape.iter().product::<usize>();
        shape
    }

    fn layer(
        &mut self,
        operation: &'static str,
        parameters: &[ParameterId],
        shape: &[usize],
        flops: u64,
    ) {
        let name = parameters.first().map_or(operation.to_owned(), |&id| {
            let name = &self.list.get(id).name;
            name.rsplit_once('.').map_or(name.as_str(), |(layer, _)| layer).to_owned()
        });
        let n_parameters = parameters.iter().map(|&id| self.list.get(id).len()).sum();
        self.layers.push(Layer { name, operation, shape: shape.to_vec(), n_parameters, flops });
    }

    /// A product with a weight, whose result has `rows` rows.
    fn product(
        &mut self,
        operation: &'static str,
        weight: ParameterId,
        bias: Option<ParameterId>,
        shape: Vec<usize>,
    ) -> Result<Vec<usize>> {
        let size = self.list.get(weight).len() as u64;
        let rows: usize = shape[..shape.len() - 1].iter().product();
        let parameters: Vec<_> = [weight].into_iter().chain(bias).collect();
        self.layer(operation, &parameters, &shape, 2 * rows as u64 * size);
        Ok(self.result(shape))
    }

    /// Returns the outputs of a weight, and checks its inputs.
    fn outputs(&self, operation: &'static str, x: &[usize], weight: ParameterId) -> Result<usize> {
        let parameter = self.list.get(weight);
        match (parameter.shape.as_slice(), x.last()) {
            (&[outputs, inputs, ..], Some(&channels)) if inputs == channels => Ok(outputs),
            (shape, _) => Err(GraphError::shape(
                operation,
                format!("input has shape {x:?}, {} has {shape:?}", parameter.name),
            )),
        }
    }
}

/// Returns the axes of [batch, frames, channels].
fn three(operation: &'static str, x: &[usize]) -> Result<[usize; 3]> {
    let problem = || format!("input has shape {x:?}, expected [batch, frames, channels]");
    x.try_into().map_err(|_| GraphError::shape(operation, problem()))
}

impl Graph for Outline<'_> {
    type Tensor = Vec<usize>;

    fn parameter(&mut self, id: ParameterId) -> Result<Vec<usize>> {
        let shape = self.list.get(id).shape.clone();
        self.layer("parameter", &[id], &shape, 0);
        Ok(self.result(shape))
    }

    fn linear(
        &mut self,
        x: &Vec<usize>,
        weight: ParameterId,
        bias: Option<ParameterId>,
    ) -> Result<Vec<usize>> {
        let outputs = self.outputs("linear", x, weight)?;
        let mut shape = x.clone();
        shape.pop();
        shape.push(outputs);
        self.product("linear", weight, bias, shape)
    }

    fn conv1d(
        &mut self,
        x: &Vec<usize>,
        weight: ParameterId,
        bias: Option<ParameterId>,
        convolution: Convolution,
    ) -> Result<Vec<usize>> {
        let [batch, frames, _] = three("conv1d", x)?;
        let outputs = self.outputs("conv1d", x, weight)?;
        let Convolution { taps, stride, padding, dilation } = convolution;
        let span = dilation * (taps - 1) + 1;
        let room = (frames + 2 * padding).checked_sub(span).ok_or_else(|| {
            GraphError::shape("conv1d", format!("input has {frames} frames, weight spans {span}"))
        })?;
        self.product("conv1d", weight, bias, vec![batch, room / stride + 1, outputs])
    }

    fn group_norm(
        &mut self,
        x: &Vec<usize>,
        norm: GroupNormalization,
        _film: Option<&Vec<usize>>,
        _activation: Activation,
    ) -> Result<Vec<usize>> {
        self.layer("group_norm", &[norm.weight, norm.bias], x, 0);
        Ok(self.result(x.clone()))
    }

    fn layer_norm(
        &mut self,
        x: &Vec<usize>,
        affine: Option<[ParameterId; 2]>,
        _epsilon: f64,
    ) -> Result<Vec<usize>> {
        if let Some(affine) = affine {
            self.layer("layer_norm", &affine, x, 0);
        }
        Ok(self.result(x.clone()))
    }

    fn activation(&mut self, x: &Vec<usize>, _activation: Activation) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn attention(&mut self, attention: Attention<Vec<usize>>) -> Result<Vec<usize>> {
        let [batch, queries, _] = three("attention", attention.query.tensor)?;
        let [_, keys, _] = three("attention", attention.key.tensor)?;
        let shape = vec![batch, queries, attention.width];
        // Q Kᵀ and its softmax times V.
        let flops = 4 * (batch * queries * keys * attention.width) as u64;
        self.layer("attention", &[], &shape, flops);
        self.kept += batch * attention.heads * queries * keys;
        Ok(self.result(shape))
    }

    fn add(&mut self, a: &Vec<usize>, b: &Vec<usize>) -> Result<Vec<usize>> {
        let (long, short) = if a.len() >= b.len() { (a, b) } else { (b, a) };
        let mut shape = long.clone();
        for (n, m) in shape.iter_mut().rev().zip(short.iter().rev()) {
            *n = (*n).max(*m);
        }
        Ok(self.result(shape))
    }

    fn mul(&mut self, a: &Vec<usize>, b: &Vec<usize>) -> Result<Vec<usize>> {
        self.add(a, b)
    }

    fn add_to_frames(&mut self, x: &Vec<usize>, _v: &Vec<usize>) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn scale(&mut self, x: &Vec<usize>, _factor: f64) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn concat(&mut self, parts: &[&Vec<usize>]) -> Result<Vec<usize>> {
        let mut shape = parts.first().map(|x| x.to_vec()).unwrap_or_default();
        if let Some(last) = shape.last_mut() {
            *last = parts.iter().filter_map(|x| x.last()).sum();
        }
        Ok(self.result(shape))
    }

    fn channels(&mut self, x: &Vec<usize>, range: Range<usize>) -> Result<Vec<usize>> {
        let mut shape = x.clone();
        shape.pop();
        shape.push(range.len());
        Ok(self.result(shape))
    }

    fn upsample(&mut self, x: &Vec<usize>, factor: usize) -> Result<Vec<usize>> {
        let [batch, frames, channels] = three("upsample", x)?;
        Ok(self.result(vec![batch, factor * frames, channels]))
    }

    fn gather(&mut self, table: &Arc<Array2<f64>>, index: &Vec<usize>) -> Result<Vec<usize>> {
        let mut shape = index.clone();
        shape.push(table.ncols());
        Ok(self.result(shape))
    }

    fn embedding(&mut self, table: ParameterId, index: &Vec<usize>) -> Result<Vec<usize>> {
        let mut shape = index.clone();
        shape.extend(self.list.get(table).shape.last());
        self.layer("embedding", &[table], &shape, 0);
        Ok(self.result(shape))
    }

    fn nearest_row(&mut self, x: &Vec<usize>, table: ParameterId) -> Result<Vec<usize>> {
        let rows = self.outputs("nearest_row", x, table)?;
        let (channels, shape) = x.split_last().expect("invariant: it has channels");
        // A difference, its square and their sum.
        let flops = 3 * (shape.iter().product::<usize>() * rows * channels) as u64;
        self.layer("nearest_row", &[], shape, flops);
        Ok(shape.to_vec())
    }

    fn straight_through(&mut self, x: &Vec<usize>, value: &Vec<usize>) -> Result<Vec<usize>> {
        if x != value {
            let problem = format!("value has shape {value:?}, input {x:?}");
            return Err(GraphError::shape("straight_through", problem));
        }
        Ok(value.clone())
    }

    fn dropout(&mut self, x: &Vec<usize>, probability: f64) -> Result<Vec<usize>> {
        Ok(if probability > 0.0 { self.result(x.clone()) } else { x.clone() })
    }

    fn select(
        &mut self,
        _choice: &Vec<usize>,
        _other: &Vec<usize>,
        x: &Vec<usize>,
    ) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn normalize(&mut self, x: &Vec<usize>, _epsilon: f64) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn rotary(
        &mut self,
        x: &Vec<usize>,
        _heads: usize,
        _past: Option<&Vec<usize>>,
    ) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn hold_frames(&mut self, x: &Vec<usize>, multiple: usize) -> Result<Vec<usize>> {
        let [batch, frames, channels] = three("hold_frames", x)?;
        Ok(vec![batch, frames.next_multiple_of(multiple), channels])
    }

    fn crop_frames(&mut self, x: &Vec<usize>, like: &Vec<usize>) -> Result<Vec<usize>> {
        let [batch, _, channels] = three("crop_frames", x)?;
        let [_, frames, _] = three("crop_frames", like)?;
        Ok(vec![batch, frames, channels])
    }

    fn frames_behind(&mut self, x: &Vec<usize>, past: &Vec<usize>) -> Result<Vec<usize>> {
        let [batch, frames, channels] = three("frames_behind", x)?;
        let [_, n_past, _] = three("frames_behind", past)?;
        Ok(self.result(vec![batch, frames.saturating_sub(n_past), channels]))
    }

    fn shift_frames(&mut self, x: &Vec<usize>, _shift: isize, _spare: usize) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn replace_ends(
        &mut self,
        x: &Vec<usize>,
        _first: &Vec<usize>,
        _last: &Vec<usize>,
    ) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn filter_frames(
        &mut self,
        x: &Vec<usize>,
        kernel: &Arc<Array2<f64>>,
        _mirror: Mirror,
    ) -> Result<Vec<usize>> {
        let [batch, frames, channels] = three("filter_frames", x)?;
        let flops = 2 * (batch * frames * channels * kernel.ncols()) as u64;
        self.layer("filter_frames", &[], x, flops);
        Ok(self.result(x.clone()))
    }

    fn frame_mask(
        &mut self,
        x: &Vec<usize>,
        _mask: Option<&Vec<usize>>,
        multiple: usize,
    ) -> Result<Vec<usize>> {
        let [batch, frames, _] = three("frame_mask", x)?;
        Ok(vec![batch, frames.next_multiple_of(multiple)])
    }

    fn stride_mask(&mut self, mask: &Vec<usize>, stride: usize) -> Result<Vec<usize>> {
        Ok(mask
            .iter()
            .enumerate()
            .map(|(i, n)| if i == 1 { n.div_ceil(stride) } else { *n })
            .collect())
    }

    fn rebatch(&mut self, x: &Vec<usize>, like: &Vec<usize>) -> Result<Vec<usize>> {
        let (Some([rows, frames]), Some(&batch)) = (x.first_chunk(), like.first()) else {
            let problem = format!("input has shape {x:?}, expected [rows, frames, channels]");
            return Err(GraphError::shape("rebatch", problem));
        };
        if batch == 0 || !(rows * frames).is_multiple_of(batch) {
            let problem =
                format!("{rows} × {frames} frames cannot be split into {batch} samples alike");
            return Err(GraphError::shape("rebatch", problem));
        }
        let mut shape = x.clone();
        (shape[0], shape[1]) = (batch, rows * frames / batch);
        Ok(self.result(shape))
    }

    fn repeat_batch(&mut self, x: &Vec<usize>, like: &Vec<usize>) -> Result<Vec<usize>> {
        let mut shape = x.clone();
        if let (Some(rows), Some(&n)) = (shape.first_mut(), like.first()) {
            *rows = n;
        }
        Ok(self.result(shape))
    }

    fn mean_dancers(
        &mut self,
        x: &Vec<usize>,
        like: &Vec<usize>,
        _mask: Option<&Vec<usize>>,
    ) -> Result<Vec<usize>> {
        let [_, frames, channels] = three("mean_dancers", x)?;
        Ok(self.result(vec![like[0], frames, channels]))
    }

    fn mean_channels(&mut self, x: &Vec<usize>) -> Result<Vec<usize>> {
        Ok(self.result(vec![x[0], 1]))
    }

    fn concat_frames(&mut self, parts: &[&Vec<usize>]) -> Result<Vec<usize>> {
        let frames = |x: &&Vec<usize>| if x.len() == 2 { 1 } else { x[1] };
        let Some(first) = parts.first() else {
            return Err(GraphError::shape("concat_frames", "there is nothing to join"));
        };
        let channels = first.last().copied().unwrap_or_default();
        let shape = vec![first[0], parts.iter().map(frames).sum(), channels];
        Ok(self.result(shape))
    }

    fn frames(&mut self, x: &Vec<usize>, first: usize, n: Option<usize>) -> Result<Vec<usize>> {
        let [batch, frames, channels] = three("frames", x)?;
        let taken = n.unwrap_or(frames.saturating_sub(first));
        Ok(self.result(vec![batch, taken, channels]))
    }

    fn token_mask(&mut self, mask: &Vec<usize>, n: usize) -> Result<Vec<usize>> {
        Ok(mask.iter().enumerate().map(|(i, m)| if i == 1 { m + n } else { *m }).collect())
    }

    fn modulate(&mut self, x: &Vec<usize>, _film: &Vec<usize>, _bias: f64) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn normalize_frames(
        &mut self,
        x: &Vec<usize>,
        _mask: Option<&Vec<usize>>,
        _epsilon: f64,
    ) -> Result<Vec<usize>> {
        Ok(self.result(x.clone()))
    }

    fn mean_frames(&mut self, x: &Vec<usize>, _mask: Option<&Vec<usize>>) -> Result<Vec<usize>> {
        let [batch, _, channels] = three("mean_frames", x)?;
        Ok(self.result(vec![batch, channels]))
    }

    fn checkpoint<F>(&mut self, inputs: &[&Vec<usize>], part: F) -> Result<Vec<usize>>
    where
        F: Fn(&mut Self, &[Vec<usize>]) -> Result<Vec<usize>> + Send + 'static,
    {
        let inputs: Vec<_> = inputs.iter().map(|&x| x.clone()).collect();
        let before = self.kept;
        self.depth += 1;
        let y = part(self, &inputs)?;
        self.depth -= 1;
        if self.depth == 0 {
            self.within_part = self.within_part.max(self.kept - before);
            self.kept = before;
            return Ok(self.result(y));
        }
        Ok(y)
    }
}

#[cfg(test)]
mod tests;
