//! From a motion capture to a trajectory: joint angles in, `[T, 25]` at [`FPS`] out.
//!
//! Order of work: forward kinematics; drop a leading T-pose; guess the length unit from the body
//! height; zero-phase low-pass; cubic-spline resampling; centre on the floor; forward differences
//! from two extra frames, which are then dropped, so that every kept frame obeys the identities.

use thiserror::Error;

use crate::units::FPS;

use super::bvh::{Bvh, JointChannel};
use super::channels::Channel;
use super::kinematics::{Poses, forward_differences, frames_of};
use super::lowpass::lowpass;
use super::phase::{Beats, bar_phase};
use super::quantile::{median, percentile};
use super::quaternion::{
    IDENTITY, Quaternion, from_axis_angle, make_sign_continuous, mul, normalize, rotate,
};
use super::spline::{CubicSpline, SplineError};
use super::style::{BodyMotion, style_channels};
use super::trajectory::{Trajectory, TrajectoryError};

/// Cutoff of the low-pass on captured signals, Hz.
pub const LOWPASS_HZ: f64 = 8.0;
/// Highest cutoff per sampling rate for captures not faster than [`FPS`].
const MAX_CUTOFF_PER_RATE: f64 = 0.4;
/// Captures up to this multiple of [`FPS`] count as not faster.
const FASTER_THAN_FPS: f64 = 1.05;
/// Fewest resampled frames: three kept ones and the two that the differences consume.
pub const MIN_RESAMPLED_FRAMES: usize = 5;
/// Frames consumed by two forward differences.
const DIFFERENCED_FRAMES: usize = 2;
/// Most resampled frames: two hours.
pub const MAX_RESAMPLED_FRAMES: usize = 216_000;
/// Most node positions held at once, nodes times frames.
pub const MAX_NODE_POSITIONS: usize = 8_000_000;
/// Body heights taken for a person's, m.
const PERSON_HEIGHT_M: std::ops::RangeInclusive<f64> = 1.2..=2.6;
/// Length units tried in turn, m: metre, CMU unit (1/0.45 inch), inch, centimetre, millimetre.
const UNITS_M: [f64; 5] = [1.0, 0.0254 / 0.45, 0.0254, 0.01, 0.001];
/// Height given to a body that is no person's height in any unit, m.
const DEFAULT_HEIGHT_M: f64 = 1.7;
/// A node jump over this multiple of the median jump ends a leading T-pose.
const POP_PER_MEDIAN_JUMP: f64 = 15.0;
/// Jumps within this many file units are never a pop, so that a still take has none.
const POP_FLOOR: f64 = 1e-9;
/// Takes up to this many frames keep all of them.
const MIN_FRAMES_FOR_POP: usize = 20;

const AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

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
    /// The capture's times cannot carry a spline.
    #[error(transparent)]
    Spline(#[from] SplineError),
    /// The result holds NaN or infinities.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}

/// Converts a capture to a trajectory at [`FPS`], shape `[T, 25]`, `T >= 3`.
///
/// `T = ⌊30 (n - 1) Δt⌋ - 1` for `n` frames at `Δt`. The path starts over the origin, the ground
/// (1st percentile of all node heights) is at 0. The phase is 0 without beats; beat times count
/// from the first kept frame of the take. Errors: [`CaptureError`].
pub fn convert_bvh(bvh: &Bvh, beats: Option<&Beats>) -> Result<Trajectory, CaptureError> {
    let mut take = Take::from_bvh(bvh)?;
    let (grid_s, t_kept) = take.resampling_grid()?;
    take.scale_to_metres()?;
    take.lowpass();

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

    let mut heights: Vec<f64> = take.heights().flatten().copied().collect();
    let ground = percentile(&mut heights, 1.0).unwrap_or(0.0);
    let origin = [p[0][0], ground, p[0][2]];
    for p in &mut p {
        *p = std::array::from_fn(|axis| p[axis] - origin[axis]);
    }
    let mut nodes = Vec::with_capacity(take.nodes.len());
    for (i, signal) in take.nodes.iter().enumerate() {
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

/// A take in world coordinates at its own sampling rate, the leading T-pose gone.
struct Take {
    /// Sampling times from the first kept frame, s.
    times_s: Vec<f64>,
    /// World coordinates of the nodes, one signal per coordinate: x, y, z of the root, and so on.
    nodes: Vec<Vec<f64>>,
    /// Orientation of the root, one signal per component w, x, y, z.
    orientation: [Vec<f64>; 4],
}

impl Take {
    fn from_bvh(bvh: &Bvh) -> Result<Self, CaptureError> {
        let (n_frames, n_nodes) = (bvh.frames().nrows(), bvh.joints().len());
        check_size("node positions", n_frames * n_nodes, MAX_NODE_POSITIONS)?;
        let mut nodes = vec![vec![0.0; n_frames]; 3 * n_nodes];
        let mut root = Vec::with_capacity(n_frames);
        let mut pose = vec![([0.0; 3], IDENTITY); n_nodes];
        for (t, row) in bvh.frames().rows().into_iter().enumerate() {
            forward_kinematics(bvh, row.iter().copied(), &mut pose);
            for (node, (position, _)) in pose.iter().enumerate() {
                for axis in 0..3 {
                    nodes[3 * node + axis][t] = position[axis];
                }
            }
            root.push(normalize(pose[0].1));
        }
        let start = first_frame_after_pop(&nodes, bvh.frame_time_s());
        for signal in &mut nodes {
            signal.drain(..start);
        }
        let mut kept = root.split_off(start);
        make_sign_continuous(&mut kept);
        let orientation = std::array::from_fn(|c| kept.iter().map(|q| q[c]).collect());
        let times_s = (start..n_frames)
            .map(|t| t as f64 * bvh.frame_time_s() - start as f64 * bvh.frame_time_s())
            .collect();
        Ok(Self { times_s, nodes, orientation })
    }

    /// Times of the resampled frames, s, and how many of them are kept.
    fn resampling_grid(&self) -> Result<(Vec<f64>, usize), CaptureError> {
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

    fn heights(&self) -> impl Iterator<Item = &Vec<f64>> {
        self.nodes.iter().skip(1).step_by(3)
    }

    /// Multiplies all lengths by the unit in which the body has a person's height.
    ///
    /// Height is the span from the 1st to the 99th percentile of all node heights.
    fn scale_to_metres(&mut self) -> Result<(), CaptureError> {
        let mut heights: Vec<f64> = self.heights().flatten().copied().collect();
        let top = percentile(&mut heights, 99.0).unwrap_or(0.0);
        let height = top - percentile(&mut heights, 1.0).unwrap_or(0.0);
        if !(height > 0.0 && height.is_finite()) {
            return Err(CaptureError::NoHeight { height });
        }
        let scale_m = UNITS_M
            .into_iter()
            .find(|unit_m| PERSON_HEIGHT_M.contains(&(height * unit_m)))
            .unwrap_or(DEFAULT_HEIGHT_M / height);
        self.nodes.iter_mut().flatten().for_each(|x| *x *= scale_m);
        Ok(())
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

/// World position and orientation of every node for one frame of channel values.
///
/// `Q[j] = Q[parent] ⊗ r₁ ⊗ r₂ …` in channel order, `P[j] = P[parent] + Q[parent] x` with `x` the
/// offset, of which a position channel replaces its own coordinate. So a root with three position
/// channels ignores its OFFSET, and a joint with six channels is placed by its channels alone.
fn forward_kinematics(
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

/// First frame after a calibration pose: many takes begin with a T-pose and jump out of it.
///
/// The last frame step within the first second (at most the first tenth) in which some node moves
/// over 15 times the median of the largest node step.
fn first_frame_after_pop(nodes: &[Vec<f64>], frame_time_s: f64) -> usize {
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
    let threshold = POP_PER_MEDIAN_JUMP * median(&mut jumps.clone()).unwrap_or(0.0) + POP_FLOOR;
    let pop = jumps.iter().take(searched.max(2)).rposition(|&jump| jump > threshold);
    pop.map_or(0, |t| t + 1)
}

fn resample(times_s: &[f64], signal: &[f64], grid_s: &[f64]) -> Result<Vec<f64>, SplineError> {
    Ok(CubicSpline::fit(times_s, signal)?.evaluate(grid_s))
}

fn check_size(what: &'static str, count: usize, limit: usize) -> Result<(), CaptureError> {
    if count > limit { Err(CaptureError::TooLarge { what, count, limit }) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    /// A post of 1.7 m: a root with six channels at 1 m, a head above and a foot below.
    fn post(rate_hz: f64, rows: &[[f64; 6]]) -> Bvh {
        let mut text = String::from(
            "HIERARCHY\nROOT hips\n{\nOFFSET 50 60 70\nCHANNELS 6 Xposition Yposition Zposition \
             Yrotation Xrotation Zrotation\nJOINT chest\n{\nOFFSET 0 0.3 0\n\
             CHANNELS 3 Zrotation Xrotation Yrotation\nEnd Site\n{\nOFFSET 0 0.4 0\n}\n}\n\
             End Site\n{\nOFFSET 0 -1 0\n}\n}\n",
        );
        text += &format!("MOTION\nFrames: {}\nFrame Time: {}\n", rows.len(), 1.0 / rate_hz);
        for row in rows {
            let words: Vec<String> = row.iter().map(f64::to_string).collect();
            text += &format!("{} 0 0 0\n", words.join(" "));
        }
        Bvh::parse(text.as_bytes()).unwrap()
    }

    #[test]
    fn a_gliding_turning_post_has_closed_forms() {
        // 0.6 m/s along x and a turn of 90 degrees per second about the vertical, at 30 Hz.
        let rows: Vec<[f64; 6]> = (0..91)
            .map(|t| [4.0 + 0.02 * f64::from(t), 1.0, -3.0, 3.0 * f64::from(t), 0.0, 0.0])
            .collect();
        let trajectory = convert_bvh(&post(30.0, &rows), None).unwrap();
        assert_eq!(trajectory.n_frames(), 89);
        for (t, row) in trajectory.view().rows().into_iter().enumerate() {
            // The 8 Hz filter passes slow signals, but its ends bend them: stay away from those.
            if !(20..69).contains(&t) {
                continue;
            }
            let angle = t as f64 * PI / 60.0;
            let want = [0.02 * t as f64, 1.0, 0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0]
                .into_iter()
                .chain([(angle / 2.0).cos(), 0.0, (angle / 2.0).sin(), 0.0])
                .chain([0.0, PI / 2.0, 0.0, 0.0]);
            for (i, w) in want.enumerate() {
                // What is left of the bent ends, twice differenced (900 per s²) in acceleration.
                assert!((f64::from(row[i]) - w).abs() < 5e-5, "frame {t} column {i}: {}", row[i]);
            }
        }
    }

    #[test]
    fn position_channels_replace_the_offset_and_rotations_apply_in_file_order() {
        let bvh = post(30.0, &[[1.0, 2.0, 3.0, 90.0, 90.0, 0.0]]);
        let mut pose = vec![([0.0; 3], IDENTITY); 4];
        forward_kinematics(&bvh, bvh.frames().iter().copied(), &mut pose);
        // Turn left to face +X, then bow: the head points along the new forward, +X.
        for (node, want) in [(0, [1.0, 2.0, 3.0]), (1, [1.3, 2.0, 3.0]), (2, [1.7, 2.0, 3.0])] {
            for (axis, w) in want.into_iter().enumerate() {
                assert!((pose[node].0[axis] - w).abs() < 1e-12, "{:?}", pose[node].0);
            }
        }
    }

    #[test]
    fn a_leading_calibration_pose_is_dropped() {
        let mut rows: Vec<[f64; 6]> =
            (0..61).map(|t| [0.01 * f64::from(t), 1.0, 0.0, 0.0, 0.0, 0.0]).collect();
        rows[0] = [5.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        rows[1] = rows[0];
        let take = Take::from_bvh(&post(60.0, &rows)).unwrap();
        assert_eq!(take.times_s.len(), 59);
        assert_eq!((take.times_s[0], take.nodes[0][0]), (0.0, 0.02));
    }

    #[test]
    fn the_length_unit_follows_from_the_height() {
        for (units_per_m, want) in [(1.0, 1.0), (100.0, 0.01), (1000.0, 0.001), (7.0, 1.0 / 7.0)] {
            let mut take =
                Take::from_bvh(&post(30.0, &[[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]; 7])).unwrap();
            take.nodes.iter_mut().flatten().for_each(|x| *x *= units_per_m);
            take.scale_to_metres().unwrap();
            // A height of 11.9 units is nobody's: it is set to 1.7 m, here by chance the true one.
            let scale = take.nodes[1][0] / units_per_m;
            assert!((scale / want - 1.0).abs() < 1e-9, "{units_per_m}: {scale}");
        }
    }

    #[test]
    fn short_flat_and_oversized_takes_are_refused() {
        let still = [[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]; 4];
        assert_eq!(
            convert_bvh(&post(30.0, &still), None).unwrap_err().to_string(),
            "capture lasts 0.100 s and gives 4 frames at 30 fps, expected at least 5; \
             use a longer take"
        );
        let flat = "HIERARCHY ROOT a\n{ CHANNELS 1 Yposition }\nMOTION Frames: 9 Frame Time: .1\n\
                    0 0 0 0 0 0 0 0 0";
        assert_eq!(
            convert_bvh(&Bvh::parse(flat.as_bytes()).unwrap(), None).unwrap_err().to_string(),
            "capture has a body height of 0.0 file units, expected a positive one; \
             check the joint offsets"
        );
        let slow = format!(
            "HIERARCHY ROOT a\n{{ CHANNELS 1 Yposition }}\nMOTION Frames: 7300 Frame Time: 1\n{}",
            "0 ".repeat(7300)
        );
        assert_eq!(
            convert_bvh(&Bvh::parse(slow.as_bytes()).unwrap(), None).unwrap_err().to_string(),
            "capture needs 218971 frames, at most 216000 are converted; split the take"
        );
        let mut vast = [[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]; 9];
        vast[4][0] = 1e300;
        let error = convert_bvh(&post(30.0, &vast), None).unwrap_err();
        let CaptureError::Trajectory(error) = error else { panic!("{error}") };
        assert_eq!(error.kind(), "non_finite");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn every_kept_frame_obeys_the_identities(
            n in 33..77usize, rate_hz in 20.0..130.0f64, speed in 0.1..9.0f64,
            turn in -400.0..400.0f64
        ) {
            let rows: Vec<[f64; 6]> = (0..n)
                .map(|t| {
                    let s = t as f64 / rate_hz;
                    [(speed * s).sin(), 1.0 + 0.1 * (7.0 * s).cos(), s * s, turn * s, 20.0 * s, 5.0]
                })
                .collect();
            let trajectory = convert_bvh(&post(rate_hz, &rows), None).unwrap();
            let x = trajectory.view().mapv(f64::from);
            for t in 0..x.nrows() - 1 {
                for i in 0..6 {
                    let derived = (x[[t + 1, i]] - x[[t, i]]) * FPS;
                    // Three roundings to f32, two of them times 30.
                    let size = x[[t, i]].abs().max(x[[t + 1, i]].abs()) * FPS + derived.abs();
                    let tolerance = 2.0 * f64::from(f32::EPSILON) * size + 1e-9;
                    prop_assert!((x[[t, i + 3]] - derived).abs() <= tolerance);
                }
            }
        }
    }
}
