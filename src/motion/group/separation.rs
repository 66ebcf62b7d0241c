//! Bodies of a group kept apart, with the least change of their paths.
//!
//! Where bodies touch, displacements d of the dancers on the floor are found that minimise
//! `Σ |d|² + τ⁴ Σ |d̈|²` such that no two centres are nearer than two radii: paths bend about as long before
//! and after a contact as τ says, so that velocities and accelerations stay those of a dancer. The least
//! distance is no convex condition; it is taken along the line between two bodies and solved again with the
//! lines that come of it (sequential convex programming; for vehicles that meet: Augugliaro, Schoellig,
//! D'Andrea, "Generation of collision-free trajectories for a quadrocopter fleet", IROS 2012).

mod contact;
mod solve;
#[cfg(test)]
mod tests;

use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView3, Axis, s};

use super::MAX_DANCERS;
use crate::motion::channels::{CHANNEL_NAMES, Channel};
use crate::motion::kinematics::{Poses, frames_of};
use crate::motion::quaternion::IDENTITY;
use crate::units::FPS;

/// How much further than they must bodies are kept apart around a contact, m: more than what the solution
/// and single precision leave.
const MARGIN_M: f64 = 0.01;
/// Frames around a contact whose paths may bend; the others keep their bits.
const REACH_FRAMES: usize = 2 * FPS as usize;
/// Frames around a contact at which the margin is asked for.
const CORE_FRAMES: usize = FPS as usize / 2;
/// Rounds in which bodies that touch anew are moved as well.
const MAX_ROUNDS: usize = 6;

/// Places on the floor, x and z in metres, `[frames, dancers]`.
type Places = Array2<[f64; 2]>;

/// Why bodies cannot be kept apart.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SeparationError {
    /// A radius that is no length.
    #[error("radius of a body is {radius_m} m, expected a number above 0 and up to {max_m} m")]
    Radius { radius_m: f64, max_m: f64 },
    /// More dancers than a group has.
    #[error("group has {n_dancers} dancers, expected at most {max}; separate smaller groups")]
    TooMany { n_dancers: usize, max: usize },
    /// A place that is none; the first in the order of dancers and frames.
    #[error(
        "channel {channel} of dancer {dancer} is {value} at frame {frame}, and bodies are kept apart by \
         their places; repair or remove the dancer"
    )]
    NonFinite { channel: &'static str, dancer: usize, frame: usize, value: f32 },
}

/// Largest radius of a body, m.
const MAX_RADIUS_M: f64 = 10.0;

