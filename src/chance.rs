//! Random choices that depend on a seed alone.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};

/// A stream of choices: ChaCha with 8 rounds.
///
/// D. J. Bernstein, "ChaCha, a variant of Salsa20", 2008.
pub struct Chance(ChaCha8Rng);

impl Chance {
    /// Starts stream number `stream` of a seed; streams are independent of each other.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(stream);
        Self(generator)
    }

    /// Returns a number below `n`, or 0 where `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
        // ⌊word · n / 2⁶⁴⌋ is uneven by less than n / 2⁶⁴.
        ((u128::from(self.0.next_u64()) * n as u128) >> 64) as usize
    }

    /// Returns a number in [0, 1), in steps of 2^-53.
    pub fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * 2.0_f64.powi(-53)
    }

    /// Puts values into a random order (Fisher and Yates, "Statistical Tables", 1938).
    pub fn shuffle<T>(&mut self, values: &mut [T]) {
        for i in (1..values.len()).rev() {
            values.swap(i, self.below(i + 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_follow_from_seed_and_stream() {
        let draw = |seed, stream| {
            let mut chance = Chance::new(seed, stream);
            (0..20).map(|_| chance.below(1000)).collect::<Vec<_>>()
        };
        assert_eq!(draw(7, 0), draw(7, 0));
        assert_ne!(draw(7, 0), draw(7, 1));
        assert_ne!(draw(7, 0), draw(8, 0));
    }

    #[test]
    fn choices_are_even() {
        let mut chance = Chance::new(3, 0);
        let mut counts = [0_u32; 5];
        (0..5000).for_each(|_| counts[chance.below(5)] += 1);
        // Three standard deviations of a binomial: 3·√(5000·0.2·0.8) = 85.
        assert!(counts.iter().all(|n| n.abs_diff(1000) <= 85), "{counts:?}");
        let mean = (0..1000).map(|_| chance.uniform()).sum::<f64>() / 1000.0;
        assert!((mean - 0.5).abs() < 3.0 / 12.0_f64.sqrt() / 1000.0_f64.sqrt(), "{mean}");
        assert_eq!(chance.below(0), 0);
        let mut order: Vec<u32> = (0..9).collect();
        chance.shuffle(&mut order);
        assert_ne!(order, (0..9).collect::<Vec<_>>());
        order.sort_unstable();
        assert_eq!(order, (0..9).collect::<Vec<_>>());
    }
}
