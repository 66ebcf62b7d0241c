//! The processes that train one network together ("ranks", as MPI calls them), and what they give each other.
//!
//! Everything is one kind of exchange: each process has a message for each. Exchanges have no names; they are matched by
//! their order, so that all processes must begin the same ones in the same order. Nothing here depends on a clock.

mod buffers;
#[cfg(test)]
mod memory;
#[cfg(feature = "mpi")]
mod mpi;
mod one;

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::autodiff::{SHARD_CHUNK, Shard};

#[cfg(feature = "mpi")]
pub use self::mpi::MpiLink;
pub use buffers::{Buffers, Numbers};
#[cfg(test)]
pub use memory::{MemoryLink, together};
pub use one::ByOne;

/// Chunks of numbers that go in one exchange: 8 MB, enough that its fixed cost does not count.
pub const EXCHANGED_CHUNKS: usize = 32;

/// Why processes could not go on together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RanksError {
    #[error("MPI did not start: {0}")]
    NotStarted(String),
    #[error(
        "this process was started as one of {told}, but MPI sees {found}; start them by the mpirun of the MPI library that \
         the executable was built with ({library}), or by srun --mpi=pmix"
    )]
    OtherSize { told: usize, found: usize, library: String },
    #[error("what rank {0} gave could not be read; do all ranks run the same executable?")]
    Unreadable(usize),
    #[error("another process is gone; the same command goes on from the last checkpoint")]
    Gone,
}

/// What one process gives another.
#[derive(Clone, Debug, PartialEq)]
pub enum Message {
    Numbers(Arc<Numbers>),
    Bytes(Arc<Vec<u8>>),
}

impl Message {
    fn numbers(self, of: usize) -> Result<Arc<Numbers>, RanksError> {
        match self {
            Self::Numbers(numbers) => Ok(numbers),
            Self::Bytes(_) => Err(RanksError::Unreadable(of)),
        }
    }

    fn bytes(self, of: usize) -> Result<Arc<Vec<u8>>, RanksError> {
        match self {
            Self::Bytes(bytes) => Ok(bytes),
            Self::Numbers(_) => Err(RanksError::Unreadable(of)),
        }
    }
}

/// What the thread that has the link shares with those that give it messages.
#[derive(Debug, Default)]
pub struct LinkState {
    pub buffers: Arc<Buffers>,
    /// Threads that have nothing else to do until messages are there.
    n_waiting: AtomicUsize,
    n_exchanges: AtomicUsize,
    n_given: AtomicUsize,
}

/// What a process gave others so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Traffic {
    pub n_exchanges: usize,
    /// Numbers of 4 bytes; the few bytes of other exchanges are not counted.
    pub n_numbers: usize,
}

impl LinkState {
    /// Returns whether somebody waits for messages, rather than computes meanwhile.
    pub fn is_waited_for(&self) -> bool {
        self.n_waiting.load(Ordering::Relaxed) > 0
    }
}

/// What carries messages between processes. It is used by one thread.
pub trait Link {
    /// Returns the number of this process, from 0.
    fn rank(&self) -> usize;

    /// Returns how many there are.
    fn size(&self) -> usize;

    /// Gives each process its message, by rank, and returns those for this one; waits until all are there.
    ///
    /// # Errors
    /// [`RanksError::Gone`].
    fn exchange(
        &mut self,
        messages: Vec<Message>,
        shared: &LinkState,
    ) -> Result<Vec<Message>, RanksError>;
}

type Answer = Result<Vec<Message>, RanksError>;

enum Order {
    Exchange(Vec<Message>, SyncSender<Answer>),
    Finish,
}

/// This process among those that train together.
pub struct Ranks {
    rank: usize,
    size: usize,
    shared: Arc<LinkState>,
    courier: Option<Courier>,
}

/// The thread that has the link.
struct Courier {
    orders: Mutex<Sender<Order>>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// An exchange under way.
pub struct Exchange {
    answer: Receiver<Answer>,
    shared: Arc<LinkState>,
}

impl Exchange {
    /// Waits for the messages of all, by rank.
    ///
    /// # Errors
    /// [`RanksError::Gone`].
    pub fn wait(self) -> Answer {
        self.shared.n_waiting.fetch_add(1, Ordering::Relaxed);
        let answer = self.answer.recv().unwrap_or(Err(RanksError::Gone));
        self.shared.n_waiting.fetch_sub(1, Ordering::Relaxed);
        answer
    }

    /// Waits for the numbers of all, by rank.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn numbers(self) -> Result<Vec<Arc<Numbers>>, RanksError> {
        self.wait()?.into_iter().enumerate().map(|(of, message)| message.numbers(of)).collect()
    }
}

