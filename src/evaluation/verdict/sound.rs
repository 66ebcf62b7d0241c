//! Is it sound?

use super::{Evidence, Rule, Test, estimate, real};

/// Least share of windows that pass every check that counts. Held-out real motion reaches 0.9 and more.
const MIN_PASS_RATE: f64 = 0.8;

/// Share of motions that must be finite from the first frame to the last: all.
const FINITE: f64 = 1.0;

/// Windows pass the strict checks, as decoded and after post-processing; motions are finite, and whole where windows
/// meet.
pub(super) fn tests(evidence: &Evidence) -> Vec<Test> {
    let test = |name, stage: &str, variant: &str| {
        Test::of_value(
            name,
            format!("share of windows that pass every strict check {stage}"),
            estimate(evidence.own, "pass_rate", variant),
            "",
            Rule::AtLeast(MIN_PASS_RATE),
            real(evidence.truth, "pass_rate", "strict"),
        )
    };
    let mut tests = Vec::new();
    if evidence.has_raw {
        tests.push(test("decoded", "as decoded", "strict_raw"));
        tests.push(test("post_processed", "after post-processing", "strict"));
    } else {
        tests.push(test("as_given", "as it is", "strict"));
    }
    let whole = |name, statistic: &str, variant: &str, least: f64| {
        let share = estimate(evidence.own, "pass_rate", variant);
        Test::of_value(
            name,
            statistic,
            share,
            "",
            Rule::AtLeast(least),
            "from the first frame to the last",
        )
    };
    tests.push(whole(
        "finite",
        "share of motions all of whose values are finite, with orientations of length 1",
        "finite",
        FINITE,
    ));
    tests.push(whole(
        "seamless",
        "share of motions whose derivatives agree also where windows meet",
        "seamless",
        MIN_PASS_RATE,
    ));
    tests
}
