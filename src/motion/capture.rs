//! From a motion capture to a trajectory: joint angles in, `[T, 25]` at [`FPS`] out.
//!
//! Order of work: forward kinematics; find the body below a root that never moves; turn the axis that is up
//! to +Y; guess the length unit from the lengths of bones; drop a leading T-pose; zero-phase low-pass;
//! cubic-spline resampling; centre on the floor; forward differences from two extra frames, which are then
//! dropped, so that every kept frame obeys the identities. What was found is told with the trajectory.

mod account;
mod group;
mod own;
mod own_axes;
mod skeleton;
mod take;
mod track;
mod unit;
mod upright;

use thiserror::Error;

pub use account::{CaptureAccount, CaptureNote, Unit};
pub use group::{GroupCapture, convert_captures, convert_tracks};
pub use track::{RATE_RANGE_HZ, RigidTrack};
pub use upright::Axis;

use take::Take;

use crate::units::FPS;

use super::bvh::Bvh;
use super::channels::Channel;
use super::dancers::DancersError;
use super::kinematics::{Poses, forward_differences, frames_of};
use super::phase::{Beats, bar_phase};
use super::quaternion::{Quaternion, make_sign_continuous, normalize};
use super::spline::{CubicSpline, SplineError};
use super::style::{BodyMotion, style_channels};
use super::trajectory::{Trajectory, TrajectoryError};

