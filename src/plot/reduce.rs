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

/// The extent of a curve within a column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Extent {
    pub min: f64,
    pub mean: f64,
    pub max: f64,
}

/// The values of a column, as far as they were counted.
#[derive(Clone, Copy, Debug)]
struct Tally {
    n: u64,
    sum: f64,
    min: f64,
    max: f64,
}

impl Tally {
    const NONE: Self = Self { n: 0, sum: 0.0, min: f64::INFINITY, max: f64::NEG_INFINITY };

    /// Counts a value in, if it is finite.
    fn add(&mut self, value: f64) {
        if value.is_finite() {
            self.n += 1;
            self.sum += value;
            self.min = self.min.min(value);
            self.max = self.max.max(value);
        }
    }

    fn extent(self) -> Option<Extent> {
        let Self { n, sum, min, max } = self;
        (n > 0).then(|| Extent { min, mean: sum / n as f64, max })
    }
}

/// Returns the extent of the finite values in each column; `None` where there are none.
pub(super) fn extents(values: ArrayView1<'_, f32>, max_columns: usize) -> Vec<Option<Extent>> {
    let n_columns = n_columns(values.len(), max_columns);
    (0..n_columns)
        .map(|column| {
            let mut tally = Tally::NONE;
            frames_of(column, n_columns, values.len()).for_each(|t| tally.add(values[t].into()));
            tally.extent()
        })
        .collect()
}

/// Returns the extent of the finite values at steps, counted from 1 to `n_steps`, that share a column;
/// `None` where there are none. Step s is in the column in which frame s - 1 of as many frames is.
pub(super) fn extents_of_steps(
    points: impl IntoIterator<Item = (u64, f64)>,
    n_steps: u64,
    n_columns: usize,
) -> Vec<Option<Extent>> {
    let mut tallies = vec![Tally::NONE; n_columns];
    for (step, value) in points {
        let step = step.clamp(1, n_steps.max(1));
        let column = (u128::from(step) * n_columns as u128).saturating_sub(1);
        let column = column / u128::from(n_steps.max(1));
        if let Some(tally) = tallies.get_mut(column as usize) {
            tally.add(value);
        }
    }
    tallies.into_iter().map(Tally::extent).collect()
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

    #[test]
    fn steps_are_in_the_columns_of_their_frames() {
        for (n_steps, n_columns) in [(7_u64, 7), (7, 3), (20_000, 454), (1, 1), (2, 5)] {
            let points = (1..=n_steps).map(|step| (step, step as f64));
            let found = extents_of_steps(points, n_steps, n_columns);
            assert_eq!(found.len(), n_columns);
            for (column, extent) in found.into_iter().enumerate() {
                let frames = frames_of(column, n_columns, n_steps as usize);
                let wanted =
                    (!frames.is_empty()).then_some((frames.start as f64 + 1.0, frames.end as f64));
                assert_eq!(extent.map(|e| (e.min, e.max)), wanted, "column {column}");
            }
        }
        let points = [(1, f64::NAN), (3, 4.0), (4, 8.0), (0, 1.0), (9, 2.0), (5, f64::INFINITY)];
        let wanted = [
            Some(Extent { min: 1.0, mean: 1.0, max: 1.0 }),
            Some(Extent { min: 2.0, mean: 14.0 / 3.0, max: 8.0 }),
        ];
        assert_eq!(extents_of_steps(points, 4, 2), wanted);
        assert_eq!(extents_of_steps(points, 0, 0), []);
        assert!(extents_of_steps([(u64::MAX, 1.0)], u64::MAX, 3)[2].is_some());
    }
}
