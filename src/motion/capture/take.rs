//! A take in world coordinates, metres and +Y up, at its own sampling rate.

use super::account::{CaptureAccount, CaptureNote};
use super::own::{OWN_UNIT_M, is_own};
use super::own_axes::OwnAxes;
use super::skeleton::{Body, Positions};
use super::unit::{DEFAULT_HEIGHT_M, is_usual, unit_of};
use super::upright::{Axis, UpAxis, UpEvidence, find_up, tilt};
use super::{
    CaptureError, DIFFERENCED_FRAMES, MAX_NODE_POSITIONS, MAX_RESAMPLED_FRAMES,
    MIN_RESAMPLED_FRAMES, check_size,
};
use crate::motion::bvh::{Bvh, JointChannel};
use crate::motion::lowpass::lowpass;
use crate::motion::quantile::{median, percentile};
use crate::motion::quaternion::{
    IDENTITY, Quaternion, conj, from_axis_angle, make_sign_continuous, mul, normalize, rotate,
};
use crate::units::FPS;

/// Cutoff of the low-pass on captured signals, Hz.
const LOWPASS_HZ: f64 = 8.0;
/// Highest cutoff per sampling rate for captures not faster than [`FPS`].
const MAX_CUTOFF_PER_RATE: f64 = 0.4;
/// Captures up to this multiple of [`FPS`] count as not faster.
const FASTER_THAN_FPS: f64 = 1.05;
/// A node jump over this multiple of the median jump ends a leading T-pose.
const POP_PER_MEDIAN_JUMP: f64 = 15.0;
/// Slowest jump that ends a leading T-pose, body heights per second: faster than any limb.
const POP_HEIGHTS_PER_S: f64 = 6.0;
/// Such a jump is over this multiple of those before and after it: an accent takes more than a frame.
const POP_PER_NEXT_JUMP: f64 = 3.0;
/// Takes up to this many frames keep all of them.
const MIN_FRAMES_FOR_POP: usize = 20;
/// A root that stays within this share of the body's height stands still.
const STILL_PER_HEIGHT: f64 = 0.005;

const AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// A take in world coordinates at its own sampling rate, the leading T-pose gone.
pub struct Take {
    /// Sampling times from the first kept frame, s.
    pub times_s: Vec<f64>,
    /// World coordinates of the body's nodes, m, one signal per coordinate: x, y, z of the root, and so on.
    pub nodes: Vec<Vec<f64>>,
    /// Orientation of the root, one signal per component w, x, y, z.
    pub orientation: [Vec<f64>; 4],
    /// Whether this program wrote it: it stays where it is.
    pub is_own: bool,
    /// Whether there is no noise to filter.
    pub is_smooth: bool,
    /// Whether the root is the only joint.
    pub is_root_alone: bool,
}

