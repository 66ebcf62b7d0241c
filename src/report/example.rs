//! A small report, and parts of others, for tests.

use super::{
    CheckLine, ComparedRun, Metric, Outcome, PairedNumber, Report, Verdict, VerdictTest,
    WorstMotion, better,
};

/// Returns a number without an interval, of a hundred things.
pub(super) fn metric(
    subject: &str,
    split: &str,
    metric: &str,
    variant: &str,
    value: Option<f64>,
) -> Metric {
    Metric {
        subject: subject.to_owned(),
        split: split.to_owned(),
        metric: metric.to_owned(),
        variant: variant.to_owned(),
        value,
        n: 100,
        better: better(metric),
        ..Metric::default()
    }
}

/// Returns a number with an interval.
pub(super) fn with_interval(metric: Metric, low: f64, high: f64) -> Metric {
    Metric { ci_low: Some(low), ci_high: Some(high), ..metric }
}

/// Returns a check of which the worst answer has no message.
pub(super) fn check(set: &str, check: &str, n: usize, n_passed: usize) -> CheckLine {
    CheckLine {
        set: set.to_owned(),
        check: check.to_owned(),
        threshold: 404.0,
        n,
        n_passed,
        worst_value: 512.0,
        ..CheckLine::default()
    }
}

/// Returns a test in metres, of which the value should be at most the limit.
pub(super) fn test(test: &str, outcome: Outcome, value: f64, limit: f64) -> VerdictTest {
    VerdictTest {
        test: test.to_owned(),
        outcome,
        statistic: "what is measured".to_owned(),
        value: Some(value),
        unit: "m".to_owned(),
        rule: "at most".to_owned(),
        limit: Some(limit),
        ..VerdictTest::default()
    }
}

pub(super) fn verdict(
    verdict: &str,
    split: &str,
    outcome: Outcome,
    tests: Vec<VerdictTest>,
) -> Verdict {
    Verdict { verdict: verdict.to_owned(), split: split.to_owned(), outcome, tests }
}

/// Returns the verdicts on motion that tumbles: one lost, two open and one won.
fn verdicts() -> Vec<Verdict> {
    let verdict_test =
        |name: &str, outcome, value: f64, (low, high), (rule, limit): (&str, f64)| VerdictTest {
            ci_low: Some(low),
            ci_high: Some(high),
            unit: String::new(),
            rule: rule.to_owned(),
            ..test(name, outcome, value, limit)
        };
    let upright = VerdictTest {
        statistic: "share of the windows that are as upright as training motion".to_owned(),
        against: "held-out real motion 0.97".to_owned(),
        message:
            "0.31 of the windows are as upright as training motion; held-out real motion has 0.97."
                .to_owned(),
        ..verdict_test("upright", Outcome::Lost, 0.31, (0.24, 0.39), ("at least", 0.92))
    };
    let jerk = VerdictTest {
        statistic: "jerk over that of real motion".to_owned(),
        against: "held-out real motion 1.02".to_owned(),
        message: "The jerk is 4.1 times that of real motion, at most 1.5 is asked.".to_owned(),
        ..verdict_test("jerk", Outcome::Lost, 4.1, (3.75, 4.5), ("at most", 1.5))
    };
    let height = VerdictTest {
        statistic: "share of the windows that are as high as training motion".to_owned(),
        against: "held-out real motion 0.95".to_owned(),
        message: "0.94 of the windows are as high as training motion.".to_owned(),
        ..verdict_test("height", Outcome::Won, 0.94, (0.91, 0.97), ("at least", 0.9))
    };
    let other_music = VerdictTest {
        statistic: "probability of as strong a coupling with the music of other songs".to_owned(),
        against: "the same motions with the music of other songs 0.02".to_owned(),
        message: "Coupling is above that with other music: p 0.004, below 0.05 is asked."
            .to_owned(),
        ..verdict_test("other_music", Outcome::Won, 0.004, (0.002, 0.008), ("below", 0.05))
    };
    let untrained = VerdictTest {
        statistic: "coupling less that of the untrained network".to_owned(),
        value: None,
        message: "4 songs are too few to hold it against the untrained network; 6 are needed."
            .to_owned(),
        ..verdict_test("untrained", Outcome::Open, 0.0, (0.0, 0.0), ("above", 0.0))
    };
    let spread = VerdictTest {
        statistic: "diversity over that of held-out real motion".to_owned(),
        against: "held-out real motion 1".to_owned(),
        message: "Motions differ as much as real ones: 0.97 of their distance.".to_owned(),
        ..verdict_test("diversity", Outcome::Won, 0.97, (0.93, 1.04), ("at least", 0.8))
    };
    vec![
        verdict("varied", "held_out", Outcome::Won, vec![spread]),
        verdict("follows_music", "held_out", Outcome::Open, vec![other_music, untrained]),
        verdict("sound", "all", Outcome::Lost, vec![jerk, upright, height]),
    ]
}

