//! A few things that many threads want, one at a time each.

use std::sync::{Condvar, Mutex, PoisonError};

/// Lends its things out; who finds none waits.
#[derive(Debug)]
pub struct Pool<T> {
    idle: Mutex<Vec<T>>,
    returned: Condvar,
    n: usize,
}

impl<T> Pool<T> {
    /// Holds some things.
    ///
    /// # Panics
    /// If there are none: every borrower would wait for ever.
    pub fn new(things: Vec<T>) -> Self {
        assert!(!things.is_empty(), "a pool lends something");
        Self { n: things.len(), idle: Mutex::new(things), returned: Condvar::new() }
    }

    /// Returns how many things there are, lent or not.
    pub fn len(&self) -> usize {
        self.n
    }

    /// Returns whether there is nothing; never.
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// Borrows a thing for as long as `work` takes; it comes back even when `work` panics.
    pub fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        struct PoolLoan<'a, T> {
            pool: &'a Pool<T>,
            thing: Option<T>,
        }
        impl<T> Drop for PoolLoan<'_, T> {
            fn drop(&mut self) {
                let mut idle = self.pool.idle.lock().unwrap_or_else(PoisonError::into_inner);
                idle.extend(self.thing.take());
                self.pool.returned.notify_one();
            }
        }
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let thing = loop {
            match idle.pop() {
                Some(thing) => break thing,
                None => idle = self.returned.wait(idle).unwrap_or_else(PoisonError::into_inner),
            }
        };
        drop(idle);
        let mut lent = PoolLoan { pool: self, thing: Some(thing) };
        work(lent.thing.as_mut().expect("lent until it is dropped"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn no_more_borrow_at_once_than_there_are_things() {
        let pool = Pool::new(vec![0_u32, 0, 0]);
        let (now, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..11 {
                scope.spawn(|| {
                    for _ in 0..50 {
                        pool.with(|count| {
                            most.fetch_max(
                                now.fetch_add(1, Ordering::SeqCst) + 1,
                                Ordering::SeqCst,
                            );
                            *count += 1;
                            std::thread::yield_now();
                            now.fetch_sub(1, Ordering::SeqCst);
                        });
                    }
                });
            }
        });
        assert!(most.load(Ordering::SeqCst) <= 3);
        let total: u32 = pool.idle.lock().unwrap().iter().sum();
        assert_eq!(total, 550);
    }

    #[test]
    fn a_thing_comes_back_from_a_panic() {
        let pool = Pool::new(vec![7]);
        let broken = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            pool.with(|_| panic!("broken"));
        }));
        assert!(broken.is_err());
        assert_eq!(pool.with(|x| *x), 7);
        assert_eq!(pool.len(), 1);
    }
}
