//! The evaluation's metrics against `tests/golden/metrics/make.py`.

mod golden;

use motiongen::evaluation::beats::{
    BeatScore, beat_alignment, motion_beats, phase_coherence, phase_error, rayleigh,
};
use motiongen::evaluation::body::{part, poses};
use motiongen::evaluation::consistency::consistency;
use motiongen::evaluation::control::{ControlErrors, control_errors, rotation_error_deg};
use motiongen::evaluation::coupling::{CoupledPassage, Coupling, CouplingSums};
use motiongen::evaluation::distribution::channel_distances;
use motiongen::evaluation::diversity::{diversity, mean_distance, multimodality};
use motiongen::evaluation::frechet::{Gaussian, frechet_distance};
use motiongen::evaluation::geometric::{GeometricThresholds, geometric_features};
use motiongen::evaluation::interval::{
    Estimate, clustered_mean_estimate, clustered_share_estimate, jackknife_estimate, mean_estimate,
    paired_difference, share_estimate,
};
use motiongen::evaluation::keyframe::{Keyframe, KeyframeMisses, keyframe_misses};
use motiongen::evaluation::kinetic::{CHUNK_FRAMES, Formula, axis_features, marker_features};
use motiongen::evaluation::locking::{BarLocking, Passage, r2_at};
use motiongen::evaluation::metrics::keyframe_numbers;
use motiongen::evaluation::reference_statistics::{
    FeatureSet, FeatureStatistics, ReferenceStatistics,
};
use motiongen::evaluation::sanity::checks;
use motiongen::evaluation::window_range::{Posture, WindowRange, posture};
use motiongen::motion::rates::MotionRange;
use motiongen::motion::vector::{minus, norm};
use motiongen::motion::{Channel, ChannelLimits};
use ndarray::{Array2, ArrayView2, s};

use golden::{MotionRow, golden};

/// Of every metric, relative to it; both sides compute in double precision.
const TOLERANCE: f64 = 1e-6;
/// Below this a number is nothing but rounding.
const NOTHING: f64 = 1e-12;

fn matrix(rows: &[Vec<f64>]) -> Array2<f64> {
    let dim = rows.first().map_or(0, Vec::len);
    Array2::from_shape_fn((rows.len(), dim), |(i, j)| rows[i][j])
}

fn assert_near(what: &str, found: f64, wanted: f64) {
    let is_near = (found - wanted).abs() <= TOLERANCE * wanted.abs() + NOTHING;
    assert!(is_near, "{what}: found {found}, wanted {wanted}");
}

fn assert_all_near(what: &str, found: &[f64], wanted: &[f64]) {
    assert_eq!(found.len(), wanted.len(), "{what}");
    for (i, (&found, &wanted)) in found.iter().zip(wanted).enumerate() {
        assert_near(&format!("{what} {i}"), found, wanted);
    }
}

#[test]
fn checks_are_the_references() {
    for row in golden().motions {
        let found = checks(row.frames().view(), ChannelLimits::Wide);
        assert_eq!(row.checks.len(), 5);
        for (name, &wanted) in &row.checks {
            let check = found.iter().find(|check| check.name == name).expect("a check");
            assert_near(name, check.value, wanted);
        }
    }
}

#[test]
fn beats_and_their_chance_are_those_of_the_published_scores() {
    for row in golden().motions {
        let beats = motion_beats(&row.poses());
        assert_eq!(beats, row.beats.motion_beats);
        let found = beat_alignment(&beats, &row.music_s, row.n_frames, row.seed).expect("beats");
        assert_eq!(found.n_music_beats, row.beats.n_music_beats);
        let directions = [
            (&found.motion_to_music, &row.beats.motion_to_music),
            (&found.music_to_motion, &row.beats.music_to_motion),
        ];
        for (found, wanted) in directions {
            assert_eq!(found.len(), wanted.len());
            for (found, wanted) in found.iter().zip(wanted) {
                let BeatScore { score, chance, lift, z, width_s } = *found;
                assert_near(&format!("score at {width_s} s"), score, wanted.score);
                assert_near(&format!("chance at {width_s} s"), chance, wanted.chance);
                assert_near(&format!("lift at {width_s} s"), lift.expect("lift"), wanted.lift);
                assert_near(&format!("z at {width_s} s"), z.expect("z"), wanted.z);
            }
        }
    }
}

