//! Finding the first number that is not finite.

use crate::model::{GraphError, ParameterId, Result};

use super::element::Element;
use super::parameters::Parameters;
use super::tensor::Tensor;

/// Refuses a tensor that holds a NaN or an infinity, naming the operation and where.
pub fn check_finite<E: Element>(
    name: &str,
    parameter: Option<ParameterId>,
    parameters: &Parameters<E>,
    what: &'static str,
    x: &Tensor<E>,
) -> Result<()> {
    let Some(flat) = x.data().iter().position(|x| !x.is_finite()) else { return Ok(()) };
    let operation = match parameter {
        Some(id) => format!("{name} of {}", parameters.list().get(id).name),
        None => name.to_owned(),
    };
    let mut rest = flat;
    let mut index: Vec<_> = x
        .shape()
        .iter()
        .rev()
        .map(|&size| {
            let i = rest % size;
            rest /= size;
            i
        })
        .collect();
    index.reverse();
    let value = x.data()[flat].to_string();
    Err(GraphError::NonFinite { operation, what, value, index, shape: x.shape().to_vec() })
}
