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

use super::{Link, LinkState, Message, Numbers, RanksError};

/// How long a thread that waits for an answer keeps the poll brisk: short pauses, and none once another process is seen to be
/// there. Large messages may move a little with each poll.
const BRISK: Duration = Duration::from_millis(20);
/// Pauses between two polls: in the time after that, and later or while no thread waits for the answer. Polling takes processor
/// time from the threads that compute.
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

/// Gives each process numbers of one kind, by rank, and returns those for this one; `room` returns memory for so many.
fn exchange<T: Equivalence + Clone>(
    link: &MpiLink,
    outgoing: &[&[T]],
    shared: &LinkState,
    room: impl Fn(usize) -> Vec<T>,
) -> Vec<Vec<T>>
where
    [T]: Buffer + BufferMut,
{
    let (world, own) = (&link.world, link.rank);
    let mut found: Vec<Vec<T>> = outgoing.iter().map(|_| Vec::new()).collect();
    scope(|scope| {
        let others = outgoing.iter().enumerate().filter(|(rank, _)| *rank != own);
        let mut under_way: Vec<_> = others
            .map(|(rank, one)| world.process_at_rank(rank as Rank).immediate_send(scope, *one))
            .collect();
        let mut expected: Vec<_> =
            found.iter_mut().enumerate().filter(|(rank, _)| *rank != own).collect();
        let started = Instant::now();
        let mut moved = None;
        loop {
            let before = (under_way.len(), expected.len());
            expected = expected
                .into_iter()
                .filter_map(|(rank, place)| {
                    let from = world.process_at_rank(rank as Rank);
                    let Some((message, status)) = from.immediate_matched_probe() else {
                        return Some((rank, place));
                    };
                    *place = room(status.count(T::equivalent_datatype()) as usize);
                    under_way.push(message.immediate_matched_receive_into(scope, &mut place[..]));
                    moved = Some(Instant::now());
                    None
                })
                .collect();
            under_way = under_way.into_iter().filter_map(|one| one.test().err()).collect();
            let now = (under_way.len(), expected.len());
            if now == (0, 0) {
                return;
            }
            if now != before {
                continue;
            }
            let is_brisk = |since: Instant| since.elapsed() < BRISK;
            match shared.is_waited_for() {
                true if moved.is_some_and(is_brisk) => std::thread::yield_now(),
                true => std::thread::sleep(PAUSES[usize::from(!is_brisk(started))]),
                false => std::thread::sleep(PAUSES[1]),
            }
        }
    });
    found
}

impl Link for MpiLink {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.size
    }

    fn exchange(
        &mut self,
        messages: Vec<Message>,
        shared: &LinkState,
    ) -> Result<Vec<Message>, RanksError> {
        let own = self.rank;
        let mut found: Vec<_> = if let Some(Message::Numbers(_)) = messages.first() {
            let outgoing: Result<Vec<_>, _> =
                messages.iter().map(|one| one.clone().numbers(own)).collect();
            let outgoing = outgoing?;
            let outgoing: Vec<_> = outgoing.iter().map(|one| &one[..]).collect();
            // What a buffer held before is written over.
            let room = |n| {
                let mut numbers = shared.buffers.take(n);
                numbers.resize(n, 0.0);
                numbers
            };
            let found = exchange(self, &outgoing, shared, room);
            found
                .into_iter()
                .map(|one| Message::Numbers(Numbers::of(one, &shared.buffers)))
                .collect()
        } else {
            let outgoing: Result<Vec<_>, _> =
                messages.iter().map(|one| one.clone().bytes(own)).collect();
            let outgoing = outgoing?;
            let outgoing: Vec<_> = outgoing.iter().map(|one| &one[..]).collect();
            let found = exchange(self, &outgoing, shared, |n| vec![0; n]);
            found.into_iter().map(|one| Message::Bytes(Arc::new(one))).collect()
        };
        if let Some(message) = messages.into_iter().nth(own) {
            found[own] = message;
        }
        Ok(found)
    }
}
