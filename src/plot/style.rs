//! The house style of every plot: colours and sizes.
//!
//! White paper, dark text, no boxes; light grid lines only where a curve is read off. Colours of
//! curves are from Okabe and Ito, Color Universal Design, 2008: they stay apart for colour-blind
//! readers, and blue and vermillion also in grey print. Text is `INK` or `MUTED`, which have a contrast
//! of at least 4.5 to 1 on white.

/// A colour: red, green and blue in sRGB.
pub(super) type Rgb = [u8; 3];

pub(super) const PAPER: Rgb = [255, 255, 255];
/// Titles, headings and tick labels.
pub(super) const INK: Rgb = [0x1f, 0x23, 0x28];
/// The color of explanations.
pub(super) const MUTED: Rgb = [0x5c, 0x64, 0x70];
/// Axis and tick lines.
pub(super) const AXIS: Rgb = [0x8a, 0x92, 0x9c];
/// Grid lines.
pub(super) const GRID: Rgb = [0xe4, 0xe7, 0xeb];
/// Values that are not finite.
pub(super) const MISSING: Rgb = [0x9a, 0xa0, 0xa6];
/// The first curve of a plot.
pub(super) const BLUE: Rgb = [0x00, 0x72, 0xb2];
/// Marks over a curve.
pub(super) const VERMILLION: Rgb = [0xd5, 0x5e, 0x00];
/// Further curves.
pub(super) const GREEN: Rgb = [0x00, 0x9e, 0x73];
pub(super) const PURPLE: Rgb = [0xcc, 0x79, 0xa7];

/// Text sizes in CSS pixels: of a plot's title, a part's with several panels, a panel's heading, and
/// all else.
pub(super) const TITLE_PX: f64 = 18.0;
pub(super) const PART_PX: f64 = 15.0;
pub(super) const HEADING_PX: f64 = 13.0;
pub(super) const TEXT_PX: f64 = 11.0;
/// Height of a figure or capital relative to the text size (DejaVu Sans: 1493 of 2048 units).
pub(super) const CAP_HEIGHT: f64 = 0.729;

/// Width of lines that belong to axes and grids.
pub(super) const HAIRLINE_PX: f64 = 1.0;
/// Width of a curve.
pub(super) const CURVE_PX: f64 = 1.5;
/// Free space at the edges of the page.
pub(super) const MARGIN_PX: f64 = 28.0;
/// Left edge of panels: margin, labels, ticks.
pub(super) const LEFT_PX: f64 = MARGIN_PX + 36.0;
/// Length of a tick line, and its distance to the label.
pub(super) const TICK_PX: f64 = 4.0;
pub(super) const TICK_GAP_PX: f64 = 4.0;

/// Device pixels per CSS pixel in a bitmap.
pub(super) const SCALE: u32 = 2;
