//! Weights read back out of a model file, for the interpreter that needs no runtime.

use half::f16;

use crate::model::Parameter;

use super::error::OnnxError;
use super::proto::{DataType, Model, Tensor};

/// Returns the values of a parameter in PyTorch's layout, widened to f32.
///
/// # Errors
/// [`OnnxError::Missing`] and [`OnnxError::Size`] for a file that has no such weight.
pub fn values_of(model: &Model, parameter: &Parameter, place: &str) -> Result<Vec<f32>, OnnxError> {
    let graph = model.graph.as_ref();
    let find = |name: &str| graph?.initializer.iter().find(|tensor| tensor.name == name);
    let transposed = format!("{}.transposed", parameter.name);
    let (tensor, is_transposed) = match (find(&parameter.name), find(&transposed)) {
        (Some(tensor), _) => (tensor, false),
        (None, Some(tensor)) => (tensor, true),
        (None, None) => {
            let name = parameter.name.clone();
            return Err(OnnxError::Missing { place: place.to_owned(), name });
        }
    };
    let scales = find(&format!("{}.scale", tensor.name));
    let axis = usize::from(is_transposed);
    let values = widened(tensor, scales, axis);
    let expected = parameter.len();
    if values.len() != expected {
        let (name, found) = (tensor.name.clone(), values.len());
        return Err(OnnxError::Size { place: place.to_owned(), name, found, expected });
    }
    Ok(match (is_transposed, parameter.shape.as_slice()) {
        (true, &[rows, columns]) => {
            (0..expected).map(|i| values[(i % columns) * rows + i / columns]).collect()
        }
        _ => values,
    })
}

/// Returns a tensor's numbers; an empty list where its bytes are of a kind that export does not write.
fn widened(tensor: &Tensor, scales: Option<&Tensor>, axis: usize) -> Vec<f32> {
    let bytes = &tensor.raw_data;
    match DataType::try_from(tensor.data_type) {
        Ok(DataType::Float) => floats(bytes),
        Ok(DataType::Float16) => {
            let halves = bytes.chunks_exact(2);
            halves.map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect()
        }
        Ok(DataType::Int8) => {
            let scales = scales.map(|scales| floats(&scales.raw_data)).unwrap_or_default();
            let behind = tensor.dims.iter().skip(axis + 1).map(|&n| n.max(1) as usize);
            let inner: usize = behind.product();
            if scales.is_empty() || inner == 0 {
                return Vec::new();
            }
            let numbers = bytes.iter().enumerate();
            numbers.map(|(i, &b)| f32::from(b as i8) * scales[(i / inner) % scales.len()]).collect()
        }
        _ => Vec::new(),
    }
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}
