//! What each operation of a network is in ONNX.
//!
//! The forms were chosen by measurement (docs/onnx.md): convolutions over an image of one row,
//! normalisation by groups as normalisation of instances of a reshaped tensor, attention as two
//! products around a softmax.

use std::ops::Range;
use std::sync::Arc;

use ndarray::Array2;

use crate::model::{
    Activation, Attention, Convolution, Graph, GraphError, GroupNormalization, Mirror, ParameterId,
    Result,
};

use super::builder::{Axes, Builder, Form, Use, Value, expect};
use super::frames;
use super::literals::{float, integer, integers, word};

impl Graph for Builder<'_> {
    type Tensor = Value;

    fn parameter(&mut self, id: ParameterId) -> Result<Value> {
        self.begin("parameter", Some(id));
        let channels = self.list.get(id).len();
        let name = self.weight(id, Use::Plain);
        Ok(self.new_last(Axes::Channels, channels, name))
    }

    fn linear(
        &mut self,
        x: &Value,
        weight: ParameterId,
        bias: Option<ParameterId>,
    ) -> Result<Value> {
        self.begin("linear", Some(weight));
        let outputs = self.outputs("linear", *x, weight)?;
        if x.axes == Axes::Frames && !self.has_last(*x) {
            let one = Convolution { taps: 1, stride: 1, padding: 0, dilation: 1 };
            return self.product(*x, weight, bias, one);
        }
        let name = self.last(*x)?;
        let weight = self.weight(weight, Use::Transposed);
        let mut y = self.node("MatMul", &[&name, &weight], vec![]);
        if let Some(bias) = bias {
            let bias = self.weight(bias, Use::Plain);
            y = self.node("Add", &[&y, &bias], vec![]);
        }
        Ok(self.new_last(x.axes, outputs, y))
    }

    fn conv1d(
        &mut self,
        x: &Value,
        weight: ParameterId,
        bias: Option<ParameterId>,
        convolution: Convolution,
    ) -> Result<Value> {
        self.begin("conv1d", Some(weight));
        self.product(*x, weight, bias, convolution)
    }

    fn group_norm(
        &mut self,
        x: &Value,
        norm: GroupNormalization,
        film: Option<&Value>,
        activation: Activation,
    ) -> Result<Value> {
        self.begin("group_norm", Some(norm.weight));
        let name = self.first("group_norm", *x)?;
        let groups = norm.groups;
        let shape = self.integers(&[0, groups as i64, -1]);
        let grouped = self.node("Reshape", &[&name, &shape], vec![]);
        let ones = self.numbers(&format!("constant/ones_{groups}"), &[groups], &vec![1.0; groups]);
        let zeros =
            self.numbers(&format!("constant/zeros_{groups}"), &[groups], &vec![0.0; groups]);
        let epsilon = vec![float("epsilon", norm.epsilon)];
        let normed = self.node("InstanceNormalization", &[&grouped, &ones, &zeros], epsilon);
        let shape = self.frames_shape(x.channels);
        let normed = self.node("Reshape", &[&normed, &shape], vec![]);
        let (gain, shift) = match film {
            None => {
                let gain = self.weight(norm.weight, Use::AlongChannels);
                (gain, self.weight(norm.bias, Use::AlongChannels))
            }
            Some(film) => {
                // (γ x̂ + β)(1 + s) + h = x̂ · γ(1 + s) + (β(1 + s) + h): two passes instead of four.
                expect("group_norm", *film, Axes::Samples)?;
                let film = self.last(*film)?;
                let halves = vec![integer("axis", 1), integer("num_outputs", 2)];
                let halves = self.nodes_of("Split", &[&film], halves, 2);
                let one = self.number(1.0);
                let scale = self.node("Add", &[&halves[0], &one], vec![]);
                let gain = self.weight(norm.weight, Use::Plain);
                let gain = self.node("Mul", &[&scale, &gain], vec![]);
                let bias = self.weight(norm.bias, Use::Plain);
                let bias = self.node("Mul", &[&scale, &bias], vec![]);
                let shift = self.node("Add", &[&bias, &halves[1]], vec![]);
                (self.beside_frames(&gain), self.beside_frames(&shift))
            }
        };
        let y = self.node("Mul", &[&normed, &gain], vec![]);
        let y = self.node("Add", &[&y, &shift], vec![]);
        let y = self.activate(&y, activation);
        Ok(self.new_first(x.channels, y))
    }

    fn layer_norm(
        &mut self,
        x: &Value,
        affine: Option<[ParameterId; 2]>,
        epsilon: f64,
    ) -> Result<Value> {
        self.begin("layer_norm", affine.map(|[weight, _]| weight));
        let name = self.last(*x)?;
        let n = x.channels;
        let [weight, bias] = match affine {
            Some(affine) => affine.map(|id| self.weight(id, Use::Plain)),
            None => [("ones", 1.0), ("zeros", 0.0)].map(|(what, value)| {
                self.numbers(&format!("constant/{what}_{n}"), &[n], &vec![value; n])
            }),
        };
        let attributes = vec![integer("axis", -1), float("epsilon", epsilon)];
        let y = self.node("LayerNormalization", &[&name, &weight, &bias], attributes);
        Ok(self.new_last(x.axes, n, y))
    }

    fn activation(&mut self, x: &Value, activation: Activation) -> Result<Value> {
        self.begin("activation", None);
        self.map(*x, x.channels, |g, x| g.activate(x, activation))
    }

    fn attention(&mut self, attention: Attention<Value>) -> Result<Value> {
        self.begin("attention", None);
        let Attention { query, key, value, width, heads, key_mask, causal } = attention;
        let q = self.heads(&query, width, heads)?;
        let k = self.heads(&key, width, heads)?;
        let mut v = self.heads(&value, width, heads)?;
        let swap = || vec![integers("perm", &[0, 1, 3, 2])];
        let q = self.node("Transpose", &[&q], swap());
        let scores = self.node("MatMul", &[&q, &k], vec![]);
        let factor = self.number(1.0 / ((width / heads) as f64).sqrt());
        let scores = self.node("Mul", &[&scores, &factor], vec![]);
        let mask = key_mask.map(|mask| self.key_row(*mask)).transpose()?;
        if let Some(mask) = &mask {
            // A query none of whose keys counts gets zeros.
            v = self.node("Mul", &[&v, mask], vec![]);
        }
        let later = causal.then(|| self.later(*query.tensor, *key.tensor)).transpose()?;
        let weights = self.key_weights(&scores, mask.as_deref(), later.as_deref());
        let weights = self.node("Transpose", &[&weights], swap());
        let y = self.node("MatMul", &[&v, &weights], vec![]);
        let shape = self.frames_shape(width);
        let y = self.node("Reshape", &[&y, &shape], vec![]);
        Ok(self.new_first(width, y))
    }

    fn add(&mut self, a: &Value, b: &Value) -> Result<Value> {
        self.binary("add", *a, *b)
    }

    fn mul(&mut self, a: &Value, b: &Value) -> Result<Value> {
        self.binary("mul", *a, *b)
    }

    fn add_to_frames(&mut self, x: &Value, v: &Value) -> Result<Value> {
        self.begin("add_to_frames", None);
        expect("add_to_frames", *v, Axes::Samples)?;
        let (x_name, v_name) = (self.first("add_to_frames", *x)?, self.last(*v)?);
        let v_name = self.beside_frames(&v_name);
        let y = self.node("Add", &[&x_name, &v_name], vec![]);
        Ok(self.new_first(x.channels, y))
    }

    fn scale(&mut self, x: &Value, factor: f64) -> Result<Value> {
        self.begin("scale", None);
        let factor = self.number(factor);
        self.map(*x, x.channels, |g, x| g.node("Mul", &[x, &factor], vec![]))
    }

    fn concat(&mut self, parts: &[&Value]) -> Result<Value> {
        self.begin("concat", None);
        let Some(&&one) = parts.first() else {
            return Err(GraphError::shape("concat", "has no inputs"));
        };
        for part in parts {
            expect("concat", **part, one.axes)?;
        }
        let channels = parts.iter().map(|part| part.channels).sum();
        let is_first = one.axes == Axes::Frames && !parts.iter().all(|x| self.has_last(**x));
        let names: Vec<String> = parts
            .iter()
            .map(|x| if is_first { self.first("concat", **x) } else { self.last(**x) })
            .collect::<Result<_>>()?;
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let axis = vec![integer("axis", if is_first { 1 } else { -1 })];
        let y = self.node("Concat", &names, axis);
        Ok(if is_first {
            self.new_first(channels, y)
        } else {
            self.new_last(one.axes, channels, y)
        })
    }

    fn channels(&mut self, x: &Value, range: Range<usize>) -> Result<Value> {
        self.begin("channels", None);
        if range.start > range.end || range.end > x.channels {
            let problem = format!("input has {} channels, {range:?} is taken", x.channels);
            return Err(GraphError::shape("channels", problem));
        }
        let axis = self.channels_axis(*x);
        let [starts, ends, axes] =
            [range.start as i64, range.end as i64, axis].map(|n| self.integers(&[n]));
        self.map(*x, range.len(), |g, x| g.node("Slice", &[x, &starts, &ends, &axes], vec![]))
    }

    fn upsample(&mut self, x: &Value, factor: usize) -> Result<Value> {
        self.begin("upsample", None);
        let name = self.first("upsample", *x)?;
        let n = factor as f32;
        let scales = match self.form {
            Form::Line => self.numbers(&format!("constant/times_{factor}"), &[3], &[1.0, 1.0, n]),
            Form::Image => {
                self.numbers(&format!("constant/times_{factor}"), &[4], &[1.0, 1.0, 1.0, n])
            }
        };
        let attributes = vec![
            word("mode", "nearest"),
            word("coordinate_transformation_mode", "asymmetric"),
            word("nearest_mode", "floor"),
        ];
        let y = self.node("Resize", &[&name, "", &scales], attributes);
        Ok(self.new_first(x.channels, y))
    }

    fn gather(&mut self, table: &Arc<Array2<f64>>, index: &Value) -> Result<Value> {
        self.begin("gather", None);
        let (rows, columns) = table.dim();
        let values: Vec<f32> = table.iter().map(|&x| x as f32).collect();
        let name = self.table(&[rows, columns], &values);
        self.rows(&name, *index, columns)
    }

    fn embedding(&mut self, table: ParameterId, index: &Value) -> Result<Value> {
        self.begin("embedding", Some(table));
        let channels = self.list.get(table).shape.last().copied().unwrap_or(0);
        let table = self.weight(table, Use::Plain);
        self.rows(&table, *index, channels)
    }

    /// argmin ‖x − c‖² = argmax x · c − ‖c‖² / 2.
    fn nearest_row(&mut self, x: &Value, table: ParameterId) -> Result<Value> {
        self.begin("nearest_row", Some(table));
        self.outputs("nearest_row", *x, table)?;
        let axes = match x.axes {
            Axes::Frames => Axes::Mask,
            Axes::Samples => Axes::Batch,
            axes => {
                let problem = format!("input has axes {axes:?}, expected Frames or Samples");
                return Err(GraphError::shape("nearest_row", problem));
            }
        };
        let name = self.last(*x)?;
        let columns = self.weight(table, Use::Transposed);
        let products = self.node("MatMul", &[&name, &columns], vec![]);
        let squares = self.node("Mul", &[&columns, &columns], vec![]);
        let first = self.integers(&[0]);
        let squares = self.node("ReduceSum", &[&squares, &first], vec![integer("keepdims", 0)]);
        let half = self.number(0.5);
        let squares = self.node("Mul", &[&squares, &half], vec![]);
        let nearness = self.node("Sub", &[&products, &squares], vec![]);
        let last = vec![integer("axis", -1), integer("keepdims", 0)];
        let y = self.node("ArgMax", &[&nearness], last);
        Ok(self.new_index(axes, y))
    }

    fn straight_through(&mut self, _x: &Value, value: &Value) -> Result<Value> {
        Ok(*value)
    }

    fn dropout(&mut self, x: &Value, _probability: f64) -> Result<Value> {
        Ok(*x)
    }

    fn select(&mut self, choice: &Value, other: &Value, x: &Value) -> Result<Value> {
        self.begin("select", None);
        expect("select", *choice, Axes::Batch)?;
        expect("select", *other, Axes::Channels)?;
        expect("select", *x, Axes::Frames)?;
        let (choice, other, name) = (self.last(*choice)?, self.last(*other)?, self.last(*x)?);
        let (zero, axes) = (self.number(0.0), self.integers(&[1, 2]));
        let chosen = self.node("Greater", &[&choice, &zero], vec![]);
        let chosen = self.node("Unsqueeze", &[&chosen, &axes], vec![]);
        let y = self.node("Where", &[&chosen, &other, &name], vec![]);
        Ok(self.new_last(Axes::Frames, x.channels, y))
    }

    fn normalize(&mut self, x: &Value, epsilon: f64) -> Result<Value> {
        self.begin("normalize", None);
        let (axes, epsilon) = (self.channels_axis(*x), self.number(epsilon));
        let axes = self.integers(&[axes]);
        self.map(*x, x.channels, |g, x| {
            let norm = g.node("ReduceL2", &[x, &axes], vec![integer("keepdims", 1)]);
            let norm = g.node("Max", &[&norm, &epsilon], vec![]);
            g.node("Div", &[x, &norm], vec![])
        })
    }

    fn rotary(&mut self, x: &Value, heads: usize, past: Option<&Value>) -> Result<Value> {
        frames::rotary(self, *x, heads, past.copied())
    }

    fn hold_frames(&mut self, x: &Value, multiple: usize) -> Result<Value> {
        frames::hold(self, *x, multiple)
    }

    fn crop_frames(&mut self, x: &Value, like: &Value) -> Result<Value> {
        self.begin("crop_frames", None);
        let ends = self.n_frames(*like)?;
        let starts = self.integers(&[0]);
        let axis = if self.has_last(*x) { 1 } else { self.frames_axis() };
        let axes = self.integers(&[axis]);
        self.map(*x, x.channels, |g, x| g.node("Slice", &[x, &starts, &ends, &axes], vec![]))
    }

    fn frames_behind(&mut self, x: &Value, past: &Value) -> Result<Value> {
        frames::behind(self, *x, *past)
    }

    fn shift_frames(&mut self, x: &Value, shift: isize, spare: usize) -> Result<Value> {
        frames::shift(self, *x, shift, spare)
    }

    fn replace_ends(&mut self, x: &Value, first: &Value, last: &Value) -> Result<Value> {
        frames::replace_ends(self, *x, *first, *last)
    }

    fn filter_frames(
        &mut self,
        x: &Value,
        kernel: &Arc<Array2<f64>>,
        mirror: Mirror,
    ) -> Result<Value> {
        frames::filter(self, *x, kernel, mirror)
    }

    fn frame_mask(&mut self, x: &Value, mask: Option<&Value>, multiple: usize) -> Result<Value> {
        frames::mask(self, *x, mask.copied(), multiple)
    }

    fn stride_mask(&mut self, mask: &Value, stride: usize) -> Result<Value> {
        self.begin("stride_mask", None);
        let name = self.last(*mask)?;
        let (starts, ends) = (self.integers(&[0]), self.integers(&[i64::MAX]));
        let (axes, steps) = (self.integers(&[1]), self.integers(&[stride as i64]));
        let y = self.node("Slice", &[&name, &starts, &ends, &axes, &steps], vec![]);
        Ok(self.new_last(Axes::Mask, 0, y))
    }

    fn rebatch(&mut self, x: &Value, like: &Value) -> Result<Value> {
        self.begin("rebatch", None);
        let (name, batch) = (self.last(*x)?, self.batch_of(*like)?);
        let rest: &[i64] = match x.axes {
            Axes::Frames => &[-1, x.channels as i64],
            _ => &[-1],
        };
        let rest = self.integers(rest);
        let shape = self.node("Concat", &[&batch, &rest], vec![integer("axis", 0)]);
        let y = self.node("Reshape", &[&name, &shape], vec![]);
        Ok(self.new_last(x.axes, x.channels, y))
    }

    fn repeat_batch(&mut self, x: &Value, like: &Value) -> Result<Value> {
        self.begin("repeat_batch", None);
        let (name, rows) = (self.last(*x)?, self.batch_of(*like)?);
        let batch = self.node("Shape", &[&name], vec![integer("start", 0), integer("end", 1)]);
        let times = self.node("Div", &[&rows, &batch], vec![]);
        let one = self.integers(&[1]);
        // [batch, …] → [batch, 1, …] → [batch, times, …] → [rows, …]
        let apart = self.node("Unsqueeze", &[&name, &one], vec![]);
        let behind = self.node("Shape", &[&name], vec![integer("start", 1)]);
        let shape = self.node("Concat", &[&batch, &times, &behind], vec![integer("axis", 0)]);
        let repeated = self.node("Expand", &[&apart, &shape], vec![]);
        let shape = self.node("Concat", &[&rows, &behind], vec![integer("axis", 0)]);
        let y = self.node("Reshape", &[&repeated, &shape], vec![]);
        Ok(self.new_last(x.axes, x.channels, y))
    }

    fn mean_dancers(&mut self, x: &Value, like: &Value, mask: Option<&Value>) -> Result<Value> {
        frames::mean_dancers(self, *x, *like, mask.copied())
    }

    fn mean_channels(&mut self, x: &Value) -> Result<Value> {
        frames::mean_channels(self, *x)
    }

    fn concat_frames(&mut self, parts: &[&Value]) -> Result<Value> {
        frames::concat(self, parts)
    }

    fn frames(&mut self, x: &Value, first: usize, n: Option<usize>) -> Result<Value> {
        self.begin("frames", None);
        expect("frames", *x, Axes::Frames)?;
        let name = self.last(*x)?;
        let end = n.map_or(i64::MAX, |n| (first + n) as i64);
        let [starts, ends, axes] = [first as i64, end, 1].map(|n| self.integers(&[n]));
        let y = self.node("Slice", &[&name, &starts, &ends, &axes], vec![]);
        Ok(self.new_last(Axes::Frames, x.channels, y))
    }

    fn token_mask(&mut self, mask: &Value, n: usize) -> Result<Value> {
        self.begin("token_mask", None);
        expect("token_mask", *mask, Axes::Mask)?;
        let name = self.last(*mask)?;
        let (pads, axes) = (self.integers(&[n as i64, 0]), self.integers(&[1]));
        let one = self.number(1.0);
        let y = self.node("Pad", &[&name, &pads, &one, &axes], vec![word("mode", "constant")]);
        Ok(self.new_last(Axes::Mask, 0, y))
    }

    fn modulate(&mut self, x: &Value, film: &Value, bias: f64) -> Result<Value> {
        self.begin("modulate", None);
        let is_of_frames = film.axes == Axes::Frames;
        if !is_of_frames {
            expect("modulate", *film, Axes::Samples)?;
        }
        let (name, mut film) = (self.last(*x)?, self.last(*film)?);
        if !is_of_frames {
            let axes = self.integers(&[1]);
            film = self.node("Unsqueeze", &[&film, &axes], vec![]);
        }
        let halves = vec![integer("axis", -1), integer("num_outputs", 2)];
        let halves = self.nodes_of("Split", &[&film], halves, 2);
        let mut scale = halves[0].clone();
        if bias != 0.0 {
            let bias = self.number(bias);
            scale = self.node("Add", &[&scale, &bias], vec![]);
        }
        let y = self.node("Mul", &[&name, &scale], vec![]);
        let y = self.node("Add", &[&y, &halves[1]], vec![]);
        Ok(self.new_last(Axes::Frames, x.channels, y))
    }

    fn normalize_frames(&mut self, x: &Value, mask: Option<&Value>, epsilon: f64) -> Result<Value> {
        self.begin("normalize_frames", None);
        let name = self.last(*x)?;
        let mean = self.mean_over_frames(*x, &name, mask)?;
        let apart = self.node("Sub", &[&name, &mean], vec![]);
        let squares = self.node("Mul", &[&apart, &apart], vec![]);
        let variance = self.mean_over_frames(*x, &squares, mask)?;
        let epsilon = self.number(epsilon);
        let variance = self.node("Add", &[&variance, &epsilon], vec![]);
        let deviation = self.node("Sqrt", &[&variance], vec![]);
        let y = self.node("Div", &[&apart, &deviation], vec![]);
        Ok(self.new_last(Axes::Frames, x.channels, y))
    }

    fn mean_frames(&mut self, x: &Value, mask: Option<&Value>) -> Result<Value> {
        self.begin("mean_frames", None);
        let name = self.last(*x)?;
        let mean = self.mean_over_frames(*x, &name, mask)?;
        let axes = self.integers(&[1]);
        let y = self.node("Squeeze", &[&mean, &axes], vec![]);
        Ok(self.new_last(Axes::Samples, x.channels, y))
    }
}
