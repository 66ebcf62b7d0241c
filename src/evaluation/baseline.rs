//! Motion that anybody could offer without a model.

use ndarray::{Array1, Array2, ArrayView2, Axis};

use crate::motion::{ColumnRole, Layout};

/// Orientations whose mean is shorter than this point everywhere; none of them is their mean.
const MIN_MEAN_NORM: f32 = 1e-3;

/// Returns the best constant: the mean of every channel over all frames of motions, `[T, columns]` each,
/// repeated for `n_frames`; orientations have length 1.
///
/// None without frames.
pub fn mean_motion<'a>(
    layout: Layout,
    motions: impl IntoIterator<Item = ArrayView2<'a, f32>>,
    n_frames: usize,
) -> Option<Array2<f32>> {
    let (mut sum, mut n) = (Array1::<f64>::zeros(layout.width()), 0_usize);
    for frames in motions {
        sum += &frames.mapv(f64::from).sum_axis(Axis(0));
        n += frames.nrows();
    }
    if n == 0 {
        return None;
    }
    let mut mean = (sum / n as f64).mapv(|x| x as f32);
    for orientation in layout.with_role(ColumnRole::Turn).map(|columns| columns.range()) {
        let norm = orientation.clone().map(|i| mean[i] * mean[i]).sum::<f32>().sqrt();
        for (i, channel) in orientation.enumerate() {
            let identity = if i == 0 { 1.0 } else { 0.0 };
            mean[channel] = if norm > MIN_MEAN_NORM { mean[channel] / norm } else { identity };
        }
    }
    Some(Array2::from_shape_fn((n_frames, layout.width()), |(_, channel)| mean[channel]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::{BODY, Channel, MOTION_DIM};

    #[test]
    fn it_is_the_mean_of_all_frames_with_a_unit_orientation() {
        let w = Channel::Quaternion.range().start;
        let mut a = Array2::<f32>::zeros((3, MOTION_DIM));
        let mut b = Array2::<f32>::zeros((1, MOTION_DIM));
        a.column_mut(1).fill(2.0);
        b.column_mut(1).fill(6.0);
        a.column_mut(w).fill(1.0);
        b.column_mut(w + 2).fill(1.0);
        let mean = mean_motion(BODY, [a.view(), b.view()], 7).expect("frames");
        assert_eq!((mean.dim(), mean[[6, 1]]), ((7, MOTION_DIM), 3.0));
        // (3, 0, 1, 0) / √10
        assert!((mean[[0, w]] - 3.0 / 10.0_f32.sqrt()).abs() < 1e-6);
        assert!((mean[[4, w + 2]] - 1.0 / 10.0_f32.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn the_root_alone_has_its_orientation_elsewhere() {
        let mut a = Array2::<f32>::zeros((2, ROOT.width()));
        a.column_mut(9).fill(3.0);
        a.column_mut(6).fill(4.0);
        a.column_mut(10).fill(4.0);
        let mean = mean_motion(ROOT, [a.view()], 1).expect("frames");
        assert_eq!((mean[[0, 6]], mean[[0, 9]], mean[[0, 10]]), (0.8, 0.6, 4.0));
    }

    #[test]
    fn orientations_that_cancel_leave_none_and_no_frames_no_mean() {
        let w = Channel::Quaternion.range().start;
        let mut a = Array2::<f32>::zeros((2, MOTION_DIM));
        a[[0, w + 1]] = 1.0;
        a[[1, w + 1]] = -1.0;
        let mean = mean_motion(BODY, [a.view()], 1).expect("frames");
        assert_eq!(mean.row(0).to_vec()[w..w + 4], [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(mean_motion(BODY, [], 5), None);
    }
}
