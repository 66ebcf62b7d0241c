//! Do the dancers of a group belong together, and keep apart?

use super::{
    GroupEvidence, Outcome, Rule, Test, differences_by_song, estimate, find, real, rounded,
};
use crate::evaluation::interval::{Estimate, paired_difference};

/// Largest share of frames and pairs whose bodies touch.
const MAX_TIF: f64 = 0.02;
/// Least distance of two centres, m: the radius of a body, so that nobody's centre is within another.
const LEAST_SEPARATION_M: f64 = 0.35;
/// Spread of the group over that of real groups.
const SPREAD_RATIO: [f64; 2] = [0.5, 2.0];
/// Difference of the dancers' velocities over that of real groups: 0 for copies of one.
const DIFFERENCE_RATIO: [f64; 2] = [0.25, 4.0];
/// How much farther from the training groups than held-out real groups their features may be.
const REALISM_MARGIN: f64 = 2.0;
/// A test that has a probability is won below it.
const ALPHA: f64 = 0.05;

/// Bodies that do not touch, a stage as real groups take it, dancers who are no copies of each other, and who belong
/// together more than soloists who were sampled one by one.
pub(super) fn tests(group: &GroupEvidence) -> Vec<Test> {
    let GroupEvidence { own, truth, .. } = group;
    let mut tests = vec![
        Test::of_value(
            "tif",
            "share of frames and pairs whose bodies touch",
            estimate(own, "tif", ""),
            "",
            Rule::AtMost(MAX_TIF),
            real(truth, "tif", ""),
        ),
        Test::of_value(
            "least_separation",
            "least distance of two bodies' centres",
            estimate(own, "least_separation", "least"),
            "m",
            Rule::AtLeast(LEAST_SEPARATION_M),
            real(truth, "least_separation", "least"),
        ),
        over_real(group, "stage", "spread of the group", "formation_spread", SPREAD_RATIO),
        over_real(
            group,
            "own_ways",
            "difference of the dancers' velocities",
            "dancer_velocity_difference",
            DIFFERENCE_RATIO,
        ),
        belong_together(group),
    ];
    let (gmr, held_out) = (estimate(own, "gmr", ""), estimate(truth, "gmr", "").value);
    // Too few windows for a covariance: left out, as Fréchet distances of one dancer's motion are.
    if let (Some(_), Some(held_out)) = (gmr.value, held_out) {
        tests.push(Test::of_value(
            "gmr",
            "Fréchet distance of the groups' kinetic features",
            gmr,
            "",
            Rule::AtMost(held_out + REALISM_MARGIN),
            real(truth, "gmr", ""),
        ));
    }
    tests
}

/// A test of a number over that of real groups.
fn over_real(
    group: &GroupEvidence,
    name: &'static str,
    what: &str,
    metric: &str,
    [low, high]: [f64; 2],
) -> Test {
    let value = estimate(group.own, metric, "");
    let held_out = estimate(group.truth, metric, "").value.filter(|x| *x > 0.0);
    let over = |x: Option<f64>| Some(x? / held_out?);
    let ratio = Estimate {
        value: over(value.value),
        ci_low: over(value.ci_low),
        ci_high: over(value.ci_high),
        n: value.n,
    };
    let statistic = format!("{what} over that of real groups");
    Test::of_value(
        name,
        statistic,
        ratio,
        "",
        Rule::Within(low, high),
        real(group.truth, metric, ""),
    )
}

/// A test of whether dancers are more in unison than soloists who were sampled one by one, song by song.
fn belong_together(group: &GroupEvidence) -> Test {
    let number = |numbers| find(numbers, "unison_index", "");
    let (own, alone) = (number(group.own), number(group.independent));
    let differences = differences_by_song(own, alone);
    let found = paired_difference(&differences);
    let against = match alone.and_then(|alone| alone.estimate.value) {
        Some(x) => format!("{} of independent soloists, {} songs", rounded(x), differences.len()),
        None => "no soloists were sampled".to_owned(),
    };
    let test = Test::of_value(
        "belong_together",
        "unison index less that of soloists who were sampled one by one",
        found.estimate,
        "",
        Rule::Above(0.0),
        against,
    );
    // One song has no spread to be held against.
    let outcome = match (test.outcome, found.p_greater) {
        (Outcome::Won, None) => Outcome::Open,
        (Outcome::Won, Some(p)) if p >= ALPHA => Outcome::Lost,
        (outcome, _) => outcome,
    };
    Test { outcome, p: found.p_greater, p_holm: found.p_greater, ..test }
}
