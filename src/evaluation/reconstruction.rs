//! How far motion that was written down and made again is from what it was.

use ndarray::ArrayView2;

use super::control::rotation_error_deg;
use crate::motion::Channel;

/// Means over all frames of some pieces of motion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReconstructionError {
    /// ⟨|p − p̂|⟩, m.
    pub position_m: f64,
    /// ⟨angle between q and q̂⟩, degrees.
    pub orientation_deg: f64,
}

/// Compares pieces of motion with themselves made again, frame by frame; none without frames.
///
/// `pairs`: \[n, 25\] each, both in one frame of reference
pub fn reconstruction_error<'a>(
    pairs: impl IntoIterator<Item = (ArrayView2<'a, f32>, ArrayView2<'a, f32>)>,
) -> Option<ReconstructionError> {
    let (mut sum, mut n) = (ReconstructionError::default(), 0.0);
    for (was, made) in pairs {
        for (was, made) in was.rows().into_iter().zip(made.rows()) {
            let values = |row: &ndarray::ArrayView1<f32>, channel: Channel, i: usize| {
                f64::from(row[channel.range().start + i])
            };
            let apart =
                |i| values(&was, Channel::Position, i) - values(&made, Channel::Position, i);
            sum.position_m += (0..3).map(|i| f64::powi(apart(i), 2)).sum::<f64>().sqrt();
            let [a, b] = [&was, &made]
                .map(|row| std::array::from_fn(|i| values(row, Channel::Quaternion, i)));
            sum.orientation_deg += rotation_error_deg(a, b);
            n += 1.0;
        }
    }
    (n > 0.0).then(|| ReconstructionError {
        position_m: sum.position_m / n,
        orientation_deg: sum.orientation_deg / n,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use crate::motion::quaternion::from_axis_angle;
    use ndarray::Array2;

    fn standing(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, MOTION_DIM));
        frames.column_mut(Channel::Quaternion.range().start).fill(1.0);
        frames
    }

    #[test]
    fn errors_are_means_over_all_frames_in_metres_and_degrees() {
        let (a, b) = (standing(3), standing(1));
        let (mut a_made, mut b_made) = (a.clone(), b.clone());
        let first = Channel::Position.range().start;
        (a_made[[0, first]], a_made[[0, first + 2]]) = (0.3, -0.4);
        let turned = from_axis_angle([0.0, 1.0, 0.0], 40_f64.to_radians());
        for (i, q) in Channel::Quaternion.range().zip(turned) {
            // The other sign is the same turn, and half its length too.
            b_made[[0, i]] = -0.5 * q as f32;
        }
        let pairs = [(a.view(), a_made.view()), (b.view(), b_made.view())];
        let found = reconstruction_error(pairs).expect("frames");
        assert!((found.position_m - 0.5 / 4.0).abs() < 1e-7, "{found:?}");
        assert!((found.orientation_deg - 40.0 / 4.0).abs() < 1e-5, "{found:?}");
        assert_eq!(reconstruction_error([]), None);
    }
}
