//! Random choices that depend on a seed alone.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};

/// Gives 64 random bits at a time.
pub trait Bits {
    fn bits(&mut self) -> u64;
}

impl Bits for ChaCha8Rng {
    fn bits(&mut self) -> u64 {
        self.next_u64()
    }
}

/// SplitMix64, a few lines in any language.
///
/// Source: Steele, Lea and Flood, "Fast Splittable Pseudorandom Number Generators", 2014.
#[derive(Clone, Debug)]
pub struct SplitMix64 {
    state: u64,
}

impl Bits for SplitMix64 {
    fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = self.state;
        let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
}

/// A stream of choices, made of the bits of a generator.
#[derive(Clone, Debug)]
pub struct Choices<G>(G);

/// Choices of what is made: ChaCha with 8 rounds.
///
/// D. J. Bernstein, "ChaCha, a variant of Salsa20", 2008.
pub type Chance = Choices<ChaCha8Rng>;

/// Draws of resampling and surrogates, which a script in any language can repeat.
pub type Draws = Choices<SplitMix64>;

impl Chance {
    /// Starts stream number `stream` of a seed; streams are independent of each other.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(stream);
        Self(generator)
    }
}

impl Draws {
    /// Starts the draws of a seed.
    pub fn new(seed: u64) -> Self {
        Self(SplitMix64 { state: seed })
    }
}

impl<G: Bits> Choices<G> {
    /// Returns 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0.bits()
    }

    /// Returns a number below `n`, ⌊bits · n / 2⁶⁴⌋, or 0 where `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
        // Uneven by less than n / 2⁶⁴.
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }

    /// Returns a number in [0, 1), in steps of 2^-53.
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * 2.0_f64.powi(-53)
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

    #[test]
    fn draws_are_those_published() {
        let mut draws = Draws::new(1_234_567);
        let first = [6_457_827_717_110_365_317, 3_203_168_211_198_807_973];
        assert_eq!([draws.bits(), draws.bits()], first);
        let mut draws = Draws::new(5);
        assert!((0..1000).all(|_| draws.below(7) < 7 && (0.0..1.0).contains(&draws.uniform())));
    }
}