/// Returns a report with something in each of its parts.
pub(super) fn example() -> Report {
    let passed = metric("generated", "all", "pass_rate", "reference", Some(118.0 / 120.0));
    let fid_k = |subject, value| metric(subject, "held_out", "fid_k", "axes", Some(value));
    let locked = |subject, name, value| metric(subject, "held_out", name, "per_song", Some(value));
    let jerk = metric("generated", "held_out", "jerk_mean", "", Some(61.25));
    Report {
        title: "Evaluation of demo".to_owned(),
        facts: vec![("motions".to_owned(), "120".to_owned())],
        verdicts: verdicts(),
        notes: vec![
            "Nobody knows which songs this model learned from.".to_owned(),
            "Each motion is the best of 8 candidates, chosen by R².".to_owned(),
        ],
        checks: vec![
            check("reference", "phase", 120, 118),
            CheckLine { stage: "raw".to_owned(), ..check("strict", "velocity", 120, 31) },
            CheckLine {
                worst_message: "Mean jerk: 512".to_owned(),
                ..check("strict", "jerk", 120, 96)
            },
            CheckLine { by_construction: true, ..check("strict", "velocity", 120, 120) },
            check("strict", "finite", 120, 120),
        ],
        metrics: vec![
            Metric { n: 120, ..passed },
            locked("generated", "locking_r2", 0.099),
            locked("generated", "locking_wrong_r2", 0.035),
            locked("generated", "locking_p", 0.005),
            locked("shuffled", "locking_r2", 0.009),
            locked("shuffled", "locking_p", 0.71),
            with_interval(fid_k("generated", 2.5), 2.25, 2.75),
            fid_k("mean_motion", 31.25),
            fid_k("held_out_truth", 0.8),
            metric("training_truth", "all", "fid_k", "axes", None),
            metric("generated", "held_out", "fid_g", "", Some(1.5)),
            metric("generated", "held_out", "diversity", "axes", Some(3.0)),
            Metric { unit: "m/s³".to_owned(), ..jerk },
        ],
        worst: vec![WorstMotion {
            name: "song 3".to_owned(),
            facts: vec![("seed".to_owned(), "7".to_owned())],
            failed: vec!["Mean jerk: 512".to_owned()],
            svg: "<svg xmlns=\"http://www.w3.org/2000/svg\"/>".to_owned(),
        }],
        against: Some(ComparedRun {
            run: "before".to_owned(),
            metrics: vec![
                with_interval(fid_k("generated", 3.5), 3.25, 3.75),
                locked("generated", "locking_p", 0.25),
            ],
            paired: vec![PairedNumber {
                metric: "fid_k".to_owned(),
                variant: "axes".to_owned(),
                split: "held_out".to_owned(),
                difference: -1.0,
                ci_low: Some(-1.5),
                ci_high: Some(-0.5),
                p_holm: Some(0.012),
                n_songs: 11,
            }],
            settings: vec![("steps".to_owned(), "20".to_owned(), "50".to_owned())],
        }),
        dial: Vec::new(),
    }
}
