//! A motion that tests know by its formula.

use ndarray::Array2;

use crate::motion::Placement;
use crate::motion::kinematics::{Poses, frames_of};
use crate::motion::quaternion::{from_axis_angle, make_sign_continuous, mul};
use crate::units::FPS;

/// A walk along a curve that turns more than once round, leaning, exact in all its channels, `[n, 25]`; it
/// begins over the origin and faces +Z.
pub fn walk(n: usize) -> Array2<f32> {
    let pose = |t: usize| {
        let s = t as f64 / FPS;
        let lean = from_axis_angle([1.0, 0.0, 0.0], 0.2 * (3.0 * s).sin());
        let turn = from_axis_angle([0.0, 1.0, 0.0], 1.1 * s);
        ([2.0 * (0.7 * s).sin(), 0.9 + 0.05 * (9.0 * s).cos(), 0.4 * s], mul(turn, lean))
    };
    let (position_m, mut orientation): (Vec<_>, Vec<_>) = (0..n + 2).map(pose).unzip();
    make_sign_continuous(&mut orientation);
    let mut frames = frames_of(&Poses { position_m, orientation }, n);
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        row[16] = (t as f32 / 53.0).fract();
        row[20] = (t as f32 * 0.01).sin();
    }
    Placement::of_first(frames.view()).expect("frames").remove(&mut frames);
    frames
}
