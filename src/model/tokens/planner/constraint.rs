//! The constraints of a frame as a condition of a planner.

use crate::motion::quaternion::{Quaternion, rotate};

/// Channels of a frame of constraints: nine of the pose, three that tell which of it is constrained.
pub const CONSTRAINT_DIM: usize = 12;

/// The constraints on the pose of one frame.
///
/// The frame is that of the window, whose first frame stands over the origin and faces +Z. There a point of the floor is
/// turned as a whole, so that x is constrained together with z or not at all.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseConstraint {
    /// x and z, in the tokenizer's units.
    pub floor: Option<[f32; 2]>,
    /// y, in the tokenizer's units.
    pub height: Option<f32>,
    /// A unit quaternion; q and −q are the same constraint.
    pub orientation: Option<Quaternion>,
}

impl PoseConstraint {
    /// Returns the channels: x, z, y, the directions of the body's +Z and +Y, and 1 for each of floor, height and
    /// orientation that is constrained; 0 elsewhere.
    ///
    /// Two axes of a rotation stand for it without a choice of sign (Zhou et al., "On the Continuity of Rotation
    /// Representations in Neural Networks", CVPR 2019).
    pub fn channels(&self) -> [f32; CONSTRAINT_DIM] {
        let mut row = [0.0; CONSTRAINT_DIM];
        if let Some([x, z]) = self.floor {
            (row[0], row[1], row[9]) = (x, z, 1.0);
        }
        if let Some(y) = self.height {
            (row[2], row[10]) = (y, 1.0);
        }
        if let Some(q) = self.orientation {
            let (forward, up) = (rotate(q, [0.0, 0.0, 1.0]), rotate(q, [0.0, 1.0, 0.0]));
            row[3..6].copy_from_slice(&forward.map(|x| x as f32));
            row[6..9].copy_from_slice(&up.map(|x| x as f32));
            row[11] = 1.0;
        }
        row
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::from_axis_angle;

    #[test]
    fn what_is_asked_stands_in_its_channels_and_nothing_elsewhere() {
        assert_eq!(PoseConstraint::default().channels(), [0.0; CONSTRAINT_DIM]);
        let floor = PoseConstraint { floor: Some([0.5, -2.0]), ..PoseConstraint::default() };
        let expected = [0.5, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0];
        assert_eq!(floor.channels(), expected);
        let height = PoseConstraint { height: Some(0.0), ..PoseConstraint::default() };
        assert_eq!(height.channels()[9..], [0.0, 1.0, 0.0], "0 m is asked for, too");
        // A quarter turn to +X: +Z becomes +X.
        let q = from_axis_angle([0.0, 1.0, 0.0], std::f64::consts::FRAC_PI_2);
        let turned =
            PoseConstraint { orientation: Some(q), ..PoseConstraint::default() }.channels();
        for (found, wanted) in turned.iter().zip([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]) {
            assert!((found - wanted).abs() < 1e-6, "{turned:?}");
        }
        let opposite =
            PoseConstraint { orientation: Some(q.map(|x| -x)), ..PoseConstraint::default() };
        assert_eq!(opposite.channels(), turned);
    }
}
