//! Curves over time.

use ndarray::ArrayView1;

use super::axis::{self, TimeAxis};
use super::frame;
use super::reduce::{self, Extent};
use super::scene::{Point, Rect, Scene, SceneItem};
use super::style::{BLUE, CURVE_PX, GRID, HAIRLINE_PX, SCALE, VERMILLION};

/// How dark the area under a curve is, and the band from the least to the greatest value of each
/// column.
const AREA_OPACITY: f64 = 0.12;
const BAND_OPACITY: f64 = 0.35;
/// Distance of the means where frames are closer than device pixels.
const MEANS_PX: f64 = 2.0;
/// Width of a value without neighbours.
pub(super) const DOT_PX: f64 = 5.0;
/// Most ticks on the vertical axis.
const MAX_TICKS: usize = 4;

/// Draws `values` with their axis; `marks` are the x of vertical lines below the curve.
pub(super) fn draw(
    scene: &mut Scene,
    rect: Rect,
    values: ArrayView1<'_, f32>,
    time: &TimeAxis,
    marks: &[f64],
) {
    if values.is_empty() {
        return frame::nothing(scene, rect, "no frames");
    }
    let columns = reduce::extents(values, n_columns(values.len(), rect.width));
    let low = columns.iter().flatten().map(|e| e.min).fold(0.0, f64::min);
    let high = columns.iter().flatten().map(|e| e.max).fold(1.0, f64::max);
    let y = |value: f64| rect.bottom() - (value - low) / (high - low) * rect.height;

    for tick in time.ticks() {
        scene.vertical(time.x(tick.value), rect.top, rect.bottom(), HAIRLINE_PX, GRID);
    }
    frame::value_grid(scene, rect, &axis::ticks(low, high, MAX_TICKS), y);

    let is_reduced = columns.len() < values.len();
    let x = |column: usize| {
        time.left + (column as f64 + 0.5) * rect.width / columns.len().max(1) as f64
    };
    let runs = runs(&columns);
    for run in &runs {
        let floor = |e: &Extent| y(if is_reduced { e.min } else { 0.0 });
        let upper = run.iter().map(|&(i, e)| [x(i), y(e.max)]);
        let lower = run.iter().rev().map(|&(i, e)| [x(i), floor(&e)]);
        let points: Vec<Point> = upper.chain(lower).collect();
        let opacity = if is_reduced { BAND_OPACITY } else { AREA_OPACITY };
        scene.items.push(SceneItem::Polygon { points, color: BLUE, opacity });
    }
    for &mark in marks {
        scene.vertical(mark, rect.top, rect.bottom(), HAIRLINE_PX, VERMILLION);
    }
    for run in &runs {
        let points: Vec<Point> = run.iter().map(|&(i, e)| [x(i), y(e.mean)]).collect();
        match points.as_slice() {
            &[alone] => scene.dot(alone, DOT_PX, BLUE),
            _ => scene.items.push(SceneItem::Polyline { points, color: BLUE, width_px: CURVE_PX }),
        }
    }
}

/// Returns how many columns stand for `n_frames` frames: one each as long as a device pixel does,
/// else as many as let the line through their means be followed.
pub(super) fn n_columns(n_frames: usize, width_px: f64) -> usize {
    let n_pixels = (width_px * f64::from(SCALE)) as usize;
    if n_frames <= n_pixels { n_frames } else { (width_px / MEANS_PX) as usize }
}

/// Returns the stretches of columns without a gap.
pub(super) fn runs(columns: &[Option<Extent>]) -> Vec<Vec<(usize, Extent)>> {
    let mut runs = vec![Vec::new()];
    for (i, column) in columns.iter().enumerate() {
        match (column, runs.last_mut()) {
            (Some(extent), Some(run)) => run.push((i, *extent)),
            _ => runs.push(Vec::new()),
        }
    }
    runs.retain(|run| !run.is_empty());
    runs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_part_runs() {
        let extent = Some(Extent { min: 0.0, mean: 0.5, max: 1.0 });
        let cases: [(&[Option<Extent>], &[usize]); 5] = [
            (&[], &[]),
            (&[None, None], &[]),
            (&[extent], &[1]),
            (&[extent, extent, None, extent], &[2, 1]),
            (&[None, extent, None, None, extent, extent], &[1, 2]),
        ];
        for (columns, wanted) in cases {
            let lengths: Vec<_> = runs(columns).iter().map(Vec::len).collect();
            assert_eq!(lengths, wanted);
        }
    }
}
