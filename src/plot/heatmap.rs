//! Heat maps with their colour bars.

use ndarray::{Array2, ArrayView2};

use super::axis::number;
use super::colormap::{self, Palette};
use super::scene::{Anchor, Image, Rect, Scene, SceneItem};
use super::style::{CAP_HEIGHT, INK, SCALE, TEXT_PX};
use super::{frame, reduce};

/// Space between a heat map and its bar, width of the bar, space between the bar and its labels.
const BAR_GAP_PX: f64 = 12.0;
const BAR_PX: f64 = 12.0;
const BAR_LABEL_GAP_PX: f64 = 5.0;
/// Room to the right of a heat map for its bar and labels.
pub(super) const BAR_ROOM_PX: f64 = BAR_GAP_PX + BAR_PX + BAR_LABEL_GAP_PX + 34.0;

/// Share of deviations that the colours can tell apart; the rest takes the colours of the ends.
const SHOWN_SHARE: f64 = 0.995;

/// How numbers become colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ColorScale {
    /// From 0 to 1, or further where values go further.
    Amount,
    /// As far below 0 as above.
    Deviation,
}

/// The two ends of a colour bar, and whether values lie beyond them.
struct Ends {
    low: f64,
    high: f64,
    is_cut: bool,
}

/// Draws `values`, `[n_frames, n_rows]` with row 0 at the bottom, and the colour bar beside them.
pub(super) fn draw(scene: &mut Scene, rect: Rect, values: ArrayView2<'_, f32>, scale: ColorScale) {
    let columns = reduce::means(values, n_columns(values.nrows(), rect.width));
    let (palette, ends) = match scale {
        ColorScale::Amount => (colormap::amounts(), amount_ends(&columns)),
        ColorScale::Deviation => (colormap::deviations(), deviation_ends(&columns)),
    };
    if columns.is_empty() {
        frame::nothing(scene, rect, "no frames");
    } else {
        let image = image(&columns, &palette, &ends);
        scene.items.push(SceneItem::Image { rect, image });
    }
    bar(scene, rect, &palette, &ends, scale);
}

/// Returns how many columns stand for `n_frames` frames: at most one per device pixel.
pub(super) fn n_columns(n_frames: usize, width_px: f64) -> usize {
    n_frames.min((width_px * f64::from(SCALE)) as usize)
}

fn finite(columns: &Array2<f32>) -> impl Iterator<Item = f64> {
    columns.iter().map(|&v| f64::from(v)).filter(|v| v.is_finite())
}

fn amount_ends(columns: &Array2<f32>) -> Ends {
    Ends {
        low: finite(columns).fold(0.0, f64::min),
        high: finite(columns).fold(1.0, f64::max),
        is_cut: false,
    }
}

/// Takes [`SHOWN_SHARE`] of the deviations, rounded up to a half, or below 1 to a tenth.
fn deviation_ends(columns: &Array2<f32>) -> Ends {
    let mut sizes: Vec<f64> = finite(columns).map(f64::abs).collect();
    let end = if sizes.is_empty() {
        1.0
    } else {
        let k = ((sizes.len() - 1) as f64 * SHOWN_SHARE) as usize;
        let (_, &mut size, _) = sizes.select_nth_unstable_by(k, f64::total_cmp);
        let per_unit = if size >= 1.0 { 2.0 } else { 10.0 };
        (size * per_unit).ceil().max(1.0) / per_unit
    };
    Ends { low: -end, high: end, is_cut: sizes.iter().any(|&size| size > end) }
}

fn image(columns: &Array2<f32>, palette: &Palette, ends: &Ends) -> Image {
    let (n_columns, n_rows) = columns.dim();
    let mut indices = Vec::with_capacity(n_columns * n_rows);
    for row in (0..n_rows).rev() {
        let row = columns.column(row);
        indices.extend(row.iter().map(|&v| colormap::index(f64::from(v), ends.low, ends.high)));
    }
    Image { n_columns, n_rows, indices, palette: Box::new(*palette) }
}

fn bar(scene: &mut Scene, beside: Rect, palette: &Palette, ends: &Ends, scale: ColorScale) {
    let left = beside.right() + BAR_GAP_PX;
    let rect = Rect { left, top: beside.top, width: BAR_PX, height: beside.height };
    let indices: Vec<u8> = (0..colormap::MISSING_INDEX).rev().collect();
    let image = Image { n_columns: 1, n_rows: indices.len(), indices, palette: Box::new(*palette) };
    scene.items.push(SceneItem::Image { rect, image });
    let mut label = |text: &str, cap_top: f64| {
        let at = [rect.right() + BAR_LABEL_GAP_PX, cap_top + CAP_HEIGHT * TEXT_PX];
        scene.text(at, Anchor::Start, text, TEXT_PX, INK);
    };
    let (below, above) = if ends.is_cut { ("≤ ", "≥ ") } else { ("", "") };
    label(&format!("{above}{}", number(ends.high)), rect.top);
    label(&format!("{below}{}", number(ends.low)), rect.bottom() - CAP_HEIGHT * TEXT_PX);
    if scale == ColorScale::Deviation {
        label("0", rect.top + (rect.height - CAP_HEIGHT * TEXT_PX) / 2.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn amounts_go_from_zero_to_one_or_further() {
        let cases = [
            (array![[0.2_f32, 0.7]], (0.0, 1.0)),
            (array![[-80.0, 0.0]], (-80.0, 1.0)),
            (array![[f32::NAN, f32::NAN]], (0.0, 1.0)),
        ];
        for (columns, wanted) in cases {
            let ends = amount_ends(&columns);
            assert_eq!((ends.low, ends.high), wanted, "{columns}");
        }
    }

    #[test]
    fn deviations_are_cut_where_hardly_any_lie() {
        let mut columns = Array2::from_shape_fn((100, 20), |(t, k)| ((t + k) % 5) as f32 * 0.6);
        columns[[3, 0]] = 40.0;
        let ends = deviation_ends(&columns);
        assert_eq!((ends.low, ends.high, ends.is_cut), (-2.5, 2.5, true));
        assert_eq!(deviation_ends(&Array2::zeros((0, 20))).high, 1.0);
        assert_eq!(deviation_ends(&Array2::zeros((4, 20))).high, 0.1);
    }

    #[test]
    fn row_zero_is_at_the_bottom() {
        let columns = array![[0.0_f32, 1.0], [f32::NAN, 0.5]];
        let ends = Ends { low: 0.0, high: 1.0, is_cut: false };
        let image = image(&columns, &colormap::amounts(), &ends);
        assert_eq!(image.indices, [254, 127, 0, 255]);
    }
}