#[test]
fn phases_are_compared_as_their_formulas_say() {
    for row in golden().motions {
        let music: Vec<f64> = row.bars().iter().map(|x| x.rem_euclid(1.0)).collect();
        let said = row.column(Channel::Phase.range().start);
        let found = [
            ("rayleigh", rayleigh(&music, &motion_beats(&row.poses()), 4)),
            ("phase_error", phase_error(&said, &music)),
            ("phase_coherence", phase_coherence(&said, &music, 4)),
        ];
        assert_eq!(row.phases.len(), found.len());
        for (name, found) in found {
            assert_near(name, found.expect("finite"), row.phases[name]);
        }
    }
}

#[test]
fn locking_is_a_regression_on_the_bar() {
    let golden = golden();
    let up = Channel::Velocity.range().start + 1;
    let rows = &golden.motions;
    let signals: Vec<Vec<f64>> = rows.iter().map(|row| row.column(up)).collect();
    let bars: Vec<Vec<f64>> = rows.iter().map(MotionRow::bars).collect();
    let late: Vec<Vec<f64>> =
        bars.iter().map(|bars| bars.iter().map(|x| x * 0.87).collect()).collect();
    let passage = |i: usize| Passage { signal: &signals[i], bars: &bars[i] };
    let mistimed = |i: usize| Passage { signal: &signals[i], bars: &late[i] };
    let cases = [
        ("alone", (0..4).map(|i| vec![passage(i)]).collect(), &golden.locking.alone),
        (
            "together",
            vec![vec![passage(0), passage(1)], vec![passage(2)]],
            &golden.locking.together,
        ),
        ("mistimed", (0..4).map(|i| vec![mistimed(i)]).collect(), &golden.locking.mistimed),
    ];
    for (what, fits, wanted) in cases {
        let fits: Vec<Vec<Passage>> = fits;
        let groups: Vec<usize> =
            fits.iter().enumerate().flat_map(|(i, fit)| fit.iter().map(move |_| i)).collect();
        let passages: Vec<Passage> = fits.into_iter().flatten().collect();
        let ratios = &golden.locking.ratios;
        let wrong: Vec<Vec<f64>> =
            ratios.iter().map(|&ratio| r2_at(&passages, &groups, ratio)).collect();
        let own = r2_at(&passages, &groups, 1.0);
        let found = BarLocking::against(&own, &wrong).expect("finite");
        assert_near(&format!("R², {what}"), found.r2, wanted.r2);
        assert_near(&format!("mean of wrong R², {what}"), found.wrong_mean, wanted.wrong_mean);
        assert_near(&format!("effect, {what}"), found.effect.expect("spread"), wanted.effect);
        assert_near(&format!("wrong share, {what}"), found.wrong_share, wanted.wrong_share);
    }
}

#[test]
fn the_coefficient_is_a_regression_on_what_was_constructed() {
    let golden = golden();
    let mut sums = CouplingSums::default();
    for row in &golden.motions {
        let heights = row.column(1);
        let rise_m_s: Vec<f64> = heights.windows(2).map(|y| (y[1] - y[0]) * 30.0).collect();
        let activity: Vec<f64> =
            (0..row.n_frames).map(|t| 0.5 + 0.4 * (0.05 * t as f64).sin()).collect();
        let bars = row.bars();
        let passage = CoupledPassage {
            rise_m_s: &rise_m_s,
            bars: &bars,
            beats_per_bar: 4,
            activity: Some(&activity),
        };
        sums.add(&Coupling::Constructed, &passage);
    }
    for &[rotation, wanted] in &golden.coupling {
        let found = sums.coefficient(rotation).expect("finite");
        assert_near(&format!("coefficient, rotated by {rotation}"), found, wanted);
    }
}

#[test]
fn bounds_of_windows_are_numpys() {
    let golden = golden();
    let found: Vec<Posture> =
        golden.motions.iter().map(|row| posture(row.frames().view()).expect("finite")).collect();
    for (found, wanted) in found.iter().zip(&golden.postures) {
        assert_near("speed", found.speed_m_s, wanted.speed_m_s);
        assert_near("turn rate", found.turn_rate_rad_s, wanted.turn_rate_rad_s);
        assert_near("tilt", found.tilt_rad, wanted.tilt_rad);
        assert_all_near("height", &found.height_m, &[wanted.lowest_m, wanted.highest_m]);
        assert_near("turning", found.turning_rad_s, wanted.turning_rad_s);
        assert_near("jerk", found.jerk_m_s3, wanted.jerk_m_s3);
        assert_all_near("speeds", &found.axis_speed_m_s, &wanted.axis_speed_m_s);
    }
    let (range, wanted) = (WindowRange::fit(&found).expect("finite"), golden.window_range);
    let numbers = |range: &WindowRange| {
        let [low, high] = range.height_m;
        let [from, to] = range.jerk_m_s3;
        let others = [range.speed_m_s, range.turn_rate_rad_s, range.tilt_rad, range.turning_rad_s];
        [&others[..], &[low, high, from, to]].concat()
    };
    assert_eq!(range.n_windows, wanted.n_windows);
    assert_all_near("bounds", &numbers(&range), &numbers(&wanted));
}

