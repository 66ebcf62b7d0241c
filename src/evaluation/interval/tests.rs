use super::*;

fn near(estimate: Estimate, wanted: [f64; 3]) {
    let found = [estimate.value, estimate.ci_low, estimate.ci_high];
    for (found, wanted) in found.into_iter().zip(wanted) {
        // Tables of t have four figures behind the point.
        assert!(found.is_some_and(|x| (x - wanted).abs() < 2e-4), "{estimate:?}, {wanted}");
    }
}

#[test]
fn students_t_is_that_of_tables() {
    for (degrees, wanted) in [(1, 12.7062), (3, 3.1824), (7, 2.3646), (19, 2.0930)] {
        assert!((t_quantile(degrees) - wanted).abs() < 1e-4, "{degrees}");
        assert!((t_upper_tail(wanted, degrees) - 0.025).abs() < 1e-5, "{degrees}");
    }
    assert_eq!((t_quantile(0), t_upper_tail(3.0, 0)), (f64::INFINITY, 1.0));
}

#[test]
fn items_of_one_cluster_count_as_alike() {
    let values = [1.0, 2.0, 4.0, 9.0, 5.5];
    let alone = clustered_mean_estimate(&values, &[0, 1, 2, 3, 4]);
    let plain = mean_estimate(&values);
    for (a, b) in [(alone.ci_low, plain.ci_low), (alone.ci_high, plain.ci_high)] {
        assert!((a.unwrap() - b.unwrap()).abs() < 1e-12, "{alone:?} {plain:?}");
    }
    // Mean 3, two clusters off by -3 and 3: √(2 · 18) / 4 = 1.5, and t(1).
    let pairs = clustered_mean_estimate(&[1.0, 2.0, 4.0, 5.0], &[7, 7, 3, 3]);
    near(pairs, [3.0, 3.0 - 12.7062 * 1.5, 3.0 + 12.7062 * 1.5]);
    let one = clustered_mean_estimate(&[1.0, 3.0], &[5, 5]);
    assert_eq!((one.value, one.ci_low, one.ci_high), (Some(2.0), None, None));
    assert_eq!(clustered_mean_estimate(&[], &[]).value, None);
    assert_eq!(clustered_mean_estimate(&[f64::NAN, 1.0], &[0, 1]).value, None);
}

#[test]
fn a_mean_has_the_interval_of_students_t() {
    // Deviations -3, 0 and 3: s = 3.
    let half = 4.30265 * 3.0 / 3.0_f64.sqrt();
    near(mean_estimate(&[2.0, 5.0, 8.0]), [5.0, 5.0 - half, 5.0 + half]);
    assert_eq!(mean_estimate(&[4.0]), Estimate::plain(Some(4.0), 1));
    assert_eq!(mean_estimate(&[]), Estimate::plain(None, 0));
    assert_eq!(mean_estimate(&[1.0, f64::NAN, 2.0]), Estimate::plain(None, 3));
    assert_eq!(mean_estimate(&[f64::INFINITY]), Estimate::plain(None, 1));
    let cut = mean_estimate(&[2.0, 5.0, 8.0]).non_negative();
    assert_eq!((cut.value, cut.ci_low), (Some(5.0), Some(0.0)));
}

#[test]
fn a_share_stays_between_nothing_and_all() {
    // Where all pass the lower bound is 1 / (1 + z²/n), and where none do the upper its rest.
    near(share_estimate(13, 13), [1.0, 1.0 / (1.0 + 1.96 * 1.96 / 13.0), 1.0]);
    near(share_estimate(0, 7), [0.0, 0.0, 1.0 - 1.0 / (1.0 + 1.96 * 1.96 / 7.0)]);
    assert_eq!(share_estimate(0, 0), Estimate::plain(None, 0));
    // Songs whose windows are all alike count as one item each, here two, and t(1) = 12.7062 tells next to nothing.
    let alike =
        clustered_share_estimate(&[true, true, true, false, false, false], &[0, 0, 0, 1, 1, 1]);
    near(alike, [0.5, 0.001_54, 0.998_46]);
    // All pass: as many items as songs, and t(2) = 4.3027.
    let all = clustered_share_estimate(&[true; 9], &[0, 0, 0, 1, 1, 1, 2, 2, 2]);
    near(all, [1.0, 1.0 / (1.0 + 4.302_65 * 4.302_65 / 3.0), 1.0]);
    assert_eq!(clustered_share_estimate(&[], &[]), Estimate::plain(None, 0));
    assert_eq!(clustered_share_estimate(&[true], &[4]).ci_low, None);
}

#[test]
fn the_jackknife_of_a_mean_is_the_mean_and_that_of_a_square_loses_its_bias() {
    let values = [3.0, 8.0, 1.0, 7.0, 2.5];
    let mean = |left_out: Option<usize>| {
        let kept: Vec<f64> = (0..5).filter(|i| Some(*i) != left_out).map(|i| values[i]).collect();
        Some(kept.iter().sum::<f64>() / kept.len() as f64)
    };
    let (found, plain) = (jackknife_estimate(5, 5, mean), mean_estimate(&values));
    assert!((found.value.unwrap() - plain.value.unwrap()).abs() < 1e-12);
    assert!((found.ci_low.unwrap() - plain.ci_low.unwrap()).abs() < 1e-12);
    // The square of a mean is s²/n too high, which the jackknife takes out exactly.
    let square = jackknife_estimate(5, 5, |left_out| mean(left_out).map(|x| x * x));
    let (m, s) = mean_and_deviation(&values).unwrap();
    assert!((square.value.unwrap() - (m * m - s * s / 5.0)).abs() < 1e-9, "{square:?}");
    assert_eq!(jackknife_estimate(1, 9, |left_out| left_out.is_none().then_some(2.0)).ci_low, None);
    assert_eq!(jackknife_estimate(3, 9, |_| Some(f64::NAN)), Estimate::plain(None, 9));
}

#[test]
fn a_difference_is_held_against_students_t() {
    let found = paired_difference(&[1.0, 2.0, 3.0]);
    // Mean 2, s = 1: t = 2 √3 = 3.4641 with two degrees.
    assert!((found.p_greater.unwrap() - 0.037_1).abs() < 1e-4, "{found:?}");
    assert!((found.p_either().unwrap() - 0.074_2).abs() < 2e-4, "{found:?}");
    assert_eq!(paired_difference(&[1.0, 1.0]).p_greater, None);
    assert_eq!(paired_difference(&[4.0]).p_greater, None);
}

#[test]
fn holm_adjusts_in_order() {
    // scipy has none; statsmodels.stats.multitest.multipletests(…, method="holm").
    let found = holm(&[0.01, 0.04, 0.03, 0.005]);
    for (found, wanted) in found.iter().zip([0.03, 0.06, 0.06, 0.02]) {
        assert!((found - wanted).abs() < 1e-12, "{found} {wanted}");
    }
    assert_eq!(holm(&[0.6, 0.7]), [1.0, 1.0]);
    assert_eq!(holm(&[]), [0.0; 0]);
}
