//! What the operations of a network have in common in ONNX.

use crate::model::{Activation, Channels, Convolution, GraphError, Mirror, ParameterId, Result};

use super::builder::{Axes, Builder, Form, Use, Value};
use super::literals::{float, integer, integers, word};
use super::proto::DataType;

/// The number that is added to the score of a masked key: e^(it) is 0 in f32.
const MASKED: f64 = -1e9;

impl Builder<'_> {
    /// The axis of frames behind the channels.
    pub(super) fn frames_axis(&self) -> i64 {
        match self.form {
            Form::Line => 2,
            Form::Image => 3,
        }
    }

    /// The shape that has channels before frames, for `Reshape`: 0 keeps the batch, −1 is the frames.
    pub(super) fn frames_shape(&mut self, channels: usize) -> String {
        match self.form {
            Form::Line => self.integers(&[0, channels as i64, -1]),
            Form::Image => self.integers(&[0, channels as i64, 1, -1]),
        }
    }

    /// \[batch, channels\] → \[batch, channels, 1\] or \[batch, channels, 1, 1\]
    pub(super) fn beside_frames(&mut self, vector: &str) -> String {
        let axes = match self.form {
            Form::Line => self.integers(&[2]),
            Form::Image => self.integers(&[2, 3]),
        };
        self.node("Unsqueeze", &[vector, &axes], vec![])
    }

    pub(super) fn binary(&mut self, operation: &'static str, a: Value, b: Value) -> Result<Value> {
        let op_type = if operation == "add" { "Add" } else { "Mul" };
        self.begin(operation, None);
        let channels = a.channels.max(b.channels);
        match (a.axes, b.axes) {
            (Axes::Frames, Axes::Frames) if !(self.has_last(a) && self.has_last(b)) => {
                let (a, b) = (self.first(operation, a)?, self.first(operation, b)?);
                let y = self.node(op_type, &[&a, &b], vec![]);
                Ok(self.new_first(channels, y))
            }
            (x, y) if x == y || y == Axes::Channels || x == Axes::Channels => {
                let axes = if x == Axes::Channels { y } else { x };
                let (a, b) = (self.last(a)?, self.last(b)?);
                let y = self.node(op_type, &[&a, &b], vec![]);
                Ok(self.new_last(axes, channels, y))
            }
            (a, b) => Err(GraphError::shape(
                operation,
                format!("inputs have axes {a:?} and {b:?}, of which neither repeats the other"),
            )),
        }
    }

    pub(super) fn activate(&mut self, x: &str, activation: Activation) -> String {
        match activation {
            Activation::Identity => x.to_owned(),
            Activation::Silu => {
                let s = self.node("Sigmoid", &[x], vec![]);
                self.node("Mul", &[x, &s], vec![])
            }
            Activation::Gelu => self.node("Gelu", &[x], vec![word("approximate", "none")]),
            Activation::Relu => self.node("Relu", &[x], vec![]),
            Activation::LeakyRelu { slope } => {
                self.node("LeakyRelu", &[x], vec![float("alpha", slope)])
            }
            Activation::Mish => self.node("Mish", &[x], vec![]),
            Activation::Tanh => self.node("Tanh", &[x], vec![]),
            Activation::Sigmoid => self.node("Sigmoid", &[x], vec![]),
        }
    }

    /// Applies what is said of a name to a value, in the form that it has.
    pub(super) fn map(
        &mut self,
        x: Value,
        channels: usize,
        f: impl FnOnce(&mut Self, &str) -> String,
    ) -> Result<Value> {
        if x.axes == Axes::Frames && !self.has_last(x) {
            let name = self.first("map", x)?;
            let y = f(self, &name);
            return Ok(self.new_first(channels, y));
        }
        let name = self.last(x)?;
        let y = f(self, &name);
        Ok(self.new_last(x.axes, channels, y))
    }

    /// The axis of a value's channels, in the form that [`Self::map`] chooses.
    pub(super) fn channels_axis(&self, x: Value) -> i64 {
        if x.axes == Axes::Frames && !self.has_last(x) { 1 } else { -1 }
    }

    /// A part of a tensor's channels as \[batch, heads, channels of a head, frames\].
    pub(super) fn heads(
        &mut self,
        part: &Channels<'_, Value>,
        width: usize,
        heads: usize,
    ) -> Result<String> {
        let x = self.first("attention", *part.tensor)?;
        let x = if (part.first, width) == (0, part.tensor.channels) {
            x
        } else {
            let [starts, ends, axes] =
                [part.first, part.first + width, 1].map(|n| self.integers(&[n as i64]));
            self.node("Slice", &[&x, &starts, &ends, &axes], vec![])
        };
        let shape = self.integers(&[0, heads as i64, (width / heads) as i64, -1]);
        Ok(self.node("Reshape", &[&x, &shape], vec![]))
    }

    /// Frames of a value, a vector of one number.
    pub(super) fn n_frames(&mut self, x: Value) -> Result<String> {
        let (name, axis) = if self.has_last(x) || x.axes != Axes::Frames {
            (self.last(x)?, 1)
        } else {
            (self.first("frames", x)?, self.frames_axis())
        };
        let ends = vec![integer("start", axis), integer("end", axis + 1)];
        Ok(self.node("Shape", &[&name], ends))
    }

    /// Samples of a value, a vector of one number.
    pub(super) fn batch_of(&mut self, x: Value) -> Result<String> {
        let name = self.last(x)?;
        Ok(self.node("Shape", &[&name], vec![integer("start", 0), integer("end", 1)]))
    }

    /// The mean of a tensor over the frames of `of` that count, \[batch, 1, channels\].
    pub(super) fn mean_over_frames(
        &mut self,
        of: Value,
        x: &str,
        mask: Option<&Value>,
    ) -> Result<String> {
        let axes = self.integers(&[1]);
        let keep = || vec![integer("keepdims", 1)];
        let Some(mask) = mask else {
            return Ok(self.node("ReduceMean", &[x, &axes], keep()));
        };
        debug_assert_eq!(of.axes, Axes::Frames);
        let (mask, last) = (self.last(*mask)?, self.integers(&[2]));
        let mask = self.node("Unsqueeze", &[&mask, &last], vec![]);
        let counted = self.node("Mul", &[x, &mask], vec![]);
        let sum = self.node("ReduceSum", &[&counted, &axes], keep());
        let n = self.node("ReduceSum", &[&mask, &axes], keep());
        let one = self.number(1.0);
        let n = self.node("Max", &[&n, &one], vec![]);
        Ok(self.node("Div", &[&sum, &n], vec![]))
    }

    /// Frames that are missing up to a multiple: (m − n mod m) mod m.
    pub(super) fn n_missing(&mut self, frames: &str, multiple: usize) -> String {
        let m = self.integers(&[multiple as i64]);
        let rest = self.node("Mod", &[frames, &m], vec![]);
        let missing = self.node("Sub", &[&m, &rest], vec![]);
        self.node("Mod", &[&missing, &m], vec![])
    }

    /// 0, 1, … for a number of frames, a vector of one number.
    pub(super) fn places(&mut self, frames: &str) -> String {
        let axes = self.integers(&[0]);
        let end = self.node("Squeeze", &[frames, &axes], vec![]);
        let (start, step) = (self.integer(0), self.integer(1));
        self.node("Range", &[&start, &end, &step], vec![])
    }

    /// A signal whose frames are its last axis, with as many mirrored frames at either end as `margin` says.
    pub(super) fn mirrored(
        &mut self,
        x: &str,
        frames: &str,
        margin: i64,
        mirror: Mirror,
    ) -> String {
        let [one, two, twice, margin] = [1, 2, 2 * margin, margin].map(|n| self.integers(&[n]));
        let length = self.node("Add", &[frames, &twice], vec![]);
        let places = self.places(&length);
        let places = self.node("Sub", &[&places, &margin], vec![]);
        let period = self.node("Mul", &[frames, &two], vec![]);
        // Of a negative number, too, the remainder has the sign of the period.
        let t = self.node("Mod", &[&places, &period], vec![]);
        // The mirror image of t is 2N − 1 − t, or 2N − 2 − t.
        let back = match mirror {
            Mirror::Even => &one,
            Mirror::Odd => &two,
        };
        let image = self.node("Sub", &[&period, back], vec![]);
        let image = self.node("Sub", &[&image, &t], vec![]);
        let is_forward = self.node("Less", &[&t, frames], vec![]);
        let taken = self.node("Where", &[&is_forward, &t, &image], vec![]);
        let zero = self.integers(&[0]);
        let taken = self.node("Max", &[&taken, &zero], vec![]);
        let frames_axis = self.frames_axis();
        let y = self.node("Gather", &[x, &taken], vec![integer("axis", frames_axis)]);
        if mirror == Mirror::Even {
            return y;
        }
        // t = N − 1 and t = 2N − 1 are 0; past N the sign is another.
        let next = self.node("Add", &[&t, &one], vec![]);
        let rest = self.node("Mod", &[&next, frames], vec![]);
        let counts = self.node("Greater", &[&rest, &zero], vec![]);
        let [counts, is_forward] = [counts, is_forward].map(|x| self.cast(&x, DataType::Float));
        let (double, minus_one) = (self.table(&[1], &[2.0]), self.table(&[1], &[-1.0]));
        let sign = self.node("Mul", &[&is_forward, &double], vec![]);
        let sign = self.node("Add", &[&sign, &minus_one], vec![]);
        let factor = self.node("Mul", &[&counts, &sign], vec![]);
        self.node("Mul", &[&y, &factor], vec![])
    }

    /// Subtracts a centre from each channel and divides by a scale.
    pub(super) fn standardized(
        &mut self,
        x: Value,
        centre: &[f32],
        scale: &[f32],
    ) -> Result<Value> {
        self.begin("standardize", None);
        let n = x.channels;
        if centre.len() != n || scale.len() != n {
            let problem = format!("input has {n} channels, its scale has {}", scale.len());
            return Err(GraphError::shape("standardize", problem));
        }
        let centre = self.numbers("scale/centre", &[n], centre);
        let scale = self.numbers("scale/scale", &[n], scale);
        let name = self.last(x)?;
        let y = self.node("Sub", &[&name, &centre], vec![]);
        let y = self.node("Div", &[&y, &scale], vec![]);
        Ok(self.new_last(x.axes, n, y))
    }

    pub(super) fn cast(&mut self, x: &str, to: DataType) -> String {
        self.node("Cast", &[x], vec![integer("to", to as i64)])
    }

    /// Rows of a table by index.
    pub(super) fn rows(&mut self, table: &str, index: Value, channels: usize) -> Result<Value> {
        let mut name = self.last(index)?;
        if !index.integer {
            name = self.cast(&name, DataType::Int64);
        }
        let y = self.node("Gather", &[table, &name], vec![]);
        let axes = if index.axes == Axes::Batch { Axes::Samples } else { Axes::Frames };
        Ok(self.new_last(axes, channels, y))
    }

    /// A mask beside heads and queries, \[batch, 1, 1, keys\].
    pub(super) fn key_row(&mut self, mask: Value) -> Result<String> {
        let (mask, axes) = (self.last(mask)?, self.integers(&[1, 2]));
        Ok(self.node("Unsqueeze", &[&mask, &axes], vec![]))
    }

    /// The softmax of scores over the keys that count: those that `mask` has as 1 and `later`, if any, as 0.
    pub(super) fn key_weights(
        &mut self,
        scores: &str,
        mask: Option<&str>,
        later: Option<&str>,
    ) -> String {
        let mut scores = scores.to_owned();
        if let Some(mask) = mask {
            let (one, factor) = (self.number(1.0), self.number(-MASKED));
            let less = self.node("Sub", &[mask, &one], vec![]);
            let bias = self.node("Mul", &[&less, &factor], vec![]);
            scores = self.node("Add", &[&scores, &bias], vec![]);
        }
        if let Some(later) = later {
            let factor = self.number(MASKED);
            let bias = self.node("Mul", &[later, &factor], vec![]);
            scores = self.node("Add", &[&scores, &bias], vec![]);
        }
        let weights = self.node("Softmax", &[&scores], vec![integer("axis", -1)]);
        match (mask, later) {
            (Some(_), Some(later)) => {
                // Where all keys up to the query are masked, the softmax has turned to later ones.
                let one = self.number(1.0);
                let kept = self.node("Sub", &[&one, later], vec![]);
                self.node("Mul", &[&weights, &kept], vec![])
            }
            _ => weights,
        }
    }

    /// \[queries, keys\], 1 where the key comes after the query and 0 elsewhere; the last query stands at the place of
    /// the last key.
    pub(super) fn later(&mut self, query: Value, key: Value) -> Result<String> {
        let (n_queries, n_keys) = (self.n_frames(query)?, self.n_frames(key)?);
        let (queries, keys) = (self.places(&n_queries), self.places(&n_keys));
        let first = self.node("Sub", &[&n_keys, &n_queries], vec![]);
        let queries = self.node("Add", &[&queries, &first], vec![]);
        let axes = self.integers(&[1]);
        let queries = self.node("Unsqueeze", &[&queries, &axes], vec![]);
        let later = self.node("Less", &[&queries, &keys], vec![]);
        Ok(self.cast(&later, DataType::Float))
    }

    pub(super) fn product(
        &mut self,
        x: Value,
        weight: ParameterId,
        bias: Option<ParameterId>,
        convolution: Convolution,
    ) -> Result<Value> {
        let outputs = self.outputs("conv1d", x, weight)?;
        let name = self.first("conv1d", x)?;
        let Convolution { taps, stride, padding, dilation } = convolution;
        let [taps, stride, padding, dilation] = [taps, stride, padding, dilation].map(|n| n as i64);
        let along = |n: i64, other: i64| match self.form {
            Form::Line => vec![n],
            Form::Image => vec![other, n],
        };
        let pads = match self.form {
            Form::Line => vec![padding, padding],
            Form::Image => vec![0, padding, 0, padding],
        };
        let attributes = vec![
            integers("kernel_shape", &along(taps, 1)),
            integers("strides", &along(stride, 1)),
            integers("dilations", &along(dilation, 1)),
            integers("pads", &pads),
        ];
        let mut inputs = vec![name, self.weight(weight, Use::Convolution)];
        if let Some(bias) = bias {
            inputs.push(self.weight(bias, Use::Plain));
        }
        let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
        let y = self.node("Conv", &inputs, attributes);
        Ok(self.new_first(outputs, y))
    }

    /// Returns the outputs of a weight, and checks its inputs.
    pub(super) fn outputs(
        &self,
        operation: &'static str,
        x: Value,
        weight: ParameterId,
    ) -> Result<usize> {
        let parameter = self.list.get(weight);
        match parameter.shape.as_slice() {
            &[outputs, inputs, ..] if inputs == x.channels => Ok(outputs),
            shape => Err(GraphError::shape(
                operation,
                format!("input has {} channels, {} has {shape:?}", x.channels, parameter.name),
            )),
        }
    }
}
