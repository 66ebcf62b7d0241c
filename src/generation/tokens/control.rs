//! Constraints in decoding: the estimate of every step is moved to where they are met.
//!
//! As the paper, whose decoder descends L_ctrl(x̂0, c) at every step of the diffusion (section 3.3, after InterControl,
//! Wang et al., NeurIPS 2024). There poses are sums of velocities, so that the gradient of a constraint reaches all
//! frames before it; here positions are channels of their own, and the gradient of (p_t − p*_t)² moves one frame and
//! makes it a spike. L_ctrl therefore has terms for the size and the jerk of what is moved, and velocities and
//! accelerations go along ([`crate::motion::correction`]). Since it is quadratic, a step goes along H⁻¹ ∇L instead of ∇L,
//! with which one step of length 1 is at its least. There poses are met as nearly as is smooth: the estimates of a step
//! are noisy, and who meets them exactly follows their noise. Exactly they are met at the end, by motion that
//! post-processing has made smooth.

use std::f64::consts::TAU;

use ndarray::Array2;

use crate::generation::control::{Constraints, WantedValue, orientation, rotation_vector};
use crate::motion::correction::{Closeness, Missing, rates, smoothest};
use crate::motion::quaternion::{from_rotation_vector, make_sign_continuous, mul};
use crate::motion::{Channel, MOTION_DIM};

/// A step towards constraints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Steering {
    /// Of an estimate: x̂0 ← x̂0 − η H⁻¹ ∇L_ctrl(x̂0), η the share of the way. The first frames stay where they are, but for
    /// what is asked of themselves.
    Estimate { n_pinned: usize, share: f64 },
    /// Of finished motion, all the way: poses are met exactly.
    Finish,
}

/// Moves frames to where constraints are met.
///
/// # Shapes
/// `frames`: \[T, 25\] in the world, of which the first is frame `first` of the track
pub fn steer(
    constraints: &Constraints,
    frames: &mut Array2<f32>,
    first: usize,
    steering: Steering,
) {
    let share = match steering {
        Steering::Estimate { share, .. } => share,
        Steering::Finish => 1.0,
    };
    let n = frames.nrows();
    let asked: Vec<(usize, WantedValue)> = constraints.in_range(first, n).collect();
    for axis in 0..3 {
        let groups = [Channel::Position, Channel::Velocity, Channel::Acceleration];
        let columns = groups.map(|group| group.range().start + axis);
        let missing = asked.iter().filter_map(|&(frame, wanted)| match wanted {
            WantedValue::Value { channel, value } => {
                let derivative = columns.iter().position(|&column| column == channel)?;
                let value = value - f64::from(frames[[frame, channel]]);
                Some(Missing { frame, derivative, value })
            }
            WantedValue::Orientation(_) => None,
        });
        let Some(u) = correction(n, &missing.collect::<Vec<_>>(), steering) else { continue };
        let v = rates(&u);
        let a = rates(&v);
        for (column, change) in columns.into_iter().zip([u, v, a]) {
            move_column(frames, column, &change, share);
        }
    }
    turn(&asked, frames, steering, share);
    let with_others = [Channel::AngularVelocity, Channel::Phase, Channel::Style];
    for channel in with_others.into_iter().flat_map(|group| group.range()) {
        debug_assert!(channel < MOTION_DIM);
        let missing = asked.iter().filter_map(|&(frame, wanted)| match wanted {
            WantedValue::Value { channel: of, value } if of == channel => {
                let value = value - f64::from(frames[[frame, channel]]);
                Some(Missing { frame, derivative: 0, value })
            }
            _ => None,
        });
        let Some(u) = correction(n, &missing.collect::<Vec<_>>(), steering) else { continue };
        move_column(frames, channel, &u, share);
    }
}

/// Turns frames to the orientations of constraints, and their angular velocities with them.
fn turn(asked: &[(usize, WantedValue)], frames: &mut Array2<f32>, steering: Steering, share: f64) {
    let n = frames.nrows();
    let mut missing: Vec<(usize, [f64; 3])> = asked
        .iter()
        .filter_map(|&(t, wanted)| match wanted {
            WantedValue::Orientation(q) => {
                Some((t, rotation_vector(q, orientation(frames.view(), t))))
            }
            WantedValue::Value { .. } => None,
        })
        .collect();
    continue_turns(&mut missing);
    let turns: Option<Vec<Vec<f64>>> = (0..3)
        .map(|axis| {
            let of_axis = missing.iter();
            let of_axis =
                of_axis.map(|&(frame, v)| Missing { frame, derivative: 0, value: v[axis] });
            correction(n, &of_axis.collect::<Vec<_>>(), steering)
        })
        .collect();
    let Some(turns) = turns else { return };
    let mut turned: Vec<_> = (0..n)
        .map(|t| {
            let v = [0, 1, 2].map(|axis| share * turns[axis][t]);
            mul(from_rotation_vector(v), orientation(frames.view(), t))
        })
        .collect();
    make_sign_continuous(&mut turned);
    for (mut row, q) in frames.rows_mut().into_iter().zip(turned) {
        for (i, x) in Channel::Quaternion.range().zip(q) {
            row[i] = x as f32;
        }
    }
    for (column, turns) in Channel::AngularVelocity.range().zip(&turns) {
        move_column(frames, column, &rates(turns), share);
    }
}

