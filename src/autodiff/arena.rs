//! Buffers that come back: an array that is no longer needed serves the next one of about its size.
//!
//! A training step asks for the same sizes in the same order each time. Memory fresh from the system
//! must be cleared page by page, which costs as much as filling it; after the first step none is.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use ndarray::{Array1, ArrayD, IxDyn, s};

use super::element::Element;

/// Elements to a cache line of `f32`; every array begins on a line.
const ALIGNMENT: usize = 16;

/// A pool of arrays, shared by its clones.
#[derive(Clone, Debug)]
pub struct Arena<E>(Arc<Mutex<Pool<E>>>);

#[derive(Debug)]
struct Pool<E> {
    /// Free memory by length.
    free: BTreeMap<usize, Vec<Vec<E>>>,
    in_use: usize,
    usage: Usage,
}

/// How much memory an arena has handed out, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Usage {
    /// Held by arrays in use.
    pub in_use_bytes: usize,
    /// The most that was in use at once.
    pub peak_bytes: usize,
    /// Asked of the system so far, in use or free.
    pub reserved_bytes: usize,
}

impl<E> Pool<E> {
    /// Takes the smallest free memory of a length or up to half as much again; where there is none, gives up the next
    /// smaller one that is not below half of it.
    fn fitting(&mut self, len: usize) -> Option<Vec<E>> {
        let found = self.free.range(len..=len + len / 2).map(|(&len, _)| len).next();
        if let Some(found) = found {
            return self.remove(found);
        }
        let smaller = self.free.range(len / 2..len).map(|(&len, _)| len).next_back();
        if let Some(memory) = smaller.and_then(|smaller| self.remove(smaller)) {
            let bytes = memory.len().saturating_sub(ALIGNMENT) * size_of::<E>();
            self.usage.reserved_bytes = self.usage.reserved_bytes.saturating_sub(bytes);
        }
        None
    }

    fn remove(&mut self, len: usize) -> Option<Vec<E>> {
        let list = self.free.get_mut(&len)?;
        let memory = list.pop();
        if list.is_empty() {
            self.free.remove(&len);
        }
        memory
    }
}

/// Returns an array that begins on a cache line of some memory.
fn aligned<E>(memory: Vec<E>, len: usize) -> Array1<E> {
    let bytes = memory.as_ptr() as usize % (ALIGNMENT * size_of::<E>());
    let skip = (ALIGNMENT - bytes / size_of::<E>()) % ALIGNMENT;
    Array1::from_vec(memory).slice_move(s![skip..skip + len])
}

impl<E: Element> Default for Arena<E> {
    fn default() -> Self {
        Self(Arc::new(Mutex::new(Pool {
            free: BTreeMap::new(),
            in_use: 0,
            usage: Usage::default(),
        })))
    }
}

impl<E: Element> Arena<E> {
    /// Returns an array that begins on a cache line, cleared.
    pub fn aligned(len: usize) -> Array1<E> {
        aligned(vec![E::ZERO; len + ALIGNMENT], len)
    }

    /// Returns an array with whatever its memory held before.
    ///
    /// It lies in the smallest free memory that holds it, unless that is half as large again; where there is none, the
    /// next smaller one is given up. So numbers of rows that differ from step to step do not fill the memory.
    pub fn take(&self, shape: &[usize]) -> ArrayD<E> {
        let len = shape.iter().product();
        let found = {
            let mut pool = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let found = pool.fitting(len + ALIGNMENT);
            pool.in_use += len;
            pool.usage.in_use_bytes = pool.in_use * size_of::<E>();
            pool.usage.peak_bytes = pool.usage.peak_bytes.max(pool.usage.in_use_bytes);
            if found.is_none() {
                pool.usage.reserved_bytes += len * size_of::<E>();
            }
            found
        };
        let memory = found.unwrap_or_else(|| vec![E::ZERO; len + ALIGNMENT]);
        let flat = aligned(memory, len);
        flat.into_shape_with_order(IxDyn(shape)).expect("the length is the product of the shape")
    }

    /// Returns an array of one value.
    pub fn filled(&self, shape: &[usize], value: E) -> ArrayD<E> {
        let mut array = self.take(shape);
        array.fill(value);
        array
    }

    /// Returns a copy of numbers in order.
    pub fn copy(&self, shape: &[usize], values: &[E]) -> ArrayD<E> {
        let mut array = self.take(shape);
        array.as_slice_mut().expect("one run of memory").copy_from_slice(values);
        array
    }

    /// Takes an array back.
    pub fn give(&self, array: ArrayD<E>) {
        let len = array.len();
        let (memory, _) = array.into_raw_vec_and_offset();
        let mut pool = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        pool.in_use = pool.in_use.saturating_sub(len);
        pool.usage.in_use_bytes = pool.in_use * size_of::<E>();
        pool.free.entry(memory.len()).or_default().push(memory);
    }

    /// Returns what is in use, and what was at most.
    pub fn usage(&self) -> Usage {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).usage
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_that_was_given_back_is_the_next_of_its_length() {
        let arena = Arena::<f32>::default();
        let first = arena.take(&[3, 5]);
        let address = first.as_ptr();
        assert_eq!(address as usize % 64, 0);
        let other = arena.take(&[15]);
        assert_eq!(arena.usage().in_use_bytes, 2 * 15 * 4);
        arena.give(first);
        assert_eq!(arena.take(&[5, 3]).as_ptr(), address);
        arena.give(other);
        let usage = arena.usage();
        assert_eq!((usage.peak_bytes, usage.reserved_bytes), (120, 120));
    }

    #[test]
    fn numbers_of_rows_that_differ_do_not_fill_the_memory() {
        let arena = Arena::<f32>::default();
        let first = arena.take(&[100]);
        let address = first.as_ptr();
        arena.give(first);
        let fewer = arena.take(&[80]);
        assert_eq!((fewer.as_ptr(), fewer.len()), (address, 80));
        arena.give(fewer);
        // What is half as large again as asked for stays free for others; what is too small is given up.
        let few = arena.take(&[40]);
        assert_ne!(few.as_ptr(), address);
        assert_eq!(arena.usage().reserved_bytes, (100 + 40) * 4);
        let more = arena.take(&[120]);
        assert_eq!(arena.usage().reserved_bytes, (40 + 120) * 4);
        assert_eq!(arena.usage().in_use_bytes, (40 + 120) * 4);
        arena.give(few);
        arena.give(more);
        for n in (100..120).rev() {
            arena.give(arena.take(&[n]));
        }
        assert_eq!(arena.usage().reserved_bytes, (40 + 120) * 4);
    }
}
