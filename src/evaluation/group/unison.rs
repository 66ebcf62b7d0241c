//! Unison: how far dancers make the same steps, at once or one behind the other.

use super::{mean, n_frames, pairs};
use crate::motion::kinematics::forward_differences;
use crate::motion::quaternion::{from_axis_angle, rotate};
use crate::motion::vector::Vector;
use crate::motion::{Placement, Poses};

/// Below this share of their mean square, velocities are taken for constant.
const MIN_SHARE: f64 = 1e-18;

/// Returns the unison index of a group, whose bars last `bar_frames`: 1 for dancers who make the same
/// steps wherever they stand and face, at once or up to a bar apart; about 0 for independent ones.
///
/// With `u(t) = R(-yaw(t)) v(t)` the velocity of a dancer in the frame of its heading, every pair has, for a
/// lag of either by up to a bar, the correlation `r = Σ u·u' / √(Σ |u|² Σ |u'|²)` over the frames and the
/// three axes, each u without its mean over these frames. The best of many lags is never near 0, so the lag
/// is taken from one half of the frames and r from the other: frames of even bars tell the lag (of equal
/// ones the shortest) with which r is taken over those of odd bars, and the other way round. The index is the
/// mean of both over all pairs.
///
/// None for fewer than two dancers, fewer than two bars, a bar of less than a frame, or where no pair moves
/// unevenly.
pub fn unison(dancers: &[Poses], bar_frames: f64) -> Option<f64> {
    let bar = bar_frames.round();
    // Written so that NaN fails.
    if !(bar >= 1.0 && bar <= n_frames(dancers) as f64 / 2.0) {
        return None;
    }
    let bar = bar as usize;
    let n_frames = n_frames(dancers);
    let velocities: Vec<Vec<Vector>> =
        dancers.iter().map(|dancer| own_velocities(dancer, n_frames)).collect();
    mean(pairs(velocities.len()).filter_map(|(i, j)| of_pair(&velocities[i], &velocities[j], bar)))
}

/// Returns velocities in the frame of the dancer's heading, m/s, one frame fewer.
pub fn own_velocities(dancer: &Poses, n_frames: usize) -> Vec<Vector> {
    let positions = &dancer.position_m[..n_frames];
    forward_differences(positions)
        .into_iter()
        .zip(positions.iter().zip(&dancer.orientation))
        .map(|(v, (&p, &q))| {
            let yaw = Placement::of(p, q).yaw_rad;
            rotate(from_axis_angle([0.0, 1.0, 0.0], -yaw), v)
        })
        .collect()
}

fn of_pair(a: &[Vector], b: &[Vector], bar: usize) -> Option<f64> {
    let lags = -(bar as i64)..=bar as i64;
    let rs: Vec<(i64, [Option<f64>; 2])> =
        lags.map(|lag| (lag, [0, 1].map(|half| correlation(a, b, lag, bar, half)))).collect();
    let crossed = |told_by: usize| {
        let better = |best: (i64, f64), next: (i64, f64)| {
            let is_better = next.1 > best.1 || (next.1 == best.1 && next.0.abs() < best.0.abs());
            if is_better { next } else { best }
        };
        let known = rs.iter().filter_map(|(lag, r)| Some((*lag, r[told_by]?)));
        let (lag, _) = known.reduce(better)?;
        rs[(lag + bar as i64) as usize].1[1 - told_by]
    };
    mean([crossed(0), crossed(1)].into_iter().flatten())
}

/// Correlation of `a[t]` and `b[t + lag]` over the frames t whose bar is even (half 0) or odd (1).
fn correlation(a: &[Vector], b: &[Vector], lag: i64, bar: usize, half: usize) -> Option<f64> {
    let (mut n, mut sum_a, mut sum_b) = (0.0, [0.0; 3], [0.0; 3]);
    let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
    for (t, u) in a.iter().enumerate().filter(|(t, _)| (t / bar) % 2 == half) {
        let Some(w) = usize::try_from(t as i64 + lag).ok().and_then(|t| b.get(t)) else {
            continue;
        };
        n += 1.0;
        for i in 0..3 {
            sum_a[i] += u[i];
            sum_b[i] += w[i];
            aa += u[i] * u[i];
            bb += w[i] * w[i];
            ab += u[i] * w[i];
        }
    }
    if n < 2.0 {
        return None;
    }
    let product = |x: [f64; 3], y: [f64; 3]| (0..3).map(|i| x[i] * y[i]).sum::<f64>() / n;
    let (va, vb) = (aa - product(sum_a, sum_a), bb - product(sum_b, sum_b));
    let is_uneven = va > MIN_SHARE * aa && vb > MIN_SHARE * bb && va > 0.0 && vb > 0.0;
    is_uneven.then(|| ((ab - product(sum_a, sum_b)) / (va * vb).sqrt()).clamp(-1.0, 1.0))
}
