//! Estimates with their 95 % intervals, and the seeded draws of resampling.
//!
//! Which interval is for what:
//!
//! * a mean over independent items (phrases, songs, replications): [`mean_estimate`], normal theory;
//! * a mean over items of which those of one song are alike: [`clustered_mean_estimate`];
//! * a share of items: [`share_estimate`], Wilson's score interval, which stays in [0, 1];
//! * a number of a whole set (Fréchet distance, R² over songs): [`bootstrap_estimate`], the value and
//!   1.96 standard errors of the bootstrap. Its percentiles are not used: a set drawn with replacement
//!   repeats items, which moves a Fréchet distance up, and the percentiles might not hold the value.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Standard deviations on either side that hold 95 % of a normal distribution, rounded as in the field.
pub const Z_95: f64 = 1.96;

/// Least share of resamples that must have a value for an interval.
const MIN_SHARE_OF_RESAMPLES: f64 = 0.9;

/// A measured number with its interval; absent where there is too little to say.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    pub value: Option<f64>,
    pub ci_low: Option<f64>,
    pub ci_high: Option<f64>,
    /// Items that were measured.
    pub n: usize,
}

impl Estimate {
    /// A number of `n` items without an interval; absent where it is not finite.
    pub fn plain(value: Option<f64>, n: usize) -> Self {
        Self { value: value.filter(|x| x.is_finite()), n, ..Self::default() }
    }

    /// A number with an interval of `half_width` on either side, if that is finite.
    fn around(value: f64, half_width: f64, n: usize) -> Self {
        let plain = Self::plain(Some(value), n);
        if plain.value.is_none() || !half_width.is_finite() {
            return plain;
        }
        Self { ci_low: Some(value - half_width), ci_high: Some(value + half_width), ..plain }
    }
}

