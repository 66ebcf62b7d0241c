//! Which way is up in a file, and the turn that makes it +Y.

use std::f64::consts::FRAC_PI_2;
use std::fmt;

use super::CaptureError;
use super::skeleton::{Body, Landmarks, Positions, STANDING_RATIO, at, sampled};
use crate::motion::quaternion::{IDENTITY, Quaternion, from_axis_angle, normalize, rotate};
use crate::motion::vector::{inner, minus};

/// A direction counts where its greatest component is at least this.
const DECIDED: f64 = 0.7;
/// Share of the rest pose's height that trunk and legs each have at least.
const PART_SHARE: f64 = 0.2;
/// One floor is steadier than another where it moves this many times less.
const STEADIER: f64 = 2.0;
/// Motion of a floor below which it does not count, of the body's height.
const STEADY_PER_HEIGHT: f64 = 0.01;

/// An axis of a file with its direction.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, clap::ValueEnum,
)]
pub enum Axis {
    #[value(name = "x")]
    #[serde(rename = "x")]
    X,
    #[value(name = "y")]
    #[serde(rename = "y")]
    Y,
    #[value(name = "z")]
    #[serde(rename = "z")]
    Z,
    #[value(name = "-x")]
    #[serde(rename = "-x")]
    MinusX,
    #[value(name = "-y")]
    #[serde(rename = "-y")]
    MinusY,
    #[value(name = "-z")]
    #[serde(rename = "-z")]
    MinusZ,
}

impl Axis {
    const ALL: [Self; 6] = [Self::X, Self::Y, Self::Z, Self::MinusX, Self::MinusY, Self::MinusZ];

    /// Returns the axis as flags and tables spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::X => "x",
            Self::Y => "y",
            Self::Z => "z",
            Self::MinusX => "-x",
            Self::MinusY => "-y",
            Self::MinusZ => "-z",
        }
    }

    /// The axis as a unit vector.
    pub fn direction(self) -> [f64; 3] {
        match self {
            Self::X => [1.0, 0.0, 0.0],
            Self::Y => [0.0, 1.0, 0.0],
            Self::Z => [0.0, 0.0, 1.0],
            Self::MinusX => [-1.0, 0.0, 0.0],
            Self::MinusY => [0.0, -1.0, 0.0],
            Self::MinusZ => [0.0, 0.0, -1.0],
        }
    }

    /// The turn that makes this axis +Y; of a body that faces -Y where Z is up, +Z becomes forward.
    pub fn to_y(self) -> Quaternion {
        let (x, z) = (Self::X.direction(), Self::Z.direction());
        match self {
            Self::Y => IDENTITY,
            Self::MinusY => from_axis_angle(x, 2.0 * FRAC_PI_2),
            Self::Z => from_axis_angle(x, -FRAC_PI_2),
            Self::MinusZ => from_axis_angle(x, FRAC_PI_2),
            Self::X => from_axis_angle(z, FRAC_PI_2),
            Self::MinusX => from_axis_angle(z, -FRAC_PI_2),
        }
    }

    /// The axis along which the mean of unit vectors is at least so long; none where they point everywhere.
    pub fn along(mean: [f64; 3], least: f64) -> Option<Self> {
        Self::ALL.into_iter().find(|axis| inner(axis.direction(), mean) >= least)
    }

    /// The axis next to a direction; none where two are about as near.
    fn next_to(v: [f64; 3], least: f64) -> Option<Self> {
        let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
        let along = |axis: &Self| inner(axis.direction(), v);
        Self::ALL.into_iter().find(|axis| length > 0.0 && along(axis) >= least * length)
    }
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The axis that is up, and how it is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpAxis {
    /// In the world of the take.
    pub axis: Axis,
    /// In the rest pose, that is in the frame of the body's root; none where it cannot be told.
    pub rest: Option<Axis>,
    pub by: UpEvidence,
}

/// How the axis is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UpEvidence {
    Found,
    /// Skeleton and poses differ, and the floor decided against this axis.
    Floor(Axis),
    /// Nothing tells.
    Assumed,
}

