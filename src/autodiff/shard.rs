//! Which numbers of a network are whose, where several processes train it together.

use std::ops::Range;

/// Numbers of a chunk; a chunk belongs to one process.
pub const SHARD_CHUNK: usize = 1 << 16;

/// The share of a process: of a run of numbers in chunks of [`SHARD_CHUNK`], those whose number is `rank` modulo `size`.
///
/// Chunks take turns, so that every process has a share of what is ready first and of what is ready last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    pub rank: usize,
    pub size: usize,
}

impl Shard {
    /// The share of a process that trains alone: everything.
    pub const WHOLE: Self = Self { rank: 0, size: 1 };

    /// Returns whether everything belongs to this process.
    pub fn is_whole(self) -> bool {
        self.size == 1
    }

    /// Returns whether a chunk belongs to this process.
    pub fn owns(self, chunk: usize) -> bool {
        chunk % self.size == self.rank
    }

    /// Returns where the process's chunks of `n` numbers lie, in order.
    pub fn ranges(self, n: usize) -> impl Iterator<Item = Range<usize>> {
        self.ranges_in(0..n)
    }

    /// Returns where the process's chunks within a range lie, in order; the range begins with a chunk.
    pub fn ranges_in(self, range: Range<usize>) -> impl Iterator<Item = Range<usize>> {
        let chunks = range.start / SHARD_CHUNK..range.end.div_ceil(SHARD_CHUNK);
        chunks
            .filter(move |&chunk| self.owns(chunk))
            .map(move |chunk| chunk_range(chunk, range.end))
    }
}

/// Returns where chunk number `chunk` of `n` numbers lies.
pub fn chunk_range(chunk: usize, n: usize) -> Range<usize> {
    (chunk * SHARD_CHUNK).min(n)..((chunk + 1) * SHARD_CHUNK).min(n)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_belongs_to_one_process() {
        for (n, size) in [(0, 2), (7, 3), (5 * SHARD_CHUNK + 11, 1), (5 * SHARD_CHUNK + 11, 4)] {
            let mut owners = vec![0; n];
            for rank in 0..size {
                for range in (Shard { rank, size }).ranges(n) {
                    owners[range].iter_mut().for_each(|owner| *owner += 1);
                }
            }
            assert!(owners.iter().all(|&owners| owners == 1), "{n} numbers, {size} processes");
        }
        let second: Vec<_> = Shard { rank: 1, size: 2 }.ranges(3 * SHARD_CHUNK + 5).collect();
        assert_eq!(second, [SHARD_CHUNK..2 * SHARD_CHUNK, 3 * SHARD_CHUNK..3 * SHARD_CHUNK + 5]);
    }
}
