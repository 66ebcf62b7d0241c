//! Group motion realism: features of a group, whose Fréchet distance from those of real groups is GMR.
//!
//! Source: Le, Pham, Do, Tjiputra, Tran, Nguyen, "Music-Driven Group Choreography", CVPR 2023, section 5.1:
//! kinetic features pooled over the dancers. There they are of 24 joints; here of the four markers of
//! [`marker_features`], in the intended formula. The distance is
//! [`frechet_distance`](crate::evaluation::frechet::frechet_distance) of the features' normal distributions.

use ndarray::{Array2, Axis};

use super::n_frames;
use crate::evaluation::body::part;
use crate::evaluation::geometric::{GeometricThresholds, geometric_features};
use crate::evaluation::kinetic::{Formula, chunks, marker_features};
use crate::motion::Poses;

/// m in `ln(1 + m x)`, by which published code brings energies near each other.
pub const ENERGY_WEIGHT: f64 = 1.5;

/// Returns `ln(1 + m x)`, m = 1.5, of an energy or expenditure.
pub fn compressed(x: f64) -> f64 {
    (ENERGY_WEIGHT * x).ln_1p()
}

/// Returns kinetic features of a group, `[chunks of 75 frames, 12]`: `ln(1 + 1.5 · mean over dancers)` of
/// each of [`MARKER_NAMES`](crate::evaluation::kinetic::MARKER_NAMES).
///
/// Frames beyond the last whole chunk are left out; no rows without dancers.
pub fn kinetic_features(dancers: &[Poses]) -> Array2<f64> {
    let mut features = pooled(dancers, |chunk| marker_features(chunk, Formula::Correct));
    features.mapv_inplace(compressed);
    features
}

/// Returns geometric features of a group, `[chunks of 75 frames, 16]`: the mean over dancers of the share
/// of frames for which each of [`GEOMETRIC_NAMES`](crate::evaluation::geometric::GEOMETRIC_NAMES) holds.
///
/// Frames beyond the last whole chunk are left out; no rows without dancers.
pub fn geometric_group_features(
    dancers: &[Poses],
    thresholds: &GeometricThresholds,
) -> Array2<f64> {
    pooled(dancers, |chunk| geometric_features(chunk, thresholds))
}

/// Means over dancers of what is found of every chunk.
fn pooled<const D: usize>(
    dancers: &[Poses],
    features: impl Fn(&Poses) -> Option<[f64; D]>,
) -> Array2<f64> {
    let mut rows = Array2::zeros((0, D));
    for frames in chunks(n_frames(dancers)) {
        let of_dancers: Vec<[f64; D]> =
            dancers.iter().filter_map(|poses| features(&part(poses, frames.clone()))).collect();
        if let Some(mean) = Array2::from(of_dancers).mean_axis(Axis(0)) {
            rows.push_row(mean.view()).expect("invariant: rows of one width");
        }
    }
    rows
}
