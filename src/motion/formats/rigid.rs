//! Positions and rotations of rigid bodies in `.npz`: of one dancer or of a group in one frame of reference.
//!
//! Members are `positions`, `[N, T, 3]` in metres, and `rotations`, `[N, T, 4]` as quaternions `(w, x, y, z)` or
//! `[N, T, 3]` as axis-angles, both body to world; without `N` for one dancer. `fps` is the rate.

use thiserror::Error;

use crate::motion::capture::RigidTrack;
use crate::motion::group::MAX_DANCERS;
use crate::motion::npy::NpyArray;
use crate::motion::npz::{Npz, NpzError};
use crate::motion::quaternion::from_rotation_vector;
use crate::units::FPS;

const POSITION_KEY: &str = "positions";
const ROTATION_KEY: &str = "rotations";
const RATE_KEY: &str = "fps";

/// Why positions and rotations were refused.
#[derive(Debug, Error)]
pub enum RigidError {
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// No positions of dancers.
    #[error(
        "npz member \"positions\" has shape {shape:?}, expected [dancers, frames, 3], or [frames, 3] of one \
         dancer; save the position of each body's root"
    )]
    Positions { shape: Vec<usize> },
    /// Rotations that do not go with the positions.
    #[error(
        "npz member \"rotations\" has shape {shape:?}, expected that of the positions, {positions:?}, with 4 \
         numbers (quaternion w, x, y, z) or 3 (axis-angle) at the end; save both of the same dancers and frames"
    )]
    Rotations { shape: Vec<usize>, positions: Vec<usize> },
    /// No dancer, or more than a group has.
    #[error(
        "npz has {n_dancers} dancers, expected 1 to {MAX_DANCERS}; split it into several phrases"
    )]
    Count { n_dancers: usize },
    /// No single rate.
    #[error("npz member \"fps\" has shape {shape:?}, expected one number; save it as one")]
    Rate { shape: Vec<usize> },
}

impl RigidError {
    /// The error's class in reports.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Npz(error) => error.kind(),
            Self::Rate { .. } => "motion_format",
            Self::Positions { .. } | Self::Rotations { .. } | Self::Count { .. } => "shape",
        }
    }
}

/// Returns whether an archive with these members is read here.
pub fn is_rigid(keys: &[String]) -> bool {
    [POSITION_KEY, ROTATION_KEY].iter().all(|key| keys.iter().any(|found| found == key))
}

/// Reads the tracks of all dancers; without `fps` they have 30 frames per second.
///
/// Errors: [`RigidError`].
pub fn read(bytes: &[u8]) -> Result<Vec<RigidTrack>, RigidError> {
    let mut archive = Npz::open(bytes)?;
    let positions = archive.read_f64(POSITION_KEY)?;
    let (n_dancers, n_frames) = match positions.shape[..] {
        [n_dancers, n_frames, 3] => (n_dancers, n_frames),
        [n_frames, 3] => (1, n_frames),
        _ => return Err(RigidError::Positions { shape: positions.shape }),
    };
    if !(1..=MAX_DANCERS).contains(&n_dancers) {
        return Err(RigidError::Count { n_dancers });
    }
    let rotations = archive.read_f64(ROTATION_KEY)?;
    let Some(width) = width_of(&rotations, &positions.shape) else {
        return Err(RigidError::Rotations { shape: rotations.shape, positions: positions.shape });
    };
    let mut notes = Vec::new();
    let rate_hz = if archive.keys().iter().any(|key| key == RATE_KEY) {
        let rate = archive.read_f64(RATE_KEY)?;
        let [rate_hz] = rate.values[..] else { return Err(RigidError::Rate { shape: rate.shape }) };
        rate_hz
    } else {
        notes.push(format!("no frame rate in the file, {FPS} fps are taken (fps says another)"));
        FPS
    };
    let orientation = |r: &[f64]| match *r {
        [w, x, y, z] => [w, x, y, z],
        _ => from_rotation_vector([r[0], r[1], r[2]]),
    };
    let track = |dancer: usize| {
        let frames = dancer * n_frames..(dancer + 1) * n_frames;
        let of_dancer = |values: &[f64], width: usize| -> Vec<f64> {
            values[frames.start * width..frames.end * width].to_vec()
        };
        RigidTrack {
            format: "positions",
            root: "body".to_owned(),
            rate_hz,
            up: None,
            unit_m: 1.0,
            position_m: of_dancer(&positions.values, 3)
                .chunks_exact(3)
                .map(|p| [p[0], p[1], p[2]])
                .collect(),
            orientation: of_dancer(&rotations.values, width)
                .chunks_exact(width)
                .map(orientation)
                .collect(),
            points_m: Vec::new(),
            height_m: None,
            is_keyframed: false,
            notes: notes.clone(),
        }
    };
    Ok((0..n_dancers).map(track).collect())
}