/// Fewest resampled frames: three kept ones and the two that the differences consume.
pub const MIN_RESAMPLED_FRAMES: usize = 5;
/// Frames consumed by two forward differences.
const DIFFERENCED_FRAMES: usize = 2;
/// Most resampled frames: two hours.
pub const MAX_RESAMPLED_FRAMES: usize = 216_000;
/// Most node positions held at once, nodes times frames.
pub const MAX_NODE_POSITIONS: usize = 8_000_000;
/// Why a capture could not be converted.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CaptureError {
    /// Too little motion to difference twice.
    #[error(
        "capture lasts {duration_s:.3} s and gives {n_frames} frames at {FPS} fps, \
         expected at least {MIN_RESAMPLED_FRAMES}; use a longer take"
    )]
    TooShort { duration_s: f64, n_frames: usize },
    /// More data than a conversion holds in memory.
    #[error("capture needs {count} {what}, at most {limit} are converted; split the take")]
    TooLarge { what: &'static str, count: usize, limit: usize },
    /// All nodes at one height, so no length unit can be guessed.
    #[error(
        "capture has a body height of {height:?} file units, expected a positive one; \
         check the joint offsets"
    )]
    NoHeight { height: f64 },
    /// Two axes are as likely to be up.
    #[error(
        "capture does not tell which axis is up: its poses say {one}, its skeleton {other}; name it with \
         --up {one} or --up {other}"
    )]
    UpUnknown { one: Axis, other: Axis },
    /// The body is carried along another axis than the format's.
    #[error(
        "capture holds its body along {posed}, while its format has {format} up; name the axis that is up \
         with --up {posed} or --up {format}"
    )]
    UpUnlike { posed: Axis, format: Axis },
    /// A value that is NaN or infinite.
    #[error(
        "capture has a value that is not finite in frame {frame}, counted from 0; repair or cut the take \
         there"
    )]
    NotFinite { frame: usize },
    /// A sampling rate that nothing is captured at.
    #[error(
        "capture has {rate_hz:?} frames per second, expected {low} to {high}; write the rate of the take"
    )]
    Rate { rate_hz: f64, low: f64, high: f64 },
    /// Captures of one group that have different axes up.
    #[error(
        "dancer {dancer} is captured with {up} up and dancer 0 with {first}; export all dancers of a group in one \
         frame of reference, or name the axis that is up with --up"
    )]
    GroupUp { dancer: usize, up: Axis, first: Axis },
    /// Captures of one group in different units of length.
    #[error(
        "dancer {dancer} is captured in units of {unit_m:?} m and dancer 0 in units of {first_m:?} m, by the \
         lengths of their bones; export all dancers of a group in one unit"
    )]
    GroupUnit { dancer: usize, unit_m: f64, first_m: f64 },
    /// Captures that make no group.
    #[error(transparent)]
    Dancers(#[from] DancersError),
    /// The capture's times cannot carry a spline.
    #[error(transparent)]
    Spline(#[from] SplineError),
    /// The result holds NaN or infinities.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}

/// A converted take.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    pub trajectory: Trajectory,
    pub account: CaptureAccount,
}

/// Converts a capture as [`convert_capture`] does, with the axis that is up found, and keeps the trajectory.
///
/// Errors: [`CaptureError`].
pub fn convert_bvh(bvh: &Bvh, beats: Option<&Beats>) -> Result<Trajectory, CaptureError> {
    convert_capture(bvh, beats, None).map(|capture| capture.trajectory)
}

/// Converts a capture to a trajectory at [`FPS`], shape `[T, 25]`, `T >= 3`, and tells what it found.
///
/// `T = ⌊30 (n - 1) Δt⌋ - 1` for `n` frames at `Δt`. The path starts over the origin, the ground
/// (1st percentile of all node heights) is at 0; a take that this program wrote stays where it is. The phase
/// is 0 without beats; beat times count from the first kept frame of the take. `up` is the axis that is up
/// in the file; none to find it. Errors: [`CaptureError`].
pub fn convert_capture(
    bvh: &Bvh,
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<Capture, CaptureError> {
    let (take, mut account) = Take::of(bvh, up)?;
    let notes = bvh.notes().iter().map(|note| CaptureNote::Text(note.to_string()));
    account.notes.splice(0..0, notes);
    Ok(Capture { trajectory: trajectory_of(take, beats, None)?, account })
}

/// Converts the track of one rigid body to a trajectory, as [`convert_capture`] does with a hierarchy.
///
/// Where the body stands over the floor is as the file says unless points beside it show the floor. A track
/// that was drawn between keys is not filtered. Errors: [`CaptureError`].
pub fn convert_track(
    track: &RigidTrack,
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<Capture, CaptureError> {
    let (take, account) = Take::of_track(track, up)?;
    Ok(Capture { trajectory: trajectory_of(take, beats, None)?, account })
}

/// Makes the trajectory of a take, which is moved so that `origin_m` comes over the origin; without one, where its
/// path starts does.
fn trajectory_of(
    mut take: Take,
    beats: Option<&Beats>,
    origin_m: Option<[f64; 3]>,
) -> Result<Trajectory, CaptureError> {
    let (grid_s, t_kept) = take.resampling_grid()?;
    take.smooth();

    let mut p: Vec<[f64; 3]> = vec![[0.0; 3]; grid_s.len()];
    for (axis, signal) in take.nodes[..3].iter().enumerate() {
        for (p, x) in p.iter_mut().zip(resample(&take.times_s, signal, &grid_s)?) {
            p[axis] = x;
        }
    }
    let mut q: Vec<Quaternion> = vec![[0.0; 4]; grid_s.len()];
    for (c, signal) in take.orientation.iter().enumerate() {
        for (q, x) in q.iter_mut().zip(resample(&take.times_s, signal, &grid_s)?) {
            q[c] = x;
        }
    }
    q.iter_mut().for_each(|q| *q = normalize(*q));
    make_sign_continuous(&mut q);

    let origin = match origin_m {
        Some(origin) => origin,
        None if take.is_own => [0.0; 3],
        None => {
            // A root alone has no feet: how high it is over the floor is as the file says.
            let ground = if take.is_root_alone { 0.0 } else { take.ground() };
            [p[0][0], ground, p[0][2]]
        }
    };
    for p in &mut p {
        *p = std::array::from_fn(|axis| p[axis] - origin[axis]);
    }
    let mut nodes = Vec::with_capacity(take.nodes.len());
    // A point without others beside it has no limbs.
    let limbs = if take.nodes.len() > 3 { take.nodes.as_slice() } else { &[] };
    for (i, signal) in limbs.iter().enumerate() {
        let centred: Vec<f64> = signal.iter().map(|x| x - origin[i % 3]).collect();
        nodes.push(resample(&take.times_s, &centred, &grid_s[..t_kept])?);
    }

    let v = forward_differences(&p);
    let a = forward_differences(&v);
    let style = style_channels(&BodyMotion {
        position_m: &p[..t_kept],
        velocity_m_s: &v[..t_kept],
        acceleration_m_s2: &a,
        orientation: &q[..t_kept],
        nodes_m: &nodes,
    });
    let phase = match beats {
        Some(beats) => bar_phase(&grid_s[..t_kept], beats),
        None => vec![0.0; t_kept],
    };
    let mut frames = frames_of(&Poses { position_m: p, orientation: q }, t_kept);
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        row[Channel::Phase.range().start] = phase[t] as f32;
        for (i, &x) in Channel::Style.range().zip(&style[t]) {
            row[i] = x as f32;
        }
    }
    let trajectory = Trajectory::new(frames)?;
    trajectory.check_finite()?;
    Ok(trajectory)
}

fn resample(times_s: &[f64], signal: &[f64], grid_s: &[f64]) -> Result<Vec<f64>, SplineError> {
    Ok(CubicSpline::fit(times_s, signal)?.evaluate(grid_s))
}

fn check_size(what: &'static str, count: usize, limit: usize) -> Result<(), CaptureError> {
    if count > limit { Err(CaptureError::TooLarge { what, count, limit }) } else { Ok(()) }
}

#[cfg(test)]
mod people;
#[cfg(test)]
mod person;
#[cfg(test)]
mod tests;
