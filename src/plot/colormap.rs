//! Colours of heat maps: a table of 255 colours and one for what is missing.

use super::style::{MISSING, Rgb};

/// Colours of a map; index 255 is [`MISSING`].
pub(super) type Palette = [Rgb; 256];

/// Index of a value that is not finite.
pub(super) const MISSING_INDEX: u8 = 255;

/// From black over purple and orange to pale yellow: lightness rises evenly, so that it reads the
/// same for colour-blind readers and in grey print.
///
/// Every eighth colour of matplotlib's `magma` (N. Smith, S. van der Walt, E. Firing, 2015; CC0),
/// from 0 to 255 in 33 points; between them straight lines in sRGB, at most 1.3 of 255 off.
#[rustfmt::skip]
const MAGMA: [u32; 33] = [
    0x000004, 0x030311, 0x0a0822, 0x130d33, 0x1d1146, 0x28115a, 0x36106a, 0x430f76, 0x50127c,
    0x5d177f, 0x691c81, 0x762181, 0x822681, 0x8f2a81, 0x9c2e7f, 0xa9327d, 0xb63779, 0xc33b75,
    0xcf4170, 0xdb486a, 0xe65163, 0xee5c5e, 0xf5695c, 0xf9785d, 0xfb8761, 0xfd9668, 0xfea571,
    0xfeb47b, 0xfec387, 0xfed194, 0xfde0a2, 0xfceeb0, 0xfcfdbf,
];

/// From blue over near white to red, for deviations from a middle.
///
/// The eleven colours of ColorBrewer's `RdBu`, turned around; between them straight lines in sRGB.
/// This product includes color specifications and designs developed by Cynthia Brewer
/// (<https://colorbrewer.org/>; Apache-2.0).
const BLUE_RED: [u32; 11] = [
    0x053061, 0x2166ac, 0x4393c3, 0x92c5de, 0xd1e5f0, 0xf7f7f7, 0xfddbc7, 0xf4a582, 0xd6604d,
    0xb2182b, 0x67001f,
];

/// Returns the map for amounts.
pub(super) fn amounts() -> Palette {
    palette(&MAGMA)
}

/// Returns the map for deviations from a middle.
pub(super) fn deviations() -> Palette {
    palette(&BLUE_RED)
}

fn palette(points: &[u32]) -> Palette {
    let mut palette = [MISSING; 256];
    for (i, color) in palette.iter_mut().take(usize::from(MISSING_INDEX)).enumerate() {
        *color = color_at(points, i as f64 / f64::from(MISSING_INDEX - 1));
    }
    palette
}

/// Returns the colour at `position`, 0 to 1, on straight lines between `points`.
fn color_at(points: &[u32], position: f64) -> Rgb {
    let x = position * (points.len() - 1) as f64;
    let i = (x.floor() as usize).min(points.len() - 2);
    let (from, to) = (points[i].to_be_bytes(), points[i + 1].to_be_bytes());
    std::array::from_fn(|c| {
        let (from, to) = (f64::from(from[c + 1]), f64::from(to[c + 1]));
        (from + (x - i as f64) * (to - from)).round() as u8
    })
}

/// Returns where `value` lies in a palette whose ends stand for `low` and `high`.
pub(super) fn index(value: f64, low: f64, high: f64) -> u8 {
    if !value.is_finite() {
        return MISSING_INDEX;
    }
    let position = (value - low) / (high - low);
    (position.clamp(0.0, 1.0) * f64::from(MISSING_INDEX - 1)).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Relative luminance, WCAG 2.2.
    fn luminance(color: Rgb) -> f64 {
        let [r, g, b] = color.map(|c| {
            let c = f64::from(c) / 255.0;
            if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        });
        0.2126 * r + 0.7152 * g + 0.0722 * b
    }

    #[test]
    fn amounts_grow_lighter_from_end_to_end() {
        let palette = amounts();
        for i in 1..255 {
            assert!(
                luminance(palette[i]) >= luminance(palette[i - 1]) - 1e-3,
                "darker at {i}: {:?} after {:?}",
                palette[i],
                palette[i - 1]
            );
        }
        assert_eq!(palette[0], [0x00, 0x00, 0x04]);
        assert_eq!(palette[254], [0xfc, 0xfd, 0xbf]);
    }

    #[test]
    fn deviations_have_their_middle_at_the_middle() {
        let palette = deviations();
        assert_eq!(palette[127], [0xf7, 0xf7, 0xf7]);
        assert_eq!(palette[usize::from(index(0.0, -3.0, 3.0))], [0xf7, 0xf7, 0xf7]);
    }

    #[test]
    fn indices_stay_in_the_palette() {
        let cases = [
            (-1.0, 0),
            (0.0, 0),
            (0.5, 127),
            (1.0, 254),
            (7.0, 254),
            (f64::NAN, 255),
            (f64::INFINITY, 255),
        ];
        for (value, wanted) in cases {
            assert_eq!(index(value, 0.0, 1.0), wanted, "{value}");
        }
    }
}