/// Returns how many numbers a rotation has, if there is one for each position.
fn width_of(rotations: &NpyArray<f64>, positions: &[usize]) -> Option<usize> {
    let (width, places) = rotations.shape.split_last()?;
    let (_, expected) = positions.split_last()?;
    (places == expected && matches!(width, 3 | 4)).then_some(*width)
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use crate::motion::npz::NpzWriter;

    type Member<'a> = (&'a str, &'a [usize], Vec<f64>);

    fn npz(members: &[Member]) -> Vec<u8> {
        let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
        for (key, shape, values) in members {
            npz.add(key, shape, values.iter().copied()).expect("written");
        }
        npz.finish().expect("written").into_inner()
    }

    fn numbers(n: usize) -> Vec<f64> {
        (0..n).map(|i| i as f64).collect()
    }

    fn refusal(members: &[Member]) -> (String, &'static str) {
        let error = read(&npz(members)).expect_err("refused");
        (error.to_string(), error.kind())
    }

    #[test]
    fn dancers_are_read_from_one_array_of_each() {
        let tracks = read(&npz(&[
            ("positions", &[2, 3, 3], numbers(18)),
            ("rotations", &[2, 3, 4], numbers(24)),
            ("fps", &[], vec![60.0]),
        ]))
        .expect("tracks");
        assert_eq!(tracks.len(), 2);
        assert_eq!(
            tracks[1].position_m,
            [[9.0, 10.0, 11.0], [12.0, 13.0, 14.0], [15.0, 16.0, 17.0]]
        );
        assert_eq!(tracks[1].orientation[2], [20.0, 21.0, 22.0, 23.0]);
        assert_eq!((tracks[0].rate_hz, tracks[0].notes.len()), (60.0, 0));
        let half = std::f64::consts::PI;
        let one = read(&npz(&[
            ("positions", &[1, 3], numbers(3)),
            ("rotations", &[1, 3], vec![0.0, half, 0.0]),
        ]))
        .expect("a track");
        assert_eq!((one.len(), one[0].rate_hz), (1, 30.0));
        let turned = one[0].orientation[0];
        for (found, expected) in turned.into_iter().zip([0.0, 0.0, 1.0, 0.0]) {
            assert!((found - expected).abs() < 1e-15, "{turned:?}");
        }
        assert_eq!(
            one[0].notes,
            ["no frame rate in the file, 30 fps are taken (fps says another)"]
        );
    }

    #[test]
    fn arrays_that_do_not_go_together_are_refused() {
        let shape = |message: &str| (message.to_owned(), "shape");
        assert_eq!(
            refusal(&[("positions", &[2, 3], numbers(6)), ("rotations", &[3, 4], numbers(12))]),
            shape(
                "npz member \"rotations\" has shape [3, 4], expected that of the positions, [2, 3], with 4 \
                 numbers (quaternion w, x, y, z) or 3 (axis-angle) at the end; save both of the same dancers \
                 and frames"
            )
        );
        assert_eq!(
            refusal(&[
                ("positions", &[2, 3, 2], numbers(12)),
                ("rotations", &[2, 3, 4], numbers(24))
            ]),
            shape(
                "npz member \"positions\" has shape [2, 3, 2], expected [dancers, frames, 3], or [frames, 3] of \
                 one dancer; save the position of each body's root"
            )
        );
        assert_eq!(
            refusal(&[
                ("positions", &[17, 1, 3], numbers(51)),
                ("rotations", &[17, 1, 3], numbers(51))
            ]),
            shape("npz has 17 dancers, expected 1 to 16; split it into several phrases")
        );
        assert_eq!(
            refusal(&[
                ("positions", &[1, 3], numbers(3)),
                ("rotations", &[1, 3], numbers(3)),
                ("fps", &[2], numbers(2)),
            ]),
            (
                "npz member \"fps\" has shape [2], expected one number; save it as one".to_owned(),
                "motion_format"
            )
        );
    }
}