#[test]
fn features_are_those_of_the_published_code_and_of_its_correction() {
    let golden = golden();
    for row in &golden.motions {
        let chunk = part(&row.poses(), 0..CHUNK_FRAMES);
        for (formula, axes, markers) in [
            (Formula::Correct, &row.axes, &row.markers),
            (Formula::Compat, &row.axes_compat, &row.markers_compat),
        ] {
            let found = axis_features(&chunk, formula).expect("frames");
            assert_all_near(&format!("axes, {formula:?}"), &found, axes);
            let found = marker_features(&chunk, formula).expect("frames");
            assert_all_near(&format!("markers, {formula:?}"), &found, markers);
        }
        let found = geometric_features(&chunk, &golden.thresholds).expect("frames");
        assert_all_near("geometric", &found, &row.geometric);
    }
}

#[test]
fn consistency_is_as_its_formulas_say() {
    for row in golden().motions {
        let found = consistency(row.frames().view(), ChannelLimits::Reference).expect("finite");
        let found = [
            ("velocity_error_m_s", found.velocity_error_m_s),
            ("acceleration_error_m_s2", found.acceleration_error_m_s2),
            ("turn_error_rad_s", found.turn_error_rad_s),
            ("norm_error", found.norm_error),
            ("jerk_mean_m_s3", found.jerk_mean_m_s3),
            ("jerk_p95_m_s3", found.jerk_p95_m_s3),
            ("log_dimensionless_jerk", found.log_dimensionless_jerk.expect("moves")),
            ("share_over_limits", found.share_over_limits),
        ];
        assert_eq!(row.consistency.len(), found.len());
        for (name, found) in found {
            assert_near(name, found, row.consistency[name]);
        }
    }
}

#[test]
fn reference_statistics_hold_the_quantiles_of_the_ground_truth() {
    let golden = golden();
    let motions: Vec<Array2<f32>> = golden.motions.iter().map(MotionRow::frames).collect();
    let views: Vec<ArrayView2<f32>> = motions.iter().map(|motion| motion.view()).collect();
    let found = ReferenceStatistics::fit(&views, "hash".to_owned()).expect("finite");
    assert_eq!((found.n_windows, found.n_chunks), (4, 4));
    let numbers = |t: &GeometricThresholds| {
        [
            t.speed_q50_m_s,
            t.speed_q90_m_s,
            t.vertical_speed_q75_m_s,
            t.radial_speed_q75_m_s,
            t.curvature_q75_per_m,
            t.height_q25_m,
            t.height_q75_m,
            t.speeding_q75_m_s2,
        ]
    };
    assert_all_near("thresholds", &numbers(&found.thresholds), &numbers(&golden.thresholds));
    let views: Vec<_> = golden.motions.iter().map(MotionRow::frames).collect();
    let range = MotionRange::fit(views.iter().map(|frames| frames.view())).expect("finite");
    let wanted = golden.training_range;
    assert_near("speed", range.speed_m_s, wanted.speed_m_s);
    assert_near("turn rate", range.turn_rate_rad_s, wanted.turn_rate_rad_s);
    let mean = |i: usize| golden.motions.iter().map(|row| row.markers[i]).sum::<f64>() / 4.0;
    for (i, &found) in found.statistics(FeatureSet::Markers).mean.iter().enumerate() {
        assert_near("mean of a feature", found, mean(i));
    }
}

