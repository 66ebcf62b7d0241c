//! How strongly a signal is locked to the bar.
//!
//! For a single rigid body the usual test of speed minima against beats finds nothing even in real
//! dance; what real dance shows is a movement that repeats with the bar.

use std::f64::consts::TAU;

/// Harmonics of the bar that are fitted.
pub const N_HARMONICS: usize = 4;
/// Numbers that are fitted: a constant, and a cosine and a sine per harmonic.
const N_FITTED: usize = 1 + 2 * N_HARMONICS;

/// Sums over the values of a signal from which its fit to the bar follows; those of two stretches add up
/// to those of both.
///
/// Products of two harmonics are halves of harmonics of their sum and difference, so that the Gram matrix
/// follows from the sums of `cos 2πhφ` and `sin 2πhφ`, h = 0 … 8.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BarSums {
    n: usize,
    /// Of the signal and its square.
    signal: f64,
    square: f64,
    cosine: [f64; 2 * N_HARMONICS + 1],
    sine: [f64; 2 * N_HARMONICS + 1],
    /// Of the signal times both, h = 0 … 4.
    by_cosine: [f64; N_HARMONICS + 1],
    by_sine: [f64; N_HARMONICS + 1],
}

impl BarSums {
    /// Sums over the values of a signal, each with its bar phase φ; whole bars do not count.
    pub fn of(values: impl IntoIterator<Item = (f64, f64)>) -> Self {
        let mut sums = Self::default();
        for (x, phase) in values {
            let (sine, cosine) = (TAU * phase.fract()).sin_cos();
            let (mut c, mut s) = (1.0, 0.0);
            sums.n += 1;
            sums.signal += x;
            sums.square += x * x;
            for h in 0..=2 * N_HARMONICS {
                sums.cosine[h] += c;
                sums.sine[h] += s;
                if h <= N_HARMONICS {
                    sums.by_cosine[h] += x * c;
                    sums.by_sine[h] += x * s;
                }
                (c, s) = (c * cosine - s * sine, s * cosine + c * sine);
            }
        }
        sums
    }

    /// Adds the sums of another stretch.
    pub fn add(&mut self, other: &Self) {
        self.n += other.n;
        self.signal += other.signal;
        self.square += other.square;
        let pairs = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        pairs(&mut self.cosine, &other.cosine);
        pairs(&mut self.sine, &other.sine);
        pairs(&mut self.by_cosine, &other.by_cosine);
        pairs(&mut self.by_sine, &other.by_sine);
    }

    /// Whether there are more values than the 9 numbers that are fitted.
    pub fn can_be_fitted(&self) -> bool {
        self.n > N_FITTED
    }

    /// Returns the share of the variance that follows the bar, as [`bar_locking`] does; NaN where a value is
    /// not finite.
    pub fn r2(&self) -> f64 {
        if !self.can_be_fitted() {
            return 0.0;
        }
        let n = self.n as f64;
        let mean = self.signal / n;
        let total = self.square - n * mean * mean;
        if !(total + self.cosine[1]).is_finite() {
            return f64::NAN;
        }
        // A variance at the rounding of the squares is none.
        if total <= self.square * f64::EPSILON * (16.0 + n) {
            return 0.0;
        }
        // Waves in the order 1, sin φ, cos φ, sin 2φ, cos 2φ, …
        let wave = |i: usize| (i.div_ceil(2), i.is_multiple_of(2));
        let (mut gram, mut projection) = ([[0.0; N_FITTED]; N_FITTED], [0.0; N_FITTED]);
        for i in 0..N_FITTED {
            let (h, is_cosine) = wave(i);
            projection[i] = if is_cosine {
                self.by_cosine[h] - mean * self.cosine[h]
            } else {
                self.by_sine[h] - mean * self.sine[h]
            };
            for (j, product) in gram[i].iter_mut().enumerate().take(i + 1) {
                let (k, other_is_cosine) = wave(j);
                let (sum, difference) = (h + k, h.abs_diff(k));
                *product = match (is_cosine, other_is_cosine) {
                    (true, true) => (self.cosine[difference] + self.cosine[sum]) / 2.0,
                    (false, false) => (self.cosine[difference] - self.cosine[sum]) / 2.0,
                    // sin hφ cos kφ = (sin (h + k)φ + sin (h - k)φ) / 2, and the sine is odd.
                    (false, true) => {
                        let sign = if h >= k { 1.0 } else { -1.0 };
                        (self.sine[sum] + sign * self.sine[difference]) / 2.0
                    }
                    (true, false) => {
                        let sign = if k >= h { 1.0 } else { -1.0 };
                        (self.sine[sum] + sign * self.sine[difference]) / 2.0
                    }
                };
            }
        }
        (explained(gram, projection) / total).clamp(0.0, 1.0)
    }
}

