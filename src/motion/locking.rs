//! How strongly a signal is locked to the bar.
//!
//! For a single rigid body the usual test of speed minima against beats finds nothing even in real
//! dance; what real dance shows is a movement that repeats with the bar.

use std::f64::consts::TAU;

/// Harmonics of the bar that are fitted.
pub const N_HARMONICS: usize = 4;
/// Numbers that are fitted: a constant, and a cosine and a sine per harmonic.
const N_FITTED: usize = 1 + 2 * N_HARMONICS;

/// Returns the share of a signal's variance that follows the bar, R² in [0, 1].
///
/// `R² = 1 - Σ(x - x̂)² / Σ(x - x̄)²` with `x̂` the least-squares fit of a constant and
/// `cos 2πhφ`, `sin 2πhφ`, h = 1 … 4, to the signal; φ the bar phase of each value. 0 for a signal that
/// is constant or has no more values than the 9 that are fitted. By chance alone R² is about 8 over
/// the number of independent values, so compare it with R² at other tempi.
pub fn bar_locking(signal: &[f64], phase: &[f64]) -> f64 {
    let n = signal.len().min(phase.len());
    if n <= N_FITTED {
        return 0.0;
    }
    let (signal, phase) = (&signal[..n], &phase[..n]);
    let mean = signal.iter().sum::<f64>() / n as f64;
    let (mut gram, mut projection) = ([[0.0; N_FITTED]; N_FITTED], [0.0; N_FITTED]);
    let mut total = 0.0;
    for (&x, &phi) in signal.iter().zip(phase) {
        let wave = waves(phi);
        for i in 0..N_FITTED {
            projection[i] += wave[i] * (x - mean);
            for j in 0..=i {
                gram[i][j] += wave[i] * wave[j];
            }
        }
        total += (x - mean) * (x - mean);
    }
    // A variance at the rounding of the mean is none.
    if total <= n as f64 * (mean.abs() * f64::EPSILON * 16.0).powi(2) {
        return 0.0;
    }
    (explained(gram, projection) / total).clamp(0.0, 1.0)
}

fn waves(phase: f64) -> [f64; N_FITTED] {
    std::array::from_fn(|i| {
        let angle = TAU * i.div_ceil(2) as f64 * phase;
        if i % 2 == 0 { angle.cos() } else { angle.sin() }
    })
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
