//! The interpreter for inference: no tape, and buffers that return at once.

use crate::model::Result;

use super::arena::Arena;
use super::element::Element;
use super::finite::check_finite;
use super::operation::{Interpreter, Operation, Run};
use super::parameters::Parameters;
use super::tensor::Tensor;

/// Runs a network without recording it; nothing is dropped.
pub struct Eager<'p, E: Element> {
    parameters: &'p Parameters<E>,
    arena: Arena<E>,
    check_finite: bool,
}

impl<'p, E: Element> Eager<'p, E> {
    /// Runs networks with these parameters, with buffers from `arena`.
    pub fn new(parameters: &'p Parameters<E>, arena: &Arena<E>) -> Self {
        Self { parameters, arena: arena.clone(), check_finite: false }
    }

    /// Looks at every result, and stops at the first number that is not finite.
    pub fn checking_finite(mut self) -> Self {
        self.check_finite = true;
        self
    }

    /// Returns an input.
    pub fn input(&self, shape: &[usize], values: &[E]) -> Tensor<E> {
        self.constant(shape, values)
    }
}

impl<E: Element> Interpreter for Eager<'_, E> {
    type Element = E;

    fn constant(&self, shape: &[usize], values: &[E]) -> Tensor<E> {
        Tensor::new(self.arena.copy(shape, values), &self.arena)
    }

    fn apply<O: Operation<E>>(&mut self, mut operation: O, x: &[&Tensor<E>]) -> Result<Tensor<E>> {
        let (parameters, arena) = (self.parameters, &self.arena);
        let run = Run { parameters, arena, recording: false, random: None };
        let y = operation.forward(x, &run)?;
        if self.check_finite {
            check_finite(operation.name(), operation.parameter(), parameters, "result", &y)?;
        }
        Ok(y)
    }

    fn run_part<F>(&mut self, inputs: &[&Tensor<E>], part: F) -> Result<Tensor<E>>
    where
        F: Fn(&mut Self, &[Tensor<E>]) -> Result<Tensor<E>> + Send + 'static,
    {
        let inputs: Vec<_> = inputs.iter().map(|&x| x.clone()).collect();
        part(self, &inputs)
    }

    fn is_training(&self) -> bool {
        false
    }
}
