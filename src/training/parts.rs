//! The gradient of a batch, computed part by part, by this process and by others, and the sum of it.
//!
//! A batch is divided into `accumulate` × `side_by_side` parts. Part p goes into gradient p mod S of the S =
//! `side_by_side` gradients, one part after the other, and the gradients are added in their order. Processes have
//! gradients each to itself, the first ones the first process, and every number is added up by the one process that it
//! belongs to, in the same order: the sum has the same bits whether 1, 2 or S processes computed it.
//!
//! A process sends (S / n)(n − 1) / n of a gradient and receives as much, n the number of processes: with one gradient
//! each what any reduction must, otherwise S / n times that, because sums of a process's own would be sums in another
//! order. Numbers leave as soon as nothing will be added to them any more, while backward goes on.

use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use crate::autodiff::op::elementwise::sum_in_order;
use crate::autodiff::{Arena, Gradients, Parameters, Tape, Tensor, Threads};
use crate::model::ParameterId;

use super::error::TrainingError;
use super::learner::{Ownership, all_windows};
use super::ranks::{Exchange, Numbers, Ranks, RanksError, piece_range};

/// Computes gradients part by part.
pub struct Parts {
    ranks: Arc<Ranks>,
    threads: Arc<Threads>,
    accumulate: usize,
    /// S, the gradients of all processes.
    n_slots: usize,
    /// Those of this process; the first takes the sum.
    gradients: Vec<Gradients<f32>>,
    arenas: Vec<Arena<f32>>,
}

/// A part that is being computed.
pub struct Part<'a> {
    /// From 0, of the batch.
    pub number: usize,
    pub arena: &'a Arena<f32>,
    gradients: &'a mut Gradients<f32>,
    /// Where gradients go when they are final, in the last part of a gradient.
    outlet: Option<Outlet<'a>>,
}

impl Part<'_> {
    /// Goes back from a loss that weighs `share` of the batch's.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn backward(
        self,
        tape: Tape<'_, f32>,
        loss: Tensor<f32>,
        share: f64,
    ) -> Result<(), TrainingError> {
        use crate::autodiff::Interpreter as _;
        let weight = tape.constant(&[], &[share as f32]);
        let Some(mut outlet) = self.outlet else {
            tape.backward_from(loss, weight, self.gradients)?;
            return Ok(());
        };
        tape.backward_telling(loss, weight, self.gradients, &mut |id, gradients| {
            outlet.is_final(id, gradients);
        })?;
        outlet.finish(self.gradients);
        Ok(())
    }
}

impl Parts {
    /// Divides batches into `accumulate` times `side_by_side` parts, all of this process.
    pub fn new(parameters: &Parameters<f32>, accumulate: usize, side_by_side: usize) -> Self {
        let n_slots = side_by_side.max(1);
        Self {
            ranks: Ranks::alone(),
            threads: Arc::new(Threads::of_process()),
            accumulate: accumulate.max(1),
            n_slots,
            gradients: (0..n_slots).map(|_| Gradients::new(parameters)).collect(),
            arenas: (0..n_slots).map(|_| Arena::default()).collect(),
        }
    }

    /// Runs on threads.
    pub fn on(&mut self, threads: &Arc<Threads>) {
        self.threads = Arc::clone(threads);
    }

    /// Shares the parts out among processes.
    ///
    /// # Errors
    /// When they cannot be shared out evenly.
    pub fn among(&mut self, ranks: &Arc<Ranks>) -> Result<(), TrainingError> {
        let (n, size) = (self.n_slots, ranks.size());
        if !n.is_multiple_of(size) {
            return Err(TrainingError::Config(format!(
                "--side-by-side {n} parts of a batch cannot be shared out among {size} ranks; give --side-by-side {} \
                 (it is a part of the run: a run that was begun with {n} goes on with {n})",
                n.next_multiple_of(size)
            )));
        }
        self.ranks = Arc::clone(ranks);
        self.gradients.truncate(n / size);
        self.arenas.truncate(n / size);
        Ok(())
    }

