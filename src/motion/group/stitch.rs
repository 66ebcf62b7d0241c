//! Pieces of a group's motion that share frames: the same dancers in both, one motion where they overlap.
//!
//! At every step of the sampling the dancers of a piece are matched to those of the piece before, and both
//! become a blend where they overlap. Source: Le, Do, Do, Pham, Tjiputra, Tran, Nguyen, "Controllable Group
//! Choreography using Contrastive Diffusion", ACM Transactions on Graphics 42, 2023, section on long-term
//! generation, and its published code (`ddim_sample_loop_progressive`, mode `long`).

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};

use super::assignment::assign;
use crate::motion::blend::{self, align_signs};
use crate::motion::channels::{BODY, Channel};
use crate::motion::choreography::accent::LEVER_ARM_M;
use crate::motion::quaternion::{Quaternion, angular_velocity, normalize};

/// Returns, for every dancer of the left piece, which dancer of the right piece continues it.
///
/// Both are the shared frames, `[N, T, 25]` in metres in one frame of reference. The cost of two dancers is
/// the mean over the frames of `|Δp| + ρ |Δθ|`, `ρ` = 0.3 m, the angle between their orientations: how far
/// apart points of their bodies are. The published cost has positions alone; where two dancers pass each
/// other closely these say little, and which way each of them faces says who is who. Equal costs change
/// nobody.
///
/// # Panics
/// When the shapes differ.
pub fn match_dancers(left: ArrayView3<f32>, right: ArrayView3<f32>) -> Vec<usize> {
    assert_eq!(left.dim(), right.dim(), "shapes of two pieces where they overlap");
    let n = left.len_of(Axis(0));
    let cost = |(i, j)| mean_distance_m(left.index_axis(Axis(0), i), right.index_axis(Axis(0), j));
    assign(Array2::from_shape_fn((n, n), cost).view())
}

/// Mean distance of two bodies, `[T, 25]` each; 0 without frames.
fn mean_distance_m(a: ArrayView2<f32>, b: ArrayView2<f32>) -> f64 {
    let norm = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let sum: f64 = a
        .rows()
        .into_iter()
        .zip(b.rows())
        .map(|(a, b)| {
            let p = Channel::Position.range().start;
            let q = Channel::Quaternion.range().start;
            let apart = std::array::from_fn(|i| f64::from(a[p + i]) - f64::from(b[p + i]));
            let [from, to]: [Quaternion; 2] =
                [a, b].map(|row| normalize(std::array::from_fn(|i| f64::from(row[q + i]))));
            norm(apart) + LEVER_ARM_M * norm(angular_velocity(from, to, 1.0))
        })
        .sum();
    sum / a.nrows().max(1) as f64
}

/// Blends the shared frames of two pieces, `[N, T, 25]` each, whose dancers are matched.
///
/// The right piece has the weight `t / (T - 1)`. Channels are blended linearly, orientations along the
/// shorter arc with the signs of the left piece, phases round the shorter way of the bar.
///
/// # Panics
/// When the shapes differ.
pub fn blend(left: ArrayView3<f32>, right: ArrayView3<f32>) -> Array3<f32> {
    assert_eq!(left.dim(), right.dim(), "shapes of two pieces where they overlap");
    let n_frames = left.len_of(Axis(1));
    let weight = |t: usize| t as f64 / n_frames.saturating_sub(1).max(1) as f64;
    let mut blended = left.to_owned();
    for ((mut blended, left), right) in
        blended.outer_iter_mut().zip(left.outer_iter()).zip(right.outer_iter())
    {
        // Erratum: the published code turns from left to left (`quat_slerp(_left, _left, …)`), so that
        // orientations jump at the end of the overlap. Here they turn to the right piece's.
        blended.assign(&blend::blend(BODY, left, right, weight));
    }
    blended
}

