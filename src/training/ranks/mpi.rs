//! Messages by MPI, each to each.
//!
//! One thread makes all calls, the one that started MPI (MPI_THREAD_FUNNELED), so that nothing is asked of the library that
//! it may lack. It never waits within MPI, where most libraries burn a core: it asks, and sleeps between.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ::mpi::environment::{Universe, library_version};
use ::mpi::request::scope;
use ::mpi::topology::SimpleCommunicator;
use ::mpi::traits::{
    Buffer, BufferMut, Communicator as _, Destination as _, Equivalence, Source as _,
};
use ::mpi::{Rank, Threading, initialize_with_threading};

use super::{Link, Message, RanksError};

/// How long a message that is expected at once is polled for without a pause: from the beginning, and without a pause once another
/// process is seen to be there. Large messages move a little with each question.
const BRISK: Duration = Duration::from_millis(20);
/// Pauses between two questions: then, and later.
const PAUSES: [Duration; 2] = [Duration::from_micros(40), Duration::from_micros(500)];

/// The world of MPI.
pub struct MpiLink {
    /// Ends MPI when it is dropped.
    _universe: Universe,
    world: SimpleCommunicator,
    rank: usize,
    size: usize,
}

impl MpiLink {
    /// Starts MPI; `told` is the number of processes in the launcher's environment.
    ///
    /// # Errors
    /// [`RanksError`], where MPI does not start or is another one than the launcher's.
    pub fn start(told: usize) -> Result<Self, RanksError> {
        let started = initialize_with_threading(Threading::Funneled);
        let Some((universe, _)) = started else {
            return Err(RanksError::NotStarted("it was started before".to_owned()));
        };
        let world = universe.world();
        let (rank, size) = (world.rank() as usize, world.size() as usize);
        if size != told {
            let library = library_version().unwrap_or_default();
            let library = library.split([',', '\n', '\0']).next().unwrap_or_default().to_owned();
            return Err(RanksError::OtherSize { told, found: size, library });
        }
        Ok(Self { _universe: universe, world, rank, size })
    }
}

/// Gives each process numbers of one kind, by rank, and returns those for this one.
fn exchange<T: Equivalence + Clone + Default>(
    link: &MpiLink,
    outgoing: &[Arc<Vec<T>>],
) -> Vec<Arc<Vec<T>>>
where
    [T]: Buffer + BufferMut,
{
    let (world, own) = (&link.world, link.rank);
    let mut found: Vec<Option<Arc<Vec<T>>>> = vec![None; outgoing.len()];
    found[own] = Some(Arc::clone(&outgoing[own]));
    scope(|scope| {
        let others = outgoing.iter().enumerate().filter(|(rank, _)| *rank != own);
        let mut under_way: Vec<_> = others
            .map(|(rank, one)| world.process_at_rank(rank as Rank).immediate_send(scope, &one[..]))
            .collect();
        let started = Instant::now();
        let mut arrived = None;
        loop {
            let mut is_idle = true;
            let missing = found.iter_mut().enumerate().filter(|(_, one)| one.is_none());
            for (rank, one) in missing {
                let from = world.process_at_rank(rank as Rank);
                if let Some((message, status)) = from.immediate_matched_probe() {
                    let mut numbers =
                        vec![T::default(); status.count(T::equivalent_datatype()) as usize];
                    message.matched_receive_into(&mut numbers[..]);
                    *one = Some(Arc::new(numbers));
                    is_idle = false;
                    arrived = Some(Instant::now());
                }
            }
            under_way = under_way.into_iter().filter_map(|one| one.test().err()).collect();
            if under_way.is_empty() && found.iter().all(Option::is_some) {
                return;
            }
            if !is_idle {
                continue;
            }
            if arrived.is_some_and(|arrived: Instant| arrived.elapsed() < BRISK) {
                std::thread::yield_now();
            } else {
                let is_brisk = started.elapsed() < BRISK;
                std::thread::sleep(PAUSES[usize::from(!is_brisk)]);
            }
        }
    });
    found.into_iter().flatten().collect()
}

impl Link for MpiLink {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.size
    }

    fn exchange(&mut self, messages: Vec<Message>) -> Result<Vec<Message>, RanksError> {
        let rank = self.rank;
        if let Some(Message::Numbers(_)) = messages.first() {
            let outgoing: Result<Vec<_>, _> =
                messages.into_iter().map(|m| m.numbers(rank)).collect();
            let outgoing = outgoing?;
            return Ok(exchange(self, &outgoing).into_iter().map(Message::Numbers).collect());
        }
        let outgoing: Result<Vec<_>, _> = messages.into_iter().map(|m| m.bytes(rank)).collect();
        let outgoing = outgoing?;
        Ok(exchange(self, &outgoing).into_iter().map(Message::Bytes).collect())
    }
}
