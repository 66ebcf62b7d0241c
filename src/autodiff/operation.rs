//! What an operation is: a forward, a backward, and what lies between them.

use crate::model::{GraphError, ParameterId, Result};

use super::arena::Arena;
use super::element::Element;
use super::parameters::{Gradients, Parameters};
use super::random::Stream;
use super::tensor::Tensor;

/// One operation of a network, a loss or a sampler.
///
/// `forward` keeps in `self` what `backward` will need, if it is recorded. Each operation lives in a
/// file of its own below `op`, with shapes and source.
pub trait Operation<E: Element>: Send + 'static {
    /// Returns the name that messages use.
    fn name(&self) -> &'static str;

    /// Returns the first of its parameters, which tells it apart from others of its name.
    fn parameter(&self) -> Option<ParameterId> {
        None
    }

    /// Returns all of its parameters.
    fn parameters(&self) -> [Option<ParameterId>; 2] {
        [self.parameter(), None]
    }

    /// Computes the result.
    ///
    /// # Errors
    /// If the sizes of the inputs do not fit.
    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>>;

    /// Computes the gradients of the inputs from that of the result, and adds those of parameters.
    ///
    /// Returns one for each input, `None` where the input needs none (`at.needs`).
    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>>;
}

/// Where a forward runs.
pub struct Run<'a, E: Element> {
    pub parameters: &'a Parameters<E>,
    pub arena: &'a Arena<E>,
    /// Whether a backward will follow, so that what it needs must be kept.
    pub recording: bool,
    /// Random numbers of this operation, in training.
    pub random: Option<Stream>,
}

impl<E: Element> Run<'_, E> {
    /// Returns a new tensor of a shape, filled by `fill`.
    pub fn tensor(&self, shape: &[usize], fill: impl FnOnce(&mut [E])) -> Tensor<E> {
        filled(self.arena, shape, fill)
    }

    /// Returns what `backward` needs of a tensor, or nothing where none will follow.
    pub fn keep(&self, x: &Tensor<E>) -> Option<Tensor<E>> {
        self.recording.then(|| x.clone())
    }
}

/// Where a backward runs.
pub struct Backward<'a, E: Element> {
    pub parameters: &'a Parameters<E>,
    pub gradients: &'a mut Gradients<E>,
    pub arena: &'a Arena<E>,
    /// Which inputs need a gradient.
    pub needs: &'a [bool],
}

impl<E: Element> Backward<'_, E> {
    /// Returns a new tensor of a shape, filled by `fill`.
    pub fn tensor(&self, shape: &[usize], fill: impl FnOnce(&mut [E])) -> Tensor<E> {
        filled(self.arena, shape, fill)
    }

    /// Returns the gradient of the only input, if it needs one.
    pub fn only(&self, gradient: impl FnOnce() -> Tensor<E>) -> Vec<Option<Tensor<E>>> {
        vec![self.needs[0].then(gradient)]
    }
}

fn filled<E: Element>(arena: &Arena<E>, shape: &[usize], fill: impl FnOnce(&mut [E])) -> Tensor<E> {
    let mut array = arena.take(shape);
    fill(array.as_slice_mut().expect("arrays of the arena lie in order"));
    Tensor::new(array, arena)
}

/// Runs operations: what the tape and the eager interpreter have in common.
///
/// Every implementation is a [`Graph`](crate::model::Graph).
pub trait Interpreter: Sized {
    type Element: Element;

    /// Returns a value that needs no gradient.
    fn constant(&self, shape: &[usize], values: &[Self::Element]) -> Tensor<Self::Element>;

    /// Runs an operation.
    fn apply<O: Operation<Self::Element>>(
        &mut self,
        operation: O,
        inputs: &[&Tensor<Self::Element>],
    ) -> Result<Tensor<Self::Element>>;

    /// Runs a part whose inner values are not kept.
    fn run_part<F>(
        &mut self,
        inputs: &[&Tensor<Self::Element>],
        part: F,
    ) -> Result<Tensor<Self::Element>>
    where
        F: Fn(&mut Self, &[Tensor<Self::Element>]) -> Result<Tensor<Self::Element>>
            + Send
            + 'static;

    /// Returns whether this is training, in which numbers are dropped.
    fn is_training(&self) -> bool;
}

/// Refuses an input whose number of axes is not as expected.
pub fn expect_axes<E: Element>(
    operation: &'static str,
    what: &str,
    x: &Tensor<E>,
    n_axes: usize,
    axes: &str,
) -> Result<()> {
    if x.shape().len() == n_axes {
        return Ok(());
    }
    let problem = format!("{what} has shape {:?}, expected {axes}", x.shape());
    Err(GraphError::shape(operation, problem))
}

/// Refuses a size that is not the expected one.
pub fn expect_size(
    operation: &'static str,
    what: &str,
    axis: &str,
    found: usize,
    whose: &str,
    expected: usize,
) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    let problem = format!("{what} has {found} {axis}, {whose} expects {expected}");
    Err(GraphError::shape(operation, problem))
}