impl Take {
    /// Reads a take: the body's motion in metres, and what was found out on the way.
    pub fn of(bvh: &Bvh, up: Option<Axis>) -> Result<(Self, CaptureAccount), CaptureError> {
        let (n_frames, n_nodes) = (bvh.frames().nrows(), bvh.joints().len());
        check_size("node positions", n_frames * n_nodes, MAX_NODE_POSITIONS)?;
        let (world, root) = world_of(bvh, 0);
        let is_own = is_own(bvh) && up.is_none();
        let body = Body::find(bvh, &world);
        let (world_root, above) = match body.nodes[0] {
            0 => (root, IDENTITY),
            node => {
                let parent = bvh.joints()[node].parent.unwrap_or(0);
                let above = world_of(bvh, parent).1.first().copied().unwrap_or(IDENTITY);
                (world_of(bvh, node).1, above)
            }
        };
        let mut account = CaptureAccount {
            root: bvh.joints()[body.nodes[0]].name.clone(),
            up: Axis::Y,
            unit_m: OWN_UNIT_M,
            cut_s: 0.0,
            notes: Vec::new(),
        };
        if body.nodes[0] != 0 {
            let (above, root) = (bvh.joints()[0].name.clone(), account.root.clone());
            account.notes.push(CaptureNote::StaticRoot { above, root });
        }
        let height = body.height(&world);
        if !(height > 0.0 && height.is_finite()) {
            return Err(CaptureError::NoHeight { height });
        }
        let found = match up {
            Some(axis) => UpAxis { axis, rest: None, by: UpEvidence::Found },
            None if is_own => UpAxis { axis: Axis::Y, rest: None, by: UpEvidence::Found },
            None => find_up(&body, &world, &world_root)?,
        };
        account.up = found.axis;
        account.notes.extend(match found.by {
            UpEvidence::Floor(other) => Some(CaptureNote::UpByFloor { up: found.axis, other }),
            UpEvidence::Assumed => Some(CaptureNote::UpAssumed),
            UpEvidence::Found => {
                (found.axis != Axis::Y).then_some(CaptureNote::Turned { up: found.axis })
            }
        });
        if !is_own {
            account.unit_m = match unit_of(height) {
                Some(unit) => {
                    if !is_usual(unit) {
                        let height_m = height * unit.size_m;
                        let note = CaptureNote::UnusualUnit { unit: unit.name, height_m };
                        account.notes.push(note);
                    }
                    unit.size_m
                }
                None => {
                    let height_m = DEFAULT_HEIGHT_M;
                    account.notes.push(CaptureNote::Scaled { height, height_m });
                    height_m / height
                }
            };
        }
        let range = body.root_range(&world);
        if range <= still_range(height) {
            let (root, range_m) = (account.root.clone(), range * account.unit_m);
            account.notes.push(CaptureNote::Motionless { root, range_m });
        }

        let mut take = Self {
            times_s: Vec::new(),
            is_root_alone: body.nodes.iter().filter(|&&i| is_joint(bvh, i)).count() == 1,
            nodes: turned(&body, &world, found.axis, account.unit_m),
            orientation: Default::default(),
            is_own,
            is_smooth: is_own,
        };
        // What of the root's orientation belongs to the file's axes, not to the body.
        let to_y = found.axis.to_y();
        let at_rest = match (found.rest, &body.landmarks) {
            (Some(rest), Some(_)) => rest.to_y(),
            _ => {
                let file_tilt = tilt(mul(to_y, above));
                match OwnAxes::find(bvh, &body, &world, &world_root, file_tilt) {
                    Some(OwnAxes { up, to_body }) => {
                        account.notes.push(CaptureNote::OwnAxes { root: account.root.clone(), up });
                        to_body
                    }
                    None => file_tilt,
                }
            }
        };
        let mut orientation: Vec<Quaternion> =
            world_root.iter().map(|&q| normalize(mul(mul(to_y, q), conj(at_rest)))).collect();
        let start = if is_own {
            0
        } else {
            let floor_m = pop_floor_m(height * account.unit_m, bvh.frame_time_s());
            first_frame_after_pop(&take.nodes, bvh.frame_time_s(), floor_m)
        };
        if start > 0 {
            account.cut_s = start as f64 * bvh.frame_time_s();
            account.notes.push(CaptureNote::Cut { n_frames: start, cut_s: account.cut_s });
            take.nodes.iter_mut().for_each(|signal| drop(signal.drain(..start)));
            orientation.drain(..start);
        }
        make_sign_continuous(&mut orientation);
        take.orientation = std::array::from_fn(|c| orientation.iter().map(|q| q[c]).collect());
        take.times_s = (start..n_frames)
            .map(|t| t as f64 * bvh.frame_time_s() - start as f64 * bvh.frame_time_s())
            .collect();
        Ok((take, account))
    }

