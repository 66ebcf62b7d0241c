//! Brings many frames to the columns that a page has room for.

use ndarray::{Array2, ArrayView1, ArrayView2};

/// Returns how many columns `n_frames` frames take: one each, or `max_columns`.
fn n_columns(n_frames: usize, max_columns: usize) -> usize {
    n_frames.min(max_columns.max(1))
}

/// Returns the frames of column `column` of `n_columns`, at least one of `n_frames`.
fn frames_of(column: usize, n_columns: usize, n_frames: usize) -> std::ops::Range<usize> {
    column * n_frames / n_columns..(column + 1) * n_frames / n_columns
}

/// Returns the mean of each row over the frames of each column, leaving out what is not finite;
/// NaN where nothing is left.
///
/// # Shapes
/// - `values`: `[n_frames, n_rows]`
/// - returns: `[n_columns, n_rows]`
pub(super) fn means(values: ArrayView2<'_, f32>, max_columns: usize) -> Array2<f32> {
    let (n_frames, n_rows) = values.dim();
    let n_columns = n_columns(n_frames, max_columns);
    let mut means = Array2::from_elem((n_columns, n_rows), f32::NAN);
    let mut sums = vec![(0.0_f64, 0_u32); n_rows];
    for (column, mut means) in means.outer_iter_mut().enumerate() {
        sums.fill((0.0, 0));
        for frame in frames_of(column, n_columns, n_frames) {
            for ((sum, n), &value) in sums.iter_mut().zip(values.row(frame)) {
                if value.is_finite() {
                    *sum += f64::from(value);
                    *n += 1;
                }
            }
        }
        for (mean, &(sum, n)) in means.iter_mut().zip(&sums) {
            if n > 0 {
                *mean = (sum / f64::from(n)) as f32;
            }
        }
    }
    means
}

/// What a curve does within a column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Extent {
    pub min: f64,
    pub mean: f64,
    pub max: f64,
}

/// Returns the extent of the finite values in each column; `None` where there are none.
pub(super) fn extents(values: ArrayView1<'_, f32>, max_columns: usize) -> Vec<Option<Extent>> {
    let n_columns = n_columns(values.len(), max_columns);
    (0..n_columns)
        .map(|column| {
            let frames = frames_of(column, n_columns, values.len());
            let finite = || frames.clone().map(|t| f64::from(values[t])).filter(|v| v.is_finite());
            let n = finite().count();
            (n > 0).then(|| Extent {
                min: finite().fold(f64::INFINITY, f64::min),
                mean: finite().sum::<f64>() / n as f64,
                max: finite().fold(f64::NEG_INFINITY, f64::max),
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn columns_share_the_frames_out() {
        for (n_frames, n_columns) in [(7, 7), (7, 3), (216_000, 2131), (1, 1)] {
            let mut next = 0;
            for column in 0..n_columns {
                let frames = frames_of(column, n_columns, n_frames);
                assert_eq!(frames.start, next);
                assert!(!frames.is_empty(), "column {column} of {n_columns} has no frame");
                next = frames.end;
            }
            assert_eq!(next, n_frames);
        }
    }

    #[test]
    fn means_leave_out_what_is_not_finite() {
        let values = array![[1.0, f32::NAN], [3.0, f32::NAN], [f32::INFINITY, 2.0], [5.0, 4.0]];
        let means = means(values.view(), 2);
        assert_eq!(means[[0, 0]], 2.0);
        assert!(means[[0, 1]].is_nan());
        assert_eq!(means[[1, 0]], 5.0);
        assert_eq!(means[[1, 1]], 3.0);
    }

    #[test]
    fn few_frames_stay_as_they_are() {
        let values = array![[1.0, 2.0], [3.0, 4.0]];
        assert_eq!(means(values.view(), 900), values);
        assert_eq!(means(values.slice(ndarray::s![..0, ..]), 900).dim(), (0, 2));
    }

    #[test]
    fn extents_keep_peaks() {
        let values = array![0.0, 9.0, 0.0, 1.0, f32::NAN, f32::NAN];
        let wanted = [
            Some(Extent { min: 0.0, mean: 3.0, max: 9.0 }),
            Some(Extent { min: 1.0, mean: 1.0, max: 1.0 }),
        ];
        assert_eq!(extents(values.view(), 2), wanted);
        assert_eq!(extents(values.view(), 3)[2], None);
        assert_eq!(extents(values.slice(ndarray::s![..0]), 3), []);
    }
}
