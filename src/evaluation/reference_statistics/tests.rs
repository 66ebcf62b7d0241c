use super::*;
use crate::evaluation::frechet::frechet_distance;
use crate::motion::kinematics::frames_of;
use crate::motion::quaternion::from_axis_angle;
use crate::units::FPS;
use ndarray::concatenate;

/// Sways and turns, faster with each number.
fn motion(i: usize, n: usize) -> Array2<f32> {
    let rate = 1.0 + 0.07 * i as f64;
    let pose = |t: usize| {
        let s = rate * t as f64 / FPS;
        let turn = from_axis_angle([0.0, 1.0, 0.0], 0.9 * s + 0.3 * (1.7 * s).sin());
        ([(1.3 * s).sin(), 1.0 + 0.1 * (2.9 * s + i as f64).cos(), 0.5 * s], turn)
    };
    let (position_m, orientation) = (0..n + 2).map(pose).unzip();
    frames_of(&Poses { position_m, orientation }, n)
}

fn fitted() -> (Vec<Array2<f32>>, ReferenceStatistics) {
    let motions: Vec<Array2<f32>> = (0..21).map(|i| motion(i, 160)).collect();
    let views: Vec<ArrayView2<f32>> = motions.iter().map(|motion| motion.view()).collect();
    let found = ReferenceStatistics::fit(&views, "abc".to_owned()).expect("finite");
    (motions, found)
}

#[test]
fn normalised_ground_truth_has_mean_zero_and_deviation_one() {
    let (motions, found) = fitted();
    assert_eq!((found.n_windows, found.n_chunks, found.window_frames), (21, 42, 160));
    let rows: Vec<Array2<f64>> = motions
        .iter()
        .map(|motion| found.features(FeatureSet::Axes, motion.view()).expect("finite"))
        .collect();
    let views: Vec<ArrayView2<f64>> = rows.iter().map(|rows| rows.view()).collect();
    let all = concatenate(Axis(0), &views).expect("as wide");
    assert_eq!(all.dim(), (42, 8));
    let (mean, deviation) = (all.mean_axis(Axis(0)).expect("rows"), all.std_axis(Axis(0), 0.0));
    for (i, (mean, deviation)) in mean.iter().zip(&deviation).enumerate() {
        assert!(mean.abs() < 1e-9, "{i}: {mean}");
        // The y axis stands upright: its features are constant, and keep their unit.
        let is_one = (deviation - 1.0).abs() < 1e-6;
        assert!(is_one || ((4..6).contains(&i) && *deviation < 1e-3), "{i}: {deviation}");
    }
}

#[test]
fn a_feature_that_is_constant_keeps_its_unit() {
    let truth = Array2::from_shape_fn((30, 2), |(i, j)| if j == 0 { i as f64 } else { 0.25 });
    let found = FeatureStatistics::fit(truth.view()).expect("finite");
    let other = found.normalize(Array2::from_elem((1, 2), 0.5).view());
    assert_eq!(other[[0, 1]], 0.25);
    assert!((other[[0, 0]] - (0.5 - 14.5) / (899.0_f64 / 12.0).sqrt()).abs() < 1e-9);
    assert!(FeatureStatistics::fit(Array2::zeros((0, 2)).view()).is_none());
}

#[test]
fn the_artefact_is_read_as_it_was_written() {
    let (_, found) = fitted();
    let text = serde_json::to_string(&found).expect("numbers");
    let read = ReferenceStatistics::from_json(&text).expect("sound");
    assert_eq!((read.version, &read.data_hash, read.n_chunks), (2, &found.data_hash, 42));
    // Reading a number may miss its last bit.
    let distance = frechet_distance(&read.geometric.gaussian, &found.geometric.gaussian);
    assert_eq!(distance, None, "42 chunks are too few for 16 features");
    for (a, b) in read.axes.mean.iter().zip(&found.axes.mean) {
        assert!((a - b).abs() <= 1e-15 * b.abs(), "{a} {b}");
    }
    assert_eq!(read.check_data("abc"), Ok(()));
    assert_eq!(
        read.check_data("def").expect_err("other data").to_string(),
        "reference statistics are of the data abc, the ground truth here is def; measure it again"
    );
}

#[test]
fn what_cannot_be_read_is_refused_by_name() {
    let (_, mut found) = fitted();
    let refusal = |found: &ReferenceStatistics| {
        let text = serde_json::to_string(found).expect("numbers");
        ReferenceStatistics::from_json(&text).expect_err("refused").to_string()
    };
    found.markers.mean.pop();
    assert_eq!(
        refusal(&found),
        "reference statistics of the features markers are not of 12 finite numbers each; measure the ground \
         truth again"
    );
    let (_, mut unbounded) = fitted();
    unbounded.window_range.height_m = [1.0, 0.5];
    assert_eq!(
        refusal(&unbounded),
        "reference statistics have bounds of windows that are no numbers or not in order; measure the ground \
         truth again"
    );
    found.version = 7;
    assert_eq!(
        refusal(&found),
        "reference statistics have version 7, this program reads version 2; measure the ground truth again \
         with this program"
    );
    let error = ReferenceStatistics::from_json("{}").expect_err("refused");
    assert_eq!(
        error.to_string(),
        "reference statistics cannot be read (missing field `version` at line 1 column 2); measure the \
         ground truth again"
    );
}

#[test]
fn motion_that_is_short_or_not_finite_is_not_measured() {
    let (motions, found) = fitted();
    let short = motion(0, 74);
    assert_eq!(found.features(FeatureSet::Axes, short.view()).expect("finite").dim(), (0, 8));
    let mut broken = motions[3].clone();
    broken[[80, 1]] = f32::NAN;
    assert_eq!(found.features(FeatureSet::Geometric, broken.view()), None);
    assert_eq!(ReferenceStatistics::fit(&[motions[0].view(), broken.view()], String::new()), None);
    assert_eq!(ReferenceStatistics::fit(&[short.view()], String::new()), None);
    assert_eq!(ReferenceStatistics::fit(&[], String::new()), None);
}
