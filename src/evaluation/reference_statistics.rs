//! What is known of real motion, by which all models are measured: an artefact with a version.
//!
//! Thresholds, means and deviations come from the windows of the training split alone and stay fixed, so that
//! the numbers of two models can be compared, and held-out real motion is measured as any other. The hash says
//! which data they are of.

use ndarray::{Array2, ArrayView2, Axis};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::motion::Poses;

use super::body::{BODY_RADIUS_M, part, poses};
use super::frechet::{DEVIATION_EPS, Gaussian};
use super::geometric::{GEOMETRIC_NAMES, GeometricThresholds, geometric_features};
use super::kinetic::{
    AXIS_NAMES, CHUNK_FRAMES, Formula, MARKER_NAMES, axis_features, chunks, marker_features,
};
use super::window_range::{Posture, WindowRange};

/// Version of the artefact: another meaning of any of its numbers is another version.
pub const REFERENCE_VERSION: u32 = 2;

/// Features of which all of the ground truth has the same value keep their unit.
const MIN_DEVIATION: f64 = 1e-6;

/// Features of a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FeatureSet {
    /// Eight kinetic features: position and axes.
    Axes,
    AxesCompat,
    /// Twelve kinetic features: markers.
    Markers,
    MarkersCompat,
    /// Sixteen geometric features.
    Geometric,
}

impl FeatureSet {
    /// Every set.
    pub const ALL: [Self; 5] =
        [Self::Axes, Self::AxesCompat, Self::Markers, Self::MarkersCompat, Self::Geometric];

    /// The name of the set in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Axes => "axes",
            Self::AxesCompat => "axes_compat",
            Self::Markers => "markers",
            Self::MarkersCompat => "markers_compat",
            Self::Geometric => "geometric",
        }
    }

    /// The names of its features.
    pub const fn features(self) -> &'static [&'static str] {
        match self {
            Self::Axes | Self::AxesCompat => &AXIS_NAMES,
            Self::Markers | Self::MarkersCompat => &MARKER_NAMES,
            Self::Geometric => &GEOMETRIC_NAMES,
        }
    }

    fn of(self, poses: &Poses, thresholds: &GeometricThresholds) -> Option<Vec<f64>> {
        match self {
            Self::Axes => axis_features(poses, Formula::Correct).map(Vec::from),
            Self::AxesCompat => axis_features(poses, Formula::Compat).map(Vec::from),
            Self::Markers => marker_features(poses, Formula::Correct).map(Vec::from),
            Self::MarkersCompat => marker_features(poses, Formula::Compat).map(Vec::from),
            Self::Geometric => geometric_features(poses, thresholds).map(Vec::from),
        }
    }

    /// Features of chunks, `[n_chunks, n_features]`.
    fn stacked(self, chunks: &[Poses], thresholds: &GeometricThresholds) -> Array2<f64> {
        let rows: Vec<Vec<f64>> =
            chunks.iter().filter_map(|chunk| self.of(chunk, thresholds)).collect();
        Array2::from_shape_fn((rows.len(), self.features().len()), |(i, j)| rows[i][j])
    }
}

/// Mean, deviation and, after both were taken out, the normal distribution of a set of features.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FeatureStatistics {
    pub mean: Vec<f64>,
    /// Of a population (n).
    pub deviation: Vec<f64>,
    pub gaussian: Gaussian,
}

impl FeatureStatistics {
    /// Fits features, `[n, dim]`; none for fewer than two, or where one is not finite.
    pub fn fit(features: ArrayView2<f64>) -> Option<Self> {
        let mean = features.mean_axis(Axis(0))?.to_vec();
        let deviation = features.std_axis(Axis(0), 0.0).to_vec();
        let gaussian = Gaussian::fit(normalized(features, &mean, &deviation).view())?;
        Some(Self { mean, deviation, gaussian })
    }

    /// Returns `(x - mean) / (deviation + 1e-10)` of features, `[n, dim]`.
    ///
    /// A feature that is constant in the ground truth keeps its unit: divided by 1e-10, the published way,
    /// one frame of difference would outweigh all other features.
    ///
    /// # Panics
    /// When the features have another dimension.
    pub fn normalize(&self, features: ArrayView2<f64>) -> Array2<f64> {
        normalized(features, &self.mean, &self.deviation)
    }

    fn is_sound(&self, dim: usize) -> bool {
        [self.mean.len(), self.deviation.len(), self.gaussian.dim()] == [dim; 3]
            && self.gaussian.is_sound()
            && self.mean.iter().chain(&self.deviation).all(|x| x.is_finite())
    }
}

fn normalized(features: ArrayView2<f64>, mean: &[f64], deviation: &[f64]) -> Array2<f64> {
    assert_eq!(features.ncols(), mean.len(), "numbers of a feature");
    Array2::from_shape_fn(features.dim(), |(i, j)| {
        let constant = deviation[j] < MIN_DEVIATION;
        let unit = if constant { 1.0 } else { deviation[j] + DEVIATION_EPS };
        (features[[i, j]] - mean[j]) / unit
    })
}

