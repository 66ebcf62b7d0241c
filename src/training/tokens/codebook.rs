//! How a codebook is learned: by moving averages of the latents that its rows stand for.

use serde::{Deserialize, Serialize};

use crate::autodiff::{Element, Parameters, Stream};
use crate::model::{Init, ParameterId, ParameterList, Role, Scope};
use crate::weights::{Archive, Section};

use crate::training::averaged::section;
use crate::training::checkpoint::Progress;
use crate::training::error::TrainingError;
use crate::training::learner::CheckpointState;

/// Name of the section of what a codebook has seen.
const CODEBOOK: &str = "codebook.";
/// Spread of latents that must serve for several rows, in units of 1 / √d.
const TILED_DEVIATION: f64 = 0.01;

/// How a codebook is learned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CodebookConfig {
    /// μ, the share of the averages that stays at a step.
    pub decay: f64,
    /// Uses in a batch, on average, below which a row is replaced.
    pub least_usage: f64,
}

impl Default for CodebookConfig {
    fn default() -> Self {
        Self { decay: 0.99, least_usage: 1.0 }
    }
}

impl CodebookConfig {
    /// Returns a tenth of the latents of a batch that each row would stand for, were all used alike; at most the 1 that
    /// MoMask publishes, whose batches have 15 latents for each row and more.
    pub fn usual_least_usage(n_latents: usize, rows: usize) -> f64 {
        (0.1 * n_latents as f64 / rows as f64).min(Self::default().least_usage)
    }
}

/// What a codebook has seen: for each row how many latents of a batch it stood for, and their sum, both as moving
/// averages.
///
/// van den Oord et al., "Neural Discrete Representation Learning", NIPS 2017, appendix A.1, with the replacement of rows
/// that T2M-GPT and MoMask publish (`QuantizeEMAReset`).
#[derive(Clone, Debug)]
pub struct Codebook<E: Element> {
    config: CodebookConfig,
    state: Parameters<E>,
    /// N, \[K\].
    usage: ParameterId,
    /// m, \[K, d\].
    sums: ParameterId,
    width: usize,
}

impl<E: Element> Codebook<E> {
    /// Returns the state of a codebook of K rows of d numbers that has seen nothing.
    pub fn new(config: &CodebookConfig, rows: usize, width: usize) -> Self {
        let mut list = ParameterList::default();
        let mut root = Scope::root(&mut list);
        let usage = root.parameter("usage", &[rows], Init::Zeros, Role::Vector);
        let sums = root.parameter("sums", &[rows, width], Init::Zeros, Role::Code);
        let state = Parameters::new(list, 0);
        Self { config: config.clone(), state, usage, sums, width }
    }

    /// Returns N, how many latents of a batch each row stood for.
    pub fn usage(&self) -> &[E] {
        self.state.get(self.usage)
    }

    /// Returns whether its rows have been put in their first places.
    pub fn is_begun(&self) -> bool {
        self.usage().iter().any(|&n| n > E::ZERO)
    }

    /// c_k ← candidate k, N_k ← n, m_k ← n c_k, n the least usage: a row that the next batch does not use is replaced.
    ///
    /// Published is N_k ← 1, with 1 as the least usage. With less, rows that nothing is near would stay until 1 has
    /// faded, 235 steps at μ = 0.99 and a tenth.
    ///
    /// - `codebook`: \[K, d\]; `candidates`: the same, as `candidates` draws them
    pub fn begin(&mut self, codebook: &mut [E], candidates: &[E]) {
        codebook.copy_from_slice(candidates);
        let least = E::from_f64(self.config.least_usage);
        let [usage, sums] = self.averages();
        usage.fill(least);
        for (m, &candidate) in sums.iter_mut().zip(candidates) {
            *m = least * candidate;
        }
    }

