//! The plot of a file's audio features.

use ndarray::ArrayView2;

use super::axis::TimeAxis;
use super::page::Page;
use super::panel::{FEATURE_DIM, N_MEL, Panel};
use super::scene::{Rect, Scene};
use super::style::{LEFT_PX, MARGIN_PX};
use super::{Format, Picture, PlotError, check_width, frame, header, heatmap, write};

/// Features of a file, or of an excerpt, and what is known of its beats.
#[derive(Clone, Copy, Debug)]
pub struct FeaturesPlot<'a> {
    /// The title of the plot, for example the file's name.
    pub title: &'a str,
    /// `[n_frames, 163]`: mel 128, chroma 12, mfcc 20, rms, spectral_centroid, onset_strength.
    /// Values that are not finite are shown as missing.
    pub values: ArrayView2<'a, f32>,
    /// Beats in seconds on the clock of `start_s`; those outside the excerpt are left out.
    pub beat_times_s: &'a [f64],
    /// Tempo in beats per minute, if known.
    pub tempo_bpm: Option<f64>,
    /// Centre frequency in Hz of each of the 128 mel bands, rising.
    pub mel_hz: &'a [f64],
    /// Time of frame 0 in seconds.
    pub start_s: f64,
}

/// Times on which the axis stays exact.
const MAX_START_S: f64 = 1e7;

/// Returns a plot of features: one panel below the other over a common axis of time, `width_px` CSS
/// pixels wide (a PNG has two pixels for each).
///
/// # Errors
/// Nothing to plot, an array of another width, mel frequencies that give no axis, or a page that is
/// too small or too large.
pub fn features(
    plot: &FeaturesPlot<'_>,
    panels: &[Panel],
    width_px: u32,
    format: Format,
) -> Result<Picture, PlotError> {
    write(&scene(plot, panels, width_px)?, format)
}

/// Lays the plot out.
pub(super) fn scene(
    plot: &FeaturesPlot<'_>,
    panels: &[Panel],
    width_px: u32,
) -> Result<Scene, PlotError> {
    check(plot, panels, width_px)?;
    let is_alone = panels.len() == 1;
    let bar_px = if panels.iter().any(|p| p.is_heat_map()) { heatmap::BAR_ROOM_PX } else { 0.0 };
    let time = TimeAxis {
        start_s: plot.start_s,
        n_frames: plot.values.nrows(),
        left: LEFT_PX,
        width: f64::from(width_px) - LEFT_PX - bar_px - MARGIN_PX,
    };
    let mut page = Page::new(plot, time);
    page.header(plot, panels);
    let mut top = header::HEADER_PX;
    let mut bottom = top;
    for &panel in panels {
        let rect = Rect {
            left: time.left,
            top: top + frame::PLOT_TOP_PX,
            width: time.width,
            height: panel.height_px(is_alone),
        };
        page.panel(panel, rect, plot);
        bottom = rect.bottom();
        top = bottom + frame::PANEL_GAP_PX;
    }
    page.time_labels(bottom);
    Ok(page.into_scene(f64::from(width_px), bottom))
}

fn check(plot: &FeaturesPlot<'_>, panels: &[Panel], width_px: u32) -> Result<(), PlotError> {
    if panels.is_empty() {
        return Err(PlotError::NoPanels { known: Panel::known() });
    }
    check_width(width_px)?;
    if plot.values.ncols() != FEATURE_DIM {
        let found = plot.values.ncols();
        return Err(PlotError::Columns { found, wanted: FEATURE_DIM });
    }
    // NaN fails every comparison.
    let rises = plot.mel_hz.windows(2).all(|hz| hz[0] < hz[1]);
    let is_positive = plot.mel_hz.iter().all(|&hz| hz > 0.0 && hz.is_finite());
    if plot.mel_hz.len() != N_MEL || !rises || !is_positive {
        return Err(PlotError::MelBands { found: plot.mel_hz.len(), wanted: N_MEL });
    }
    if !(-MAX_START_S..=MAX_START_S).contains(&plot.start_s) {
        return Err(PlotError::Start { start_s: plot.start_s, max_s: MAX_START_S });
    }
    Ok(())
}