/// Why reference statistics were refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ReferenceError {
    /// Not the JSON of the artefact.
    #[error("reference statistics cannot be read ({message}); measure the ground truth again")]
    Unreadable { message: String },
    /// Made by a program that means something else by its numbers.
    #[error(
        "reference statistics have version {found}, this program reads version {expected}; \
         measure the ground truth again with this program"
    )]
    Version { found: u32, expected: u32 },
    /// Of other data than those at hand.
    #[error(
        "reference statistics are of the data {found}, the ground truth here is {expected}; measure it again"
    )]
    Data { found: String, expected: String },
    /// Numbers are missing.
    #[error(
        "reference statistics of the features {set} are not of {dim} finite numbers each; measure the ground \
         truth again"
    )]
    Features { set: &'static str, dim: usize },
    /// Bounds of windows are missing or not in order.
    #[error(
        "reference statistics have bounds of windows that are no numbers or not in order; measure the ground \
         truth again"
    )]
    Bounds,
}

/// Statistics of the ground truth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReferenceStatistics {
    pub version: u32,
    /// Hash of the data that were measured, as the store has it.
    pub data_hash: String,
    /// Windows of the training split.
    pub n_windows: usize,
    pub window_frames: usize,
    pub n_chunks: usize,
    pub chunk_frames: usize,
    pub body_radius_m: f64,
    pub thresholds: GeometricThresholds,
    pub window_range: WindowRange,
    pub axes: FeatureStatistics,
    pub axes_compat: FeatureStatistics,
    pub markers: FeatureStatistics,
    pub markers_compat: FeatureStatistics,
    pub geometric: FeatureStatistics,
}

impl ReferenceStatistics {
    /// Measures windows of real motion of the training split, `[T, 25]` each, all of one length.
    ///
    /// None for fewer than two chunks of 75 frames, or where a motion is not finite.
    pub fn fit(windows: &[ArrayView2<f32>], data_hash: String) -> Option<Self> {
        let (mut all, mut postures) = (Vec::new(), Vec::new());
        for frames in windows {
            let whole = poses(*frames)?;
            postures.push(Posture::new(&whole)?);
            all.extend(chunks(whole.len()).map(|chunk| part(&whole, chunk)));
        }
        let thresholds = GeometricThresholds::fit(&all)?;
        let statistics_of =
            |set: FeatureSet| FeatureStatistics::fit(set.stacked(&all, &thresholds).view());
        Some(Self {
            version: REFERENCE_VERSION,
            data_hash,
            n_windows: windows.len(),
            window_frames: windows.first().map_or(0, |frames| frames.nrows()),
            n_chunks: all.len(),
            chunk_frames: CHUNK_FRAMES,
            body_radius_m: BODY_RADIUS_M,
            thresholds,
            window_range: WindowRange::fit(&postures)?,
            axes: statistics_of(FeatureSet::Axes)?,
            axes_compat: statistics_of(FeatureSet::AxesCompat)?,
            markers: statistics_of(FeatureSet::Markers)?,
            markers_compat: statistics_of(FeatureSet::MarkersCompat)?,
            geometric: statistics_of(FeatureSet::Geometric)?,
        })
    }

    /// Reads the artefact from JSON.
    ///
    /// Errors: [`ReferenceError`] for text that is not such an artefact, another version, and features of
    /// another size.
    pub fn from_json(text: &str) -> Result<Self, ReferenceError> {
        /// The version, which tells whether the rest can be read.
        #[derive(Deserialize)]
        struct VersionField {
            version: u32,
        }
        let unreadable =
            |e: serde_json::Error| ReferenceError::Unreadable { message: e.to_string() };
        let VersionField { version } = serde_json::from_str(text).map_err(unreadable)?;
        if version != REFERENCE_VERSION {
            return Err(ReferenceError::Version { found: version, expected: REFERENCE_VERSION });
        }
        let found: Self = serde_json::from_str(text).map_err(unreadable)?;
        for set in FeatureSet::ALL {
            let dim = set.features().len();
            if !found.statistics(set).is_sound(dim) {
                return Err(ReferenceError::Features { set: set.name(), dim });
            }
        }
        if !found.window_range.is_sound() || found.window_frames == 0 {
            return Err(ReferenceError::Bounds);
        }
        Ok(found)
    }

    /// Checks that the artefact is of the data with this hash.
    ///
    /// Errors: [`ReferenceError::Data`].
    pub fn check_data(&self, hash: &str) -> Result<(), ReferenceError> {
        if self.data_hash == hash {
            return Ok(());
        }
        Err(ReferenceError::Data { found: self.data_hash.clone(), expected: hash.to_owned() })
    }

    /// The statistics of a set of features.
    pub fn statistics(&self, set: FeatureSet) -> &FeatureStatistics {
        match set {
            FeatureSet::Axes => &self.axes,
            FeatureSet::AxesCompat => &self.axes_compat,
            FeatureSet::Markers => &self.markers,
            FeatureSet::MarkersCompat => &self.markers_compat,
            FeatureSet::Geometric => &self.geometric,
        }
    }

    /// Returns normalised features of a motion, `[T, 25]`, a row for each chunk of 75 frames; none where the
    /// motion is not finite.
    pub fn features(&self, set: FeatureSet, frames: ArrayView2<f32>) -> Option<Array2<f64>> {
        let features = set.stacked(&chunks_of(frames)?, &self.thresholds);
        Some(self.statistics(set).normalize(features.view()))
    }
}

fn chunks_of(frames: ArrayView2<f32>) -> Option<Vec<Poses>> {
    let whole = poses(frames)?;
    Some(chunks(whole.len()).map(|chunk| part(&whole, chunk)).collect())
}

#[cfg(test)]
mod tests;
