//! A parameter as a tensor.

use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, ParameterId, Result, Role};

/// A parameter that is no weight of a layer, in its own shape. No inputs.
pub struct Take(pub ParameterId);

impl<E: Element> Operation<E> for Take {
    fn name(&self) -> &'static str {
        "parameter"
    }

    fn parameter(&self) -> Option<ParameterId> {
        Some(self.0)
    }

    fn forward(&mut self, _: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let parameter = run.parameters.list().get(self.0);
        if parameter.role == Role::Weight {
            let problem =
                format!("{} is the weight of a layer, which alone can use it", parameter.name);
            return Err(GraphError::shape("parameter", problem));
        }
        let values = run.parameters.get(self.0);
        Ok(run.tensor(&parameter.shape, |y| y.copy_from_slice(values)))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        at.gradients.add(self.0, dy.data());
        Vec::new()
    }
}