    /// N_k ← μ N_k + (1 − μ) n_k and m_k ← μ m_k + (1 − μ) Σ h, n_k and h the latents that row k stands for in a batch;
    /// then c_k ← m_k / N_k where N_k is at least the least usage, else candidate k.
    ///
    /// N and m of a row that is replaced go on, as published.
    ///
    /// - `codebook`, `candidates`: \[K, d\]; `latents`: \[M, d\]; `tokens`: their rows, \[M\]
    pub fn update(
        &mut self,
        codebook: &mut [E],
        latents: &[E],
        tokens: &[usize],
        candidates: &[E],
    ) {
        let (mu, d) = (E::from_f64(self.config.decay), self.width);
        let (rest, least) = (E::ONE - mu, E::from_f64(self.config.least_usage));
        let [usage, sums] = self.averages();
        let mut counts = vec![0.0_f64; usage.len()];
        let mut totals = vec![E::ZERO; sums.len()];
        for (h, &k) in latents.chunks_exact(d).zip(tokens) {
            counts[k] += 1.0;
            for (total, &h) in totals[k * d..][..d].iter_mut().zip(h) {
                *total += h;
            }
        }
        for (n, count) in usage.iter_mut().zip(counts) {
            *n = mu * *n + rest * E::from_f64(count);
        }
        for (m, total) in sums.iter_mut().zip(totals) {
            *m = mu * *m + rest * total;
        }
        let rows = codebook.chunks_exact_mut(d).zip(candidates.chunks_exact(d));
        for ((code, candidate), (m, &n)) in rows.zip(sums.chunks_exact(d).zip(&*usage)) {
            for ((c, &m), &candidate) in code.iter_mut().zip(m).zip(candidate) {
                *c = if n >= least { m / n } else { candidate };
            }
        }
    }

    /// Returns N and m for writing.
    fn averages(&mut self) -> [&mut [E]; 2] {
        let plan = self.state.plan();
        let ranges = [plan.range(self.usage), plan.range(self.sums)];
        let all = self.state.all_mut();
        all.get_disjoint_mut(ranges).expect("invariant: two parameters lie apart")
    }
}

/// A checkpoint keeps N and m.
impl CheckpointState for Codebook<f32> {
    fn sections(&self) -> Vec<Section<'_, f32>> {
        vec![Section { prefix: CODEBOOK, plan: self.state.plan(), values: self.state.all() }]
    }

    fn restore(
        &mut self,
        archive: &Archive,
        place: &str,
        _at: &Progress,
    ) -> Result<(), TrainingError> {
        self.state = section(archive, CODEBOOK, &self.state, place)?;
        Ok(())
    }
}

/// Draws K latents of a batch without putting any back; of fewer than K, all are taken again, moved by a little.
///
/// `latents`: \[M, d\], M above 0 → \[K, d\]
pub fn candidates<E: Element>(
    latents: &[E],
    width: usize,
    rows: usize,
    random: [Stream; 2],
) -> Vec<E> {
    let m = latents.len() / width;
    let mut order: Vec<usize> = (0..m).collect();
    // The first places of a permutation (Fisher and Yates).
    let n_drawn = rows.min(m);
    let mut numbers = vec![0.0_f64; n_drawn];
    random[0].uniform(0, &mut numbers);
    for (i, u) in numbers.into_iter().enumerate() {
        order.swap(i, i + (u * (m - i) as f64) as usize);
    }
    let mut found: Vec<E> =
        (0..rows).flat_map(|k| &latents[order[k % n_drawn] * width..][..width]).copied().collect();
    if m < rows {
        let mut noise = vec![E::ZERO; found.len()];
        random[1].normal(0, &mut noise);
        let deviation = E::from_f64(TILED_DEVIATION / (width as f64).sqrt());
        for (x, z) in found.iter_mut().zip(noise) {
            *x += deviation * z;
        }
    }
    found
}

/// Returns how often each of so many rows is among tokens.
pub fn counts(tokens: &[usize], rows: usize) -> Vec<u64> {
    let mut counts = vec![0; rows];
    tokens.iter().for_each(|&k| counts[k] += 1);
    counts
}

