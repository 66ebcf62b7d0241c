//! Random draws of resampling and surrogates, seeded.

/// Draws that depend on a seed alone: SplitMix64, a few lines in any language.
///
/// Source: Steele, Lea and Flood, "Fast Splittable Pseudorandom Number Generators", 2014.
#[derive(Clone, Debug)]
pub struct Draws {
    state: u64,
}

impl Draws {
    /// Starts the draws of a seed.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// Returns 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = self.state;
        let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Returns a number below `n`, `⌊bits · n / 2⁶⁴⌋`, or 0 where `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
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
    fn draws_are_those_published() {
        let mut draws = Draws::new(1_234_567);
        let first = [6_457_827_717_110_365_317, 3_203_168_211_198_807_973];
        assert_eq!([draws.bits(), draws.bits()], first);
        let mut draws = Draws::new(5);
        assert!((0..1000).all(|_| draws.below(7) < 7 && (0.0..1.0).contains(&draws.uniform())));
        let mut order: Vec<usize> = (0..31).collect();
        draws.shuffle(&mut order);
        assert_ne!(order, (0..31).collect::<Vec<_>>());
        order.sort_unstable();
        assert_eq!(order, (0..31).collect::<Vec<_>>());
        assert_eq!(Draws::new(0).below(0), 0);
    }
}
