//! Threads in the place of processes, for tests.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

use super::{Link, LinkState, Message, Ranks, RanksError};

/// A link between threads: a channel from each to each.
pub struct MemoryLink {
    rank: usize,
    to: Vec<Sender<Message>>,
    from: Vec<Receiver<Message>>,
}

impl MemoryLink {
    /// Returns the link of one, given its channels to and from each.
    pub fn of(rank: usize, to: Vec<Sender<Message>>, from: Vec<Receiver<Message>>) -> Self {
        Self { rank, to, from }
    }
}

impl Link for MemoryLink {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.to.len()
    }

    fn exchange(
        &mut self,
        messages: Vec<Message>,
        _: &LinkState,
    ) -> Result<Vec<Message>, RanksError> {
        for (to, message) in self.to.iter().zip(messages) {
            to.send(message).map_err(|_| RanksError::Gone)?;
        }
        self.from.iter().map(|from| from.recv().map_err(|_| RanksError::Gone)).collect()
    }
}

/// Does the work of `size` processes on threads, and returns what each found, by rank.
pub fn together<R: Send>(size: usize, work: impl Fn(Arc<Ranks>) -> R + Sync) -> Vec<R> {
    let mut senders: Vec<Vec<Sender<Message>>> = (0..size).map(|_| Vec::new()).collect();
    let mut receivers: Vec<Vec<Receiver<Message>>> = Vec::new();
    for _ in 0..size {
        let (to, from): (Vec<_>, Vec<_>) = (0..size).map(|_| channel()).unzip();
        to.into_iter().zip(&mut senders).for_each(|(to, senders)| senders.push(to));
        receivers.push(from);
    }
    let links = senders.into_iter().zip(receivers).enumerate();
    let links: Vec<_> = links.map(|(rank, (to, from))| MemoryLink { rank, to, from }).collect();
    let work = &work;
    std::thread::scope(|scope| {
        let start = |link: MemoryLink| {
            scope.spawn(move || {
                let ranks = Ranks::start(move || Ok(link)).expect("a thread");
                let found = work(Arc::clone(&ranks));
                ranks.finish().expect("all are there");
                found
            })
        };
        let threads: Vec<_> = links.into_iter().map(start).collect();
        threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
    })
}
