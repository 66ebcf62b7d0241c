//! How far the values of each channel lie from those of the ground truth.

use ndarray::ArrayView2;

use crate::motion::MOTION_DIM;

/// A channel of the ground truth that spreads less counts as constant.
const MIN_DEVIATION: f64 = 1e-6;

/// Returns the Wasserstein distance of order 1 between two sets of values, `∫ |F(x) - G(x)| dx`, in their
/// unit.
///
/// Both are sorted. None where a set is empty or a value is not finite. Source: Ramdas, Garcia and Cuturi,
/// "On Wasserstein Two Sample Testing", 2015.
pub fn wasserstein(a: &mut [f64], b: &mut [f64]) -> Option<f64> {
    if a.is_empty() || b.is_empty() || a.iter().chain(b.iter()).any(|x| !x.is_finite()) {
        return None;
    }
    a.sort_unstable_by(f64::total_cmp);
    b.sort_unstable_by(f64::total_cmp);
    let (mut i, mut j, mut sum) = (0, 0, 0.0);
    let mut last = a[0].min(b[0]);
    while i < a.len() || j < b.len() {
        let next_a = a.get(i).copied().unwrap_or(f64::INFINITY);
        let next_b = b.get(j).copied().unwrap_or(f64::INFINITY);
        let next = next_a.min(next_b);
        let shares = (i as f64 / a.len() as f64, j as f64 / b.len() as f64);
        sum += (shares.0 - shares.1).abs() * (next - last);
        last = next;
        if next_a <= next_b {
            i += 1;
        } else {
            j += 1;
        }
    }
    Some(sum)
}

/// Returns the Wasserstein distance of each channel of motion, `[T, 25]` each, in standard deviations of the
/// ground truth.
///
/// None for channels that are constant in the ground truth, that have a value that is not finite, or where
/// there are no frames.
///
/// # Panics
/// When there are other than 25 channels.
pub fn channel_distances(
    motion: ArrayView2<f32>,
    truth: ArrayView2<f32>,
) -> [Option<f64>; MOTION_DIM] {
    assert_eq!((motion.ncols(), truth.ncols()), (MOTION_DIM, MOTION_DIM), "channels of motion");
    std::array::from_fn(|i| {
        let column = |frames: ArrayView2<f32>| -> Vec<f64> {
            frames.column(i).iter().map(|&x| f64::from(x)).collect()
        };
        let (mut motion, mut truth) = (column(motion), column(truth));
        let n = truth.len() as f64;
        let mean = truth.iter().sum::<f64>() / n;
        let deviation = (truth.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
        let distance = wasserstein(&mut motion, &mut truth)?;
        (deviation >= MIN_DEVIATION).then(|| distance / deviation)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use proptest::prelude::*;

    #[test]
    fn a_shift_is_its_own_distance() {
        let mut a: Vec<f64> = (0..31).map(|i| f64::from(i * i % 31)).collect();
        let mut b: Vec<f64> = a.iter().map(|x| x - 2.5).collect();
        assert!((wasserstein(&mut a, &mut b).expect("finite") - 2.5).abs() < 1e-12);
    }

    #[test]
    fn sets_of_unequal_size_have_a_closed_form() {
        // All of {0} moves to {0, 1, 3}: a third each by 0, 1 and 3.
        let distance = wasserstein(&mut [0.0], &mut [3.0, 0.0, 1.0]).expect("finite");
        assert!((distance - 4.0 / 3.0).abs() < 1e-15);
        assert_eq!(wasserstein(&mut [], &mut [1.0]), None);
        assert_eq!(wasserstein(&mut [f64::NAN], &mut [1.0]), None);
    }

    #[test]
    fn channels_are_measured_in_deviations_of_the_truth() {
        // Channel i is ±(i + 1) in turn, whose deviation is i + 1; the last one is constant.
        let truth = Array2::from_shape_fn((40, MOTION_DIM), |(t, i)| {
            if i == 24 { 1.0 } else { (i + 1) as f32 * if t % 2 == 0 { 1.0 } else { -1.0 } }
        });
        let mut motion = truth.clone();
        motion.column_mut(3).mapv_inplace(|x| x + 2.0);
        motion[[7, 5]] = f32::NAN;
        let found = channel_distances(motion.view(), truth.view());
        assert_eq!((found[0], found[3], found[5], found[24]), (Some(0.0), Some(0.5), None, None));
    }

    proptest! {
        #[test]
        fn it_is_a_distance(
            mut a in prop::collection::vec(-9.0..9.0f64, 1..20),
            mut b in prop::collection::vec(-9.0..9.0f64, 1..20),
        ) {
            let there = wasserstein(&mut a, &mut b).expect("finite");
            let back = wasserstein(&mut b, &mut a).expect("finite");
            prop_assert!((there - back).abs() < 1e-12 && there >= 0.0);
            let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
            prop_assert!(there >= (mean(&a) - mean(&b)).abs() - 1e-12);
        }
    }
}
