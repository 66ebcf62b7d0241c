use ndarray::Array2;

use super::*;
use crate::motion::channels::{BODY, Channel, MOTION_DIM};
use crate::motion::kinematics::{Poses, forward_differences, frames_of};
use crate::motion::npy;
use crate::motion::postprocess::noise::{
    NONE, Noise, VARIANCES, exact, farthest, frames, fused, mean_square, noisy, truth,
};
use crate::motion::postprocess::{
    AxisVariances, Coherence, PostProcessConfig, SavitzkyGolay, process, process_holding,
};
use crate::motion::quaternion::{from_axis_angle, mul, rotate};

/// Solves by elimination, with the largest pivot.
fn dense(mut a: Array2<f64>, mut b: Vec<f64>) -> Vec<f64> {
    let n = b.len();
    for k in 0..n {
        let pivot = (k..n)
            .max_by(|i, j| a[[*i, k]].abs().total_cmp(&a[[*j, k]].abs()))
            .expect("rows are left");
        (0..n).for_each(|j| a.swap([k, j], [pivot, j]));
        b.swap(k, pivot);
        for i in k + 1..n {
            let factor = a[[i, k]] / a[[k, k]];
            (k..n).for_each(|j| a[[i, j]] -= factor * a[[k, j]]);
            b[i] -= factor * b[k];
        }
    }
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|j| a[[k, j]] * b[j]).sum();
        b[k] = (b[k] - known) / a[[k, k]];
    }
    b
}

/// The definition with whole matrices: p = (I w_p + DᵀD w_v + D²ᵀD² w_a)⁻¹ (p̂ w_p + Dᵀv̂ w_v + D²ᵀâ w_a), held
/// values taken to the right.
fn by_definition(measured: &FusionMeasurements, axis: usize, held: &[bool]) -> Vec<f64> {
    let n = measured.position.len();
    let mut rows = Vec::new();
    for t in 0..n {
        let w = |of: AxisVariances| 1.0 / of.of_axis(axis);
        rows.push((vec![(t, 1.0)], measured.position[t][axis], w(VARIANCES.position_m2)));
        if t + 1 < n {
            let d = vec![(t, -FPS), (t + 1, FPS)];
            rows.push((d, measured.velocity[t][axis], w(VARIANCES.velocity_m2_s2)));
        }
        if t + 2 < n {
            let d = vec![(t, 900.0), (t + 1, -1800.0), (t + 2, 900.0)];
            rows.push((d, measured.acceleration[t][axis], w(VARIANCES.acceleration_m2_s4)));
        }
    }
    let (mut a, mut b) = (Array2::zeros((n, n)), vec![0.0; n]);
    for (terms, y, w) in &rows {
        for &(i, c) in terms {
            b[i] += w * c * y;
            terms.iter().for_each(|&(j, d)| a[[i, j]] += w * c * d);
        }
    }
    for t in (0..n).filter(|t| held.get(*t) == Some(&true)) {
        let known = measured.position[t][axis];
        (0..n).for_each(|i| b[i] -= a[[i, t]] * known);
        a.row_mut(t).fill(0.0);
        a.column_mut(t).fill(0.0);
        (a[[t, t]], b[t]) = (1.0, known);
    }
    dense(a, b)
}

#[test]
fn positions_are_those_of_the_definition_with_whole_matrices() {
    for (n, seed) in [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (17, 6), (90, 7)] {
        let measured = noisy(&truth(n), &VARIANCES, seed);
        let position: Vec<[bool; 3]> = (0..n).map(|t| [t % 7 == 2, t == 0, t + 1 == n]).collect();
        for held in [NONE, HeldPoses { position, orientation: Vec::new() }] {
            let found = fused(&measured, &VARIANCES, &held);
            assert_eq!(found.len(), n);
            for axis in 0..3 {
                let mask: Vec<bool> = held.position.iter().map(|axes| axes[axis]).collect();
                for (t, wanted) in by_definition(&measured, axis, &mask).into_iter().enumerate() {
                    let found = found[t][axis];
                    // Rounding of equations that are conditioned a thousandfold.
                    assert!((found - wanted).abs() < 1e-12, "{n}, {t}: {found} {wanted}");
                    if mask.get(t) == Some(&true) {
                        assert_eq!(found, measured.position[t][axis], "held to the bit");
                    }
                }
            }
        }
    }
}

