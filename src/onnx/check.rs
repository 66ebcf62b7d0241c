//! The rules of ONNX that need no runtime to be checked.
//!
//! From `onnx/checker.cc` and the specification (<https://onnx.ai/onnx/repo-docs/IR.html>): versions,
//! single assignment, order, arity, attribute types, sizes of tensors; and one of our own, that no weight
//! lies about unused.

use std::collections::BTreeSet;

use super::error::OnnxError;
use super::file::{IR_VERSION, OPSET};
use super::proto::{AttributeType, DataType, Graph, Model, Node, Tensor};

/// The operators that are written: name, fewest and most inputs, attributes.
///
/// Versions: the newest of each up to opset 21 (<https://onnx.ai/onnx/operators>).
const OPERATORS: [(&str, usize, usize, &[&str]); 45] = [
    ("Add", 2, 2, &[]),
    ("ArgMax", 1, 1, &["axis", "keepdims"]),
    ("Cast", 1, 1, &["to"]),
    ("Concat", 1, usize::MAX, &["axis"]),
    ("Conv", 2, 3, &["kernel_shape", "strides", "dilations", "pads", "group"]),
    ("Cos", 1, 1, &[]),
    ("DequantizeLinear", 2, 3, &["axis"]),
    ("Div", 2, 2, &[]),
    ("Equal", 2, 2, &[]),
    ("Expand", 2, 2, &[]),
    ("Gather", 2, 2, &["axis"]),
    ("Gelu", 1, 1, &["approximate"]),
    ("Greater", 2, 2, &[]),
    ("Identity", 1, 1, &[]),
    ("InstanceNormalization", 3, 3, &["epsilon"]),
    ("LayerNormalization", 2, 3, &["axis", "epsilon"]),
    ("LeakyRelu", 1, 1, &["alpha"]),
    ("Less", 2, 2, &[]),
    ("MatMul", 2, 2, &[]),
    ("Max", 1, usize::MAX, &[]),
    ("Min", 1, usize::MAX, &[]),
    ("Mish", 1, 1, &[]),
    ("Mod", 2, 2, &[]),
    ("Mul", 2, 2, &[]),
    ("Pad", 2, 4, &["mode"]),
    ("Range", 3, 3, &[]),
    ("ReduceL2", 1, 2, &["keepdims"]),
    ("ReduceMean", 1, 2, &["keepdims"]),
    ("ReduceSum", 1, 2, &["keepdims"]),
    ("Relu", 1, 1, &[]),
    ("Reshape", 2, 2, &[]),
    ("Resize", 1, 4, &["mode", "coordinate_transformation_mode", "nearest_mode"]),
    ("Shape", 1, 1, &["start", "end"]),
    ("Sigmoid", 1, 1, &[]),
    ("Sin", 1, 1, &[]),
    ("Slice", 3, 5, &[]),
    ("Softmax", 1, 1, &["axis"]),
    ("Split", 1, 2, &["axis", "num_outputs"]),
    ("Sqrt", 1, 1, &[]),
    ("Squeeze", 1, 2, &[]),
    ("Sub", 2, 2, &[]),
    ("Tanh", 1, 1, &[]),
    ("Transpose", 1, 1, &["perm"]),
    ("Unsqueeze", 2, 2, &[]),
    ("Where", 3, 3, &[]),
];

/// Refuses a model that breaks a rule; `place` is what messages call it.
///
/// # Errors
/// [`OnnxError::Check`] with the first rule that is broken.
pub fn check(model: &Model, place: &str) -> Result<(), OnnxError> {
    let refuse = |problem: String| OnnxError::Check { place: place.to_owned(), problem };
    if model.ir_version != IR_VERSION {
        let found = model.ir_version;
        return Err(refuse(format!(
            "has IR version {found}, opset {OPSET} goes with {IR_VERSION}"
        )));
    }
    if model.opset_import.len() != 1 || model.opset() != OPSET {
        return Err(refuse(format!("must import opset {OPSET} of the standard domain alone")));
    }
    let graph = model.graph.as_ref().ok_or_else(|| refuse("has no graph".to_owned()))?;
    graph_rules(graph).map_err(refuse)
}