/// Returns the share of a signal's variance that follows the bar, R² in [0, 1].
///
/// `R² = 1 - Σ(x - x̂)² / Σ(x - x̄)²` with `x̂` the least-squares fit of a constant and
/// `cos 2πhφ`, `sin 2πhφ`, h = 1 … 4, to the signal; φ the bar phase of each value. 0 for a signal that
/// is constant or has no more values than the 9 that are fitted. By chance alone R² is about 8 over
/// the number of independent values, so compare it with R² at other tempi.
pub fn bar_locking(signal: &[f64], phase: &[f64]) -> f64 {
    // Squares keep more digits about the mean.
    let n = signal.len().min(phase.len());
    let mean = signal[..n].iter().sum::<f64>() / n.max(1) as f64;
    BarSums::of(signal.iter().map(|x| x - mean).zip(phase.iter().copied())).r2()
}

/// Returns `bᵀ G⁻¹ b`, the sum of squares that the fit explains, by Cholesky factors `G = L Lᵀ`:
/// it is `|y|²` with `L y = b`. Waves that repeat earlier ones (phases on few points) add nothing.
fn explained(gram: [[f64; N_FITTED]; N_FITTED], b: [f64; N_FITTED]) -> f64 {
    let mut l = gram;
    let mut y = [0.0; N_FITTED];
    for i in 0..N_FITTED {
        for j in 0..i {
            let dot: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            l[i][j] = if l[j][j] > 0.0 { (gram[i][j] - dot) / l[j][j] } else { 0.0 };
        }
        let rest = gram[i][i] - (0..i).map(|k| l[i][k] * l[i][k]).sum::<f64>();
        let is_new = rest > 1e-9 * gram[i][i];
        l[i][i] = if is_new { rest.sqrt() } else { 0.0 };
        let dot: f64 = (0..i).map(|k| l[i][k] * y[k]).sum();
        y[i] = if is_new { (b[i] - dot) / l[i][i] } else { 0.0 };
    }
    y.iter().map(|y| y * y).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn phases(n: usize, bar_frames: f64) -> Vec<f64> {
        (0..n).map(|t| (t as f64 / bar_frames).fract()).collect()
    }

    #[test]
    fn low_harmonics_of_the_bar_are_locked_entirely() {
        let phase = phases(311, 47.3);
        for h in 1..=4 {
            let wave: Vec<f64> =
                phase.iter().map(|p| 3.0 + (TAU * f64::from(h) * p + 0.7).cos()).collect();
            assert!((bar_locking(&wave, &phase) - 1.0).abs() < 1e-12, "{h}");
        }
        let fifth: Vec<f64> = phases(473, 47.3).iter().map(|p| (TAU * 5.0 * p).sin()).collect();
        // 473 frames are ten bars, over which harmonics are orthogonal.
        assert!(bar_locking(&fifth, &phases(473, 47.3)) < 1e-3);
    }

    #[test]
    fn half_of_the_variance_is_one_half() {
        let phase = phases(600, 60.0);
        let both: Vec<f64> = phase
            .iter()
            .enumerate()
            .map(|(t, p)| (TAU * p).sin() + (TAU * 7.0 * t as f64 / 60.0).cos())
            .collect();
        assert!((bar_locking(&both, &phase) - 0.5).abs() < 1e-12);
    }

    /// The definition: least squares by the normal equations of the nine waves themselves.
    fn by_definition(signal: &[f64], phase: &[f64]) -> f64 {
        let wave = |phi: f64| -> [f64; N_FITTED] {
            std::array::from_fn(|i| {
                let angle = TAU * i.div_ceil(2) as f64 * phi;
                if i % 2 == 0 { angle.cos() } else { angle.sin() }
            })
        };
        let mean = signal.iter().sum::<f64>() / signal.len() as f64;
        let (mut gram, mut b) = ([[0.0; N_FITTED]; N_FITTED], [0.0; N_FITTED]);
        for (x, &phi) in signal.iter().zip(phase) {
            let wave = wave(phi);
            for i in 0..N_FITTED {
                b[i] += wave[i] * (x - mean);
                (0..=i).for_each(|j| gram[i][j] += wave[i] * wave[j]);
            }
        }
        explained(gram, b) / signal.iter().map(|x| (x - mean).powi(2)).sum::<f64>()
    }

    #[test]
    fn sums_of_stretches_are_those_of_the_whole_and_fit_as_by_definition() {
        let signal: Vec<f64> = (0..137).map(|t| f64::from(t * t % 23) / 7.0 + 1.3).collect();
        let phase: Vec<f64> =
            (0..137).map(|t| f64::from(t) / 31.7 + 0.004 * f64::from(t % 5)).collect();
        let expected = by_definition(&signal, &phase);
        assert!((0.003..0.99).contains(&expected), "{expected}");
        let sums =
            |range: std::ops::Range<usize>| BarSums::of(range.map(|t| (signal[t], phase[t])));
        let mut both = sums(0..50);
        both.add(&sums(50..137));
        for found in [bar_locking(&signal, &phase), sums(0..137).r2(), both.r2()] {
            assert!((found - expected).abs() < 1e-11, "{found} {expected}");
        }
        assert!(BarSums::of([(0.0, f64::NAN); 20]).r2().is_nan());
        assert!(BarSums::of((0..20).map(|t| (f64::NAN, f64::from(t) / 7.0))).r2().is_nan());
    }

    #[test]
    fn another_tempo_is_not_locked() {
        let signal: Vec<f64> = phases(900, 60.0).iter().map(|p| (TAU * p).sin()).collect();
        // Thirty seconds of a bar that is a sixth longer: 2.1 bars apart at the end.
        assert!(bar_locking(&signal, &phases(900, 70.0)) < 0.02);
    }

    #[test]
    fn short_constant_and_degenerate_signals_are_finite() {
        assert_eq!(bar_locking(&[1.0; 9], &phases(9, 4.0)), 0.0);
        assert_eq!(bar_locking(&[0.1; 90], &phases(90, 31.0)), 0.0);
        assert_eq!(bar_locking(&[], &[]), 0.0);
        // Two phases only: a square wave is a line through two points.
        let square: Vec<f64> = (0..40).map(|t| f64::from(t % 2)).collect();
        let phase: Vec<f64> = (0..40).map(|t| f64::from(t % 2) / 2.0).collect();
        assert!((bar_locking(&square, &phase) - 1.0).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn it_is_a_share_and_does_not_depend_on_unit_or_offset(
            x in prop::collection::vec(-5.0..5.0f64, 0..80), bar in 2.5..60.0f64,
            scale in 0.01..100.0f64, offset in -3.0..3.0f64
        ) {
            let phase = phases(x.len(), bar);
            let r2 = bar_locking(&x, &phase);
            prop_assert!((0.0..=1.0).contains(&r2));
            let other: Vec<f64> = x.iter().map(|x| x * scale + offset).collect();
            prop_assert!((bar_locking(&other, &phase) - r2).abs() < 1e-6);
        }
    }
}
