//! How far motion is from what was asked of it.
//!
//! As in OmniControl and GMD (`calculate_trajectory_error`), for one rigid body.

use crate::motion::quaternion::{Quaternion, conj, mul, normalize};
use crate::motion::vector::norm;

/// Misses of a position that count, mm; the second is the one that is reported.
pub const POSITION_THRESHOLDS_MM: [f64; 2] = [200.0, 500.0];
/// Misses of an orientation that count, degrees.
pub const ROTATION_THRESHOLDS_DEG: [f64; 2] = [10.0, 30.0];

/// Returns the angle of the turn between two orientations, `2 acos |a · b|`, 0 to π rad.
///
/// Computed as `2 atan2(|u|, |w|)` of `a* b = (w, u)`, which keeps the digits of small angles.
pub fn rotation_error_rad(a: Quaternion, b: Quaternion) -> f64 {
    let [w, x, y, z] = mul(conj(normalize(a)), normalize(b));
    2.0 * norm([x, y, z]).atan2(w.abs())
}

/// Returns the angle of the turn between two orientations in degrees, 0 to 180.
pub fn rotation_error_deg(a: Quaternion, b: Quaternion) -> f64 {
    rotation_error_rad(a, b).to_degrees()
}

/// Errors of control over several motions, for one threshold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlErrors {
    /// Motions with keyframes.
    pub n_samples: usize,
    pub n_keyframes: usize,
    /// In the unit of the errors.
    pub threshold: f64,
    /// Traj. err.: share of the motions with a miss above the threshold.
    pub trajectory: f64,
    /// Loc. err.: share of the keyframes with such a miss, of all motions together.
    pub location: f64,
    /// The same, a share of each motion first and then their mean, as MaskControl has it.
    pub location_by_sample: f64,
    /// Avg. err.: mean miss over all keyframes; none where one is not finite.
    pub mean: Option<f64>,
    /// The same, a mean of each motion first.
    pub mean_by_sample: Option<f64>,
}

/// Sums up the misses of each motion at its keyframes, in the unit of `threshold`.
///
/// A miss that is not finite is above any threshold. Motions without keyframes do not count; none where
/// there are no others.
pub fn control_errors<S: AsRef<[f64]>>(samples: &[S], threshold: f64) -> Option<ControlErrors> {
    let samples: Vec<&[f64]> =
        samples.iter().map(|misses| misses.as_ref()).filter(|misses| !misses.is_empty()).collect();
    if samples.is_empty() {
        return None;
    }
    let is_above = |miss: &f64| !miss.is_finite() || *miss > threshold;
    let n_above = |misses: &[f64]| misses.iter().filter(|&miss| is_above(miss)).count();
    let sum = |misses: &[f64]| misses.iter().sum::<f64>();
    let over_samples = |statistic: &dyn Fn(&[f64]) -> f64| {
        samples.iter().map(|&misses| statistic(misses)).sum::<f64>() / samples.len() as f64
    };
    let n_keyframes: usize = samples.iter().map(|misses| misses.len()).sum();
    let all_above: usize = samples.iter().map(|&misses| n_above(misses)).sum();
    let all_sum: f64 = samples.iter().map(|&misses| sum(misses)).sum();
    let finite = |x: f64| x.is_finite().then_some(x);
    Some(ControlErrors {
        n_samples: samples.len(),
        n_keyframes,
        threshold,
        trajectory: over_samples(&|misses| f64::from(u8::from(n_above(misses) > 0))),
        location: all_above as f64 / n_keyframes as f64,
        location_by_sample: over_samples(&|misses| n_above(misses) as f64 / misses.len() as f64),
        mean: finite(all_sum / n_keyframes as f64),
        mean_by_sample: finite(over_samples(&|misses| sum(misses) / misses.len() as f64)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::{IDENTITY, from_axis_angle};

    #[test]
    fn angles_are_those_of_the_turn_whatever_the_signs() {
        let axis = [0.6, 0.0, 0.8];
        for angle in [0.0, 1e-9, 0.3, 3.0] {
            let q = from_axis_angle(axis, angle);
            for q in [q, q.map(|c| -c), q.map(|c| 3.0 * c)] {
                assert!((rotation_error_rad(IDENTITY, q) - angle).abs() < 1e-15 + 1e-12 * angle);
            }
        }
        assert!(
            (rotation_error_deg(IDENTITY, from_axis_angle(axis, 4.0)) - 130.816_881).abs() < 1e-5
        );
    }

    #[test]
    fn pooled_and_averaged_errors_differ_where_motions_have_unequal_keyframes() {
        let samples = [vec![100.0, 300.0, 700.0, 100.0], vec![50.0], vec![], vec![200.0, 200.0]];
        let found = control_errors(&samples, 200.0).expect("keyframes");
        assert_eq!((found.n_samples, found.n_keyframes), (3, 7));
        assert!((found.trajectory - 1.0 / 3.0).abs() < 1e-15, "200 is not above 200");
        assert!((found.location - 2.0 / 7.0).abs() < 1e-15);
        assert!((found.location_by_sample - 0.5 / 3.0).abs() < 1e-15);
        assert_eq!(found.mean, Some(1650.0 / 7.0));
        assert!((found.mean_by_sample.expect("finite") - 550.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn a_miss_that_is_not_finite_is_a_miss() {
        let found = control_errors(&[vec![f64::NAN, 1.0], vec![1.0]], 500.0).expect("keyframes");
        assert_eq!((found.trajectory, found.mean, found.mean_by_sample), (0.5, None, None));
        assert!((found.location - 1.0 / 3.0).abs() < 1e-15);
        assert_eq!(control_errors(&[Vec::<f64>::new(), Vec::new()], 500.0), None);
    }
}