/// Takes of each turn the one of the two, this way or the other way round, that is nearer to the turn before: between two
/// of nearly half a turn a body is not turned all the way back.
fn continue_turns(turns: &mut [(usize, [f64; 3])]) {
    let mut before: Option<[f64; 3]> = None;
    for (_, turn) in turns {
        let angle = turn.iter().map(|x| x * x).sum::<f64>().sqrt();
        if let Some(before) = before
            && angle > 0.0
        {
            let other = turn.map(|x| x * (1.0 - TAU / angle));
            let apart =
                |v: [f64; 3]| -> f64 { v.iter().zip(before).map(|(a, b)| (a - b) * (a - b)).sum() };
            if apart(other) < apart(*turn) {
                *turn = other;
            }
        }
        before = Some(*turn);
    }
}

/// Returns the smoothest correction of an axis; none where it has no constraint.
fn correction(n: usize, missing: &[Missing], steering: Steering) -> Option<Vec<f64>> {
    let (n_pinned, closeness) = match steering {
        Steering::Estimate { n_pinned, .. } => (n_pinned, Closeness::Near),
        Steering::Finish => (0, Closeness::Exact),
    };
    (!missing.is_empty()).then(|| smoothest(n, n_pinned, missing, closeness))
}

fn move_column(frames: &mut Array2<f32>, column: usize, change: &[f64], share: f64) {
    for (x, change) in frames.column_mut(column).into_iter().zip(change) {
        *x = (f64::from(*x) + share * change) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generation::control::facing;
    use crate::generation::walk::walk;
    use crate::motion::ChannelLimits;

    fn value(channel: usize, value: f64) -> WantedValue {
        WantedValue::Value { channel, value }
    }

    fn constraints(wanted: Vec<(usize, WantedValue)>) -> Constraints {
        Constraints::new(wanted, 400, ChannelLimits::Wide).expect("sound constraints")
    }

    #[test]
    fn a_step_of_length_one_meets_what_is_asked_and_a_shorter_one_goes_its_share() {
        let before = walk(121);
        let (x, z) = (f64::from(before[[50, 0]]) + 0.3, f64::from(before[[90, 2]]) - 0.2);
        let asked = constraints(vec![
            (250, value(0, x)),
            (290, value(2, z)),
            (260, value(1, 1.1)),
            (270, WantedValue::Orientation(facing(0.4))),
            (280, value(16, 0.25)),
            // Beyond these frames.
            (350, value(0, 2.0)),
        ]);
        let estimate = |n_pinned, share| Steering::Estimate { n_pinned, share };
        let mut moved = before.clone();
        steer(&asked, &mut moved, 200, Steering::Finish);
        for miss in asked.errors_from(moved.view(), 200) {
            // f32 of some metres; of angles what its cosine keeps.
            assert!(miss.error < 1e-6, "{miss:?}");
        }
        let mut moved = before.clone();
        steer(&asked, &mut moved, 200, estimate(3, 1.0));
        for miss in asked.errors_from(moved.view(), 200) {
            assert!(miss.error < 3e-3, "{miss:?}");
        }
        for t in 0..3 {
            for channel in 0..3 {
                let apart = (moved[[t, channel]] - before[[t, channel]]).abs();
                assert!(apart < 1e-6, "frame {t}: {apart}");
            }
        }
        let mut half = before.clone();
        steer(&asked, &mut half, 200, estimate(3, 0.5));
        assert!((half[[50, 0]] - before[[50, 0]] - 0.15).abs() < 3e-3);
        let mut none = before.clone();
        steer(&asked, &mut none, 0, estimate(3, 1.0));
        assert_eq!(none, before, "nothing is asked of these frames");
    }

    #[test]
    fn a_body_is_not_turned_back_and_forth_between_turns_of_nearly_half() {
        let mut before = walk(121);
        for mut row in before.rows_mut() {
            for (i, x) in Channel::Quaternion.range().zip([1.0, 0.0, 0.0, 0.0]) {
                row[i] = x;
            }
        }
        // 179° and 181°, which is −179°.
        let asked = constraints(vec![
            (40, WantedValue::Orientation(facing(179.0_f64.to_radians()))),
            (60, WantedValue::Orientation(facing(181.0_f64.to_radians()))),
        ]);
        let mut moved = before;
        steer(&asked, &mut moved, 0, Steering::Finish);
        for t in 40..=60 {
            let q = orientation(moved.view(), t);
            let apart = rotation_vector(facing(std::f64::consts::PI), q);
            let apart = apart.iter().map(|x| x * x).sum::<f64>().sqrt().to_degrees();
            // It fades a little between the two; turned back it would pass 0°.
            assert!(apart < 40.0, "frame {t}: {apart}° from half a turn");
        }
    }

    #[test]
    fn velocities_and_accelerations_go_along() {
        let before = walk(121);
        let x = f64::from(before[[60, 0]]) + 0.4;
        let mut moved = before.clone();
        steer(&constraints(vec![(60, value(0, x))]), &mut moved, 0, Steering::Finish);
        let change =
            |t: usize, channel: usize| f64::from(moved[[t, channel]] - before[[t, channel]]);
        for t in 0..119 {
            let v = 30.0 * (change(t + 1, 0) - change(t, 0));
            assert!((change(t, 3) - v).abs() < 1e-3, "velocity at {t}");
            let a = 30.0 * (change(t + 1, 3) - change(t, 3));
            assert!((change(t, 6) - a).abs() < 2e-2, "acceleration at {t}");
        }
    }
}
