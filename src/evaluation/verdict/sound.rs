//! Is it sound?

use super::{Evidence, Rule, Test, estimate, real};

/// Least share of windows that pass every check that counts. Held-out real motion reaches 0.9 and more.
const MIN_PASS_RATE: f64 = 0.8;

/// Windows pass the strict checks, as decoded and after post-processing.
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
    tests
}