    /// Times of the resampled frames, s, and how many of them are kept.
    pub fn resampling_grid(&self) -> Result<(Vec<f64>, usize), CaptureError> {
        let duration_s = self.times_s.last().copied().unwrap_or(0.0);
        // A last frame that misses the grid by rounding still counts.
        let n_frames = (duration_s * FPS + 1e-6).floor() as usize + 1;
        if n_frames < MIN_RESAMPLED_FRAMES {
            return Err(CaptureError::TooShort { duration_s, n_frames });
        }
        check_size("frames", n_frames, MAX_RESAMPLED_FRAMES)?;
        check_size("node positions", n_frames * (self.nodes.len() / 3), MAX_NODE_POSITIONS)?;
        let grid_s = (0..n_frames).map(|t| t as f64 / FPS).collect();
        Ok((grid_s, n_frames - DIFFERENCED_FRAMES))
    }

    /// Height of the floor: the 1st percentile of all node heights, m.
    pub fn ground(&self) -> f64 {
        let heights = self.nodes.iter().skip(1).step_by(3).flatten();
        percentile(&mut heights.copied().collect::<Vec<_>>(), 1.0).unwrap_or(0.0)
    }

    /// Leaves out what comes before a time, s; times count from the first frame that is kept.
    pub fn drop_start(&mut self, start_s: f64) {
        // A frame at the time itself stays, whatever its rounding.
        let n_dropped = self.times_s.partition_point(|&t| t < start_s - 1e-9);
        let Some(&first_s) = self.times_s.get(n_dropped).filter(|_| n_dropped > 0) else { return };
        self.times_s.drain(..n_dropped);
        self.times_s.iter_mut().for_each(|t| *t -= first_s);
        for signal in self.nodes.iter_mut().chain(&mut self.orientation) {
            signal.drain(..n_dropped);
        }
    }

    /// Filters the noise of the capture, once.
    pub fn smooth(&mut self) {
        if !std::mem::replace(&mut self.is_smooth, true) {
            self.lowpass();
        }
    }

    fn lowpass(&mut self) {
        let mut intervals: Vec<f64> = self.times_s.windows(2).map(|t| t[1] - t[0]).collect();
        let Some(interval_s) = median(&mut intervals) else { return };
        let rate_hz = 1.0 / interval_s;
        let cutoff_hz = if rate_hz > FPS * FASTER_THAN_FPS {
            LOWPASS_HZ
        } else {
            LOWPASS_HZ.min(MAX_CUTOFF_PER_RATE * rate_hz)
        };
        for signal in self.nodes.iter_mut().chain(&mut self.orientation) {
            lowpass(signal, cutoff_hz, rate_hz);
        }
        for t in 0..self.times_s.len() {
            let q = normalize(std::array::from_fn(|c| self.orientation[c][t]));
            for (signal, component) in self.orientation.iter_mut().zip(q) {
                signal[t] = component;
            }
        }
    }
}

fn is_joint(bvh: &Bvh, node: usize) -> bool {
    !bvh.joints()[node].channels.is_empty()
}

/// World coordinates of all nodes in file units, and the orientation of one of them.
fn world_of(bvh: &Bvh, node: usize) -> (Positions, Vec<Quaternion>) {
    let (n_frames, n_nodes) = (bvh.frames().nrows(), bvh.joints().len());
    let mut world = vec![vec![0.0; n_frames]; 3 * n_nodes];
    let mut orientation = Vec::with_capacity(n_frames);
    let mut pose = vec![([0.0; 3], IDENTITY); n_nodes];
    for (t, row) in bvh.frames().rows().into_iter().enumerate() {
        forward_kinematics(bvh, row.iter().copied(), &mut pose);
        for (node, (position, _)) in pose.iter().enumerate() {
            for axis in 0..3 {
                world[3 * node + axis][t] = position[axis];
            }
        }
        orientation.push(normalize(pose[node].1));
    }
    (world, orientation)
}

