//! Batches in order, made ahead by threads of their own so that a step never waits.

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::store::StoreError;

use super::batch::Batch;
use super::learner::{Ownership, all_windows};
use super::window::Windows;

/// Batches that each thread makes ahead.
const AHEAD: usize = 2;

/// Gives the batches of training, one after the other.
///
/// Window number i of training is number i mod n of the order of epoch ⌊i / n⌋, n windows an epoch: a
/// batch may reach over the end of an epoch, and none is left out. So a batch depends on its number
/// alone, whichever thread makes it.
pub struct Loader {
    threads: Vec<JoinHandle<()>>,
    batches: Vec<Receiver<Result<Batch, StoreError>>>,
    next: u64,
    waited: Duration,
}

impl Loader {
    /// Starts threads that make batches of `batch_size` windows, from batch number `first` on.
    pub fn start(
        windows: &Arc<Windows>,
        batch_size: usize,
        first: u64,
        n_threads: NonZeroUsize,
    ) -> Self {
        Self::start_some(windows, batch_size, first, n_threads, &all_windows())
    }

    /// Starts as [`Loader::start`] does, for a process that learns from some windows of each batch alone.
    pub fn start_some(
        windows: &Arc<Windows>,
        batch_size: usize,
        first: u64,
        n_threads: NonZeroUsize,
        ownership: &Ownership,
    ) -> Self {
        let n = n_threads.get() as u64;
        let (threads, batches) = (0..n)
            .map(|thread| {
                let (sender, receiver) = sync_channel(AHEAD);
                let (windows, ownership) = (Arc::clone(windows), Arc::clone(ownership));
                let work = move || {
                    let mut order = Order::default();
                    for number in (first + thread..).step_by(n as usize) {
                        let wanted = order.batch(&windows, number, batch_size);
                        let batch = windows.train_some(&wanted, &ownership);
                        let failed = batch.is_err();
                        // The receiver is dropped once training is over.
                        if sender.send(batch).is_err() || failed {
                            return;
                        }
                    }
                };
                (std::thread::spawn(work), receiver)
            })
            .unzip();
        Self { threads, batches, next: 0, waited: Duration::ZERO }
    }

    /// Returns the next batch.
    ///
    /// # Errors
    /// [`StoreError`] when the frames at hand could not be read.
    ///
    /// # Panics
    /// When a thread panicked, or after an error.
    pub fn next_batch(&mut self) -> Result<Batch, StoreError> {
        let started = Instant::now();
        let thread = (self.next % self.batches.len() as u64) as usize;
        let batch = self.batches[thread].recv().expect("a loader's thread goes on until dropped");
        self.next += 1;
        self.waited = started.elapsed();
        batch
    }

    /// Returns how long the last batch was waited for.
    pub fn waited(&self) -> Duration {
        self.waited
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.batches.clear();
        for thread in self.threads.drain(..) {
            // A panic was already reported to the thread that waited for the batch.
            thread.join().ok();
        }
    }
}

/// The orders of the epochs that a batch lies in.
#[derive(Default)]
struct Order {
    epochs: Vec<(u64, Vec<u32>)>,
}

impl Order {
    fn batch(&mut self, windows: &Windows, number: u64, batch_size: usize) -> Vec<(u64, u32)> {
        let (n, first) = (windows.n_train() as u64, number * batch_size as u64);
        (first..first + batch_size as u64)
            .map(|i| (i, self.of(windows, i / n)[(i % n) as usize]))
            .collect()
    }

    fn of(&mut self, windows: &Windows, epoch: u64) -> &[u32] {
        if let Some(i) = self.epochs.iter().position(|(e, _)| *e == epoch) {
            return &self.epochs[i].1;
        }
        self.epochs.retain(|(e, _)| e + 1 == epoch);
        self.epochs.push((epoch, windows.order(epoch)));
        let last = self.epochs.len() - 1;
        &self.epochs[last].1
    }
}
