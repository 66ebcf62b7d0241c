//! Threads that stay awake between operations.

use std::num::NonZeroUsize;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Threads that share the work of operations.
pub struct Threads {
    n: NonZeroUsize,
    /// `None` for those that the process has anyway.
    pool: Option<rayon::ThreadPool>,
    /// Pools of their own for parts that are done side by side, made when they are first needed.
    parts: OnceLock<Vec<rayon::ThreadPool>>,
}

impl Threads {
    /// Starts threads.
    ///
    /// # Errors
    /// When the system gives none.
    pub fn start(n: NonZeroUsize) -> std::io::Result<Self> {
        Ok(Self { n, pool: Some(pool_of(n.get())?), parts: OnceLock::new() })
    }

    /// Uses those that the process has anyway.
    pub fn of_process() -> Self {
        let n = NonZeroUsize::new(rayon::current_num_threads()).unwrap_or(NonZeroUsize::MIN);
        Self { n, pool: None, parts: OnceLock::new() }
    }

    /// Does work on them, awake from its beginning to its end; see [`keep_awake`].
    pub fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        match &self.pool {
            Some(pool) => pool.install(|| keep_awake(work)),
            None => work(),
        }
    }

    /// Does the work of parts 0, 1, … side by side, each on its share of the threads, and returns the
    /// results in order.
    ///
    /// A small network's operations are too short to be shared out well; two halves of a batch side by
    /// side keep two threads busy all the time. Not to be called within [`Threads::run`], whose threads
    /// would be waiting meanwhile.
    ///
    /// # Panics
    /// When the work of a part does.
    pub fn side_by_side<T: Send, R: Send>(
        &self,
        parts: Vec<T>,
        work: impl Fn(T) -> R + Sync,
    ) -> Vec<R> {
        if parts.len() == 1 || self.n.get() == 1 {
            return parts.into_iter().map(|part| self.run(|| work(part))).collect();
        }
        let pools = self.parts.get_or_init(|| {
            let n_pools = parts.len().min(self.n.get());
            let each = self.n.get() / n_pools;
            (0..n_pools).filter_map(|_| pool_of(each).ok()).collect()
        });
        if pools.is_empty() {
            return parts.into_iter().map(|part| self.run(|| work(part))).collect();
        }
        // Pool i does parts i, i + the number of pools, and so on.
        let n_pools = pools.len();
        let mut shares: Vec<Vec<T>> = (0..n_pools).map(|_| Vec::new()).collect();
        let n_parts = parts.len();
        for (i, part) in parts.into_iter().enumerate() {
            shares[i % n_pools].push(part);
        }
        let work = &work;
        let done: Vec<Vec<R>> = std::thread::scope(|scope| {
            let started: Vec<_> = pools
                .iter()
                .zip(shares)
                .map(|(pool, share)| {
                    scope.spawn(move || {
                        pool.install(|| keep_awake(|| share.into_iter().map(work).collect()))
                    })
                })
                .collect();
            let join = |thread: std::thread::ScopedJoinHandle<'_, Vec<R>>| {
                thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            started.into_iter().map(join).collect()
        });
        let mut shares: Vec<_> = done.into_iter().map(Vec::into_iter).collect();
        (0..n_parts).filter_map(|i| shares[i % n_pools].next()).collect()
    }
}

fn pool_of(n: usize) -> std::io::Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new().num_threads(n).build().map_err(std::io::Error::other)
}

/// How long to wait for the other threads to take part; those that are busy elsewhere are left alone.
const PATIENCE: Duration = Duration::from_micros(200);

/// Runs work whose parallel parts follow each other within microseconds.
///
/// Between two operations of a network a thread of the pool finds nothing to do and goes to sleep; to
/// wake it takes longer than many an operation, on a virtual machine up to 50 µs. Here the other threads
/// of the pool look for work until all of it is done. The result is the same with or without.
///
/// Call it inside the pool (`pool.install(|| keep_awake(|| …))`), around a forward or a whole step.
pub fn keep_awake<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    let others = rayon::current_num_threads().saturating_sub(1);
    if others == 0 || rayon::current_thread_index().is_none() {
        return work();
    }
    let (open, done, n_started) =
        (AtomicBool::new(true), AtomicBool::new(false), AtomicUsize::new(0));
    rayon::scope(|scope| {
        for _ in 0..others {
            scope.spawn(|_| {
                // Closed before the work begins: a task that the working thread itself takes up while
                // it waits for others finds that, and does not wait for its own end.
                if !open.load(Ordering::SeqCst) {
                    return;
                }
                n_started.fetch_add(1, Ordering::SeqCst);
                while !done.load(Ordering::Acquire) {
                    if rayon::yield_now() == Some(rayon::Yield::Idle) {
                        std::hint::spin_loop();
                    }
                }
            });
        }
        // Until then this thread takes up no task.
        let started = Instant::now();
        while n_started.load(Ordering::SeqCst) < others && started.elapsed() < PATIENCE {
            std::hint::spin_loop();
        }
        open.store(false, Ordering::SeqCst);
        // Also when the work panics.
        let _finish = Finish(&done);
        work()
    })
}

/// Says that the work is done when it is dropped.
struct Finish<'a>(&'a AtomicBool);

impl Drop for Finish<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    fn pool(threads: usize) -> rayon::ThreadPool {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads")
    }

    #[test]
    fn work_gives_its_result_with_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let sum = pool(threads).install(|| {
                keep_awake(|| {
                    (0..100).map(|_| (0..64_u64).into_par_iter().sum::<u64>()).sum::<u64>()
                })
            });
            assert_eq!(sum, 100 * 2016, "{threads} threads");
        }
        assert_eq!(keep_awake(|| 7), 7, "outside of any pool");
    }

    #[test]
    fn parts_come_back_in_order_with_any_number_of_threads() {
        for n in [1, 2, 3, 5] {
            let threads = Threads::start(NonZeroUsize::new(n).expect("above 0")).expect("threads");
            for n_parts in [1, 2, 3, 4, 7] {
                let parts: Vec<u64> = (0..n_parts).collect();
                let sums = threads.side_by_side(parts, |part| {
                    (0..1000_u64).into_par_iter().map(|x| x * part).sum::<u64>()
                });
                let wanted: Vec<_> = (0..n_parts).map(|part| 499_500 * part).collect();
                assert_eq!(sums, wanted, "{n} threads");
            }
        }
        let doubled = Threads::of_process().side_by_side(vec![3, 4], |x| 2 * x);
        assert_eq!(doubled, [6, 8]);
    }

    #[test]
    fn two_at_once_in_one_pool_do_not_wait_for_each_other() {
        let work =
            |i: u64| keep_awake(move || (0..1000_u64).into_par_iter().map(|x| x + i).sum::<u64>());
        let sums = pool(2).install(|| rayon::join(|| work(1), || work(2)));
        assert_eq!(sums, (500_500, 501_500));
    }

    #[test]
    fn a_panic_in_the_work_ends_the_waiting() {
        let result = std::panic::catch_unwind(|| {
            pool(2).install(|| keep_awake(|| panic!("as intended")));
        });
        assert!(result.is_err());
    }
}
