//! What can be said of a group: how it moves together, keeps apart and is spread over the floor.
//!
//! Motion is `[N, T, 25]` in metres, in one frame of reference. Dancers who are absent are left out with
//! [`present`]. Like all measures these look at positions and orientations and difference them anew.

pub mod contact;
pub mod correlation;
pub mod difference;
pub mod formation;
pub mod numbers;
pub mod realism;
#[cfg(test)]
mod tests;
pub mod unison;

use ndarray::{Array3, ArrayView3, Axis};

use super::body::poses;
use crate::motion::Poses;

/// What is measured of one group; none where it is not defined, as for a single dancer.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GroupMeasures {
    /// [`correlation::published_correlation`], which has a unit: GMC.
    pub gmc_published: Option<f64>,
    /// [`correlation::correlation`], in [-1, 1].
    pub gmc_correlation: Option<f64>,
    /// [`unison::unison`], up to 1.
    pub unison: Option<f64>,
    /// [`contact::Contacts::share`], in [0, 1]: TIF.
    pub tif: Option<f64>,
    /// [`contact::Contacts::per_frame`]: TIF as published.
    pub touching_pairs_per_frame: Option<f64>,
    /// [`contact::Contacts::least_m`].
    pub least_separation_m: Option<f64>,
    /// [`formation::Coverage::hull_m2`].
    pub coverage_m2: Option<f64>,
    /// [`formation::Coverage::spread_m`].
    pub spread_m: Option<f64>,
    /// [`difference::Difference::of_features`].
    pub dancer_diversity: Option<f64>,
    /// [`difference::Difference::of_velocities_m_s`].
    pub dancer_velocity_difference_m_s: Option<f64>,
}

/// Measures a group, `[N, T, 25]`, whose bars last `bar_frames` frames and whose bodies have a radius of
/// `radius_m`.
///
/// Nothing is measured where a pose is none; see [`dancers`].
///
/// # Panics
/// When there are other than 25 channels.
pub fn measure(group: ArrayView3<f32>, bar_frames: f64, radius_m: f64) -> GroupMeasures {
    let Some(dancers) = dancers(group) else { return GroupMeasures::default() };
    let contacts = contact::contacts(&dancers, radius_m);
    let coverage = formation::coverage(&dancers);
    let difference = difference::difference(&dancers);
    GroupMeasures {
        gmc_published: correlation::published_correlation(&dancers),
        gmc_correlation: correlation::correlation(&dancers),
        unison: unison::unison(&dancers, bar_frames),
        tif: contacts.map(|x| x.share),
        touching_pairs_per_frame: contacts.map(|x| x.per_frame),
        least_separation_m: contacts.map(|x| x.least_m),
        coverage_m2: coverage.map(|x| x.hull_m2),
        spread_m: coverage.map(|x| x.spread_m),
        dancer_diversity: difference.and_then(|x| x.of_features),
        dancer_velocity_difference_m_s: difference.map(|x| x.of_velocities_m_s),
    }
}

/// Returns the dancers of a group who are there, in their order.
///
/// # Panics
/// When the mask is not as long as the group.
pub fn present(group: ArrayView3<f32>, is_present: &[bool]) -> Array3<f32> {
    assert_eq!(group.len_of(Axis(0)), is_present.len(), "dancers of a group and of its mask");
    let there: Vec<usize> = (0..is_present.len()).filter(|i| is_present[*i]).collect();
    group.select(Axis(0), &there)
}

/// Returns the poses of every dancer, `[N, T, 25]`; none where one has a pose that is not finite, or a
/// quaternion of 0.
///
/// # Panics
/// When there are other than 25 channels.
pub fn dancers(group: ArrayView3<f32>) -> Option<Vec<Poses>> {
    group.outer_iter().map(poses).collect()
}

/// Frames that all dancers have.
fn n_frames(dancers: &[Poses]) -> usize {
    dancers.iter().map(Poses::len).min().unwrap_or(0)
}

/// Pairs of dancers, each once.
fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |i| (i + 1..n).map(move |j| (i, j)))
}

/// Mean of what is there; none of nothing.
fn mean(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0);
    for x in values {
        sum += x;
        n += 1;
    }
    (n > 0).then(|| sum / f64::from(n))
}
