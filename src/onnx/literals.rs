//! Attributes, tensors and descriptions of values, from what they say.

use super::builder::Axes;
use super::proto::{
    Attribute, AttributeType, DataType, Dimension, Shape, Size, Tensor, TensorType, Type, ValueInfo,
};

/// An attribute that is a whole number.
pub(super) fn integer(name: &str, i: i64) -> Attribute {
    Attribute {
        name: name.to_owned(),
        i,
        r#type: AttributeType::Int.into(),
        ..Attribute::default()
    }
}

/// An attribute that is a number.
pub(super) fn float(name: &str, f: f64) -> Attribute {
    let (name, f) = (name.to_owned(), f as f32);
    Attribute { name, f, r#type: AttributeType::Float.into(), ..Attribute::default() }
}

/// An attribute that is a list of whole numbers.
pub(super) fn integers(name: &str, ints: &[i64]) -> Attribute {
    let (name, ints) = (name.to_owned(), ints.to_vec());
    Attribute { name, ints, r#type: AttributeType::Ints.into(), ..Attribute::default() }
}

/// An attribute that is a word.
pub(super) fn word(name: &str, s: &str) -> Attribute {
    let (name, s) = (name.to_owned(), s.as_bytes().to_vec());
    Attribute { name, s, r#type: AttributeType::String.into(), ..Attribute::default() }
}

pub(super) fn signed(dims: &[usize]) -> Vec<i64> {
    dims.iter().map(|&n| n as i64).collect()
}

pub(super) fn float_tensor(name: String, dims: Vec<i64>, values: &[f32]) -> Tensor {
    Tensor {
        dims,
        data_type: DataType::Float.into(),
        name,
        raw_data: values.iter().flat_map(|x| x.to_le_bytes()).collect(),
        ..Tensor::default()
    }
}

/// \[rows, columns\] → \[columns, rows\]
pub(super) fn transposed(values: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    (0..rows * columns).map(|i| values[(i % rows) * columns + i / rows]).collect()
}

/// Rounds to 8 bits: w ≈ s_o q, s_o = max |w_o| / 127 for each entry o of `axis`.
pub(super) fn quantized(values: &[f32], dims: &[usize], axis: usize) -> (Vec<u8>, Vec<f32>) {
    let inner: usize = dims[axis + 1..].iter().product();
    let output = |i: usize| (i / inner.max(1)) % dims[axis];
    let mut scales = vec![0.0_f32; dims[axis]];
    for (i, x) in values.iter().enumerate() {
        let scale = &mut scales[output(i)];
        *scale = scale.max(x.abs() / 127.0);
    }
    // A row of zeros is zeros with any scale.
    scales.iter_mut().filter(|s| **s == 0.0).for_each(|s| *s = 1.0);
    let round = |(i, x): (usize, &f32)| (x / scales[output(i)]).round() as i8 as u8;
    (values.iter().enumerate().map(round).collect(), scales)
}

pub(super) fn value_info(
    name: &str,
    axes: Axes,
    channels: usize,
    data_type: DataType,
    meaning: &str,
) -> ValueInfo {
    let open = |name: &str| Dimension { value: Some(Size::Name(name.to_owned())) };
    let fixed = Dimension { value: Some(Size::Number(channels as i64)) };
    let dim = match axes {
        Axes::Frames => vec![open("batch"), open("frames"), fixed],
        Axes::Samples => vec![open("batch"), fixed],
        Axes::Batch => vec![open("batch")],
        Axes::Mask => vec![open("batch"), open("frames")],
        Axes::Channels => vec![fixed],
    };
    let tensor_type = TensorType { elem_type: data_type.into(), shape: Some(Shape { dim }) };
    ValueInfo {
        name: name.to_owned(),
        r#type: Some(Type { tensor_type: Some(tensor_type) }),
        doc_string: meaning.to_owned(),
    }
}
