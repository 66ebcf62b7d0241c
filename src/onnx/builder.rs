//! Collects the nodes, weights, inputs and outputs of an ONNX graph.
//!
//! What the operations are is in [`super::operations`]; here they get names, forms and storage.

use std::collections::BTreeMap;

use half::f16;

use crate::model::{GraphError, ParameterId, ParameterList, Result, Role};

use super::literals::{float_tensor, integer, integers, quantized, signed, transposed, value_info};
use super::proto::{Attribute, DataType, Graph, Node, Size, Tensor, ValueInfo};
use super::storage::Storage;

/// How convolutions see frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Form {
    /// \[batch, channels, frames\]: one axis.
    Line,
    /// \[batch, channels, 1, frames\]: an image of one row, for which onnxruntime has blocked kernels.
    #[default]
    Image,
}

/// Which axes a value has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axes {
    /// \[batch, frames, channels\]
    Frames,
    /// \[batch, channels\]
    Samples,
    /// \[batch\]
    Batch,
    /// \[batch, frames\]
    Mask,
    /// \[channels\]
    Channels,
}

/// A value of the graph that is being written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Value {
    pub(super) id: usize,
    pub(super) axes: Axes,
    /// Channels, where it has any.
    pub(super) channels: usize,
    /// Whether it holds int64.
    pub(super) integer: bool,
}

/// The names under which a value exists.
#[derive(Clone, Debug, Default)]
struct Names {
    /// With channels last, as networks speak of it.
    last: Option<String>,
    /// With channels before frames, as convolutions want it.
    first: Option<String>,
}

/// Where a weight is used, which decides its axes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Use {
    /// As it is.
    Plain,
    /// As the right side of a product: \[in, out\].
    Transposed,
    /// As a convolution's, with as many axes as the form asks for.
    Convolution,
    /// As a vector along the channels of [`Form`].
    AlongChannels,
}

/// Writes what a network does as ONNX nodes; a [`Graph`](crate::model::Graph).
pub struct Builder<'p> {
    pub(super) list: &'p ParameterList,
    weights: &'p dyn Fn(ParameterId) -> Vec<f32>,
    pub(super) form: Form,
    storage: Storage,
    nodes: Vec<Node>,
    initializers: Vec<Tensor>,
    inputs: Vec<ValueInfo>,
    outputs: Vec<ValueInfo>,
    values: Vec<Names>,
    /// How often a name was used.
    used: BTreeMap<String, usize>,
    /// Weights and constants that exist, by what they are.
    known: BTreeMap<(String, Use), String>,
    /// The prefix of the names of the nodes that follow.
    label: String,
}

