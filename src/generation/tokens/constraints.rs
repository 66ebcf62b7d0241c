//! Constraints as a planner of tokens sees them, and where constraints act.

use std::ops::Range;

use ndarray::{Array2, ArrayView1};
use serde::{Deserialize, Serialize};

use crate::generation::control::{Constraints, WantedValue};
use crate::model::{CONSTRAINT_DIM, PoseConstraint};
use crate::motion::quaternion::{Quaternion, normalize};
use crate::motion::{Channel, MOTION_DIM, Normalizer, Placement};

/// Where constraints act.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// On the plan and in decoding.
    Both,
    /// On the plan alone: motion meets them roughly.
    Plan,
    /// In decoding alone: motion is planned without them and moved to meet them.
    Decode,
    /// Nowhere; how far motion is from them is reported.
    None,
}

impl Control {
    /// Returns the name that flags and messages use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Both => "both",
            Self::Plan => "plan",
            Self::Decode => "decode",
            Self::None => "none",
        }
    }

    /// Returns whether constraints are a condition of the plan.
    pub fn plans(self) -> bool {
        matches!(self, Self::Both | Self::Plan)
    }

    /// Returns whether constraints are enforced in decoding, and of what is decoded.
    pub fn decodes(self) -> bool {
        matches!(self, Self::Both | Self::Decode)
    }
}

/// Returns the constraints on the poses of a window, [`PoseConstraint::channels`] of each frame; none where there are none.
///
/// - `frames`: those of the window in the track
/// - `place`: where the window stands in the world
/// - `normalizer`: the tokenizer's units
///
/// x alone, or z alone, is no constraint on a point of the floor once the window is turned, and is left to decoding.
pub fn window_constraints(
    constraints: &Constraints,
    frames: &Range<usize>,
    place: Placement,
    normalizer: &Normalizer,
) -> Option<Array2<f32>> {
    let n = frames.len();
    let mut poses = Array2::zeros((n, MOTION_DIM));
    let quaternion = Channel::Quaternion.range().start;
    poses.column_mut(quaternion).fill(1.0);
    let mut has = vec![[false; 4]; n];
    for (t, wanted) in constraints.in_range(frames.start, n) {
        match wanted {
            WantedValue::Value { channel, value }
                if Channel::Position.range().contains(&channel) =>
            {
                poses[[t, channel]] = value as f32;
                has[t][channel - Channel::Position.range().start] = true;
            }
            WantedValue::Orientation(q) => {
                for (i, x) in q.into_iter().enumerate() {
                    poses[[t, quaternion + i]] = x as f32;
                }
                has[t][3] = true;
            }
            WantedValue::Value { .. } => {}
        }
    }
    place.remove(&mut poses);
    let turned: Vec<Quaternion> = poses.rows().into_iter().map(orientation).collect();
    normalizer.normalize(poses.view_mut());
    let mut channels = Array2::zeros((n, CONSTRAINT_DIM));
    for (t, [x, y, z, is_turned]) in has.into_iter().enumerate() {
        let at = |axis: usize| poses[[t, Channel::Position.range().start + axis]];
        let asked = PoseConstraint {
            floor: (x && z).then(|| [at(0), at(2)]),
            height: y.then(|| at(1)),
            orientation: is_turned.then_some(turned[t]),
        };
        channels.row_mut(t).iter_mut().zip(asked.channels()).for_each(|(x, asked)| *x = asked);
    }
    channels.iter().any(|&x| x != 0.0).then_some(channels)
}

fn orientation(row: ArrayView1<f32>) -> Quaternion {
    let first = Channel::Quaternion.range().start;
    normalize(std::array::from_fn(|i| f64::from(row[first + i])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generation::control::facing;
    use crate::generation::walk::walk;
    use crate::motion::ChannelLimits;

    fn value(frame: usize, channel: usize, value: f64) -> (usize, WantedValue) {
        (frame, WantedValue::Value { channel, value })
    }

    fn asked(wanted: Vec<(usize, WantedValue)>, place: Placement) -> Option<Array2<f32>> {
        let constraints =
            Constraints::new(wanted, 400, ChannelLimits::Wide).expect("sound constraints");
        let mut normalizer = Normalizer::identity();
        (normalizer.centre[1], normalizer.scale[2]) = (0.5, 2.0);
        window_constraints(&constraints, &(100..110), place, &normalizer)
    }

    #[test]
    fn what_is_asked_is_that_of_the_window_in_its_own_place_and_units() {
        // The window stands at (1, −2) and faces +X: what lies 3 m before it is 3 m along its own +Z.
        let place = Placement { x_m: 1.0, z_m: -2.0, yaw_rad: std::f64::consts::FRAC_PI_2 };
        let wanted = vec![
            value(104, 0, 4.0),
            value(104, 2, -2.0),
            value(105, 1, 0.9),
            // x alone, and a frame of another window.
            value(106, 0, 1.0),
            value(120, 1, 0.9),
            (107, WantedValue::Orientation(facing(std::f64::consts::FRAC_PI_2))),
        ];
        let channels = asked(wanted, place).expect("constraints");
        assert_eq!(channels.dim(), (10, 12));
        let near = |t: usize, wanted: [f32; 12]| {
            for (found, wanted) in channels.row(t).iter().zip(wanted) {
                assert!((found - wanted).abs() < 1e-6, "frame {t}: {}", channels.row(t));
            }
        };
        let floor = [0.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0];
        near(4, floor);
        near(5, [0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        near(6, [0.0; 12]);
        // It faces as the window does.
        near(7, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn nothing_is_asked_where_nothing_lies_in_the_window() {
        let place = Placement::default();
        assert_eq!(asked(vec![value(99, 0, 1.0), value(110, 1, 1.0)], place), None);
        assert_eq!(asked(vec![value(104, 2, 1.0)], place), None, "z alone");
        // A velocity is no pose.
        assert_eq!(asked(vec![value(104, 3, 1.0)], place), None);
    }

    #[test]
    fn a_motion_that_is_asked_for_is_what_training_asks_of_it() {
        let motion = walk(10);
        let mut wanted = Vec::new();
        for (t, row) in motion.rows().into_iter().enumerate() {
            let axes = (0..3).map(|axis| value(100 + t, axis, f64::from(row[axis])));
            wanted.extend(axes);
            wanted.push((100 + t, WantedValue::Orientation(orientation(row))));
        }
        let place = Placement::of_first(motion.view()).expect("frames");
        let channels = asked(wanted, place).expect("constraints");
        let mut placed = motion;
        place.remove(&mut placed);
        for (row, pose) in channels.rows().into_iter().zip(placed.rows()) {
            let expected = PoseConstraint {
                floor: Some([pose[0], pose[2] / 2.0]),
                height: Some(pose[1] - 0.5),
                orientation: Some(orientation(pose)),
            };
            for (found, wanted) in row.iter().zip(expected.channels()) {
                assert!((found - wanted).abs() < 1e-5, "{row}");
            }
        }
    }
}
