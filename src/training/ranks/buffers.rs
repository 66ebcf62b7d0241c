//! Memory of messages, used again: memory fresh from the system costs more than what is put into it.

use std::ops::Deref;
use std::sync::{Arc, Mutex, PoisonError};

/// Buffers that no message needs any more.
#[derive(Debug, Default)]
pub struct Buffers(Mutex<Vec<Vec<f32>>>);

impl Buffers {
    /// Returns a buffer with room for `n` numbers, and whatever numbers it held before.
    pub fn take(&self, n: usize) -> Vec<f32> {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // The last one is most likely to be in a cache; one that is too small would grow, and be copied on its way.
        let place = idle.iter().rposition(|buffer| buffer.capacity() >= n);
        place.map_or_else(|| Vec::with_capacity(n), |place| idle.swap_remove(place))
    }

    fn give(&self, buffer: Vec<f32>) {
        if buffer.capacity() > 0 {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).push(buffer);
        }
    }
}

/// The numbers of a message, whose memory goes back to the buffers that it came from.
#[derive(Debug)]
pub struct Numbers {
    values: Vec<f32>,
    buffers: Arc<Buffers>,
}

impl Numbers {
    /// Returns numbers whose memory goes to some buffers in the end.
    pub fn of(values: Vec<f32>, buffers: &Arc<Buffers>) -> Arc<Self> {
        Arc::new(Self { values, buffers: Arc::clone(buffers) })
    }
}

impl Deref for Numbers {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.values
    }
}

impl PartialEq for Numbers {
    fn eq(&self, other: &Self) -> bool {
        self.values == other.values
    }
}

impl Drop for Numbers {
    fn drop(&mut self) {
        self.buffers.give(std::mem::take(&mut self.values));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_a_message_serves_the_next_one_that_fits() {
        let buffers = Arc::<Buffers>::default();
        let address = |numbers: &Numbers| numbers.as_ptr();
        let [small, large] = [10, 1000].map(|n| Numbers::of(vec![1.0; n], &buffers));
        let (at_small, at_large) = (address(&small), address(&large));
        let also_small = Arc::clone(&small);
        drop((small, large));
        // One that somebody still reads is not given away.
        let (second, third) = (buffers.take(1000), buffers.take(5));
        assert_eq!(second.as_ptr(), at_large);
        assert_ne!(third.as_ptr(), at_small);
        drop(also_small);
        let (fourth, fifth) = (buffers.take(20), buffers.take(5));
        assert!(fourth.capacity() >= 20 && fourth.as_ptr() != at_small);
        assert_eq!(fifth.as_ptr(), at_small);
    }
}