impl Ranks {
    /// A process that trains alone.
    pub fn alone() -> Arc<Self> {
        Arc::new(Self { rank: 0, size: 1, shared: Arc::default(), courier: None })
    }

    /// Starts the thread that has the link, which is made there.
    ///
    /// # Errors
    /// What making it says.
    pub fn start<L: Link + 'static>(
        make: impl FnOnce() -> Result<L, RanksError> + Send + 'static,
    ) -> Result<Arc<Self>, RanksError> {
        let (orders, given) = channel();
        let (told, place) = sync_channel(1);
        let shared = Arc::<LinkState>::default();
        let at = Arc::clone(&shared);
        let work = move || {
            let mut link = match make() {
                Ok(link) => link,
                Err(error) => return told.send(Err(error)).unwrap_or_default(),
            };
            told.send(Ok((link.rank(), link.size()))).unwrap_or_default();
            for order in given {
                match order {
                    Order::Exchange(messages, answer) => {
                        // Nobody waits for the answer once the process is on its way out.
                        answer.send(link.exchange(messages, &at)).unwrap_or_default();
                    }
                    Order::Finish => return drop(link),
                }
            }
            // Others are still at work: to take leave of them in order would be to wait for them.
            std::mem::forget(link);
        };
        let thread = std::thread::Builder::new()
            .name("ranks".to_owned())
            .spawn(work)
            .map_err(|e| RanksError::NotStarted(e.to_string()))?;
        let (rank, size) = place.recv().unwrap_or(Err(RanksError::Gone))?;
        let courier = Courier { orders: Mutex::new(orders), thread: Mutex::new(Some(thread)) };
        Ok(Arc::new(Self { rank, size, shared, courier: Some(courier) }))
    }

    pub fn rank(&self) -> usize {
        self.rank
    }

    pub fn size(&self) -> usize {
        self.size
    }

    /// Returns whether this is the process that decides, tells and writes.
    pub fn is_first(&self) -> bool {
        self.rank == 0
    }

    pub fn is_alone(&self) -> bool {
        self.size == 1
    }

    /// Returns what of a network's numbers is this process's to keep.
    pub fn shard(&self) -> Shard {
        Shard { rank: self.rank, size: self.size }
    }

    /// Returns what this process gave others so far.
    pub fn traffic(&self) -> Traffic {
        let count = |counter: &AtomicUsize| counter.load(Ordering::Relaxed);
        let (n_exchanges, n_numbers) =
            (count(&self.shared.n_exchanges), count(&self.shared.n_given));
        Traffic { n_exchanges, n_numbers }
    }

    /// Begins to give each process its message, by rank.
    pub fn begin(&self, messages: Vec<Message>) -> Exchange {
        let (answer, exchange) = sync_channel(1);
        let n_numbers = |(rank, message): (usize, &Message)| match message {
            Message::Numbers(numbers) if rank != self.rank => numbers.len(),
            _ => 0,
        };
        let n_given = messages.iter().enumerate().map(n_numbers).sum();
        self.shared.n_exchanges.fetch_add(1, Ordering::Relaxed);
        self.shared.n_given.fetch_add(n_given, Ordering::Relaxed);
        match &self.courier {
            None => answer.send(Ok(messages)).unwrap_or_default(),
            Some(courier) => {
                let orders = courier.orders.lock().unwrap_or_else(PoisonError::into_inner);
                // Where the thread is gone so is the answer, which says it.
                orders.send(Order::Exchange(messages, answer)).unwrap_or_default();
            }
        }
        Exchange { answer: exchange, shared: Arc::clone(&self.shared) }
    }

    /// Begins to give each process its numbers, by rank.
    pub fn begin_numbers(&self, numbers: Vec<Vec<f32>>) -> Exchange {
        let message = |one| Message::Numbers(Numbers::of(one, &self.shared.buffers));
        self.begin(numbers.into_iter().map(message).collect())
    }

    /// Returns the chunks of a process within a range, one behind the other.
    pub fn packed(&self, values: &[f32], range: Range<usize>, rank: usize) -> Vec<f32> {
        let shard = Shard { rank, size: self.size };
        let n = shard.ranges_in(range.clone()).map(|own| own.len()).sum();
        let mut numbers = self.shared.buffers.take(n);
        numbers.clear();
        shard.ranges_in(range).for_each(|own| numbers.extend_from_slice(&values[own]));
        numbers
    }

    /// Gives all the same bytes, and returns those of all, by rank.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn share_bytes(&self, own: Vec<u8>) -> Result<Vec<Arc<Vec<u8>>>, RanksError> {
        let message = Message::Bytes(Arc::new(own));
        let found = self.begin(vec![message; self.size]).wait()?;
        found.into_iter().enumerate().map(|(of, message)| message.bytes(of)).collect()
    }

    /// Gives all a value, and returns those of all, by rank.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn share<T: Serialize + DeserializeOwned>(&self, own: &T) -> Result<Vec<T>, RanksError> {
        let text = serde_json::to_vec(own).map_err(|_| RanksError::Unreadable(self.rank))?;
        let read = |(of, text): (usize, Arc<Vec<u8>>)| {
            serde_json::from_slice(&text).map_err(|_| RanksError::Unreadable(of))
        };
        self.share_bytes(text)?.into_iter().enumerate().map(read).collect()
    }

    /// Gives all some numbers, and returns those of all, by rank, to the last bit.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn share_numbers(&self, own: &[f64]) -> Result<Vec<Vec<f64>>, RanksError> {
        if self.is_alone() {
            return Ok(vec![own.to_vec()]);
        }
        let bytes = own.iter().flat_map(|x| x.to_le_bytes()).collect();
        let read = |bytes: Arc<Vec<u8>>| {
            let words = bytes.chunks_exact(8);
            words.map(|word| f64::from_le_bytes(word.try_into().unwrap_or_default())).collect()
        };
        Ok(self.share_bytes(bytes)?.into_iter().map(read).collect())
    }

    /// Returns the numbers of the first process.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn of_first(&self, own: &[f64]) -> Result<Vec<f64>, RanksError> {
        let own = if self.is_first() { own } else { &[] };
        Ok(self.share_numbers(own)?.swap_remove(0))
    }

    /// Puts the chunks that each process keeps into the numbers of all.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn spread(&self, values: &mut [f32]) -> Result<(), RanksError> {
        self.put_together(values, |_| true)
    }

    /// Puts the chunks that each process keeps into the numbers of the first; those of others stay as they are.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn collect(&self, values: &mut [f32]) -> Result<(), RanksError> {
        self.put_together(values, |rank| rank == 0)
    }

    fn put_together(
        &self,
        values: &mut [f32],
        receives: impl Fn(usize) -> bool,
    ) -> Result<(), RanksError> {
        if self.is_alone() {
            return Ok(());
        }
        let nothing = Numbers::of(Vec::new(), &self.shared.buffers);
        let n = values.len();
        let n_pieces = n.div_ceil(EXCHANGED_CHUNKS * SHARD_CHUNK);
        let (mut under_way, mut n_begun) = (VecDeque::new(), 0);
        for piece in 0..n_pieces {
            // One is on its way while the one before is put in its place.
            while n_begun < n_pieces.min(piece + 2) {
                let own = self.packed(values, piece_range(n_begun, n), self.rank);
                let own = Numbers::of(own, &self.shared.buffers);
                let message = |rank: usize| {
                    let gets = receives(rank) && rank != self.rank;
                    Message::Numbers(Arc::clone(if gets { &own } else { &nothing }))
                };
                under_way.push_back(self.begin((0..self.size).map(message).collect()));
                n_begun += 1;
            }
            let Some(exchange) = under_way.pop_front() else { break };
            let found = exchange.numbers()?;
            if !receives(self.rank) {
                continue;
            }
            let range = piece_range(piece, n);
            for (rank, numbers) in found.into_iter().enumerate() {
                if rank != self.rank {
                    let shard = Shard { rank, size: self.size };
                    unpack(&numbers, values, range.clone(), shard);
                }
            }
        }
        Ok(())
    }

    /// Takes leave of the others, once all have come to this.
    ///
    /// # Errors
    /// When a message of another process did not come.
    pub fn finish(&self) -> Result<(), RanksError> {
        let Some(courier) = &self.courier else { return Ok(()) };
        self.share_bytes(Vec::new())?;
        courier
            .orders
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .send(Order::Finish)
            .unwrap_or_default();
        let thread = courier.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        thread.map_or(Ok(()), |thread| thread.join().map_err(|_| RanksError::Gone))
    }
}

/// Returns where the numbers of exchange number `piece` of `n` lie; they begin with a chunk.
pub fn piece_range(piece: usize, n: usize) -> Range<usize> {
    let len = EXCHANGED_CHUNKS * SHARD_CHUNK;
    (piece * len).min(n)..((piece + 1) * len).min(n)
}

fn unpack(numbers: &[f32], values: &mut [f32], range: Range<usize>, shard: Shard) {
    let mut rest = numbers;
    for own in shard.ranges_in(range) {
        let Some((numbers, others)) = rest.split_at_checked(own.len()) else { return };
        values[own].copy_from_slice(numbers);
        rest = others;
    }
}

#[cfg(test)]
mod tests;
