//! Motions on their way from the store to their numbers: one reads, all others measure.

use std::num::NonZeroUsize;
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, sync_channel};

use ndarray::{Array2, s};

use crate::evaluation::Measured;
use crate::evaluation::reference_statistics::ReferenceStatistics;
use crate::motion::{ChannelLimits, MOTION_DIM};
use crate::stages::extract::pool::lock;

/// Frames that are kept of all motions together, to compare the values of channels.
pub const MAX_KEPT_FRAMES: usize = 60_000;

/// How motions are measured.
pub struct Measurer<'a> {
    pub limits: ChannelLimits,
    pub reference: Option<&'a ReferenceStatistics>,
    /// Most frames of a motion that are looked at.
    pub num_frames: Option<usize>,
    /// One of so many frames is kept.
    pub stride: usize,
    pub threads: NonZeroUsize,
}

/// A motion that was measured.
pub struct Seen {
    pub measured: Measured,
    /// Every so manieth of its frames, [_, 25].
    pub kept: Array2<f32>,
}

impl Measurer<'_> {
    /// Measures the motions that `feed` gives out by number, and returns them in order of it; a number that
    /// is never given out stays empty.
    ///
    /// # Errors
    /// What `feed` says.
    pub fn run<E: Send>(
        &self,
        n: usize,
        feed: impl FnOnce(&mut dyn FnMut(usize, Array2<f32>)) -> Result<(), E>,
    ) -> Result<Vec<Option<Seen>>, E> {
        let seen: Mutex<Vec<Option<Seen>>> = Mutex::new((0..n).map(|_| None).collect());
        let (sender, receiver) = sync_channel::<(usize, Array2<f32>)>(4 * self.threads.get());
        let receiver: Mutex<Receiver<_>> = Mutex::new(receiver);
        std::thread::scope(|scope| {
            for _ in 0..self.threads.get() {
                scope.spawn(|| {
                    loop {
                        // The lock must not be held while the motion is measured.
                        let next = lock(&receiver).recv();
                        let Ok((i, frames)) = next else { return };
                        let found = self.look(&frames);
                        lock(&seen)[i] = Some(found);
                    }
                });
            }
            // The workers are there until the sender goes.
            let mut give = |i, frames| sender.send((i, frames)).unwrap_or(());
            let fed = feed(&mut give);
            drop(sender);
            fed
        })?;
        Ok(seen.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
    }

    /// Measures one motion.
    pub fn look(&self, frames: &Array2<f32>) -> Seen {
        let n = self.num_frames.unwrap_or(usize::MAX).min(frames.nrows());
        let frames = frames.slice(s![..n, ..]);
        Seen {
            measured: Measured::of(frames, self.limits, self.reference),
            kept: frames.slice(s![..;self.stride, ..]).to_owned(),
        }
    }
}

/// Returns the kept frames of motions one behind the other, \[n, 25\].
pub fn kept_of<'a>(seen: impl IntoIterator<Item = &'a Seen>) -> Array2<f32> {
    let mut frames = Array2::zeros((0, MOTION_DIM));
    for seen in seen {
        frames.append(ndarray::Axis(0), seen.kept.view()).expect("25 channels each");
    }
    frames
}

/// Returns one of how many frames is kept of `n_frames`.
pub fn stride_for(n_frames: usize) -> usize {
    n_frames.div_ceil(MAX_KEPT_FRAMES).max(1)
}
