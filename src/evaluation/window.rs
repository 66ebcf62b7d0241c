//! Windows: all that is compared is measured on stretches of one length.
//!
//! Several numbers depend on how long a motion is (a maximum over frames, the log-dimensionless jerk) or on
//! where it has wandered to. Generated tracks last minutes, phrases of a library four seconds; cut into windows
//! of one length, each over the origin and facing +Z at its first frame, both can be compared.

use ndarray::{Array2, ArrayView2, s};

use crate::motion::Placement;
use crate::motion::quantile::percentile;

use super::kinetic::CHUNK_FRAMES;

/// Frames of a window, where the training motion is long enough: four seconds, as networks are trained on.
pub const WINDOW_FRAMES: usize = 120;

/// Percentage of the training motions that may be shorter than a window.
const SHORTER_PERCENT: f64 = 10.0;

/// Returns the length of windows for training motions of these lengths: 120 frames, or as many as nine in ten
/// of them have.
///
/// None where that is below the 75 frames of which features are made.
pub fn window_frames(n_frames: impl IntoIterator<Item = usize>) -> Option<usize> {
    let mut lengths: Vec<f64> = n_frames.into_iter().map(|n| n as f64).collect();
    let most = percentile(&mut lengths, SHORTER_PERCENT)?.floor() as usize;
    let length = most.min(WINDOW_FRAMES);
    (length >= CHUNK_FRAMES).then_some(length)
}

/// Returns the length of windows for motions of these lengths where there is no training motion to compare with: 120
/// frames, or as many as nine in ten of them have.
pub fn own_window_frames(n_frames: impl IntoIterator<Item = usize>) -> usize {
    let mut lengths: Vec<f64> = n_frames.into_iter().map(|n| n as f64).collect();
    let most = percentile(&mut lengths, SHORTER_PERCENT).unwrap_or(0.0).floor() as usize;
    most.clamp(1, WINDOW_FRAMES)
}

/// Returns the first frames of the windows of a motion, one behind the other; what is left at its end belongs to
/// none.
pub fn window_starts(n_frames: usize, window_frames: usize) -> impl Iterator<Item = usize> {
    (0..n_frames / window_frames.max(1)).map(move |i| i * window_frames)
}

/// Returns a window of a motion, `[n_frames, 25]`, over the origin and facing +Z at its first frame.
///
/// # Panics
/// When the motion ends before.
pub fn window(frames: ArrayView2<f32>, first: usize, n_frames: usize) -> Array2<f32> {
    let mut found = frames.slice(s![first..first + n_frames, ..]).to_owned();
    if let Some(placement) = Placement::of_first(found.view()) {
        placement.remove(&mut found);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;

    #[test]
    fn windows_are_of_one_length_and_leave_out_the_rest() {
        assert_eq!(window_starts(377, 120).collect::<Vec<_>>(), [0, 120, 240]);
        assert_eq!(window_starts(119, 120).count(), 0);
        assert_eq!(window_frames([120; 11]), Some(120));
        assert_eq!(window_frames([300; 11]), Some(120));
        // One in eleven may be shorter; two may not.
        let mut lengths = vec![110; 11];
        lengths[4] = 3;
        assert_eq!(window_frames(lengths.clone()), Some(110));
        lengths[5] = 3;
        assert_eq!(window_frames(lengths), None);
        assert_eq!(window_frames([]), None);
        assert_eq!(
            [own_window_frames([31, 40, 35]), own_window_frames([]), own_window_frames([900])],
            [31, 1, 120]
        );
    }

    #[test]
    fn a_window_stands_over_the_origin() {
        let mut frames = Array2::zeros((7, MOTION_DIM));
        for t in 0..7 {
            frames[[t, 0]] = 2.0 + t as f32;
            frames[[t, 1]] = 0.9;
            frames[[t, 9]] = 1.0;
        }
        let found = window(frames.view(), 3, 4);
        assert_eq!(found.dim(), (4, MOTION_DIM));
        assert_eq!([found[[0, 0]], found[[3, 0]], found[[0, 1]]], [0.0, 3.0, 0.9]);
    }
}
