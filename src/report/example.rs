//! A small report, and parts of others, for tests.

use super::{Against, CheckLine, Metric, Report, Worst, better};

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

/// Returns a report with something in each of its parts.
pub(super) fn example() -> Report {
    let passed = metric("generated", "all", "pass_rate", "reference", Some(118.0 / 120.0));
    let fid_k = |subject, value| metric(subject, "held_out", "fid_k", "axes", Some(value));
    let locked = |subject, name, value| metric(subject, "held_out", name, "per_song", Some(value));
    let jerk = metric("generated", "held_out", "jerk_mean", "", Some(61.25));
    Report {
        title: "Evaluation of demo".to_owned(),
        facts: vec![("motions".to_owned(), "120".to_owned())],
        verdicts: Vec::new(),
        notes: Vec::new(),
        checks: vec![
            check("reference", "phase", 120, 118),
            CheckLine {
                worst_message: "Mean jerk: 512".to_owned(),
                ..check("strict", "jerk", 120, 96)
            },
            check("strict", "velocity", 120, 119),
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
            metric("ground_truth", "all", "fid_k", "axes", None),
            metric("generated", "held_out", "fid_g", "", Some(1.5)),
            metric("generated", "held_out", "diversity", "axes", Some(3.0)),
            Metric { unit: "m/s³".to_owned(), ..jerk },
        ],
        worst: vec![Worst {
            name: "song 3".to_owned(),
            facts: vec![("seed".to_owned(), "7".to_owned())],
            failed: vec!["Mean jerk: 512".to_owned()],
            svg: "<svg xmlns=\"http://www.w3.org/2000/svg\"/>".to_owned(),
        }],
        against: Some(Against {
            run: "before".to_owned(),
            metrics: vec![
                with_interval(fid_k("generated", 3.5), 3.25, 3.75),
                locked("generated", "locking_p", 0.25),
            ],
            paired: Vec::new(),
            settings: vec![("steps".to_owned(), "20".to_owned(), "50".to_owned())],
        }),
    }
}