/// Finds the axis that is up.
///
/// The rest pose tells it, and so do trunk and legs as the take holds them. Where these differ (a body that
/// lies, joints with axes of their own, a root that turns the file's axes), the axis along which the lowest
/// point of the body is steadier is taken, and where neither is, Y if one of them says so.
///
/// # Errors
/// [`CaptureError::UpUnknown`] where two axes are as likely.
pub fn find_up(
    body: &Body,
    world: &Positions,
    orientation: &[Quaternion],
) -> Result<UpAxis, CaptureError> {
    let rest = rest_up(body);
    let (trunk, legs) = match &body.landmarks {
        Some(landmarks) => posed(body, landmarks, world),
        None => {
            let turned = rest.map(|rest| {
                let turned = orientation.iter().map(|&q| rotate(q, rest.direction()));
                Axis::next_to(mean(turned), DECIDED)
            });
            (turned.flatten(), None)
        }
    };
    let found = |axis, by| Ok(UpAxis { axis, rest, by });
    let Some(posed) = trunk.or(legs) else {
        return match rest {
            Some(axis) => found(axis, UpEvidence::Found),
            None => found(Axis::Y, UpEvidence::Assumed),
        };
    };
    let other = match rest {
        Some(rest) if rest == posed => return found(posed, UpEvidence::Found),
        Some(rest) => rest,
        None if posed == Axis::Y => return found(posed, UpEvidence::Found),
        None => Axis::Y,
    };
    let height = body.height(world);
    let unsteady = |axis: Axis| floor_motion(body, world, axis).max(STEADY_PER_HEIGHT * height);
    let (of_posed, of_other) = (unsteady(posed), unsteady(other));
    if of_posed * STEADIER <= of_other {
        found(posed, if posed == Axis::Y { UpEvidence::Found } else { UpEvidence::Floor(other) })
    } else if of_other * STEADIER <= of_posed {
        found(other, if other == Axis::Y { UpEvidence::Found } else { UpEvidence::Floor(posed) })
    } else if posed == Axis::Y || rest == Some(Axis::Y) {
        found(Axis::Y, UpEvidence::Found)
    } else {
        Err(CaptureError::UpUnknown { one: posed, other })
    }
}

/// Up in the rest pose: from the feet over the pelvis to the head, or along what is far longer than wide.
fn rest_up(body: &Body) -> Option<Axis> {
    let Some(Landmarks { head, feet, pelvis }) = &body.landmarks else {
        let extent = |axis: usize| {
            let x = body.rest.iter().map(|p| p[axis]);
            let (low, high) =
                x.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
            high - low
        };
        let extents: [f64; 3] = std::array::from_fn(extent);
        return (0..3).find_map(|axis| {
            let others = extents[(axis + 1) % 3].max(extents[(axis + 2) % 3]);
            let stands = extents[axis] > 0.0 && extents[axis] >= STANDING_RATIO * others;
            stands.then_some([Axis::X, Axis::Y, Axis::Z][axis])
        });
    };
    let foot = mean(feet.iter().map(|&foot| body.rest[foot]));
    let (trunk, legs) =
        (minus(body.rest[*head], body.rest[*pelvis]), minus(body.rest[*pelvis], foot));
    let whole: [f64; 3] = std::array::from_fn(|c| trunk[c] + legs[c]);
    let axis = Axis::next_to(whole, DECIDED)?;
    let height = inner(axis.direction(), whole);
    // Where every bone lies along one axis, head and feet are on one side.
    let both = [trunk, legs].iter().all(|v| inner(axis.direction(), *v) >= PART_SHARE * height);
    both.then_some(axis)
}

/// Where trunk and legs point over the take, from below to above.
fn posed(
    body: &Body,
    Landmarks { head, feet, pelvis }: &Landmarks,
    world: &Positions,
) -> (Option<Axis>, Option<Axis>) {
    let frames = sampled(world.first().map_or(0, Vec::len));
    let place = |node: usize, t: usize| at(world, body.nodes[node], t);
    let over_take = |from_to: &dyn Fn(usize) -> [f64; 3]| {
        let units = frames.iter().map(|&t| {
            let v = from_to(t);
            let length = v.iter().map(|c| c * c).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
            v.map(|c| c / length)
        });
        let mean = mean(units);
        let length = mean.iter().map(|c| c * c).sum::<f64>().sqrt();
        // What points everywhere points nowhere.
        if length >= DECIDED { Axis::next_to(mean, DECIDED) } else { None }
    };
    let trunk = over_take(&|t| minus(place(*head, t), place(*pelvis, t)));
    let legs =
        over_take(&|t| minus(place(*pelvis, t), mean(feet.iter().map(|&foot| place(foot, t)))));
    (trunk, legs)
}

/// Standard deviation of the body's lowest point along an axis, file units.
fn floor_motion(body: &Body, world: &Positions, up: Axis) -> f64 {
    let direction = up.direction();
    let lowest: Vec<f64> = sampled(world.first().map_or(0, Vec::len))
        .into_iter()
        .map(|t| {
            let heights = body.nodes.iter().map(|&i| inner(direction, at(world, i, t)));
            heights.fold(f64::INFINITY, f64::min)
        })
        .collect();
    let n = lowest.len().max(1) as f64;
    let mean = lowest.iter().sum::<f64>() / n;
    (lowest.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Part of a rotation that is not about +Y: what tilts.
pub fn tilt(q: Quaternion) -> Quaternion {
    let norm = q[0].hypot(q[2]);
    if norm < 1e-9 {
        return q;
    }
    let (w, y) = (q[0] / norm, q[2] / norm);
    // The turn about +Y, inverted, times the whole.
    let back = [w, 0.0, -y, 0.0];
    normalize(crate::motion::quaternion::mul(back, q))
}

fn mean(vectors: impl Iterator<Item = [f64; 3]>) -> [f64; 3] {
    let (mut sum, mut n) = ([0.0; 3], 0.0);
    for v in vectors {
        for c in 0..3 {
            sum[c] += v[c];
        }
        n += 1.0;
    }
    sum.map(|c| c / f64::max(n, 1.0))
}
