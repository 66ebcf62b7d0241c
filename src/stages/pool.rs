//! Workers that take tasks from one queue, within a budget of memory.

use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Memory that the work under way may take.
pub struct Budget {
    total_bytes: u64,
    used_bytes: Mutex<u64>,
    freed: Condvar,
}

/// A share of a [`Budget`], given back when it is dropped.
pub struct BudgetShare<'a> {
    budget: &'a Budget,
    bytes: u64,
}

impl Budget {
    pub fn new(total_bytes: u64) -> Self {
        Self { total_bytes, used_bytes: Mutex::new(0), freed: Condvar::new() }
    }

    /// Waits until `bytes` are free; a request for more than the whole budget waits until all of it is free.
    pub fn take(&self, bytes: u64) -> BudgetShare<'_> {
        let bytes = bytes.min(self.total_bytes);
        let mut used = lock(&self.used_bytes);
        while *used + bytes > self.total_bytes {
            used = self.freed.wait(used).unwrap_or_else(PoisonError::into_inner);
        }
        *used += bytes;
        BudgetShare { budget: self, bytes }
    }
}

impl Drop for BudgetShare<'_> {
    fn drop(&mut self) {
        *lock(&self.budget.used_bytes) -= self.bytes;
        self.budget.freed.notify_all();
    }
}

pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Does all tasks that `next` gives, on `n_workers` threads, until one returns an error.
///
/// `next` runs under a lock, so that tasks begin in its order; `work` runs beside the others.
///
/// # Errors
/// The first error of `work`.
pub fn run<T: Send, E: Send>(
    n_workers: NonZeroUsize,
    next: impl FnMut() -> Option<T> + Send,
    work: impl Fn(T) -> Result<(), E> + Sync,
) -> Result<(), E> {
    let next = Mutex::new(next);
    let stop = AtomicBool::new(false);
    let outcome = Mutex::new(Ok(()));
    std::thread::scope(|scope| {
        for _ in 0..n_workers.get() {
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    // The lock must not be held while the task is done.
                    let task = (lock(&next))();
                    let Some(task) = task else { return };
                    if let Err(e) = work(task) {
                        stop.store(true, Ordering::Relaxed);
                        let mut outcome = lock(&outcome);
                        if outcome.is_ok() {
                            *outcome = Err(e);
                        }
                    }
                }
            });
        }
    });
    outcome.into_inner().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicU64;

    #[test]
    fn every_task_is_done_once_and_within_the_budget() {
        let budget = Budget::new(10);
        let (in_use, sum) = (AtomicU64::new(0), AtomicU64::new(0));
        let mut tasks = (1..=50u64).collect::<Vec<_>>().into_iter();
        let done: Result<(), ()> = run(
            NonZeroUsize::new(3).expect("3 is not 0"),
            || tasks.next(),
            |task| {
                // Shares of 0 to 12, the largest of which are more than there is.
                let bytes = task % 13;
                let _share = budget.take(bytes);
                let now = in_use.fetch_add(bytes.min(10), Ordering::SeqCst) + bytes.min(10);
                assert!(now <= 10, "{now}");
                sum.fetch_add(task, Ordering::SeqCst);
                in_use.fetch_sub(bytes.min(10), Ordering::SeqCst);
                Ok(())
            },
        );
        assert_eq!((done, sum.into_inner()), (Ok(()), 50 * 51 / 2));
    }

    #[test]
    fn an_error_ends_the_work() {
        let mut tasks = 0..1000;
        let n_done = AtomicU64::new(0);
        let done = run(
            NonZeroUsize::MIN,
            || tasks.next(),
            |task| {
                n_done.fetch_add(1, Ordering::SeqCst);
                if task == 3 { Err("three") } else { Ok(()) }
            },
        );
        assert_eq!((done, n_done.into_inner()), (Err("three"), 4));
    }
}
