//! The panels of a plot of features: one per block of the 163 values of a frame.

use std::ops::Range;
use std::str::FromStr;

use super::{PlotError, names_of, panel_named};

/// Values of a frame.
pub(super) const FEATURE_DIM: usize = 163;
/// Bands of the mel spectrum.
pub(super) const N_MEL: usize = 128;

/// A panel, which shows one block of features over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Panel {
    Mel,
    Chroma,
    Mfcc,
    Rms,
    SpectralCentroid,
    OnsetStrength,
}

impl Panel {
    /// Every panel, in the order of the values in a frame.
    pub const ALL: [Self; 6] = [
        Self::Mel,
        Self::Chroma,
        Self::Mfcc,
        Self::Rms,
        Self::SpectralCentroid,
        Self::OnsetStrength,
    ];

    /// Returns the block's name, as in feature files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mel => "mel",
            Self::Chroma => "chroma",
            Self::Mfcc => "mfcc",
            Self::Rms => "rms",
            Self::SpectralCentroid => "spectral_centroid",
            Self::OnsetStrength => "onset_strength",
        }
    }

    /// Returns the names of every panel, as messages list them.
    pub(super) fn known() -> String {
        names_of(&Self::ALL, Self::name)
    }

    /// Returns where the block is in a frame.
    pub(super) fn columns(self) -> Range<usize> {
        match self {
            Self::Mel => 0..N_MEL,
            Self::Chroma => 128..140,
            Self::Mfcc => 140..160,
            Self::Rms => 160..161,
            Self::SpectralCentroid => 161..162,
            Self::OnsetStrength => 162..FEATURE_DIM,
        }
    }

    pub(super) fn heading(self) -> &'static str {
        match self {
            Self::Mel => "Mel spectrum",
            Self::Chroma => "Chroma",
            Self::Mfcc => "MFCC",
            Self::Rms => "RMS",
            Self::SpectralCentroid => "Spectral centroid",
            Self::OnsetStrength => "Onset strength",
        }
    }

    /// Returns what the values mean, from long to short; the longest that has room is shown.
    pub(super) fn meanings(self) -> [&'static str; 2] {
        match self {
            Self::Mel => [
                "level in 128 bands; 1 is the file’s loudest, 0 its quietest (at most 80 dB below)",
                "level in 128 bands",
            ],
            Self::Chroma => [
                "strength of the 12 pitch classes, all octaves together; 1 is the frame’s strongest",
                "strength of the 12 pitch classes",
            ],
            Self::Mfcc => [
                "shape of the spectrum (timbre); standard deviations from the file’s mean",
                "timbre, in standard deviations",
            ],
            Self::Rms => ["level; 1 is the file’s loudest frame", "level"],
            Self::SpectralCentroid => {
                ["brightness; 0 is the file’s darkest frame, 1 its brightest", "brightness"]
            }
            Self::OnsetStrength => ["attacks; 1 is the file’s strongest", "attacks"],
        }
    }

    /// Returns the height of the panel in CSS pixels, among others and alone. Heights of heat maps
    /// are whole device pixels per row.
    pub(super) fn height_px(self, is_alone: bool) -> f64 {
        match (self, is_alone) {
            (Self::Mel, false) => 320.0,
            (Self::Mel, true) => 384.0,
            (Self::Chroma, false) => 168.0,
            (Self::Chroma, true) => 240.0,
            (Self::Mfcc, false) => 160.0,
            (Self::Mfcc, true) => 280.0,
            (Self::Rms | Self::SpectralCentroid | Self::OnsetStrength, false) => 84.0,
            (Self::Rms | Self::SpectralCentroid | Self::OnsetStrength, true) => 180.0,
        }
    }

    /// Returns whether the panel is a heat map, with a colour bar at its right.
    pub(super) fn is_heat_map(self) -> bool {
        matches!(self, Self::Mel | Self::Chroma | Self::Mfcc)
    }
}

impl FromStr for Panel {
    type Err = PlotError;

    fn from_str(name: &str) -> Result<Self, PlotError> {
        panel_named(&Self::ALL, Self::name, name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_panels_share_out_a_frame() {
        let mut next = 0;
        for panel in Panel::ALL {
            assert_eq!(panel.columns().start, next, "{panel:?}");
            next = panel.columns().end;
        }
        assert_eq!(next, FEATURE_DIM);
    }

    #[test]
    fn names_are_read_back() {
        for panel in Panel::ALL {
            assert_eq!(panel.name().parse::<Panel>().unwrap(), panel);
        }
        assert_eq!(
            "mels".parse::<Panel>().unwrap_err().to_string(),
            "panel \"mels\" is unknown; the panels are mel, chroma, mfcc, rms, spectral_centroid, \
             onset_strength"
        );
    }
}