    /// Returns the gradient of the batch; of several processes' numbers those of the process's share.
    pub fn gradients(&mut self) -> &mut Gradients<f32> {
        &mut self.gradients[0]
    }

    /// Returns buffers for work beside the parts.
    pub fn arena(&self) -> &Arena<f32> {
        &self.arenas[0]
    }

    pub fn threads(&self) -> &Arc<Threads> {
        &self.threads
    }

    /// Returns the number of parts of a batch of which at most so many can be made.
    pub fn number(&self, most: usize) -> usize {
        number(self.accumulate, self.n_slots, most)
    }

    /// Returns which windows of a batch this process learns from, where parts are made of `unit` windows in their order.
    pub fn ownership(&self, unit: usize) -> Ownership {
        if self.ranks.is_alone() {
            return all_windows();
        }
        let (accumulate, n_slots, slots) = (self.accumulate, self.n_slots, self.slots());
        Arc::new(move |n_dancers| {
            let n = n_dancers.len();
            let n_units = n.div_ceil(unit);
            let n_parts = number(accumulate, n_slots, n_units);
            let mut owned = vec![false; n];
            for part in (0..n_parts).filter(|part| slots.contains(&(part % n_slots))) {
                let at = |part: usize| (part * n_units / n_parts * unit).min(n);
                owned[at(part)..at(part + 1)].fill(true);
            }
            owned
        })
    }

    fn owns(&self, part: usize) -> bool {
        self.slots().contains(&(part % self.n_slots))
    }

    /// Returns which of the S gradients are this process's.
    fn slots(&self) -> Range<usize> {
        let (rank, each) = (self.ranks.rank(), self.n_slots / self.ranks.size());
        rank * each..(rank + 1) * each
    }

    /// Returns what all processes found of their parts, part by part, given what this one found of its own in order.
    ///
    /// # Errors
    /// When another process is gone.
    pub fn of_all(
        &self,
        n_parts: usize,
        own: Vec<Vec<f64>>,
    ) -> Result<Vec<Vec<f64>>, TrainingError> {
        if self.ranks.is_alone() {
            return Ok(own);
        }
        // Each part's numbers behind their number.
        let with_length = |part: &Vec<f64>| {
            std::iter::once(part.len() as f64).chain(part.iter().copied()).collect::<Vec<_>>()
        };
        let flat: Vec<f64> = own.iter().flat_map(with_length).collect();
        let mut all: Vec<_> =
            self.ranks.share_numbers(&flat)?.into_iter().map(Vec::into_iter).collect();
        let each = self.n_slots / self.ranks.size();
        let mut next = |part: usize| {
            let numbers = &mut all[part % self.n_slots / each];
            let n = numbers.next().unwrap_or_default() as usize;
            numbers.by_ref().take(n).collect()
        };
        Ok((0..n_parts).map(&mut next).collect())
    }

    /// Returns the weight of every part, given that of those of this process.
    ///
    /// # Errors
    /// When another process is gone.
    pub fn weights(
        &self,
        n_parts: usize,
        weight: impl Fn(usize) -> f64,
    ) -> Result<Vec<f64>, TrainingError> {
        let own = (0..n_parts).filter(|&part| self.owns(part));
        let own: Vec<_> = own.map(|part| vec![weight(part)]).collect();
        Ok(self.of_all(n_parts, own)?.into_iter().flatten().collect())
    }

