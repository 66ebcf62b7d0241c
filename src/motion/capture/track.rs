//! One rigid body's track: what formats give that have no hierarchy of joints.

use super::account::{CaptureAccount, CaptureNote};
use super::take::{Take, first_frame_after_pop, pop_floor_m, still_range};
use super::unit::DEFAULT_HEIGHT_M;
use super::upright::Axis;
use super::{CaptureError, MAX_NODE_POSITIONS, check_size};
use crate::motion::quaternion::{Quaternion, make_sign_continuous, mul, normalize, rotate};

/// A body's mean direction of up tells the axis where its greatest component is at least this.
const FOUND: f64 = 0.8;
/// It contradicts what its format says where it is at least this.
const CONTRADICTED: f64 = 0.9;
/// Lowest and highest sampling rate, Hz.
pub const RATE_RANGE_HZ: (f64, f64) = (1.0, 10_000.0);

/// A rigid body that moves, with whatever other points are known beside it.
///
/// Body axes are +Y up and +Z forward, as [`crate::motion`] has them; the world's are the file's.
#[derive(Clone, Debug, PartialEq)]
pub struct RigidTrack {
    /// Where it comes from, as the column `motion_format` spells it.
    pub format: &'static str,
    /// The name of the moving object in the file.
    pub root: String,
    pub rate_hz: f64,
    /// The axis that is up by the format's definition; none where the body tells it.
    pub up: Option<Axis>,
    /// Metres of one file unit.
    pub unit_m: f64,
    /// Root position by frame, m.
    pub position_m: Vec<[f64; 3]>,
    /// Root orientation by frame, body to world; normalised when it is converted.
    pub orientation: Vec<Quaternion>,
    /// Positions of other points, m: by point, then by frame.
    pub points_m: Vec<Vec<[f64; 3]>>,
    /// Height of the body where it is known, m.
    pub height_m: Option<f64>,
    /// Whether it was drawn between keys instead of captured: no noise to filter, no pose to leave out.
    pub is_keyframed: bool,
    pub notes: Vec<String>,
}

impl Take {
    /// Reads a track: its motion with +Y up, and what was found out on the way.
    ///
    /// # Errors
    /// [`CaptureError`] where it is too large, not finite, or up cannot be told.
    pub fn of_track(
        track: &RigidTrack,
        up: Option<Axis>,
    ) -> Result<(Self, CaptureAccount), CaptureError> {
        let n_frames = track.position_m.len().min(track.orientation.len());
        check_size("node positions", n_frames * (1 + track.points_m.len()), MAX_NODE_POSITIONS)?;
        let (low, high) = RATE_RANGE_HZ;
        let rate_hz = track.rate_hz;
        if !(low..=high).contains(&rate_hz) {
            return Err(CaptureError::Rate { rate_hz, low, high });
        }
        check_finite(track, n_frames)?;
        let mut notes: Vec<_> = track.notes.iter().cloned().map(CaptureNote::Text).collect();
        let axis = match up {
            Some(axis) => axis,
            None => up_of(track, &mut notes)?,
        };
        if axis != Axis::Y {
            notes.push(CaptureNote::Turned { up: axis });
        }
        let mut account = CaptureAccount {
            root: track.root.clone(),
            up: axis,
            unit_m: track.unit_m,
            cut_s: 0.0,
            notes,
        };

        let to_y = axis.to_y();
        let points = std::iter::once(&track.position_m).chain(&track.points_m);
        let mut nodes = Vec::with_capacity(3 * (1 + track.points_m.len()));
        for point in points {
            let turned: Vec<[f64; 3]> =
                point.iter().take(n_frames).map(|&p| rotate(to_y, p)).collect();
            nodes.extend((0..3).map(|c| turned.iter().map(|p| p[c]).collect::<Vec<_>>()));
        }
        let height_m = track.height_m.unwrap_or(DEFAULT_HEIGHT_M);
        let range_m = range(&nodes[..3]);
        if range_m <= still_range(height_m) {
            account.notes.push(CaptureNote::Motionless { root: track.root.clone(), range_m });
        }
        let mut orientation: Vec<Quaternion> =
            track.orientation.iter().take(n_frames).map(|&q| normalize(mul(to_y, q))).collect();
        let start = if track.is_keyframed {
            0
        } else {
            first_frame_after_pop(&nodes, 1.0 / rate_hz, pop_floor_m(height_m, 1.0 / rate_hz))
        };
        if start > 0 {
            account.cut_s = start as f64 / rate_hz;
            account.notes.push(CaptureNote::Cut { n_frames: start, cut_s: account.cut_s });
            nodes.iter_mut().for_each(|signal| drop(signal.drain(..start)));
            orientation.drain(..start);
        }
        make_sign_continuous(&mut orientation);
        let take = Self {
            times_s: (0..n_frames - start).map(|t| t as f64 / rate_hz).collect(),
            orientation: std::array::from_fn(|c| orientation.iter().map(|q| q[c]).collect()),
            is_own: false,
            is_smooth: track.is_keyframed,
            is_root_alone: track.points_m.is_empty(),
            nodes,
        };
        Ok((take, account))
    }
}

fn check_finite(track: &RigidTrack, n_frames: usize) -> Result<(), CaptureError> {
    let is_finite = |t: usize| {
        let points = track.points_m.iter().filter_map(|point| point.get(t)).flatten();
        let root = track.position_m[t].iter().chain(&track.orientation[t]);
        root.chain(points).all(|x| x.is_finite())
    };
    match (0..n_frames).find(|&t| !is_finite(t)) {
        Some(frame) => Err(CaptureError::NotFinite { frame }),
        None => Ok(()),
    }
}

/// The axis that is up by the format, held against how the body is carried over the take.
pub(super) fn up_of(
    track: &RigidTrack,
    notes: &mut Vec<CaptureNote>,
) -> Result<Axis, CaptureError> {
    let n = track.orientation.len().max(1) as f64;
    let mut mean = [0.0; 3];
    for &q in &track.orientation {
        let up = rotate(normalize(q), [0.0, 1.0, 0.0]);
        mean = std::array::from_fn(|c| mean[c] + up[c] / n);
    }
    match track.up {
        Some(axis) if track.is_keyframed => Ok(axis),
        Some(axis) => match Axis::along(mean, CONTRADICTED) {
            Some(posed) if posed != axis => Err(CaptureError::UpUnlike { posed, format: axis }),
            _ => Ok(axis),
        },
        None => Ok(Axis::along(mean, FOUND).unwrap_or_else(|| {
            notes.push(CaptureNote::UpAssumed);
            Axis::Y
        })),
    }
}

/// Greatest range of any of the signals.
fn range(signals: &[Vec<f64>]) -> f64 {
    let span = |x: &Vec<f64>| {
        let (low, high) =
            x.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
        (high - low).max(0.0)
    };
    signals.iter().map(span).fold(0.0, f64::max)
}