/// Returns exp(−Σ p ln p), p the share of each row by its count: how many rows are in use, were all used alike.
pub fn perplexity(counts: &[u64]) -> f64 {
    let all = counts.iter().sum::<u64>() as f64;
    let shares = counts.iter().filter(|&&n| n > 0).map(|&n| n as f64 / all);
    shares.map(|p| -p * p.ln()).sum::<f64>().exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn latents(m: usize, d: usize) -> Vec<f64> {
        (0..m * d).map(|i| (i as f64 * 0.37).sin()).collect()
    }

    fn streams(seed: u64) -> [Stream; 2] {
        [1, 2].map(|stream| Stream::new(seed, stream))
    }

    #[test]
    fn rows_that_the_first_batches_do_not_use_are_replaced_at_once_and_used_ones_stay() {
        let config = CodebookConfig { decay: 0.99, least_usage: 0.125 };
        let mut book = Codebook::<f64>::new(&config, 2, 1);
        let mut codes = [0.0; 2];
        book.begin(&mut codes, &[1.0, 5.0]);
        assert_eq!((codes, book.usage()), ([1.0, 5.0], &[0.125; 2][..]));
        // Row 0 stands for both latents, row 1 for none.
        book.update(&mut codes, &[1.0, 2.0], &[0, 0], &[7.0, 8.0]);
        let (n, m) = (0.99 * 0.125 + 0.01 * 2.0, 0.99 * 0.125 + 0.01 * 3.0);
        assert!((codes[0] - m / n).abs() < 1e-12, "{codes:?}");
        assert_eq!(codes[1], 8.0);
    }

    #[test]
    fn a_row_must_be_used_a_tenth_as_often_as_the_mean_and_never_more_than_once() {
        let least = CodebookConfig::usual_least_usage;
        assert!((least(960, 1024) - 0.09375).abs() < 1e-15);
        assert_eq!(least(960, 32), 1.0);
        assert_eq!(least(15_360, 1024), 1.0);
    }

    #[test]
    fn candidates_are_latents_of_the_batch_and_none_comes_twice() {
        let (m, d, rows) = (23, 3, 17);
        let batch = latents(m, d);
        let found = candidates(&batch, d, rows, streams(5));
        let places: Vec<usize> = found
            .chunks(d)
            .map(|row| batch.chunks(d).position(|h| h == row).expect("a latent"))
            .collect();
        let mut sorted = places.clone();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), rows);
        let other = candidates(&batch, d, rows, streams(6));
        assert_ne!(other, found, "another seed draws others");
        assert_eq!(candidates(&batch, d, rows, streams(5)), found);
    }

    #[test]
    fn of_few_latents_all_are_taken_again_and_moved_by_a_hundredth() {
        let (m, d, rows) = (5, 16, 23);
        let batch = latents(m, d);
        let found = candidates(&batch, d, rows, streams(5));
        let mut n_taken = [0; 5];
        for row in found.chunks(d) {
            let distance = |h: &[f64]| -> f64 {
                h.iter().zip(row).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
            };
            let nearest = (0..m)
                .min_by(|&a, &b| {
                    distance(&batch[a * d..][..d]).total_cmp(&distance(&batch[b * d..][..d]))
                })
                .expect("a latent");
            n_taken[nearest] += 1;
            // The length of 16 numbers of deviation 0.01 / 4 is 0.01, and hardly ever twice that.
            let moved = distance(&batch[nearest * d..][..d]);
            assert!((0.003..0.025).contains(&moved), "{moved}");
        }
        n_taken.sort_unstable();
        assert_eq!(n_taken, [4, 4, 5, 5, 5]);
    }

    #[test]
    fn perplexity_counts_rows_that_are_used_alike() {
        assert_eq!(counts(&[0, 3, 5, 0, 3, 5], 7), [2, 0, 0, 2, 0, 2, 0]);
        assert!((perplexity(&[2, 0, 0, 2, 0, 2, 0]) - 3.0).abs() < 1e-12);
        assert!((perplexity(&[0, 0, 9]) - 1.0).abs() < 1e-12);
        // Shares ½, ¼, ¼: 2^(3/2).
        assert!((perplexity(&[2, 1, 1]) - 2.0_f64.powf(1.5)).abs() < 1e-12);
    }
}
