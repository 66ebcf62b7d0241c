//! Where two bodies touch, and along which line they are moved apart.

use std::f64::consts::{PI, TAU};

/// Bodies whose centres are nearer than this have no direction from one to the other, m.
const SAME_PLACE_M: f64 = 1e-9;
/// How much further apart than they should be two bodies are looked after as well, m.
const NEAR_M: f64 = 0.5;
/// Where two bodies come nearer than this share of their least distance they pass through each other.
const DEEP_SHARE: f64 = 0.5;

/// Two bodies at a frame that are near each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    pub frame: usize,
    pub dancers: [usize; 2],
    /// Unit, from the second dancer to the first: along this they are kept apart.
    pub direction: [f64; 2],
    /// How far apart they should be at least, m.
    pub wanted_m: f64,
}

/// Returns where two dancers are near each other: `apart_m[t]` is from the second to the first,
/// `wanted_m[t]` their least distance.
///
/// Where two bodies pass through each other the line between them turns round within a frame. There the
/// direction turns evenly from that of the first frame of the contact to that of the last, as far as the
/// line turns in all: one goes round the other. Bodies that stay at one place are moved as `otherwise` says.
pub fn contacts(
    dancers: [usize; 2],
    apart_m: &[[f64; 2]],
    wanted_m: &[f64],
    otherwise: f64,
) -> Vec<Contact> {
    let short: Vec<f64> = apart_m
        .iter()
        .zip(wanted_m)
        .map(|(apart, wanted)| apart[0].hypot(apart[1]) - wanted)
        .collect();
    let mut angles: Vec<f64> = apart_m.iter().map(|apart| apart[1].atan2(apart[0])).collect();
    let mut first = 0;
    for run in short.chunk_by(|a, b| (*a < 0.0) == (*b < 0.0)) {
        let frames = first..first + run.len();
        first = frames.end;
        if run.iter().zip(&wanted_m[frames.clone()]).any(|(short, w)| *short < -DEEP_SHARE * w) {
            angles[frames.clone()].copy_from_slice(&even_turn(&apart_m[frames], otherwise));
        }
    }
    let near = (0..apart_m.len()).filter(|&t| short[t] < NEAR_M);
    near.map(|frame| {
        let direction = [angles[frame].cos(), angles[frame].sin()];
        Contact { frame, dancers, direction, wanted_m: wanted_m[frame] }
    })
    .collect()
}

/// Returns angles, rad, that turn evenly as far as the line between two bodies does.
fn even_turn(apart_m: &[[f64; 2]], otherwise: f64) -> Vec<f64> {
    let known: Vec<f64> = apart_m
        .iter()
        .filter(|apart| apart[0].hypot(apart[1]) > SAME_PLACE_M)
        .map(|apart| apart[1].atan2(apart[0]))
        .collect();
    let Some(&start) = known.first() else { return vec![otherwise; apart_m.len()] };
    let turn: f64 = known.windows(2).map(|a| wrapped(a[1] - a[0])).sum();
    let n_steps = (apart_m.len() - 1).max(1) as f64;
    (0..apart_m.len()).map(|t| start + turn * t as f64 / n_steps).collect()
}

/// The angle in [-π, π): of two ways round the one that is shorter, and to the right of two that are equal.
fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// Returns the angle at which dancer `a` stands from dancer `b` where all `n` stand in a circle.
pub fn angle_in_circle([a, b]: [usize; 2], n: usize) -> f64 {
    let [a, b] = [a, b].map(|i| TAU * i as f64 / n as f64);
    (a.sin() - b.sin()).atan2(a.cos() - b.cos())
}
