//! Values that flow through a network.

use std::sync::Arc;

use ndarray::{ArrayD, ArrayViewD, IxDyn};

use super::arena::Arena;
use super::element::Element;
use super::tape::NodeId;

/// An array in row-major order, shared by its clones; its memory returns to the arena with the last.
#[derive(Clone, Debug)]
pub struct Tensor<E: Element> {
    value: Arc<Value<E>>,
    shape: Vec<usize>,
    /// The node that computed it, where a tape recorded that.
    pub(super) node: Option<NodeId>,
}

#[derive(Debug)]
struct Value<E: Element> {
    /// `None` only while it is dropped or moved out.
    array: Option<ArrayD<E>>,
    arena: Arena<E>,
}

impl<E: Element> Drop for Value<E> {
    fn drop(&mut self) {
        if let Some(array) = self.array.take() {
            self.arena.give(array);
        }
    }
}

impl<E: Element> Tensor<E> {
    /// Wraps an array of the arena.
    pub(super) fn new(array: ArrayD<E>, arena: &Arena<E>) -> Self {
        debug_assert!(array.is_standard_layout(), "tensors lie in order");
        let shape = array.shape().to_vec();
        let value = Value { array: Some(array), arena: arena.clone() };
        Self { value: Arc::new(value), shape, node: None }
    }

    /// Returns the values as an array.
    pub fn view(&self) -> ArrayViewD<'_, E> {
        let shape = IxDyn(&self.shape);
        ArrayViewD::from_shape(shape, self.data()).expect("the length is the product of the shape")
    }

    /// Returns the values in order.
    pub fn data(&self) -> &[E] {
        let array = self.value.array.as_ref().expect("present until dropped");
        array.as_slice().expect("tensors lie in order")
    }

    /// Returns the size of each axis.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Returns the number of values.
    pub fn len(&self) -> usize {
        self.data().len()
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the size of the last axis, 1 for a scalar.
    pub fn channels(&self) -> usize {
        self.shape().last().copied().unwrap_or(1)
    }

    /// Returns the number of rows, where the last axis is a row.
    pub fn rows(&self) -> usize {
        self.shape().split_last().map_or(1, |(_, leading)| leading.iter().product())
    }

    /// Returns the only value of a scalar.
    pub fn scalar(&self) -> E {
        assert_eq!(self.len(), 1, "a scalar, not {:?}", self.shape());
        self.data()[0]
    }

    /// Returns the values for writing, a copy of them where others see this tensor.
    pub(super) fn data_mut(&mut self) -> &mut [E] {
        if Arc::get_mut(&mut self.value).is_none() {
            let copy = self.value.arena.copy(self.shape(), self.data());
            *self = Self::new(copy, &self.value.arena.clone());
        }
        let value = Arc::get_mut(&mut self.value).expect("just made unique");
        value.array.as_mut().and_then(|a| a.as_slice_mut()).expect("tensors lie in order")
    }

    /// Returns whether this is the only reference to the values, so that they may be overwritten.
    pub(super) fn is_unique(&self) -> bool {
        Arc::strong_count(&self.value) == 1
    }

    /// Returns the same values under another shape of equal length; none is moved.
    pub(super) fn reshaped(mut self, shape: &[usize]) -> Self {
        assert_eq!(self.len(), shape.iter().product::<usize>(), "equal lengths");
        self.shape = shape.to_vec();
        self.node = None;
        self
    }
}
