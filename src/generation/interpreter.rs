//! Workers of our own interpreter, which engines of every family run their networks by.

use std::num::NonZeroUsize;

use ndarray::Array3;

use super::pool::Pool;
use crate::autodiff::{Arena, Tensor, Threads};

/// Name of the interpreter in flags and tables.
pub const EAGER: &str = "eager";

/// Threads of a worker and the memory of its results.
struct EagerWorker {
    threads: Threads,
    arena: Arena<f32>,
}

/// Workers that run networks side by side.
pub struct EagerWorkers(Pool<EagerWorker>);

impl EagerWorkers {
    /// Starts so many workers of so many threads each.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn start((n_workers, n_threads): (NonZeroUsize, NonZeroUsize)) -> std::io::Result<Self> {
        let worker =
            |_| Ok(EagerWorker { threads: Threads::start(n_threads)?, arena: Arena::default() });
        let workers = (0..n_workers.get()).map(worker).collect::<std::io::Result<Vec<_>>>()?;
        Ok(Self(Pool::new(workers)))
    }

    /// Returns how many calls run at once.
    pub fn n_workers(&self) -> usize {
        self.0.len()
    }

    /// Does work on the threads of a worker, in its memory.
    pub fn run<R: Send>(&self, work: impl FnOnce(&Arena<f32>) -> R + Send) -> R {
        self.0.with(|EagerWorker { threads, arena }| threads.run(|| work(arena)))
    }
}

/// Returns a tensor of three axes as an array.
pub fn to_array(x: &Tensor<f32>) -> Array3<f32> {
    let [a, b, c] = x.shape() else { unreachable!("networks return three axes") };
    Array3::from_shape_vec((*a, *b, *c), x.data().to_vec()).expect("as many as its shape says")
}