/// Written by `tests/golden/motion/fusion.py`: positions by SciPy's band solver, orientations by its
/// general least squares over rotation matrices.
#[test]
fn poses_are_those_of_scipy() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/motion/fusion.npy");
    let array = npy::read_f64(&std::fs::read(path).expect("the golden file")).expect("an array");
    let (n, width) = (array.shape[0], array.shape[1]);
    assert_eq!((n, width), (47, 23));
    let at = |t: usize, i: usize| array.values[t * width + i];
    let vectors =
        |first: usize| (0..n).map(|t| std::array::from_fn(|i| at(t, first + i))).collect();
    let quaternions = |first: usize| -> Vec<Quaternion> {
        (0..n).map(|t| std::array::from_fn(|i| at(t, first + i))).collect()
    };
    let measured = FusionMeasurements {
        position: vectors(0),
        velocity: vectors(3),
        acceleration: vectors(6),
        orientation: quaternions(9),
        angular_velocity: vectors(13),
    };
    let wanted: Vec<[f64; 3]> = vectors(16);
    for (found, wanted) in fused(&measured, &VARIANCES, &NONE).iter().zip(&wanted) {
        for axis in 0..3 {
            assert!((found[axis] - wanted[axis]).abs() < 1e-12, "{found:?} against {wanted:?}");
        }
    }
    let found = measured.orientations(&VARIANCES, &NONE);
    // What the other solver stops at.
    assert!(farthest(&found, &quaternions(19)) < 1e-8, "{}", farthest(&found, &quaternions(19)));
}

#[test]
fn what_agrees_with_itself_stays() {
    for n in [0, 1, 2, 3, 201] {
        let measured = exact(&truth(n));
        for d in measured.shifts(&VARIANCES, &NONE) {
            // Rounding of differences of a few metres, times the rate squared, divided by it again.
            assert!(size(d) < 1e-13, "{d:?}");
        }
        let q = measured.orientations(&VARIANCES, &NONE);
        assert!(farthest(&q, &measured.orientation) < 1e-13);
    }
}

#[test]
fn an_error_that_is_the_same_everywhere_cannot_be_seen() {
    let measured = noisy(&truth(60), &VARIANCES, 11);
    let mut moved = noisy(&truth(60), &VARIANCES, 11);
    moved.position.iter_mut().for_each(|p| *p = [p[0] + 3.0, p[1] - 0.5, p[2] + 1.0]);
    let shifts = measured.shifts(&VARIANCES, &NONE);
    for (a, b) in shifts.iter().zip(moved.shifts(&VARIANCES, &NONE)) {
        assert!((0..3).all(|i| (a[i] - b[i]).abs() < 1e-12));
    }
}

/// Alone, 1/σ_p² + |D(f)|²/σ_v² is what is known of p at the frequency f, so that its variance is the mean
/// of 1 / (1/σ_p² + (2 FPS sin πf)²/σ_v²) over f: σ_p² / sqrt(1 + 4 w FPS²), w = σ_p²/σ_v².
#[test]
fn errors_shrink_as_theory_says() {
    let variances = FusionVariances {
        position_m2: AxisVariances::even(4e-4),
        velocity_m2_s2: AxisVariances::even(0.04),
        // As good as not there.
        acceleration_m2_s4: AxisVariances::even(1e12),
        ..VARIANCES
    };
    let n = 6001;
    let poses = truth(n);
    let found = fused(&noisy(&poses, &variances, 5), &variances, &NONE);
    let wanted = 4e-4 / (1.0 + 4.0 * 0.01 * 900.0_f64).sqrt();
    for axis in 0..3 {
        let ratio = mean_square(&found, &poses.position_m, axis) / wanted;
        // Some 6,000 / 6 independent errors: 4.5 %, thrice.
        assert!((ratio - 1.0).abs() < 0.135, "{ratio}");
    }
    // With velocities that are exact nothing is left but the mean of the errors: σ_p²/n.
    let exact_velocity = FusionVariances { velocity_m2_s2: AxisVariances::even(1e-9), ..variances };
    let n = 201;
    let poses = truth(n);
    let mut measured = exact(&poses);
    let mut noise = Noise::new(8);
    let mut mean = [0.0; 3];
    for p in &mut measured.position {
        let error = noise.vector(&variances.position_m2);
        for axis in 0..3 {
            p[axis] += error[axis];
            mean[axis] += error[axis] / n as f64;
        }
    }
    let found = fused(&measured, &exact_velocity, &NONE);
    for (p, truth) in found.iter().zip(&poses.position_m) {
        for axis in 0..3 {
            let error = p[axis] - truth[axis];
            // As far as 1e-9 is not 0: sums of up to 200 errors, 0.3 m, add up over 200 frames, and
            // 4e-4/1e-9 900 takes them down.
            assert!((error - mean[axis]).abs() < 1e-6, "{error} {}", mean[axis]);
        }
    }
}

