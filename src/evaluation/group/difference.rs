//! How different the dancers of one group are from each other.

use ndarray::Array2;

use super::correlation::pieces;
use super::realism::compressed;
use super::unison::own_velocities;
use super::{mean, n_frames, pairs};
use crate::evaluation::body::part;
use crate::evaluation::diversity::mean_distance;
use crate::evaluation::kinetic::{Formula, marker_features};
use crate::motion::Poses;
use crate::motion::vector::{minus, norm};

/// How different dancers are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// Mean distance of two dancers' kinetic features, `ln(1 + 1.5 x)` of the twelve of
    /// [`marker_features`], over pieces of five seconds: how much each moves, not when. None for fewer than
    /// three frames.
    pub of_features: Option<f64>,
    /// Mean distance of two dancers' velocities in the frames of their headings, m/s: what they do at the
    /// same moment, so that a canon differs, too.
    pub of_velocities_m_s: f64,
}

/// Returns how different dancers are, both measures 0 for copies wherever they stand and face.
///
/// None for fewer than two dancers or two frames.
pub fn difference(dancers: &[Poses]) -> Option<Difference> {
    let n_frames = n_frames(dancers);
    if dancers.len() < 2 || n_frames < 2 {
        return None;
    }
    let of_piece = |frames: std::ops::Range<usize>| {
        let features: Option<Vec<[f64; 12]>> = dancers
            .iter()
            .map(|dancer| {
                let features = marker_features(&part(dancer, frames.clone()), Formula::Correct)?;
                Some(features.map(compressed))
            })
            .collect();
        mean_distance(Array2::from(features?).view())
    };
    let velocities: Vec<_> =
        dancers.iter().map(|dancer| own_velocities(dancer, n_frames)).collect();
    let apart = pairs(dancers.len()).flat_map(|(i, j)| {
        let both = velocities[i].iter().zip(&velocities[j]);
        both.map(|(a, b)| norm(minus(*a, *b))).collect::<Vec<_>>()
    });
    Some(Difference {
        of_features: mean(pieces(n_frames).into_iter().filter_map(of_piece)),
        of_velocities_m_s: mean(apart)?,
    })
}
