//! What a conversion found out about a take, and what it did to it.

use std::fmt;

use super::upright::Axis;

/// A unit of length that takes are written in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unit {
    pub name: &'static str,
    /// Metres of one file unit.
    pub size_m: f64,
}

/// The findings on a take.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureAccount {
    /// Name of the joint whose motion the trajectory is.
    pub root: String,
    /// The axis that is up in the file.
    pub up: Axis,
    /// Metres of one file unit.
    pub unit_m: f64,
    /// Length of what was cut off at the start, s.
    pub cut_s: f64,
    /// Notes for a reader.
    pub notes: Vec<CaptureNote>,
}

/// Something of a take that its reader should know.
#[derive(Clone, Debug, PartialEq)]
pub enum CaptureNote {
    /// Of the text.
    Text(String),
    /// Joints above the body do not move.
    StaticRoot { above: String, root: String },
    /// The body's root does not move.
    Motionless { root: String, range_m: f64 },
    /// Another axis than Y is up.
    Turned { up: Axis },
    /// Nothing tells which axis is up.
    UpAssumed,
    /// Skeleton and poses differ about the axis, and the steadier floor decided.
    UpByFloor { up: Axis, other: Axis },
    /// The root joint's axes are not the body's.
    OwnAxes { root: String, up: Axis },
    /// Lengths are in an unusual unit.
    UnusualUnit { unit: &'static str, height_m: f64 },
    /// Lengths are in no unit of which a person would be made.
    Scaled { height: f64, height_m: f64 },
    /// The start was cut off.
    Cut { n_frames: usize, cut_s: f64 },
}

impl fmt::Display for CaptureNote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Text(note) => f.write_str(note),
            Self::StaticRoot { above, root } => {
                write!(f, "root {above} never moves, the body's root is {root}")
            }
            Self::Motionless { root, range_m } => {
                write!(f, "root {root} stands still, it moves within {:.1} mm", range_m * 1e3)
            }
            Self::Turned { up } => write!(f, "{up} is up in the file"),
            Self::UpAssumed => {
                f.write_str("nothing tells which axis is up, y is assumed (--up names another)")
            }
            Self::UpByFloor { up, other } => write!(
                f,
                "{up} is up in the file by its steadier floor, {other} by its poses (--up names another)"
            ),
            Self::OwnAxes { root, up } => write!(
                f,
                "joint {root} has axes of its own, {up} is the body's up, it is turned upright"
            ),
            Self::UnusualUnit { unit, height_m } => {
                write!(f, "lengths are taken for {unit}, the body for {height_m:.2} m")
            }
            Self::Scaled { height, height_m } => write!(
                f,
                "a body of {height:.4} file units is nobody's in any unit, it is scaled to {height_m} m"
            ),
            Self::Cut { n_frames, cut_s } => write!(
                f,
                "the first {n_frames} frames ({cut_s:.2} s) are cut, a pose that the body jumps out of"
            ),
        }
    }
}