/// Makes two pieces one motion where they overlap; returns which dancers of the later piece were put in
/// whose place.
///
/// `[N, T, 25]` each in metres, in one frame of reference; `shift` frames of the earlier piece come before
/// the first of the later one. The later piece's dancers are put in the order of the earlier one's, and the
/// shared frames of both become their [`blend()`].
///
/// # Panics
/// When numbers of dancers or channels differ, or no frame is shared.
pub fn stitch(earlier: &mut Array3<f32>, later: &mut Array3<f32>, shift: usize) -> Vec<usize> {
    let n_shared = earlier.len_of(Axis(1)).saturating_sub(shift).min(later.len_of(Axis(1)));
    assert!(n_shared > 0, "two pieces share frames");
    let shared = s![.., shift..shift + n_shared, ..];
    let order = match_dancers(earlier.slice(shared), later.slice(s![.., ..n_shared, ..]));
    *later = later.select(Axis(0), &order);
    let both = blend(earlier.slice(shared), later.slice(s![.., ..n_shared, ..]));
    for (both, mut after) in both.outer_iter().zip(later.outer_iter_mut()) {
        // One rotation has two quaternions: what comes after the shared frames goes on with theirs.
        let last = s![n_shared - 1.., ..];
        align_signs(BODY, both.slice(last), &mut after.slice_mut(last));
    }
    earlier.slice_mut(shared).assign(&both);
    later.slice_mut(s![.., ..n_shared, ..]).assign(&both);
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use crate::motion::quaternion::{dot, from_axis_angle};

    /// Dancer i walks along x at z = 1.5 i, turning at its own rate.
    fn group(n: usize, n_frames: usize) -> Array3<f32> {
        let mut group = Array3::zeros((n, n_frames, MOTION_DIM));
        for i in 0..n {
            for t in 0..n_frames {
                let mut row = group.slice_mut(s![i, t, ..]);
                row[0] = 0.02 * t as f32;
                row[2] = 1.5 * i as f32;
                row[16] = (0.03 * t as f32).fract();
                row[17] = i as f32 / 10.0;
                let angle = 0.4 * i as f64 + 0.05 * (i + 1) as f64 * t as f64;
                for (c, x) in from_axis_angle([0.0, 1.0, 0.0], angle).into_iter().enumerate() {
                    row[9 + c] = x as f32;
                }
            }
        }
        group
    }

    fn quaternion(group: &Array3<f32>, i: usize, t: usize) -> Quaternion {
        std::array::from_fn(|c| f64::from(group[[i, t, 9 + c]]))
    }

    #[test]
    fn shuffled_dancers_are_found_again() {
        let left = group(5, 37);
        let order = [3, 0, 4, 2, 1];
        let right = left.select(Axis(0), &order);
        let found = match_dancers(left.view(), right.view());
        // Dancer `order[k]` of the left is dancer k of the right.
        for (k, &i) in order.iter().enumerate() {
            assert_eq!(found[i], k, "{found:?}");
        }
        assert_eq!(match_dancers(left.view(), left.view()), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn dancers_at_one_place_are_told_apart_by_how_they_face() {
        let mut left = group(2, 11);
        left.slice_mut(s![.., .., 2]).fill(0.0);
        let right = left.select(Axis(0), &[1, 0]);
        assert_eq!(match_dancers(left.view(), right.view()), [1, 0]);
    }

    #[test]
    fn the_cost_is_the_mean_distance_of_points_of_the_bodies() {
        let still = |x: f32, z: f32, angle: f64| {
            let mut frames = Array2::zeros((3, MOTION_DIM));
            for mut row in frames.rows_mut() {
                (row[0], row[2]) = (x, z);
                for (c, q) in from_axis_angle([1.0, 0.0, 0.0], angle).into_iter().enumerate() {
                    row[9 + c] = q as f32;
                }
            }
            frames
        };
        let found = mean_distance_m(still(3.0, 0.0, 0.5).view(), still(0.0, -4.0, -0.7).view());
        // 5 m and 1.2 rad at 0.3 m.
        assert!((found - 5.36).abs() < 1e-6, "{found}");
    }

    #[test]
    fn orientations_turn_from_left_to_right() {
        let n_frames = 9;
        let left = group(3, n_frames);
        let mut right = left.clone();
        for i in 0..3_usize {
            for t in 0..n_frames {
                let mut row = right.slice_mut(s![i, t, ..]);
                row[1] = 0.8;
                // A turn of 1 rad more, and the other of the two quaternions.
                let angle = 1.0 + 0.4 * i as f64 + 0.05 * (i + 1) as f64 * t as f64;
                for (c, x) in from_axis_angle([0.0, 1.0, 0.0], angle).into_iter().enumerate() {
                    row[9 + c] = -x as f32;
                }
            }
        }
        let found = blend(left.view(), right.view());
        for i in 0..3_usize {
            for t in 0..n_frames {
                let share = t as f64 / 8.0;
                assert!((f64::from(found[[i, t, 1]]) - 0.8 * share).abs() < 1e-6);
                let turned =
                    angular_velocity(quaternion(&left, i, t), quaternion(&found, i, t), 1.0);
                // Single precision of quaternions.
                assert!((turned[1] - share).abs() < 1e-6, "{i} {t}: {turned:?}");
                assert!(dot(quaternion(&left, i, t), quaternion(&found, i, t)) > 0.0);
            }
        }
        let alone = blend(left.slice(s![.., ..1, ..]), right.slice(s![.., ..1, ..]));
        assert_eq!(alone, left.slice(s![.., ..1, ..]), "one frame is the left's");
    }

    #[test]
    fn pieces_of_one_motion_are_that_motion() {
        let track = group(4, 50);
        let mut earlier = track.slice(s![.., ..30, ..]).to_owned();
        let mut later = track.slice(s![.., 20.., ..]).select(Axis(0), &[2, 3, 1, 0]);
        later.slice_mut(s![0, .., 9..13]).mapv_inplace(|x| -x);
        let order = stitch(&mut earlier, &mut later, 20);
        assert_eq!(order, [3, 2, 0, 1]);
        for (found, wanted) in earlier.iter().zip(track.slice(s![.., ..30, ..])) {
            assert!((found - wanted).abs() < 3e-7, "{found} {wanted}");
        }
        for (found, wanted) in later.iter().zip(track.slice(s![.., 20.., ..])) {
            assert!((found - wanted).abs() < 3e-7, "{found} {wanted}");
        }
    }
}
