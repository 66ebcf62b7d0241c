//! Kinetic features: how fast a body moves and how much it accelerates, averaged over a chunk.
//!
//! Two shapes: eight numbers after DanceCamera3D's features of a camera (position and the three axes of the
//! body), and twelve after AIST++ (markers on the body, in the place of joints). Both in the intended formula
//! and as the field computes it, for comparison with published numbers only.

use std::ops::Range;

use crate::motion::Poses;
use crate::motion::quaternion::{Quaternion, rotate};
use crate::units::FPS;

use super::body::BODY_RADIUS_M;
use crate::motion::vector::{Vector, minus, norm};

/// Frames of a chunk: 2.5 s, as in DanceCamera3D.
pub const CHUNK_FRAMES: usize = 75;

/// Frames on either side over which velocity and acceleration are averaged.
const HALF_WINDOW: usize = 2;

/// Fewest frames that have an acceleration.
const MIN_FRAMES: usize = 3;

/// Names of [`axis_features`].
pub const AXIS_NAMES: [&str; 8] = [
    "position_velocity",
    "position_acceleration",
    "x_axis_velocity",
    "x_axis_acceleration",
    "y_axis_velocity",
    "y_axis_acceleration",
    "z_axis_velocity",
    "z_axis_acceleration",
];

/// Names of [`marker_features`].
pub const MARKER_NAMES: [&str; 12] = [
    "root_horizontal",
    "root_vertical",
    "root_expenditure",
    "x_marker_horizontal",
    "x_marker_vertical",
    "x_marker_expenditure",
    "y_marker_horizontal",
    "y_marker_vertical",
    "y_marker_expenditure",
    "z_marker_horizontal",
    "z_marker_vertical",
    "z_marker_expenditure",
];

/// How acceleration is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Formula {
    /// `(p[t+1] - 2 p[t] + p[t-1]) / Δt²` at Δt = 1/30 s.
    Correct,
    /// As in Bailando, Lodge, POPDG: `((p[t+1] - p[t]) / Δt - (p[t] - p[t-1] / Δt)) / Δt`, whose parenthesis
    /// is misplaced, at Δt = 1/60 s whatever the frame rate, positions counted from the first frame's.
    Compat,
}

impl Formula {
    fn frame_time_s(self) -> f64 {
        match self {
            Self::Correct => 1.0 / FPS,
            Self::Compat => 1.0 / 60.0,
        }
    }

    /// Where positions are counted from; without this the misplaced parenthesis would measure how far away
    /// a motion begins.
    fn origin(self, poses: &Poses) -> Vector {
        match self {
            Self::Correct => [0.0; 3],
            Self::Compat => poses.position_m[0],
        }
    }
}

/// Returns the chunks of a motion, one behind the other; frames beyond the last whole one are left out.
pub fn chunks(n_frames: usize) -> impl Iterator<Item = Range<usize>> {
    (0..n_frames / CHUNK_FRAMES).map(|i| i * CHUNK_FRAMES..(i + 1) * CHUNK_FRAMES)
}

/// Returns `mean |v̄|²` and `mean |ā|` of the position (m²/s², m/s²) and of the x, y and z axis of the body
/// (1/s², 1/s²), in this order.
///
/// Means over the frames from the second on; v̄ and ā averages over five frames, fewer at the ends. None for
/// fewer than three frames. Source: DanceCamera3D, `my_utils/camera_features.py`, without the field of view.
pub fn axis_features(poses: &Poses, formula: Formula) -> Option<[f64; 8]> {
    if poses.len() < MIN_FRAMES {
        return None;
    }
    let origin = formula.origin(poses);
    let mut subjects: Vec<Vec<Vector>> =
        vec![poses.position_m.iter().map(|&p| minus(p, origin)).collect()];
    for axis in 0..3 {
        subjects.push(poses.orientation.iter().map(|&q| rotate(q, unit(axis))).collect());
    }
    Some(std::array::from_fn(|i| {
        let subject = &subjects[i / 2][..poses.len()];
        if i % 2 == 0 {
            mean_over(subject, |t| norm(velocity(subject, t, formula)).powi(2))
        } else {
            mean_over(subject, |t| norm(acceleration(subject, t, formula)))
        }
    }))
}

/// Returns `mean |v̄ of x and z|²`, `mean v̄_y²` (m²/s²) and `mean |ā|` (m/s²) of the body's centre and of
/// markers 0.25 m along its x, y and z axis, in this order.
///
/// None for fewer than three frames. Source: AIST++, `aist_plusplus/features/kinetic.py`.
pub fn marker_features(poses: &Poses, formula: Formula) -> Option<[f64; 12]> {
    let energies = marker_energies(poses, formula)?;
    let n = energies.len() as f64;
    Some(std::array::from_fn(|i| energies.iter().map(|frame| frame[i]).sum::<f64>() / n))
}

/// Returns what [`marker_features`] are the means of, for every frame from the second on.
///
/// None for fewer than three frames.
pub fn marker_energies(poses: &Poses, formula: Formula) -> Option<Vec<[f64; 12]>> {
    if poses.len() < MIN_FRAMES {
        return None;
    }
    let origin = formula.origin(poses);
    let markers = markers_m(poses)
        .map(|marker| -> Vec<Vector> { marker.into_iter().map(|p| minus(p, origin)).collect() });
    let energies = |t: usize| {
        std::array::from_fn(|i| {
            let marker = &markers[i / 3];
            match i % 3 {
                0 => {
                    let [x, _, z] = velocity(marker, t, formula);
                    x * x + z * z
                }
                1 => velocity(marker, t, formula)[1].powi(2),
                _ => norm(acceleration(marker, t, formula)),
            }
        })
    };
    Some((1..poses.len()).map(energies).collect())
}