/// Names an axis of an input or output.
fn name_axis(info: Option<&mut ValueInfo>, axis: usize, name: &str) {
    let shape = info.and_then(|info| info.r#type.as_mut());
    let shape = shape.and_then(|t| t.tensor_type.as_mut()).and_then(|t| t.shape.as_mut());
    if let Some(dimension) = shape.and_then(|shape| shape.dim.get_mut(axis)) {
        dimension.value = Some(Size::Name(name.to_owned()));
    }
}

impl<'p> Builder<'p> {
    /// Begins with a network's parameters and where their values come from, in PyTorch's layout.
    pub fn new(
        list: &'p ParameterList,
        weights: &'p dyn Fn(ParameterId) -> Vec<f32>,
        form: Form,
        storage: Storage,
    ) -> Self {
        Self {
            list,
            weights,
            form,
            storage,
            nodes: Vec::new(),
            initializers: Vec::new(),
            inputs: Vec::new(),
            outputs: Vec::new(),
            values: Vec::new(),
            used: BTreeMap::new(),
            known: BTreeMap::new(),
            label: String::new(),
        }
    }

    /// Adds an input of numbers.
    pub fn input(&mut self, name: &str, axes: Axes, channels: usize, meaning: &str) -> Value {
        self.described(name, axes, channels, DataType::Float, meaning)
    }

    /// Adds an input of \[batch, frames, channels\] whose frames are not those of other inputs.
    pub fn framed_input(
        &mut self,
        name: &str,
        frames: &str,
        channels: usize,
        meaning: &str,
    ) -> Value {
        let value = self.input(name, Axes::Frames, channels, meaning);
        self.name_axis(1, frames);
        value
    }

    /// Adds an input whose samples are not those of other inputs.
    pub fn batched_input(
        &mut self,
        name: &str,
        axes: Axes,
        batch: &str,
        channels: usize,
        meaning: &str,
    ) -> Value {
        let value = self.input(name, axes, channels, meaning);
        self.name_axis(0, batch);
        value
    }

    /// Names an axis of the input that was added last.
    pub(super) fn name_axis(&mut self, axis: usize, name: &str) {
        name_axis(self.inputs.last_mut(), axis, name);
    }

    /// Names an axis of the output that was added last.
    pub(super) fn name_output_axis(&mut self, axis: usize, name: &str) {
        name_axis(self.outputs.last_mut(), axis, name);
    }

    /// Adds an input of whole numbers.
    pub fn integer_input(&mut self, name: &str, axes: Axes, meaning: &str) -> Value {
        self.described(name, axes, 0, DataType::Int64, meaning)
    }

    /// Adds an input that is 0 for every sample where it is not given.
    ///
    /// It has an initializer of its name, of a batch of one, which is repeated over the batch; the first
    /// axis has a name of its own, since it may be 1 where the batch is more.
    pub fn optional_input(
        &mut self,
        name: &str,
        axes: Axes,
        channels: usize,
        meaning: &str,
    ) -> Value {
        let value = self.described(name, axes, channels, DataType::Float, meaning);
        let mut dims = vec![1];
        if axes == Axes::Samples {
            dims.push(channels as i64);
        }
        self.name_axis(0, "batch or 1");
        self.initializers.push(float_tensor(name.to_owned(), dims, &vec![0.0; channels.max(1)]));
        value
    }

    fn described(
        &mut self,
        name: &str,
        axes: Axes,
        channels: usize,
        data_type: DataType,
        meaning: &str,
    ) -> Value {
        self.inputs.push(value_info(name, axes, channels, data_type, meaning));
        self.used.insert(name.to_owned(), 1);
        let names = Names { last: Some(name.to_owned()), first: None };
        let integer = data_type == DataType::Int64;
        Value { integer, ..self.value(axes, channels, names) }
    }

    /// Names an output.
    ///
    /// # Errors
    /// None that a network written over `Graph` can bring about.
    pub fn output(&mut self, name: &str, value: Value, meaning: &str) -> Result<()> {
        let last = self.last(value)?;
        self.nodes.push(Node {
            input: vec![last],
            output: vec![name.to_owned()],
            name: name.to_owned(),
            op_type: "Identity".to_owned(),
            ..Node::default()
        });
        let data_type = if value.integer { DataType::Int64 } else { DataType::Float };
        self.outputs.push(value_info(name, value.axes, value.channels, data_type, meaning));
        Ok(())
    }

    /// Returns the graph.
    pub fn finish(self, name: &str) -> Graph {
        Graph {
            node: self.nodes,
            name: name.to_owned(),
            initializer: self.initializers,
            input: self.inputs,
            output: self.outputs,
        }
    }

    /// Names the nodes that come after a parameter's layer, or after an operation.
    pub(super) fn begin(&mut self, operation: &str, parameter: Option<ParameterId>) {
        self.label = match parameter {
            None => operation.to_owned(),
            Some(id) => {
                let name = &self.list.get(id).name;
                name.rsplit_once('.').map_or(name.as_str(), |(layer, _)| layer).to_owned()
            }
        };
    }

    fn unique(&mut self, name: String) -> String {
        let n = self.used.entry(name.clone()).or_default();
        *n += 1;
        if *n == 1 { name } else { format!("{name}_{n}") }
    }

    /// Adds a node and returns the name of its result.
    pub(super) fn node(
        &mut self,
        op_type: &str,
        inputs: &[&str],
        attributes: Vec<Attribute>,
    ) -> String {
        self.nodes_of(op_type, inputs, attributes, 1).remove(0)
    }

    /// Adds a node with several results.
    pub(super) fn nodes_of(
        &mut self,
        op_type: &str,
        inputs: &[&str],
        attribute: Vec<Attribute>,
        n: usize,
    ) -> Vec<String> {
        let name = self.unique(format!("{}/{op_type}", self.label));
        let output: Vec<String> = match n {
            1 => vec![name.clone()],
            _ => (0..n).map(|i| format!("{name}:{i}")).collect(),
        };
        self.nodes.push(Node {
            input: inputs.iter().map(|&x| x.to_owned()).collect(),
            output: output.clone(),
            name,
            op_type: op_type.to_owned(),
            attribute,
            domain: String::new(),
        });
        output
    }

    fn value(&mut self, axes: Axes, channels: usize, names: Names) -> Value {
        self.values.push(names);
        Value { id: self.values.len() - 1, axes, channels, integer: false }
    }

    /// A value whose tensor has channels last, or none.
    pub(super) fn new_last(&mut self, axes: Axes, channels: usize, name: String) -> Value {
        self.value(axes, channels, Names { last: Some(name), first: None })
    }

    /// Whole numbers.
    pub(super) fn new_index(&mut self, axes: Axes, name: String) -> Value {
        Value { integer: true, ..self.new_last(axes, 0, name) }
    }

    /// A value of frames whose tensor has channels before frames.
    pub(super) fn new_first(&mut self, channels: usize, name: String) -> Value {
        self.value(Axes::Frames, channels, Names { last: None, first: Some(name) })
    }

    /// Returns whether a value exists with channels last.
    pub(super) fn has_last(&self, value: Value) -> bool {
        self.values[value.id].last.is_some()
    }

    /// Returns the name of a value with channels last, and transposes it if need be.
    pub(super) fn last(&mut self, value: Value) -> Result<String> {
        let Names { last, first } = self.values[value.id].clone();
        if let Some(name) = last {
            return Ok(name);
        }
        let first = first.expect("a value exists in one form at least");
        let line = match self.form {
            Form::Line => first,
            Form::Image => {
                let axes = self.integers(&[2]);
                self.node("Squeeze", &[&first, &axes], vec![])
            }
        };
        let name = self.node("Transpose", &[&line], vec![integers("perm", &[0, 2, 1])]);
        self.values[value.id].last = Some(name.clone());
        Ok(name)
    }

    /// Returns the name of a value of frames with channels before frames.
    pub(super) fn first(&mut self, operation: &'static str, value: Value) -> Result<String> {
        expect(operation, value, Axes::Frames)?;
        let Names { last, first } = self.values[value.id].clone();
        if let Some(name) = first {
            return Ok(name);
        }
        let last = last.expect("a value exists in one form at least");
        let line = self.node("Transpose", &[&last], vec![integers("perm", &[0, 2, 1])]);
        let name = match self.form {
            Form::Line => line,
            Form::Image => {
                let axes = self.integers(&[2]);
                self.node("Unsqueeze", &[&line, &axes], vec![])
            }
        };
        self.values[value.id].first = Some(name.clone());
        Ok(name)
    }

    /// Returns a constant vector of whole numbers.
    pub(super) fn integers(&mut self, numbers: &[i64]) -> String {
        let words: Vec<String> = numbers.iter().map(i64::to_string).collect();
        self.constant(format!("constant/{}", words.join(",")), |name| Tensor {
            dims: vec![numbers.len() as i64],
            data_type: DataType::Int64.into(),
            name,
            raw_data: numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ..Tensor::default()
        })
    }

    /// Returns a constant whole number, without axes.
    pub(super) fn integer(&mut self, number: i64) -> String {
        self.constant(format!("constant/{number}_scalar"), |name| Tensor {
            data_type: DataType::Int64.into(),
            name,
            raw_data: number.to_le_bytes().to_vec().into(),
            ..Tensor::default()
        })
    }

    /// Returns a constant number, without axes.
    pub(super) fn number(&mut self, number: f64) -> String {
        let number = number as f32;
        self.constant(format!("constant/{number:?}_f32"), |name| {
            float_tensor(name, vec![], &[number])
        })
    }

    /// Returns a constant tensor, which is known by its name.
    pub(super) fn numbers(&mut self, name: &str, dims: &[usize], numbers: &[f32]) -> String {
        self.constant(name.to_owned(), |name| float_tensor(name, signed(dims), numbers))
    }

    /// Returns a new constant tensor.
    pub(super) fn table(&mut self, dims: &[usize], numbers: &[f32]) -> String {
        let name = self.unique(format!("{}/table", self.label));
        self.initializers.push(float_tensor(name.clone(), signed(dims), numbers));
        name
    }

    fn constant(&mut self, what: String, make: impl FnOnce(String) -> Tensor) -> String {
        let key = (what.clone(), Use::Plain);
        if let Some(name) = self.known.get(&key) {
            return name.clone();
        }
        let name = self.unique(what);
        self.initializers.push(make(name.clone()));
        self.known.insert(key, name.clone());
        name
    }

    /// Returns a parameter as a use of it wants it.
    pub(super) fn weight(&mut self, id: ParameterId, r#use: Use) -> String {
        let parameter = self.list.get(id);
        let key = (parameter.name.clone(), r#use);
        if let Some(name) = self.known.get(&key) {
            return name.clone();
        }
        let mut values = (self.weights)(id);
        let mut dims = parameter.shape.clone();
        // Axes behind the channels.
        let behind = match self.form {
            Form::Line => 1,
            Form::Image => 2,
        };
        match r#use {
            Use::Plain => {}
            Use::Transposed => {
                values = transposed(&values, dims[0], dims[1]);
                dims.swap(0, 1);
            }
            Use::Convolution => {
                // A linear layer over frames is a convolution with one tap.
                let taps = dims.get(2).copied().unwrap_or(1);
                dims.truncate(2);
                dims.extend(std::iter::repeat_n(1, behind - 1));
                dims.push(taps);
            }
            Use::AlongChannels => dims.extend(std::iter::repeat_n(1, behind)),
        }
        // The first use has the parameter's name; a second one in other axes is a copy.
        let suffix = if r#use == Use::Transposed { ".transposed" } else { "" };
        let name = self.unique(format!("{}{suffix}", parameter.name));
        let is_weight = parameter.role == Role::Weight;
        let storage = if is_weight { self.storage } else { Storage::Fp32 };
        let used = match storage {
            Storage::Fp32 => {
                self.initializers.push(float_tensor(name.clone(), signed(&dims), &values));
                name
            }
            Storage::Fp16 => {
                let raw_data = values.iter().flat_map(|&x| f16::from_f32(x).to_le_bytes());
                self.initializers.push(Tensor {
                    dims: signed(&dims),
                    data_type: DataType::Float16.into(),
                    name: name.clone(),
                    raw_data: raw_data.collect(),
                    ..Tensor::default()
                });
                self.node("Cast", &[&name], vec![integer("to", DataType::Float as i64)])
            }
            Storage::Int8 => {
                let axis = usize::from(r#use == Use::Transposed);
                let (bytes, scales) = quantized(&values, &dims, axis);
                self.initializers.push(Tensor {
                    dims: signed(&dims),
                    data_type: DataType::Int8.into(),
                    name: name.clone(),
                    raw_data: bytes.into(),
                    ..Tensor::default()
                });
                let scale = format!("{name}.scale");
                let n = scales.len() as i64;
                self.initializers.push(float_tensor(scale.clone(), vec![n], &scales));
                let axis = vec![integer("axis", axis as i64)];
                self.node("DequantizeLinear", &[&name, &scale], axis)
            }
        };
        self.known.insert(key, used.clone());
        used
    }
}

/// Refuses a value whose axes are not those that an operation takes.
pub(super) fn expect(operation: &'static str, value: Value, axes: Axes) -> Result<()> {
    if value.axes == axes {
        return Ok(());
    }
    let (found, expected) = (value.axes, axes);
    Err(GraphError::shape(operation, format!("input has axes {found:?}, expected {expected:?}")))
}