#[test]
fn backwards_in_time_is_the_same_motion_backwards() {
    let n = 53;
    let measured = noisy(&truth(n), &VARIANCES, 21);
    let negated = |x: [f64; 3]| x.map(|x| -x);
    let back = FusionMeasurements {
        position: measured.position.iter().rev().copied().collect(),
        velocity: (0..n).map(|t| negated(measured.velocity[(2 * n - 2 - t) % n])).collect(),
        acceleration: (0..n).map(|t| measured.acceleration[(2 * n - 3 - t) % n]).collect(),
        orientation: measured.orientation.iter().rev().copied().collect(),
        angular_velocity: (0..n)
            .map(|t| negated(measured.angular_velocity[(2 * n - 2 - t) % n]))
            .collect(),
    };
    let found = fused(&measured, &VARIANCES, &NONE);
    let found_back = fused(&back, &VARIANCES, &NONE);
    for t in 0..n {
        assert!((0..3).all(|i| (found[t][i] - found_back[n - 1 - t][i]).abs() < 1e-13));
    }
    let q = measured.orientations(&VARIANCES, &NONE);
    let q_back: Vec<_> = back.orientations(&VARIANCES, &NONE).into_iter().rev().collect();
    // Where steps of 1e-12 end.
    assert!(farthest(&q, &q_back) < 1e-9, "{}", farthest(&q, &q_back));
}

#[test]
fn a_dancer_who_faces_elsewhere_is_fused_alike() {
    let measured = noisy(&truth(40), &VARIANCES, 31);
    let turn = from_axis_angle([0.0, 1.0, 0.0], 2.2);
    let turned = |x: &[[f64; 3]]| x.iter().map(|x| rotate(turn, *x)).collect::<Vec<_>>();
    let other = FusionMeasurements {
        position: turned(&measured.position),
        velocity: turned(&measured.velocity),
        acceleration: turned(&measured.acceleration),
        orientation: measured.orientation.iter().map(|q| mul(turn, *q)).collect(),
        angular_velocity: turned(&measured.angular_velocity),
    };
    let wanted = turned(&fused(&measured, &VARIANCES, &NONE));
    for (a, b) in fused(&other, &VARIANCES, &NONE).iter().zip(&wanted) {
        assert!((0..3).all(|i| (a[i] - b[i]).abs() < 1e-12));
    }
    let wanted: Vec<_> =
        measured.orientations(&VARIANCES, &NONE).iter().map(|q| mul(turn, *q)).collect();
    assert!(farthest(&other.orientations(&VARIANCES, &NONE), &wanted) < 1e-9);
}

#[test]
fn motion_falls_apart_where_it_is_not_finite() {
    let n = 40;
    let whole = noisy(&truth(n), &VARIANCES, 71);
    let mut holed = noisy(&truth(n), &VARIANCES, 71);
    holed.position[15] = [f64::NAN, whole.position[15][1], f64::INFINITY];
    holed.velocity[7][1] = f64::NEG_INFINITY;
    holed.acceleration[20][1] = f64::NAN;
    holed.orientation[18] = [f64::NAN, 0.0, 1.0, 0.0];
    holed.orientation[30] = [0.0; 4];
    holed.angular_velocity[3][2] = f64::NAN;
    let found = fused(&holed, &VARIANCES, &NONE);
    assert!(found[15][0].is_nan() && found[15][2] == f64::INFINITY);
    let part = |from: usize, to: usize| FusionMeasurements {
        position: holed.position[from..to].to_vec(),
        velocity: holed.velocity[from..to].to_vec(),
        acceleration: holed.acceleration[from..to].to_vec(),
        orientation: holed.orientation[from..to].to_vec(),
        angular_velocity: holed.angular_velocity[from..to].to_vec(),
    };
    for (from, to) in [(0, 15), (16, n)] {
        let alone = fused(&part(from, to), &VARIANCES, &NONE);
        for (t, alone) in (from..to).zip(&alone) {
            for axis in [0, 2] {
                assert!((found[t][axis] - alone[axis]).abs() < 1e-13, "{t}, {axis}");
            }
        }
    }
    // An axis without the value goes on, and hardly differs far away.
    let unhurt = fused(&whole, &VARIANCES, &NONE);
    for t in 0..n {
        assert!(found[t][1].is_finite());
        assert!(t > 0 && t < 33 || (found[t][1] - unhurt[t][1]).abs() < 2e-3, "{t}");
    }
    let q = holed.orientations(&VARIANCES, &NONE);
    assert!(q[18][0].is_nan() && q[18][2] == 1.0 && q[30] == [0.0; 4]);
    for (from, to) in [(0, 18), (19, 30), (31, n)] {
        let alone = part(from, to).orientations(&VARIANCES, &NONE);
        assert!(farthest(&q[from..to], &alone) < 1e-9, "{from}");
    }
}