/// Returns the distance of two dancers on the floor at a frame, m: `√(Δx² + Δz²)`; shape `[N, T, 25]`.
pub fn distance_m(group: ArrayView3<f32>, dancers: [usize; 2], frame: usize) -> f64 {
    let [a, b] = dancers.map(|i| place_m(group, i, frame));
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Where a dancer stands on the floor, x and z in metres.
fn place_m(group: ArrayView3<f32>, dancer: usize, frame: usize) -> [f64; 2] {
    let first = Channel::Position.range().start;
    [0, 2].map(|axis| f64::from(group[[dancer, frame, first + axis]]))
}

/// Keeps the bodies of a group apart: no two centres are nearer than `2 radius_m` on the floor.
///
/// `[N, T, 25]` in metres, in one frame of reference. What changes is x and z of dancers within two seconds
/// of a contact, and with them velocity and acceleration, which are the forward differences of the new
/// positions there; all else, and a group whose bodies never touch, keeps its bits. Time is linear in T.
///
/// # Errors
/// [`SeparationError`] for a radius that is none, a place that is not finite, or more than 16 dancers.
///
/// # Panics
/// When there are other than 25 channels.
pub fn separate(group: ArrayView3<f32>, radius_m: f64) -> Result<Array3<f32>, SeparationError> {
    check(group, radius_m)?;
    let least_m = 2.0 * radius_m;
    let (n_dancers, n_frames, _) = group.dim();
    let places = Places::from_shape_fn((n_frames, n_dancers), |(t, i)| place_m(group, i, t));
    let mut is_contact = contacts(&places, least_m);
    let mut moved = places.clone();
    let mut is_new = is_contact.clone();
    for _ in 0..MAX_ROUNDS {
        for span in spans(&is_contact, REACH_FRAMES) {
            if !is_new[span.clone()].contains(&true) {
                continue;
            }
            let problem = solve::Problem {
                places: places.slice(s![span.clone(), ..]),
                is_core: near(&is_contact, CORE_FRAMES)[span.clone()].to_vec(),
                least_m,
                is_held: [span.start > 0, span.end < n_frames],
            };
            moved.slice_mut(s![span, ..]).assign(&problem.solve());
        }
        rounded(&mut moved);
        let touching = contacts(&moved, least_m);
        for ((is_new, is_contact), touches) in is_new.iter_mut().zip(&mut is_contact).zip(touching)
        {
            *is_new = touches && !*is_contact;
            *is_contact |= touches;
        }
    }
    // What the rounds left, if anything.
    for t in (0..n_frames).filter(|t| is_contact[*t]) {
        solve::part(moved.row_mut(t), least_m + MARGIN_M / 10.0, least_m);
    }
    Ok(with_places(group, &places, &moved))
}

fn check(group: ArrayView3<f32>, radius_m: f64) -> Result<(), SeparationError> {
    if !(radius_m > 0.0 && radius_m <= MAX_RADIUS_M) {
        return Err(SeparationError::Radius { radius_m, max_m: MAX_RADIUS_M });
    }
    let n_dancers = group.len_of(Axis(0));
    if n_dancers > MAX_DANCERS {
        return Err(SeparationError::TooMany { n_dancers, max: MAX_DANCERS });
    }
    for (dancer, frames) in group.outer_iter().enumerate() {
        for (frame, row) in frames.rows().into_iter().enumerate() {
            if let Some(i) = Channel::Position.range().find(|&i| !row[i].is_finite()) {
                let (channel, value) = (CHANNEL_NAMES[i], row[i]);
                return Err(SeparationError::NonFinite { channel, dancer, frame, value });
            }
        }
    }
    Ok(())
}

/// Returns at which frames two bodies touch.
fn contacts(places: &Places, least_m: f64) -> Vec<bool> {
    let touch = |row: ndarray::ArrayView1<[f64; 2]>| {
        (0..row.len())
            .any(|a| (0..a).any(|b| (row[a][0] - row[b][0]).hypot(row[a][1] - row[b][1]) < least_m))
    };
    places.rows().into_iter().map(touch).collect()
}

/// Returns at which frames there is a contact within `reach` frames.
fn near(is_contact: &[bool], reach: usize) -> Vec<bool> {
    let mut is_near = vec![false; is_contact.len()];
    for span in spans(is_contact, reach) {
        is_near[span].fill(true);
    }
    is_near
}

/// Returns the frames within `reach` of contacts, as few and long as they are.
fn spans(is_contact: &[bool], reach: usize) -> Vec<Range<usize>> {
    let mut spans: Vec<Range<usize>> = Vec::new();
    for t in (0..is_contact.len()).filter(|t| is_contact[*t]) {
        let (first, end) = (t.saturating_sub(reach), (t + reach + 1).min(is_contact.len()));
        match spans.last_mut() {
            Some(last) if first <= last.end => last.end = end,
            _ => spans.push(first..end),
        }
    }
    spans
}

/// Rounds places to what a motion holds.
fn rounded(places: &mut Places) {
    places.mapv_inplace(|place| place.map(|x| f64::from(x as f32)));
}

/// Returns a group with other places, and the velocities and accelerations that follow from them.
fn with_places(group: ArrayView3<f32>, before: &Places, after: &Places) -> Array3<f32> {
    let mut out = group.to_owned();
    let n_frames = before.nrows();
    for (i, mut frames) in out.outer_iter_mut().enumerate() {
        let is_moved: Vec<bool> = (0..n_frames).map(|t| before[[t, i]] != after[[t, i]]).collect();
        // An acceleration looks two frames ahead.
        for span in spans(&is_moved, 2) {
            let span = span.start..span.end.saturating_sub(2).max(span.start + 1);
            let end = if span.end + 2 >= n_frames { n_frames } else { span.end };
            let position = |t: usize| {
                let [x, z] = after[[t, i]];
                [x, f64::from(group[[i, t, Channel::Position.range().start + 1]]), z]
            };
            let position_m: Vec<[f64; 3]> =
                (span.start..(end + 2).min(n_frames)).map(position).collect();
            let orientation = vec![IDENTITY; position_m.len()];
            let derived = frames_of(&Poses { position_m, orientation }, end - span.start);
            for channel in [Channel::Position, Channel::Velocity, Channel::Acceleration] {
                let columns = s![.., channel.range()];
                frames
                    .slice_mut(s![span.start..end, ..])
                    .slice_mut(columns)
                    .assign(&derived.slice(columns));
            }
        }
    }
    out
}
