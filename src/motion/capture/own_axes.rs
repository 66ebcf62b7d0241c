//! Root joints whose axes are not the body's.
//!
//! A joint without rotation has the axes of the file, so the rest pose tells how a body lies in them. Where
//! every bone of it points along one axis (LAFAN1: +X), no rest pose stands, and the joint's axes are found
//! from the pose instead: trunk and hips keep their place on the root.

use super::skeleton::{Body, Landmarks, Positions, at, sampled};
use super::upright::Axis;
use crate::motion::bvh::Bvh;
use crate::motion::quaternion::{Quaternion, conj, from_axis_angle, mul, rotate};

/// An axis is the body's where its share of the direction is at least this.
const DECIDED: f64 = 0.7;

/// A root joint's axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnAxes {
    /// The joint's axis along the trunk.
    pub up: Axis,
    /// The turn from the joint's axes to the body's: +Y up, +Z forward.
    pub to_body: Quaternion,
}

impl OwnAxes {
    /// Finds the axes of a root joint; none where the trunk has no axis of it, or `expected`, the turn that
    /// the rest pose or the file's axes call for, sets the trunk upright.
    pub fn find(
        bvh: &Bvh,
        body: &Body,
        world: &Positions,
        orientation: &[Quaternion],
        expected: Quaternion,
    ) -> Option<Self> {
        let Landmarks { head, feet, pelvis } = body.landmarks.as_ref()?;
        let in_joint = |from: usize, to: usize| {
            let frames = sampled(orientation.len());
            let mut mean = [0.0; 3];
            for &t in &frames {
                let (a, b) = (at(world, body.nodes[from], t), at(world, body.nodes[to], t));
                let way = rotate(conj(orientation[t]), std::array::from_fn(|c| b[c] - a[c]));
                let length = way.iter().map(|x| x * x).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
                mean = std::array::from_fn(|c| mean[c] + way[c] / length / frames.len() as f64);
            }
            Axis::along(mean, DECIDED)
        };
        let up = in_joint(*pelvis, *head)?;
        if rotate(expected, up.direction())[1] >= DECIDED {
            return None;
        }
        let hips: Vec<usize> = feet.iter().map(|&foot| body.branch_below(*pelvis, foot)).collect();
        let side = |is_of: fn(&str) -> bool| {
            let is_of =
                |&&hip: &&usize| is_of(&bvh.joints()[body.nodes[hip]].name.to_ascii_lowercase());
            hips.iter().find(is_of).copied()
        };
        let (left, right) = (side(is_left)?, side(is_right)?);
        let left = rotate(up.to_y(), in_joint(right, left)?.direction());
        // An axis along the trunk is no way from hip to hip.
        if left[1].abs() >= DECIDED {
            return None;
        }
        let heading = from_axis_angle([0.0, 1.0, 0.0], left[2].atan2(left[0]));
        Some(Self { up, to_body: mul(heading, up.to_y()) })
    }
}

fn is_left(name: &str) -> bool {
    name.contains("left") || name.starts_with("l_") || name.ends_with("_l")
}

fn is_right(name: &str) -> bool {
    name.contains("right") || name.starts_with("r_") || name.ends_with("_r")
}