#[test]
fn held_poses_keep_their_bits_and_others_go_along() {
    let n = 61;
    let measured = noisy(&truth(n), &VARIANCES, 81);
    let held = HeldPoses {
        position: (0..31).map(|t| [t == 30, false, t == 30]).collect(),
        orientation: (0..n).map(|t| t == 0 || t == 30 || t == 31).collect(),
    };
    let config = PostProcessConfig {
        coherence: Coherence::Fuse,
        fusion_variances: Some(VARIANCES),
        relock_phase: false,
        ..PostProcessConfig::default()
    };
    // What comes before fusion leaves the poses alone.
    let mut before = frames(&measured);
    let nothing_else = PostProcessConfig { coherence: Coherence::Keep, ..config.clone() };
    process(&nothing_else, &mut before, None);
    let mut found = before.clone();
    let moved = process_holding(&config, &mut found, None, &held).expect("fused");
    let row = |frames: &Array2<f32>, t: usize, channel: Channel| -> Vec<u32> {
        channel.range().map(|i| frames[[t, i]].to_bits()).collect()
    };
    let position = |frames: &Array2<f32>| row(frames, 30, Channel::Position);
    assert_eq!(position(&found)[0], position(&before)[0]);
    assert_ne!(position(&found)[1], position(&before)[1]);
    assert_eq!(position(&found)[2], position(&before)[2]);
    for t in 0..n {
        let same = row(&found, t, Channel::Quaternion) == row(&before, t, Channel::Quaternion);
        assert_eq!(same, held.orientation[t], "{t}");
    }
    assert!((5.0..60.0).contains(&moved.position_rms_mm), "{moved:?}");
    assert!(moved.position_max_mm > 1.5 * moved.position_rms_mm, "{moved:?}");
    assert!((1.0..20.0).contains(&moved.orientation_rms_deg), "{moved:?}");
    assert!(moved.orientation_max_deg > 1.5 * moved.orientation_rms_deg, "{moved:?}");
    // Held near another value, the path bends towards it.
    let mut pulled = noisy(&truth(n), &VARIANCES, 81);
    pulled.position[30][0] += 0.5;
    let only = HeldPoses { position: held.position, orientation: Vec::new() };
    let a = fused(&measured, &VARIANCES, &only);
    let b = fused(&pulled, &VARIANCES, &only);
    let change: Vec<f64> = a.iter().zip(&b).map(|(a, b)| b[0] - a[0]).collect();
    assert!((change[30] - 0.5).abs() < 1e-15 && change[29] > 0.3 && change[31] > 0.3);
    assert!(change[0].abs() < 0.02 && change[60].abs() < 0.02);
}

#[test]
fn what_follows_from_fused_poses_is_derived_and_a_second_time_changes_little() {
    let config = PostProcessConfig { coherence: Coherence::Fuse, ..PostProcessConfig::default() };
    config.check().expect("settings that make sense");
    for n in [0, 1, 2, 3, 77] {
        let decoded = frames(&noisy(&truth(n), &FusionVariances::default(), 91));
        let mut found = decoded.clone();
        let moved = process_holding(&config, &mut found, None, &NONE).expect("fused");
        assert_eq!(moved.position_max_mm > 0.0, n > 1, "a single frame has nothing to agree with");
        let measured = FusionMeasurements::of(&BODY.body(), found.view());
        let poses = Poses { position_m: measured.position, orientation: measured.orientation };
        let derived = frames_of(&poses, n);
        assert_eq!(found, derived);
        let mut again = found.clone();
        let moved = process_holding(&config, &mut again, None, &NONE).expect("fused");
        // Rounding of metres to single precision.
        assert!(moved.position_max_mm < 1e-3 && moved.orientation_max_deg < 1e-4, "{moved:?}");
        let mut derived_again = found.clone();
        assert_eq!(
            process_holding(&config.without_smoothing(), &mut derived_again, None, &NONE),
            None
        );
        assert_eq!(derived_again, found);
    }
}