/// Returns where the body's centre and markers 0.25 m along its x, y and z axis are, m, by frame.
pub fn markers_m(poses: &Poses) -> [Vec<Vector>; 4] {
    let offsets =
        [[0.0; 3], unit(0), unit(1), unit(2)].map(|offset| offset.map(|x| BODY_RADIUS_M * x));
    offsets.map(|offset| {
        let at = |(&p, &q): (&Vector, &Quaternion)| {
            let arm = rotate(q, offset);
            std::array::from_fn(|i| p[i] + arm[i])
        };
        poses.position_m.iter().zip(&poses.orientation).map(at).collect()
    })
}

fn unit(axis: usize) -> Vector {
    std::array::from_fn(|i| f64::from(u8::from(i == axis)))
}

/// Mean over all frames but the first.
fn mean_over(x: &[Vector], value: impl Fn(usize) -> f64) -> f64 {
    (1..x.len()).map(value).sum::<f64>() / (x.len() - 1) as f64
}

/// Mean of the differences of the window around frame `t`, of which there is at least one.
fn velocity(x: &[Vector], t: usize, formula: Formula) -> Vector {
    // Of `x[s] - x[s-1]` for s from `first` to `last` the ends are left.
    let (first, last) = (t.saturating_sub(HALF_WINDOW).max(1), (t + HALF_WINDOW).min(x.len() - 1));
    let n = (last + 1 - first) as f64;
    minus(x[last], x[first - 1]).map(|d| d / (n * formula.frame_time_s()))
}

/// Mean of the second differences of the window around frame `t`, of which there is at least one.
fn acceleration(x: &[Vector], t: usize, formula: Formula) -> Vector {
    let dt = formula.frame_time_s();
    let (first, last) = (t.saturating_sub(HALF_WINDOW).max(1), (t + HALF_WINDOW).min(x.len() - 2));
    let mut sum = [0.0; 3];
    for s in first..=last {
        for (i, sum) in sum.iter_mut().enumerate() {
            let (before, here, after) = (x[s - 1][i], x[s][i], x[s + 1][i]);
            let v2 = (after - here) / dt;
            let v1 = match formula {
                Formula::Correct => (here - before) / dt,
                Formula::Compat => here - before / dt,
            };
            *sum += (v2 - v1) / dt;
        }
    }
    sum.map(|sum| sum / (last + 1 - first) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::from_axis_angle;

    /// Accelerates at 2 m/s² along x from 7 m, rises at 0.3 m/s, turns at 1.5 rad/s about the vertical.
    fn poses(n: usize) -> Poses {
        let time_s = |t: usize| t as f64 / FPS;
        Poses {
            position_m: (0..n).map(|t| [7.0 + time_s(t).powi(2), 0.3 * time_s(t), 0.0]).collect(),
            orientation: (0..n)
                .map(|t| from_axis_angle([0.0, 1.0, 0.0], 1.5 * time_s(t)))
                .collect(),
        }
    }

    #[test]
    fn uniform_acceleration_and_turning_have_closed_forms() {
        let found = axis_features(&poses(75), Formula::Correct).expect("frames");
        assert!((found[1] - 2.0).abs() < 1e-9, "{found:?}");
        // An axis that turns at ω has speed ω and acceleration ω², a little less by the averages.
        for i in [2, 6] {
            assert!((found[i] / 2.25 - 1.0).abs() < 0.01, "{found:?}");
            assert!((found[i + 1] / 2.25 - 1.0).abs() < 0.01, "{found:?}");
        }
        assert!(found[4] < 1e-20 && found[5] < 1e-9, "{found:?}");
        let found = marker_features(&poses(75), Formula::Correct).expect("frames");
        assert!((found[1] - 0.09).abs() < 1e-12 && (found[2] - 2.0).abs() < 1e-9, "{found:?}");
        assert!((found[7] - 0.09).abs() < 1e-12 && (found[8] - 2.0).abs() < 1e-9, "{found:?}");
        assert!((found[0] - found[6]).abs() < 1e-12, "the y axis is the axis of the turn");
    }

    #[test]
    fn three_frames_have_one_acceleration_and_two_none() {
        let found = axis_features(&poses(3), Formula::Correct).expect("three frames");
        assert!((found[1] - 2.0).abs() < 1e-9, "{found:?}");
        assert_eq!(axis_features(&poses(2), Formula::Correct), None);
        assert_eq!(marker_features(&poses(2), Formula::Compat), None);
    }

    #[test]
    fn the_misplaced_parenthesis_measures_places() {
        // Stands one metre away from where it began: v1 = x - 60 x, and a = 60 · 59.
        let mut poses = poses(9);
        for (t, p) in poses.position_m.iter_mut().enumerate() {
            *p = [if t == 0 { 4.0 } else { 5.0 }, 0.0, 0.0];
        }
        let x: Vec<Vector> = poses.position_m.iter().map(|&p| minus(p, [4.0, 0.0, 0.0])).collect();
        assert!((norm(acceleration(&x, 6, Formula::Compat)) - 3540.0).abs() < 1e-9);
        assert!(norm(acceleration(&x, 6, Formula::Correct)) < 1e-9);
        let compat = marker_features(&poses, Formula::Compat).expect("frames");
        assert!(compat[2] > 2000.0, "{compat:?}");
        // Twice the frame rate, four times the energy.
        let correct = marker_features(&poses, Formula::Correct).expect("frames");
        assert!((compat[0] / correct[0] - 4.0).abs() < 1e-9);
    }

    #[test]
    fn chunks_leave_the_rest_out() {
        assert_eq!(chunks(160).collect::<Vec<_>>(), [0..75, 75..150]);
        assert_eq!(chunks(74).count(), 0);
    }
}
