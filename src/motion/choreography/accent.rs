//! Kinematic accents: the moments at which a body all but stops before it goes on.

use crate::motion::quantile::percentile;
use crate::motion::vector::norm;
use crate::units::FPS;

/// Lever arm that turns a rate of turning into a speed, m: about half the width of the hips and
/// shoulders, so that a spin on the spot counts as motion.
pub const LEVER_ARM_M: f64 = 0.3;
/// An accent is lower than its surroundings by at least this, m/s.
const MIN_PROMINENCE_M_S: f64 = 0.05;
/// And by at least this share of the range of the whole take.
const MIN_PROMINENCE_PER_RANGE: f64 = 0.15;
/// How far the surroundings of an accent reach, frames.
const SURROUNDINGS_FRAMES: usize = 75;

/// Returns the effort of every frame, m/s: `|v| + ρ |ω|` with `ρ` = 0.3 m.
pub fn effort(velocity_m_s: &[[f64; 3]], angular_velocity_rad_s: &[[f64; 3]]) -> Vec<f64> {
    let turning = angular_velocity_rad_s.iter().map(|w| LEVER_ARM_M * norm(*w));
    velocity_m_s.iter().zip(turning).map(|(v, turning)| norm(*v) + turning).collect()
}

/// Returns the energy of every frame, J per kg: `(|v|² + ρ² |ω|²) / 2` with `ρ` = 0.3 m.
pub fn energy(velocity_m_s: &[[f64; 3]], angular_velocity_rad_s: &[[f64; 3]]) -> Vec<f64> {
    let turning = angular_velocity_rad_s.iter().map(|w| (LEVER_ARM_M * norm(*w)).powi(2));
    velocity_m_s
        .iter()
        .zip(turning)
        .map(|(v, turning)| (norm(*v).powi(2) + turning) / 2.0)
        .collect()
}

/// Returns the frames of the accents of an effort signal, ascending: its prominent minima.
///
/// A minimum is prominent if on both sides, before anything lower and within 2.5 s, the effort rises
/// above it by 0.05 m/s and by 15 % of the range between the 5th and 95th percentile of the take.
pub fn accents(effort_m_s: &[f64]) -> Vec<usize> {
    let at = |p| percentile(&mut effort_m_s.to_vec(), p).unwrap_or(0.0);
    let range_m_s = at(95.0) - at(5.0);
    let prominence_m_s = MIN_PROMINENCE_M_S.max(MIN_PROMINENCE_PER_RANGE * range_m_s);
    let rises = |from: f64, side: &mut dyn Iterator<Item = &f64>| {
        side.take(SURROUNDINGS_FRAMES)
            .take_while(|&&e| e >= from)
            .any(|&e| e - from >= prominence_m_s)
    };
    (1..effort_m_s.len().saturating_sub(1))
        .filter(|&t| {
            let here = effort_m_s[t];
            here < effort_m_s[t - 1]
                && here <= effort_m_s[t + 1]
                && rises(here, &mut effort_m_s[..t].iter().rev())
                && rises(here, &mut effort_m_s[t + 1..].iter())
        })
        .collect()
}

/// Returns where a take is cut, ascending: its ends, its accents, and points that divide what lies
/// longer than `longest_frames` between two of those evenly.
pub fn cuts(effort_m_s: &[f64], longest_frames: usize) -> Vec<usize> {
    let Some(last) = effort_m_s.len().checked_sub(1) else { return Vec::new() };
    let ends = accents(effort_m_s).into_iter().chain([last]);
    let mut cuts = vec![0];
    for end in ends {
        let start = cuts[cuts.len() - 1];
        let n_pieces = (end - start).div_ceil(longest_frames);
        cuts.extend((1..=n_pieces).map(|i| start + (end - start) * i / n_pieces));
    }
    cuts
}

/// Returns forward differences of a signal per second, the last one held.
pub fn held_differences<const N: usize>(x: &[[f64; N]]) -> Vec<[f64; N]> {
    let difference = |w: &[[f64; N]]| std::array::from_fn(|i| (w[1][i] - w[0][i]) * FPS);
    let mut d: Vec<[f64; N]> = x.windows(2).map(difference).collect();
    d.extend(x.first().map(|_| d.last().copied().unwrap_or([0.0; N])));
    d
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn a_spin_on_the_spot_is_effort_and_energy() {
        let (v, w) = ([[3.0, 0.0, 4.0]], [[0.0, -2.0, 0.0]]);
        assert_eq!(effort(&v, &w), [5.6]);
        assert_eq!(energy(&v, &w), [(25.0 + 0.36) / 2.0]);
    }

    #[test]
    fn accents_are_the_valleys_of_a_wave() {
        // Peaks at 1.2 m/s, valleys at 0.2 m/s every 20 frames, the first at frame 15.
        let wave: Vec<f64> =
            (0..100).map(|t| 0.7 + 0.5 * (TAU * f64::from(t) / 20.0).sin()).collect();
        assert_eq!(accents(&wave), [15, 35, 55, 75, 95]);
    }

    #[test]
    fn ripples_are_no_accents_and_plateaus_are_one() {
        let ripple = |t: usize| if t.is_multiple_of(4) { 0.0 } else { 0.02 };
        let wave = |t: usize| 1.0 + (TAU * t as f64 / 50.0).cos() + ripple(t);
        let found = accents(&(0..100).map(wave).collect::<Vec<_>>());
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].abs_diff(25) <= 3 && found[1].abs_diff(75) <= 3, "{found:?}");
        assert_eq!(accents(&[1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0]), [2]);
        assert_eq!(accents(&[0.5; 40]), Vec::<usize>::new());
        assert_eq!(accents(&[]), Vec::<usize>::new());
    }

    #[test]
    fn long_stretches_without_accents_are_divided() {
        assert_eq!(cuts(&[1.0; 161], 75), [0, 53, 106, 160]);
        assert_eq!(cuts(&[1.0; 76], 75), [0, 75]);
        assert_eq!(cuts(&[1.0], 75), [0]);
        assert_eq!(cuts(&[], 75), Vec::<usize>::new());
    }

    #[test]
    fn the_last_difference_is_held() {
        assert_eq!(held_differences(&[[1.0], [2.0], [4.0]]), [[30.0], [60.0], [60.0]]);
        assert_eq!(held_differences(&[[7.0, 1.0]]), [[0.0, 0.0]]);
        assert!(held_differences::<3>(&[]).is_empty());
    }
}