/// A capture of ours (Carnegie Mellon 01_01, jumps and turns), with errors of the default variances.
#[test]
fn a_capture_comes_out_of_noise_better_than_by_smoothing() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/motion/cmu_01_01.expected.npy");
    let array = npy::read_f64(&std::fs::read(path).expect("the golden file")).expect("an array");
    let row = |t: usize| &array.values[t * MOTION_DIM..(t + 1) * MOTION_DIM];
    let poses = Poses {
        position_m: (0..array.shape[0]).map(|t| std::array::from_fn(|i| row(t)[i])).collect(),
        orientation: (0..array.shape[0]).map(|t| std::array::from_fn(|i| row(t)[9 + i])).collect(),
    };
    let decoded = frames(&noisy(&poses, &FusionVariances::default(), 101));
    let result = |coherence: Coherence, savitzky_golay: Option<SavitzkyGolay>| {
        let config =
            PostProcessConfig { coherence, savitzky_golay, ..PostProcessConfig::default() };
        let mut frames = decoded.clone();
        process(&config, &mut frames, None);
        let found = FusionMeasurements::of(&BODY.body(), frames.view());
        let error: f64 =
            (0..3).map(|axis| mean_square(&found.position, &poses.position_m, axis)).sum();
        let d = forward_differences;
        let jerk = |p: &[[f64; 3]]| d(&d(&d(p))).into_iter().map(size).sum::<f64>();
        let angles = poses.orientation.iter().zip(&found.orientation);
        let turned: f64 = angles.map(|(a, b)| Displacement::angle(a, b).powi(2)).sum();
        [error.sqrt(), jerk(&found.position) / jerk(&poses.position_m), turned.sqrt()]
    };
    let fused = result(Coherence::Fuse, None);
    let smoothed = result(Coherence::Derive, Some(SavitzkyGolay::default()));
    // 34.6 mm of noise become 11 mm and 16 mm.
    assert!(fused[0] < 0.8 * smoothed[0], "{fused:?} against {smoothed:?}");
    assert!(fused[1] < 0.5 * smoothed[1], "{fused:?} against {smoothed:?}");
    assert!(fused[2] < 0.85 * smoothed[2], "{fused:?} against {smoothed:?}");
}

#[test]
fn filters_with_a_long_memory_are_as_smooth_as_the_solution() {
    // Positions that are worth little beside velocities: each residual is felt for seconds.
    let start = FusionVariances::default();
    let variances = FusionVariances { position_m2: start.position_m2.times(128.0), ..start };
    let filters = FusionFilters::new(&variances);
    let n = 120;
    let mut noise = Noise::new(5);
    let still = vec![[0.0; 3]; n];
    let velocity: Vec<[f64; 3]> =
        (0..n).map(|_| std::array::from_fn(|_| 0.2 * noise.normal())).collect();
    let acceleration: Vec<[f64; 3]> =
        (0..n).map(|_| std::array::from_fn(|_| 2.0 * noise.normal())).collect();
    let filtered = |axis: usize, t: usize| -> f64 {
        let sum = |h: &Array2<f64>, r: &[[f64; 3]]| -> f64 {
            let m = h.ncols() / 2;
            let taps = (0..h.ncols()).filter_map(|j| Some((j, r.get((t + j).checked_sub(m)?)?)));
            taps.map(|(j, r)| h[[axis, j]] * r[axis]).sum()
        };
        sum(&filters.velocity, &velocity) + sum(&filters.acceleration, &acceleration)
    };
    let measured = FusionMeasurements {
        position: still.clone(),
        velocity: velocity.clone(),
        acceleration: acceleration.clone(),
        orientation: Vec::new(),
        angular_velocity: Vec::new(),
    };
    let exact = measured.shifts(&variances, &NONE);
    for axis in 0..3 {
        let jerk = |path: &[f64]| {
            let third = path.windows(4).map(|x| x[3] - 3.0 * x[2] + 3.0 * x[1] - x[0]);
            third.map(f64::abs).sum::<f64>()
        };
        // Away from the ends, of which filters do not know.
        let path: Vec<f64> = (20..n - 20).map(|t| filtered(axis, t)).collect();
        let solved: Vec<f64> = exact[20..n - 20].iter().map(|shift| shift[axis]).collect();
        let ratio = jerk(&path) / jerk(&solved);
        assert!((0.95..1.05).contains(&ratio), "axis {axis}: {ratio}");
    }
}
