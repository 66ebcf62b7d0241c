//! One number for a motion, by which the best of several is kept.

use ndarray::ArrayView2;

use super::locking::wrong_tempi;
use super::sanity::checks;
use crate::motion::locking::bar_locking;
use crate::motion::phase::unwrapped;
use crate::motion::{Channel, ChannelLimits};

/// Error of a decoded velocity at which coherence counts half, m/s: about a quarter of the mean speed of dance.
const HALF_COHERENT_M_S: f64 = 0.1;

/// Tempi beside the music's own that locking is held against.
const N_WRONG_TEMPI: usize = 12;

/// The score of a motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// From 0 to 1; none for motion that is not finite.
    pub total: Option<f64>,
    pub n_passed: usize,
    pub n_checks: usize,
    /// R² of the vertical velocity with the bar's phase, less that at wrong tempi; none without beats.
    pub locking: Option<f64>,
}

/// Scores a motion, `[T, 25]`, with the bar phase of its frames and the error of its velocity as it was
/// decoded, m/s.
///
/// The mean of: the share of the sanity checks that are passed; 1 / (1 + e / 0.1), e the error; and, where
/// there are beats, max(0, R² − R²₀), R² that of the vertical velocity with the bar (4 harmonics) and R²₀ its
/// mean at 12 wrong tempi.
pub fn score(
    frames: ArrayView2<f32>,
    limits: ChannelLimits,
    phase: Option<&[f64]>,
    velocity_error_m_s: f64,
) -> Score {
    let checks = checks(frames, limits);
    let n_passed = checks.iter().filter(|check| check.passed).count();
    let vertical: Vec<f64> =
        frames.column(Channel::Velocity.range().start + 1).iter().map(|&x| f64::from(x)).collect();
    let locking = phase.map(|phase| locking_above_chance(&vertical, phase));
    let sound = n_passed as f64 / checks.len() as f64;
    let coherent = 1.0 / (1.0 + velocity_error_m_s / HALF_COHERENT_M_S);
    let parts = [Some(sound), Some(coherent), locking.map(|x| x.max(0.0))];
    let n = parts.iter().flatten().count();
    let total = parts.iter().flatten().sum::<f64>() / n as f64;
    let is_finite = total.is_finite() && frames.iter().all(|x| x.is_finite());
    Score { total: is_finite.then_some(total), n_passed, n_checks: checks.len(), locking }
}

/// Returns R² of a vertical velocity with the bar, less its mean at wrong tempi.
///
/// Harmonics are free, so that motion which is chosen by this says nothing of where in the bar it rises.
pub fn locking_above_chance(vertical_m_s: &[f64], phase: &[f64]) -> f64 {
    let bars = unwrapped(phase);
    let at = |tempo: f64| {
        let phase: Vec<f64> = bars.iter().map(|x| (x * tempo).rem_euclid(1.0)).collect();
        bar_locking(vertical_m_s, &phase)
    };
    let tempi = wrong_tempi(N_WRONG_TEMPI);
    let wrong = tempi.iter().map(|&tempo| at(tempo)).sum::<f64>() / tempi.len() as f64;
    at(1.0) - wrong
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use std::f64::consts::TAU;

    fn phase(n: usize) -> Vec<f64> {
        (0..n).map(|t| (t as f64 / 47.0).fract()).collect()
    }

    /// Stands at the origin and bobs at a tempo.
    fn bobbing(n: usize, tempo: f64) -> Array2<f32> {
        let mut frames = Array2::zeros((n, 25));
        frames.column_mut(9).fill(1.0);
        for t in 0..n {
            frames[[t, 4]] = (TAU * tempo * t as f64 / 47.0).sin() as f32;
        }
        frames
    }

    #[test]
    fn motion_in_time_scores_above_motion_out_of_time() {
        let score_at = |tempo| {
            let frames = bobbing(900, tempo);
            score(frames.view(), ChannelLimits::Wide, Some(&phase(900)), 0.1)
        };
        let (right, wrong) = (score_at(1.0), score_at(0.93));
        assert!(right.locking > Some(0.9) && wrong.locking < Some(0.1), "{right:?} {wrong:?}");
        assert!(right.total > wrong.total);
        let expected = (right.n_passed as f64 / 13.0 + 0.5 + right.locking.expect("beats")) / 3.0;
        assert!((right.total.expect("finite") - expected).abs() < 1e-12);
    }

    #[test]
    fn without_beats_two_parts_count_and_nan_has_no_score() {
        let mut frames = bobbing(90, 1.0);
        let scored = score(frames.view(), ChannelLimits::Wide, None, 0.0);
        let expected = (scored.n_passed as f64 / 13.0 + 1.0) / 2.0;
        assert_eq!((scored.locking, scored.total), (None, Some(expected)));
        frames[[3, 20]] = f32::NAN;
        assert_eq!(score(frames.view(), ChannelLimits::Wide, None, 0.0).total, None);
        assert_eq!(score(bobbing(90, 1.0).view(), ChannelLimits::Wide, None, f64::NAN).total, None);
    }
}