#[test]
fn distances_between_sets_of_features_are_scipys() {
    let golden = golden().features;
    let [truth, other, flat] =
        [&golden.truth, &golden.other, &golden.flat].map(|rows| matrix(rows));
    let statistics = FeatureStatistics::fit(truth.view()).expect("finite");
    assert_all_near("mean", &statistics.mean, &golden.mean);
    assert_all_near("deviation", &statistics.deviation, &golden.deviation);
    for (found, wanted) in statistics.gaussian.covariance.iter().zip(&golden.covariance) {
        assert_all_near("covariance", found, wanted);
    }
    let fit = |features: &Array2<f64>| Gaussian::fit(features.view()).expect("finite");
    let normalized = fit(&statistics.normalize(other.view()));
    for (what, a, b, wanted) in [
        ("normalised", &statistics.gaussian, &normalized, golden.frechet),
        ("raw", &fit(&truth), &fit(&other), golden.frechet_raw),
        ("singular", &fit(&truth), &fit(&flat), golden.frechet_flat),
    ] {
        assert_near(what, frechet_distance(a, b).expect("enough features"), wanted);
        assert_near(what, frechet_distance(b, a).expect("enough features"), wanted);
    }
    assert_near("Dist", mean_distance(other.view()).expect("pairs"), golden.mean_distance);
    assert_near("diversity", diversity(other.view(), 13, 5).expect("pairs"), golden.diversity);
    let all = diversity(other.view(), 300, 6).expect("pairs");
    assert_near("diversity of all pairs", all, golden.diversity_all);
    let conditions: Vec<Array2<f64>> = golden.conditions.iter().map(|rows| matrix(rows)).collect();
    let views: Vec<ArrayView2<f64>> = conditions.iter().map(|rows| rows.view()).collect();
    let found = multimodality(&views, 10, 11).expect("pairs");
    assert_near("multimodality", found, golden.multimodality);
}

#[test]
fn channels_are_as_far_apart_as_scipy_says() {
    let golden = golden();
    let [truth, motion] = [0, 1].map(|i| golden.motions[i].frames());
    let found = channel_distances(motion.view(), truth.view());
    let found: Vec<f64> = found.into_iter().map(|x| x.expect("varies")).collect();
    assert_all_near("distance of channel", &found, &golden.channels);
}

#[test]
fn misses_are_summed_up_as_omnicontrol_does() {
    let golden = golden();
    let (mut all_mm, mut all_deg) = (Vec::new(), Vec::new());
    for (row, sample) in golden.motions.iter().zip(&golden.control.samples) {
        let poses = row.poses();
        let pose_at = |i: usize| (poses.position_m[sample.at[i]], poses.orientation[sample.at[i]]);
        let n = sample.at.len();
        let mm: Vec<f64> =
            (0..n).map(|i| 1e3 * norm(minus(pose_at(i).0, sample.position[i]))).collect();
        let deg: Vec<f64> =
            (0..n).map(|i| rotation_error_deg(pose_at(i).1, sample.quaternion[i])).collect();
        assert_all_near("miss in mm", &mm, &sample.mm);
        assert_all_near("miss in degrees", &deg, &sample.deg);
        all_mm.push(mm);
        all_deg.push(deg);
    }
    let cases = golden.control.position.iter().map(|row| (&all_mm, row));
    for (misses, wanted) in cases.chain(golden.control.rotation.iter().map(|row| (&all_deg, row))) {
        let found: ControlErrors = control_errors(misses, wanted.threshold).expect("keyframes");
        assert_eq!((found.n_samples, found.n_keyframes), (3, 9));
        assert_near("trajectory", found.trajectory, wanted.trajectory);
        assert_near("location", found.location, wanted.location);
        assert_near("location by sample", found.location_by_sample, wanted.location_by_sample);
        assert_near("mean", found.mean.expect("finite"), wanted.mean);
        let by_sample = found.mean_by_sample.expect("finite");
        assert_near("mean by sample", by_sample, wanted.mean_by_sample);
    }
}

