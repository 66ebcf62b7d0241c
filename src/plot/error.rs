//! What can keep a plot from being made, each as one sentence.

/// Why a plot could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlotError {
    /// A name that no panel has.
    #[error("panel \"{name}\" is unknown; the panels are {known}")]
    UnknownPanel { name: String, known: String },
    /// An empty list of panels.
    #[error("no panels to plot; ask for one of {known}")]
    NoPanels { known: String },
    /// An array of another width.
    #[error("features have {found} values per frame; a plot needs {wanted}")]
    Columns { found: usize, wanted: usize },
    /// A group of another width, or of nobody.
    #[error(
        "group has shape [{n_dancers}, {n_frames}, {n_channels}]; a plot needs [N, T, {wanted}] with \
         dancers and frames"
    )]
    Group { n_dancers: usize, n_frames: usize, n_channels: usize, wanted: usize },
    /// Codes of which none is used.
    #[error("no tokens to plot; run motiongen tokenize first")]
    NoTokens,
    /// Mel bands that give no axis.
    #[error(
        "{found} mel band frequencies; a plot needs {wanted} that are finite, above 0 Hz and rise"
    )]
    MelBands { found: usize, wanted: usize },
    /// A start time on which no axis can stand.
    #[error("the first frame is at {start_s} s; a plot needs a time within ±{max_s} s")]
    Start { start_s: f64, max_s: f64 },
    /// A width that no plot fits.
    #[error("plot is {width_px} px wide; choose a width from {min_px} to {max_px} px")]
    Width { width_px: u32, min_px: u32, max_px: u32 },
    /// A page beyond what the bitmap can hold.
    #[error("plot is {width_px} × {height_px} px; ask for fewer panels or a smaller width")]
    Size { width_px: u32, height_px: u32 },
    /// The PNG encoder refused.
    #[error("plot could not be encoded as PNG")]
    Encode(#[from] png::EncodingError),
}