fn graph_rules(graph: &Graph) -> Result<(), String> {
    let mut known: BTreeSet<&str> = BTreeSet::new();
    for input in &graph.input {
        if input.name.is_empty() || !known.insert(&input.name) {
            return Err(format!("input \"{}\" has no name of its own", input.name));
        }
        let tensor = input.r#type.as_ref().and_then(|t| t.tensor_type.as_ref());
        if tensor.is_none_or(|t| t.elem_type == 0 || t.shape.is_none()) {
            return Err(format!("input {} has no type or no shape", input.name));
        }
    }
    let inputs = known.clone();
    let mut initializers = BTreeSet::new();
    for tensor in &graph.initializer {
        tensor_rules(tensor)?;
        // An initializer of an input's name is the input's default.
        let is_new = known.insert(&tensor.name) || inputs.contains(tensor.name.as_str());
        if !is_new || !initializers.insert(tensor.name.as_str()) {
            return Err(format!("initializer {} exists twice", tensor.name));
        }
    }
    let mut used: BTreeSet<&str> = BTreeSet::new();
    let mut names = BTreeSet::new();
    for node in &graph.node {
        node_rules(node)?;
        if !names.insert(&node.name) {
            return Err(format!("two nodes are called {}", node.name));
        }
        for input in node.input.iter().filter(|name| !name.is_empty()) {
            if !known.contains(input.as_str()) {
                return Err(format!("node {} reads {input} before it is made", node.name));
            }
            used.insert(input);
        }
        for output in &node.output {
            if output.is_empty() || !known.insert(output) {
                return Err(format!("node {} writes {output}, which exists", node.name));
            }
        }
    }
    for output in &graph.output {
        if !known.contains(output.name.as_str()) {
            return Err(format!("output {} is made by no node", output.name));
        }
    }
    match initializers.difference(&used).next() {
        Some(name) => Err(format!("initializer {name} is used by no node")),
        None => Ok(()),
    }
}

fn tensor_rules(tensor: &Tensor) -> Result<(), String> {
    let name = &tensor.name;
    let size = match DataType::try_from(tensor.data_type) {
        Ok(DataType::Float) => 4,
        Ok(DataType::Float16) => 2,
        Ok(DataType::Int8 | DataType::Bool) => 1,
        Ok(DataType::Int64) => 8,
        _ => return Err(format!("initializer {name} has elements of a kind that is not written")),
    };
    let location = tensor.external_data.iter().find(|entry| entry.key == "location");
    if let Some(location) = location.map(|entry| entry.value.as_str())
        && (location.contains(['/', '\\']) || location.starts_with('.'))
    {
        return Err(format!(
            "initializer {name} lies in {location:?}, which is not beside the file"
        ));
    }
    let n =
        tensor.dims.iter().try_fold(1_usize, |n, &dim| n.checked_mul(usize::try_from(dim).ok()?));
    let expected = n.and_then(|n| n.checked_mul(size));
    if expected != Some(tensor.raw_data.len()) && tensor.external_data.is_empty() {
        let (dims, found) = (&tensor.dims, tensor.raw_data.len());
        return Err(format!("initializer {name} has {found} bytes for the shape {dims:?}"));
    }
    Ok(())
}

fn node_rules(node: &Node) -> Result<(), String> {
    let (name, op) = (&node.name, node.op_type.as_str());
    if !node.domain.is_empty() {
        return Err(format!("node {name} is of the domain {}, which is not standard", node.domain));
    }
    let Some((_, least, most, attributes)) = OPERATORS.iter().find(|(known, ..)| *known == op)
    else {
        return Err(format!("node {name} is a {op}, which this program does not write"));
    };
    let n = node.input.len();
    if n < *least || n > *most {
        return Err(format!("node {name} has {n} inputs; {op} takes {least} to {most}"));
    }
    for attribute in &node.attribute {
        if !attributes.contains(&attribute.name.as_str()) {
            return Err(format!("node {name} has the attribute {}; {op} has none", attribute.name));
        }
        if AttributeType::try_from(attribute.r#type) == Ok(AttributeType::Undefined) {
            return Err(format!("attribute {} of node {name} has no type", attribute.name));
        }
    }
    Ok(())
}