#[test]
fn motions_are_measured_at_their_keyframes_as_omnicontrol_does() {
    let golden = golden();
    let of_motion = |(row, sample): (&MotionRow, &golden::SampleRow)| {
        let keyframe = |i: usize| Keyframe {
            frame: sample.at[i],
            position_m: sample.position[i].map(Some),
            orientation: Some(sample.quaternion[i]),
        };
        let keyframes: Vec<Keyframe> = (0..sample.at.len()).map(keyframe).collect();
        let found = keyframe_misses(row.frames().view(), &keyframes);
        // Motion is kept as f32, and NumPy has it as f64: 1e-7 of a metre.
        let is_near = |found: &[f64], wanted: &[f64], within: f64| {
            assert_eq!(found.len(), wanted.len());
            assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < within), "{found:?}");
        };
        is_near(&found.position_mm, &sample.mm, 1e-3);
        is_near(&found.orientation_deg, &sample.deg, 1e-4);
        is_near(&found.timing_s, &sample.timing_s, 1e-12);
        found
    };
    let misses: Vec<KeyframeMisses> =
        golden.motions.iter().zip(&golden.control.samples).map(of_motion).collect();
    let motions: Vec<(usize, &KeyframeMisses)> = (0..).zip(&misses).collect();
    let numbers = keyframe_numbers(&motions);
    let check = |metric: &str, variant: &str, wanted: f64| {
        let found = numbers.iter().find(|n| n.metric == metric && n.variant == variant);
        let found = found.unwrap_or_else(|| panic!("no {metric} {variant}")).estimate;
        let value = found.value.expect("a value");
        assert!(
            (value - wanted).abs() <= 1e-5 * wanted.abs(),
            "{metric} {variant}: {value}, not {wanted}"
        );
        assert!(found.ci_low <= found.value && found.value <= found.ci_high, "{metric} {variant}");
    };
    let kinds = [
        ("position", "mm", &golden.control.position),
        ("orientation", "deg", &golden.control.rotation),
    ];
    for (kind, unit, rows) in kinds {
        for row in rows {
            let variant = format!("{kind}_{}{unit}", row.threshold);
            check("control_trajectory_error", &variant, row.trajectory);
            check("control_location_error", &variant, row.location);
            let by_sample = format!("{variant}_by_sample");
            check("control_location_error", &by_sample, row.location_by_sample);
            check("control_average_error", kind, row.mean);
            check("control_average_error", &format!("{kind}_by_sample"), row.mean_by_sample);
        }
    }
    let [pooled, by_sample] = golden.control.timing;
    check("control_timing_error", "position", pooled);
    check("control_timing_error", "position_by_sample", by_sample);
}

#[test]
fn intervals_are_those_of_their_formulas() {
    let golden = golden().intervals;
    let check = |what: &str, found: Estimate, wanted: [f64; 3]| {
        let found = [found.value, found.ci_low, found.ci_high].map(|x| x.expect("a number"));
        assert_all_near(what, &found, &wanted);
    };
    let (values, clusters) = (&golden.values, &golden.clusters);
    check("mean", mean_estimate(values), golden.mean);
    check("mean over clusters", clustered_mean_estimate(values, clusters), golden.clustered);
    check("share", share_estimate(17, 23), golden.share);
    let passed: Vec<bool> = values.iter().map(|x| *x < 2.0).collect();
    let found = clustered_share_estimate(&passed, clusters);
    check("share over clusters", found, golden.clustered_share);
    let spread = |left_out: Option<usize>| {
        let kept: Vec<f64> = values
            .iter()
            .zip(clusters)
            .filter(|(_, cluster)| Some(**cluster) != left_out)
            .map(|(x, _)| *x)
            .collect();
        mean_distance(Array2::from_shape_vec((kept.len(), 1), kept).ok()?.view())
    };
    check("jackknife", jackknife_estimate(5, 23, spread), golden.jackknife_of_pairs);
    let differences: Vec<f64> = values[..7].iter().map(|x| x - 1.5).collect();
    let found = paired_difference(&differences).p_greater.expect("a spread");
    assert_near("p of a difference", found, golden.p_greater);
}

#[test]
fn motion_that_is_not_finite_has_no_metric_and_passes_no_check() {
    let golden = golden();
    let mut frames = golden.motions[0].frames();
    let channels = Channel::Position.range().start..Channel::Phase.range().end;
    frames.slice_mut(s![40, channels]).fill(f32::NAN);
    assert!(poses(frames.view()).is_none());
    assert!(consistency(frames.view(), ChannelLimits::Wide).is_none());
    assert!(ReferenceStatistics::fit(&[frames.view()], String::new()).is_none());
    assert!(MotionRange::fit([frames.view()]).is_none());
    assert!(posture(frames.view()).is_none());
    let range = golden.window_range.checks(None);
    let all = checks(frames.view(), ChannelLimits::Wide);
    let passed: Vec<&str> =
        all.iter().chain(&range).filter(|check| check.passed).map(|check| check.name).collect();
    // A fall of the phase is one between numbers: `phase` and `finite` say that some are none.
    assert!(passed.iter().all(|name| *name == "phase_monotonic"), "{passed:?}");
}
