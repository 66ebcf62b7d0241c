//! Random numbers that depend on a seed and a place, never on the order of the work.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};

use crate::model::Init;

use super::element::Element;

/// The random numbers of one operation: a stream of ChaCha with 8 rounds.
///
/// D. J. Bernstein, "ChaCha, a variant of Salsa20", 2008.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stream {
    seed: u64,
    stream: u64,
}

impl Stream {
    /// Returns stream number `stream` of a seed.
    pub fn new(seed: u64, stream: u64) -> Self {
        Self { seed, stream }
    }

    /// Fills `target`, which begins at element `start`, with 32 random bits each.
    pub fn words(self, start: usize, target: &mut [u32]) {
        let mut generator = ChaCha8Rng::seed_from_u64(self.seed);
        generator.set_stream(self.stream);
        generator.set_word_pos(start as u128);
        for word in target {
            *word = generator.next_u32();
        }
    }

    /// Returns the generator, at element `start` of the stream, two words an element.
    fn at(self, start: usize) -> ChaCha8Rng {
        let mut generator = ChaCha8Rng::seed_from_u64(self.seed);
        generator.set_stream(self.stream);
        generator.set_word_pos(2 * start as u128);
        generator
    }

    /// Fills `target`, which begins at element `start`, with numbers uniform in \[0, 1), steps of 2^-53.
    pub fn uniform<E: Element>(self, start: usize, target: &mut [E]) {
        let mut generator = self.at(start);
        for x in target {
            *x = E::from_f64((generator.next_u64() >> 11) as f64 * 2.0_f64.powi(-53));
        }
    }

    /// Fills `target` with numbers of the standard normal distribution.
    ///
    /// Box and Muller, "A Note on the Generation of Random Normal Deviates", 1958: element i takes the
    /// radius and the angle from the two words of its own.
    pub fn normal<E: Element>(self, start: usize, target: &mut [E]) {
        let mut generator = self.at(start);
        for x in target {
            let radius = (f64::from(generator.next_u32()) + 1.0) * 2.0_f64.powi(-32);
            let angle = f64::from(generator.next_u32()) * 2.0_f64.powi(-32);
            let normal = (-2.0 * radius.ln()).sqrt() * (std::f64::consts::TAU * angle).cos();
            *x = E::from_f64(normal);
        }
    }
}

/// Returns the first values of a parameter; they depend on the seed and its name alone.
pub fn initial<E: Element>(init: Init, name: &str, seed: u64, len: usize) -> Vec<E> {
    let mut values = vec![E::ZERO; len];
    let stream = Stream::new(seed, xxhash_rust::xxh3::xxh3_64(name.as_bytes()));
    match init {
        Init::Zeros => {}
        Init::Ones => values.fill(E::ONE),
        Init::Uniform { bound } => {
            stream.uniform(0, &mut values);
            for x in &mut values {
                *x = E::from_f64((2.0 * x.to_f64() - 1.0) * bound);
            }
        }
        Init::Normal { deviation } => {
            stream.normal(0, &mut values);
            for x in &mut values {
                *x = E::from_f64(x.to_f64() * deviation);
            }
        }
    }
    values
}