    /// Does the work of the parts of this process, each of which goes back once, and adds up the gradients of all
    /// processes; returns what the work found, in order of parts.
    ///
    /// # Errors
    /// Errors of the work, and when another process is gone.
    pub fn differentiate<R: Send>(
        &mut self,
        n_parts: usize,
        work: impl Fn(Part<'_>) -> Result<R, TrainingError> + Sync,
    ) -> Result<Vec<R>, TrainingError> {
        let (slots, n_slots) = (self.slots(), self.n_slots);
        let reduction = (!self.ranks.is_alone())
            .then(|| Reduction::new(&self.ranks, &mut self.gradients, n_slots));
        self.gradients.iter_mut().for_each(Gradients::clear);
        let mut found = Vec::new();
        for first in (0..n_parts).step_by(n_slots) {
            let numbers = first + slots.start..(first + slots.end).min(n_parts);
            let places = self.gradients.iter_mut().zip(&self.arenas).enumerate();
            let parts: Vec<_> = numbers
                .zip(places)
                .map(|(number, (place, (gradients, arena)))| {
                    let is_last = number + n_slots >= n_parts;
                    let outlet = reduction.as_ref().filter(|_| is_last);
                    let outlet = outlet.map(|reduction| Outlet::new(reduction, place));
                    Part { number, arena, gradients, outlet }
                })
                .collect();
            if parts.is_empty() {
                continue;
            }
            for part in self.threads.side_by_side(parts, &work) {
                found.push(part?);
            }
        }
        let threads = Arc::clone(&self.threads);
        let Some(reduction) = reduction else {
            let (whole, others) = self.gradients.split_first_mut().expect("at least one");
            threads.run(|| others.iter_mut().for_each(|other| whole.add_all(other)));
            return Ok(found);
        };
        // Of a batch with fewer parts than gradients.
        for (place, gradients) in self.gradients.iter_mut().enumerate() {
            if slots.start + place >= n_parts {
                Outlet::new(&reduction, place).finish(gradients);
            }
        }
        let gradients = &mut self.gradients;
        threads.run(|| reduction.finish(gradients))?;
        Ok(found)
    }
}

fn number(accumulate: usize, n_slots: usize, most: usize) -> usize {
    (accumulate * n_slots).clamp(1, most.max(1))
}

/// The sum of the gradients of all processes, under way.
struct Reduction<'a> {
    ranks: &'a Ranks,
    n_slots: usize,
    /// Gradients of a process.
    n_own: usize,
    /// Numbers of a gradient.
    n: usize,
    n_pieces: usize,
    /// Where each parameter lies.
    ranges: Vec<Range<usize>>,
    leaving: Mutex<Leaving>,
}

/// What is on its way to other processes: pieces, the last of a gradient first, as backward comes to them.
struct Leaving {
    /// For pieces that have not left: of each gradient of this process the numbers for each other process.
    packed: Vec<Vec<Option<Vec<Vec<f32>>>>>,
    /// Exchanges that were begun, from the last piece down.
    begun: Vec<Exchange>,
}

impl<'a> Reduction<'a> {
    fn new(ranks: &'a Ranks, gradients: &mut [Gradients<f32>], n_slots: usize) -> Self {
        let plan = Arc::clone(gradients[0].plan());
        let (n, n_own) = (plan.len(), gradients.len());
        let n_pieces = (0..).take_while(|&piece| !piece_range(piece, n).is_empty()).count();
        let packed = (0..n_pieces).map(|_| (0..n_own).map(|_| None).collect()).collect();
        let ranges = plan.list().iter().map(|(id, _)| plan.range(id)).collect();
        let leaving = Mutex::new(Leaving { packed, begun: Vec::new() });
        Self { ranks, n_slots, n_own, n, n_pieces, ranges, leaving }
    }

    /// Returns the parameters that lie within a range, wholly or in part.
    fn parameters_in(&self, range: &Range<usize>) -> Range<usize> {
        let first = self.ranges.partition_point(|own| own.end <= range.start);
        let end = self.ranges.partition_point(|own| own.start < range.end);
        first..end
    }

    /// Takes a piece of a gradient of this process that is final, and begins the exchange of those that are complete.
    fn take(&self, place: usize, piece: usize, gradients: &mut Gradients<f32>) {
        let range = piece_range(piece, self.n);
        let values = gradients.settled(self.parameters_in(&range), 0..self.n);
        let for_rank = |rank: usize| match rank == self.ranks.rank() {
            true => Vec::new(),
            false => self.ranks.packed(values, range.clone(), rank),
        };
        let numbers = (0..self.ranks.size()).map(for_rank).collect();
        let mut leaving = self.leaving.lock().unwrap_or_else(PoisonError::into_inner);
        leaving.packed[piece][place] = Some(numbers);
        while leaving.begun.len() < self.n_pieces {
            let next = self.n_pieces - 1 - leaving.begun.len();
            if leaving.packed[next].iter().any(Option::is_none) {
                return;
            }
            let mut together = vec![Vec::new(); self.ranks.size()];
            for numbers in std::mem::take(&mut leaving.packed[next]).into_iter().flatten() {
                for (all, one) in together.iter_mut().zip(numbers) {
                    if all.is_empty() { *all = one } else { all.extend(one) }
                }
            }
            let exchange = self.ranks.begin_numbers(together);
            leaving.begun.push(exchange);
        }
    }