/// World coordinates of a body's nodes, m, with the axis that is up turned to +Y.
fn turned(body: &Body, world: &Positions, up: Axis, unit_m: f64) -> Vec<Vec<f64>> {
    let to_y = up.to_y();
    let columns = AXES.map(|axis| rotate(to_y, axis).map(f64::round));
    let mut nodes = Vec::with_capacity(3 * body.nodes.len());
    for &node in &body.nodes {
        let n_frames = world[3 * node].len();
        for weights in (0..3).map(|axis| columns.map(|column| column[axis])) {
            let coordinate =
                |t: usize| (0..3).map(|c| weights[c] * world[3 * node + c][t]).sum::<f64>();
            nodes.push((0..n_frames).map(|t| coordinate(t) * unit_m).collect());
        }
    }
    nodes
}

/// World position and orientation of every node for one frame of channel values.
///
/// `Q[j] = Q[parent] ⊗ r₁ ⊗ r₂ …` in channel order, `P[j] = P[parent] + Q[parent] x` with `x` the
/// offset, of which a position channel replaces its own coordinate. So a root with three position
/// channels ignores its OFFSET, and a joint with six channels is placed by its channels alone.
pub fn forward_kinematics(
    bvh: &Bvh,
    values: impl Iterator<Item = f64>,
    pose: &mut [([f64; 3], Quaternion)],
) {
    let mut values = values;
    for (j, joint) in bvh.joints().iter().enumerate() {
        let mut x = joint.offset;
        let mut q = IDENTITY;
        for (channel, value) in joint.channels.iter().zip(&mut values) {
            match *channel {
                JointChannel::Position(axis) => x[axis] = value,
                JointChannel::Rotation(axis) => {
                    q = mul(q, from_axis_angle(AXES[axis], value.to_radians()));
                }
            }
        }
        pose[j] = match joint.parent {
            None => (x, q),
            Some(parent) => {
                let (origin, turn) = pose[parent];
                let x = rotate(turn, x);
                (std::array::from_fn(|i| origin[i] + x[i]), mul(turn, q))
            }
        };
    }
}

/// Greatest range of a root that stands still, in the unit of the body's height.
pub fn still_range(height: f64) -> f64 {
    STILL_PER_HEIGHT * height
}

/// Shortest step of a frame that ends a leading T-pose, m.
pub fn pop_floor_m(height_m: f64, frame_time_s: f64) -> f64 {
    POP_HEIGHTS_PER_S * height_m * frame_time_s
}

/// First frame after a calibration pose: many takes begin with a T-pose and jump out of it.
///
/// The last frame step within the first second (at most the first tenth) in which some node moves over 15
/// times the median of the largest node step, over `floor_m`, and over three times what it moves in the step
/// before and after.
pub fn first_frame_after_pop(nodes: &[Vec<f64>], frame_time_s: f64, floor_m: f64) -> usize {
    let n_frames = nodes.first().map_or(0, Vec::len);
    if n_frames <= MIN_FRAMES_FOR_POP {
        return 0;
    }
    let jumps: Vec<f64> = (1..n_frames)
        .map(|t| {
            let step = |node: &[Vec<f64>]| {
                node.iter().map(|x| (x[t] - x[t - 1]).powi(2)).sum::<f64>().sqrt()
            };
            nodes.chunks(3).map(step).fold(0.0, f64::max)
        })
        .collect();
    let searched = (1.0 / frame_time_s).min(n_frames as f64 * 0.1) as usize;
    let median_jump = median(&mut jumps.clone()).unwrap_or(0.0);
    let threshold = (POP_PER_MEDIAN_JUMP * median_jump).max(floor_m);
    let stands_out = |t: usize| {
        let next_to = [t.checked_sub(1), t.checked_add(1)];
        let next = next_to.iter().filter_map(|t| jumps.get((*t)?)).fold(0.0, |a: f64, &b| a.max(b));
        jumps[t] > POP_PER_NEXT_JUMP * next
    };
    let is_pop = |t: &usize| jumps[*t] > threshold && stands_out(*t);
    (0..searched.max(2).min(jumps.len())).rev().find(is_pop).map_or(0, |t| t + 1)
}
