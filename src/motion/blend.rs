//! From one motion to another: every group of columns in the way of its role.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, ArrayViewMut2, s};

use super::layout::{ColumnRole, Layout};
use super::quaternion::{Quaternion, dot, slerp};

/// Blends two motions, `[T, columns]` each: at frame `t` the second has the weight `weight(t)`.
///
/// Orientations are turned along the shorter arc, phases round the shorter way of the bar; orientations
/// have the signs of the first motion.
pub fn blend(
    layout: Layout,
    a: ArrayView2<f32>,
    b: ArrayView2<f32>,
    weight: impl Fn(usize) -> f64,
) -> Array2<f32> {
    let mut blend = a.to_owned();
    for (t, (mut row, b)) in blend.rows_mut().into_iter().zip(b.rows()).enumerate() {
        let w = weight(t);
        let at = |i: usize| f64::from(b[i]);
        for columns in layout.groups() {
            match columns.group.role {
                ColumnRole::Turn => {
                    let first = columns.first;
                    let from: Quaternion = std::array::from_fn(|i| f64::from(row[first + i]));
                    let to: Quaternion = std::array::from_fn(|i| at(first + i));
                    for (i, x) in columns.range().zip(between(from, to, w)) {
                        row[i] = x as f32;
                    }
                }
                ColumnRole::Phase => {
                    let i = columns.first;
                    let from = f64::from(row[i]);
                    // The shorter way, which may lead over a downbeat. Where it does not nothing is wrapped:
                    // estimates on their way to a phase may lie outside [0, 1).
                    let n_bars = (at(i) - from).round();
                    let x = from + w * (at(i) - from - n_bars);
                    row[i] = if n_bars == 0.0 { x } else { x.rem_euclid(1.0) } as f32;
                }
                ColumnRole::Place | ColumnRole::Vector | ColumnRole::Free => {
                    for i in columns.range() {
                        let from = f64::from(row[i]);
                        row[i] = (from + w * (at(i) - from)) as f32;
                    }
                }
            }
        }
    }
    blend
}

/// Turns from one orientation to another along the shorter arc; lengths, which estimates have, are blended
/// apart.
fn between(from: Quaternion, to: Quaternion, w: f64) -> Quaternion {
    let (a, b) = (dot(from, from).sqrt(), dot(to, to).sqrt());
    if !(a > 1e-9 && b > 1e-9) {
        return std::array::from_fn(|i| from[i] + w * (to[i] - from[i]));
    }
    let length = a + w * (b - a);
    slerp(from.map(|x| x / a), to.map(|x| x / b), w).map(|x| x * length)
}

/// Gives all orientations the sign that is nearer to the first frame of what they follow.
pub fn align_signs(layout: Layout, like: ArrayView2<f32>, frames: &mut ArrayViewMut2<f32>) {
    let (Some(a), Some(b)) = (like.rows().into_iter().next(), frames.rows().into_iter().next())
    else {
        return;
    };
    let is_opposite = |range: Range<usize>| range.map(|i| a[i] * b[i]).sum::<f32>() < 0.0;
    let opposite: Vec<_> = layout
        .with_role(ColumnRole::Turn)
        .map(|columns| columns.range())
        .filter(|range| is_opposite(range.clone()))
        .collect();
    for range in opposite {
        frames.slice_mut(s![.., range]).mapv_inplace(|x| -x);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::quaternion::from_axis_angle;
    use crate::motion::{BODY, Channel, MOTION_DIM};

    /// One frame that is turned about the vertical and stands in a bar.
    fn frame(angle_rad: f64, phase: f32) -> Array2<f32> {
        let mut frame = Array2::from_elem((1, MOTION_DIM), 2.0);
        for (i, x) in Channel::Quaternion.range().zip(from_axis_angle([0.0, 1.0, 0.0], angle_rad)) {
            frame[[0, i]] = x as f32;
        }
        frame[[0, Channel::Phase.range().start]] = phase;
        frame
    }

    #[test]
    fn every_channel_is_blended_in_its_own_way() {
        let (a, mut b) = (frame(0.4, 0.9), frame(1.6, 0.2));
        b.slice_mut(s![.., Channel::Quaternion.range()]).mapv_inplace(|x| -x);
        b.slice_mut(s![.., Channel::Style.range()]).fill(6.0);
        b.slice_mut(s![.., Channel::Position.range()]).fill(-2.0);
        let found = blend(BODY, a.view(), b.view(), |_| 0.25);
        let wanted = from_axis_angle([0.0, 1.0, 0.0], 0.7);
        for (i, wanted) in Channel::Quaternion.range().zip(wanted) {
            // Single precision of both.
            assert!((f64::from(found[[0, i]]) - wanted).abs() < 2e-7, "{i}: {}", found[[0, i]]);
        }
        // A quarter of 0.3 of a bar, over the downbeat.
        assert!((found[[0, 16]] - 0.975).abs() < 1e-6, "{}", found[[0, 16]]);
        assert_eq!((found[[0, 0]], found[[0, 24]], found[[0, 3]]), (1.0, 3.0, 2.0));
    }

    #[test]
    fn the_root_alone_is_blended_by_its_roles() {
        // Turned by 0.4 and 1.6 about the vertical, the second with the other sign.
        let frame = |x: f32, angle: f64, sign: f64| {
            let mut frame = Array2::from_elem((1, ROOT.width()), x);
            for (i, q) in (6..10).zip(from_axis_angle([0.0, 1.0, 0.0], angle)) {
                frame[[0, i]] = (sign * q) as f32;
            }
            frame
        };
        let (a, mut b) = (frame(2.0, 0.4, 1.0), frame(6.0, 1.6, -1.0));
        let found = blend(ROOT, a.view(), b.view(), |_| 0.25);
        let wanted = from_axis_angle([0.0, 1.0, 0.0], 0.7);
        for (i, x) in found.row(0).iter().enumerate() {
            let wanted = if (6..10).contains(&i) { wanted[i - 6] } else { 3.0 };
            assert!((f64::from(*x) - wanted).abs() < 2e-7, "{i}: {x}");
        }
        align_signs(ROOT, a.view(), &mut b.view_mut());
        assert!(b[[0, 6]] > 0.6 && b[[0, 5]] == 6.0 && b[[0, 10]] == 6.0, "{b}");
    }

    #[test]
    fn signs_follow_the_first_frame() {
        let like = frame(0.1, 0.0);
        let mut frames = frame(0.3, 0.5).mapv(|x| -x);
        align_signs(BODY, like.view(), &mut frames.view_mut());
        assert!(frames[[0, 9]] > 0.9 && frames[[0, 0]] == -2.0, "{frames}");
        let kept = frames.clone();
        align_signs(BODY, like.view(), &mut frames.view_mut());
        assert_eq!(frames, kept);
    }
}