    /// Waits for what the others computed, and adds up the process's share, in order of gradients.
    fn finish(self, gradients: &mut [Gradients<f32>]) -> Result<(), TrainingError> {
        let begun = self.leaving.into_inner().unwrap_or_else(PoisonError::into_inner).begun;
        let (rank, n_own) = (self.ranks.rank(), self.n_own);
        let (first, others) = gradients.split_first_mut().expect("at least one");
        let first = first.all();
        let others: Vec<&[f32]> = others.iter_mut().map(|other| &*other.all()).collect();
        let pieces = (0..self.n_pieces).rev().zip(begun);
        for (piece, exchange) in pieces {
            let found = exchange.numbers()?;
            let range = piece_range(piece, self.n);
            let shard = self.ranks.shard();
            let n: usize = shard.ranges_in(range.clone()).map(|own| own.len()).sum();
            let is_whole =
                |(of, numbers): (usize, &Arc<Numbers>)| of == rank || numbers.len() == n_own * n;
            if let Some(of) = found.iter().enumerate().position(|one| !is_whole(one)) {
                return Err(RanksError::Unreadable(of).into());
            }
            // Where a chunk lies among the numbers of a gradient that were received.
            let mut at = 0;
            for own in shard.ranges_in(range) {
                let of_slot = |slot: usize| match (slot / n_own, slot % n_own) {
                    (of, place) if of != rank => Some(&found[of][place * n + at..][..own.len()]),
                    (_, 0) => None,
                    (_, place) => Some(&others[place - 1][own.clone()]),
                };
                let numbers: Vec<_> = (0..self.n_slots).map(of_slot).collect();
                sum_in_order(&mut first[own.clone()], &numbers);
                at += own.len();
            }
        }
        Ok(())
    }
}

/// Where the pieces of one gradient go when they are final.
struct Outlet<'a> {
    reduction: &'a Reduction<'a>,
    /// Of the process's gradients.
    place: usize,
    /// Parameters of each piece that are not final.
    n_left: Vec<usize>,
    is_taken: Vec<bool>,
}

impl<'a> Outlet<'a> {
    fn new(reduction: &'a Reduction<'a>, place: usize) -> Self {
        let n_pieces = reduction.n_pieces;
        let count = |piece| reduction.parameters_in(&piece_range(piece, reduction.n)).len();
        let n_left = (0..n_pieces).map(count).collect();
        Self { reduction, place, n_left, is_taken: vec![false; n_pieces] }
    }

    fn is_final(&mut self, id: ParameterId, gradients: &mut Gradients<f32>) {
        let range = &self.reduction.ranges[id.0];
        if range.is_empty() {
            return;
        }
        let pieces = (0..self.n_left.len()).filter(|&piece| {
            let piece = piece_range(piece, self.reduction.n);
            piece.start < range.end && range.start < piece.end
        });
        for piece in pieces.collect::<Vec<_>>() {
            self.n_left[piece] -= 1;
            if self.n_left[piece] == 0 {
                self.take(piece, gradients);
            }
        }
    }

    fn take(&mut self, piece: usize, gradients: &mut Gradients<f32>) {
        if !std::mem::replace(&mut self.is_taken[piece], true) {
            self.reduction.take(self.place, piece, gradients);
        }
    }

    /// Takes what backward did not come to.
    fn finish(mut self, gradients: &mut Gradients<f32>) {
        for piece in (0..self.n_left.len()).rev() {
            self.take(piece, gradients);
        }
    }
}

#[cfg(test)]
mod tests;