/// Returns mean and standard deviation (of a sample: n - 1); none for fewer than two values or where one
/// is not finite.
pub fn mean_and_deviation(values: &[f64]) -> Option<(f64, f64)> {
    if values.len() < 2 {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
    let deviation = (squares / (n - 1.0)).sqrt();
    (mean.is_finite() && deviation.is_finite()).then_some((mean, deviation))
}

/// Estimates a mean over independent items: `x̄ ± 1.96 s / √n`.
///
/// Absent without items or where one is not finite; no interval for a single one.
pub fn mean_estimate(values: &[f64]) -> Estimate {
    let n = values.len();
    match (mean_and_deviation(values), values) {
        (Some((mean, s)), _) => Estimate::around(mean, Z_95 * s / (n as f64).sqrt(), n),
        (None, &[single]) => Estimate::plain(Some(single), n),
        (None, _) => Estimate::plain(None, n),
    }
}

/// Estimates a mean over items of which those of one cluster, such as a song, are no independent ones.
///
/// `x̄ ± 1.96 √(G/(G-1) Σ_g (Σ_{i in g} (x_i - x̄))²) / n` with G clusters, which for clusters of one item is
/// [`mean_estimate`]. `clusters` names the cluster of each value. Absent without items or where one is not
/// finite; no interval for a single cluster. Source: Liang and Zeger, "Longitudinal Data Analysis Using
/// Generalized Linear Models", 1986, for a mean.
pub fn clustered_mean_estimate(values: &[f64], clusters: &[usize]) -> Estimate {
    let n = values.len();
    let mean = values.iter().sum::<f64>() / n as f64;
    if n == 0 || !mean.is_finite() {
        return Estimate::plain(None, n);
    }
    let mut sums: BTreeMap<usize, f64> = BTreeMap::new();
    for (x, cluster) in values.iter().zip(clusters) {
        *sums.entry(*cluster).or_default() += x - mean;
    }
    let n_clusters = sums.len() as f64;
    let spread = n_clusters / (n_clusters - 1.0) * sums.values().map(|x| x * x).sum::<f64>();
    Estimate::around(mean, Z_95 * spread.sqrt() / n as f64, n)
}

/// Estimates the share of `n` items that `n_true` of them are, with Wilson's score interval.
///
/// `(p + z²/2n ± z √(p (1 - p) / n + z²/4n²)) / (1 + z²/n)`, z = 1.96. Source: Wilson, "Probable Inference,
/// the Law of Succession, and Statistical Inference", 1927.
pub fn share_estimate(n_true: usize, n: usize) -> Estimate {
    if n == 0 {
        return Estimate::plain(None, 0);
    }
    let (p, count) = (n_true.min(n) as f64 / n as f64, n as f64);
    let z2 = Z_95 * Z_95;
    let middle = p + z2 / (2.0 * count);
    let half = Z_95 * (p * (1.0 - p) / count + z2 / (4.0 * count * count)).sqrt();
    let scale = 1.0 + z2 / count;
    let bound = |x: f64| Some((x / scale).clamp(0.0, 1.0));
    Estimate { value: Some(p), ci_low: bound(middle - half), ci_high: bound(middle + half), n }
}

/// Estimates a number of a whole set of `n` items: `value ± 1.96 s`, s the standard deviation of the
/// number over `n_resamples` sets of n items that are drawn with replacement.
///
/// `statistic` is given the indices of the items. Items must be independent: songs rather than the
/// phrases cut from them. Absent where the set has no value; no interval where a tenth of the resamples
/// have none. Source: Efron, "Bootstrap Methods: Another Look at the Jackknife", 1979.
pub fn bootstrap_estimate(
    n: usize,
    n_resamples: usize,
    seed: u64,
    statistic: impl Fn(&[usize]) -> Option<f64>,
) -> Estimate {
    let all: Vec<usize> = (0..n).collect();
    let value = statistic(&all).filter(|x| x.is_finite());
    let (Some(value), true) = (value, n > 1) else { return Estimate::plain(value, n) };
    let mut draws = Draws::new(seed);
    let mut indices = all;
    let mut found = Vec::with_capacity(n_resamples);
    for _ in 0..n_resamples {
        indices.fill_with(|| draws.below(n));
        found.extend(statistic(&indices).filter(|x| x.is_finite()));
    }
    let enough = found.len() as f64 >= MIN_SHARE_OF_RESAMPLES * n_resamples as f64;
    match mean_and_deviation(&found) {
        Some((_, s)) if enough => Estimate::around(value, Z_95 * s, n),
        _ => Estimate::plain(Some(value), n),
    }
}

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

    fn near(estimate: Estimate, wanted: [f64; 3]) {
        let found = [estimate.value, estimate.ci_low, estimate.ci_high];
        for (found, wanted) in found.into_iter().zip(wanted) {
            assert!(found.is_some_and(|x| (x - wanted).abs() < 1e-12), "{estimate:?}, {wanted}");
        }
    }

    #[test]
    fn items_of_one_cluster_count_as_alike() {
        let values = [1.0, 2.0, 4.0, 9.0, 5.5];
        let alone = clustered_mean_estimate(&values, &[0, 1, 2, 3, 4]);
        let plain = mean_estimate(&values);
        for (a, b) in [(alone.ci_low, plain.ci_low), (alone.ci_high, plain.ci_high)] {
            assert!((a.unwrap() - b.unwrap()).abs() < 1e-12, "{alone:?} {plain:?}");
        }
        // Mean 3, two clusters off by -3 and 3: √(2 · 18) / 4 = 1.5.
        let pairs = clustered_mean_estimate(&[1.0, 2.0, 4.0, 5.0], &[7, 7, 3, 3]);
        assert_eq!((pairs.value, pairs.n), (Some(3.0), 4));
        assert!((pairs.ci_high.unwrap() - (3.0 + 1.96 * 1.5)).abs() < 1e-12, "{pairs:?}");
        let one = clustered_mean_estimate(&[1.0, 3.0], &[5, 5]);
        assert_eq!((one.value, one.ci_low, one.ci_high), (Some(2.0), None, None));
        assert_eq!(clustered_mean_estimate(&[], &[]).value, None);
        assert_eq!(clustered_mean_estimate(&[f64::NAN, 1.0], &[0, 1]).value, None);
    }

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

    #[test]
    fn a_mean_has_the_interval_of_normal_theory() {
        // Deviations -3, 0 and 3: s = 3.
        let half = 1.96 * 3.0 / 3.0_f64.sqrt();
        near(mean_estimate(&[2.0, 5.0, 8.0]), [5.0, 5.0 - half, 5.0 + half]);
        assert_eq!(mean_estimate(&[4.0]), Estimate::plain(Some(4.0), 1));
        assert_eq!(mean_estimate(&[]), Estimate::plain(None, 0));
        assert_eq!(mean_estimate(&[1.0, f64::NAN, 2.0]), Estimate::plain(None, 3));
        assert_eq!(mean_estimate(&[f64::INFINITY]), Estimate::plain(None, 1));
    }

    #[test]
    fn a_share_stays_between_nothing_and_all() {
        // Where all pass the lower bound is 1 / (1 + z²/n), and where none do the upper its rest.
        near(share_estimate(13, 13), [1.0, 1.0 / (1.0 + 1.96 * 1.96 / 13.0), 1.0]);
        near(share_estimate(0, 7), [0.0, 0.0, 1.0 - 1.0 / (1.0 + 1.96 * 1.96 / 7.0)]);
        assert_eq!(share_estimate(0, 0), Estimate::plain(None, 0));
    }

    #[test]
    fn the_bootstrap_of_a_mean_agrees_with_normal_theory() {
        let values: Vec<f64> = (0..101).map(|i| f64::from(i * i % 101)).collect();
        let mean = |indices: &[usize]| {
            Some(indices.iter().map(|&i| values[i]).sum::<f64>() / indices.len() as f64)
        };
        let (a, b) = (bootstrap_estimate(101, 2000, 3, mean), mean_estimate(&values));
        assert!((a.value.expect("a mean") - b.value.expect("a mean")).abs() < 1e-12);
        let width = |e: Estimate| e.ci_high.expect("an interval") - e.ci_low.expect("an interval");
        // A standard deviation of 2000 draws is good to 1 / √4000.
        assert!((width(a) / width(b) - 1.0).abs() < 0.06, "{a:?} {b:?}");
        assert_eq!(a, bootstrap_estimate(101, 2000, 3, mean));
    }

    #[test]
    fn what_has_no_value_has_no_interval() {
        assert_eq!(bootstrap_estimate(5, 10, 0, |_| None), Estimate::plain(None, 5));
        assert_eq!(bootstrap_estimate(5, 10, 0, |_| Some(f64::NAN)), Estimate::plain(None, 5));
        let once = |indices: &[usize]| (indices == [0, 1, 2, 3, 4]).then_some(2.0);
        assert_eq!(bootstrap_estimate(5, 10, 0, once), Estimate::plain(Some(2.0), 5));
        assert_eq!(bootstrap_estimate(1, 10, 0, |_| Some(2.0)), Estimate::plain(Some(2.0), 1));
    }
}
