//! Sanity checks: who passed all of a set, and each check with its worst answer.

use super::html::{Escaped, put};
use super::names::{ALL, OWN, words};
use super::numbers::{number, percent, short};
use super::rows::find;
use super::{CheckLine, Report};

/// The sets that are known, in the order in which they are shown.
pub(super) const SETS: [&str; 2] = ["reference", "strict"];

/// Width of a bar for all motions, px.
const BAR_PX: f64 = 90.0;

/// How many motions passed every check of a set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Passed {
    Exactly {
        n_passed: usize,
        n: usize,
    },
    /// Each check is known, but not whether they failed for the same motions.
    AtMost {
        n_passed: usize,
        n: usize,
    },
    NotMeasured,
}

impl Passed {
    /// Looks for the pass rate of all motions, then at the checks of the set.
    pub fn of(report: &Report, set: &str) -> Self {
        let rate = find(&report.metrics, OWN, ["pass_rate", set], ALL);
        if let Some((rate, n)) = rate.and_then(|metric| Some((metric.finite()?, metric.n))) {
            let n_passed = (rate * n as f64).round();
            return Self::Exactly {
                n_passed: n_passed as usize,
                n: usize::try_from(n).unwrap_or(0),
            };
        }
        let lines = || report.checks.iter().filter(|line| line.set == set);
        let Some(worst) = lines().min_by_key(|line| line.n_passed) else {
            return Self::NotMeasured;
        };
        let CheckLine { n_passed, n, .. } = *worst;
        match lines().filter(|line| line.n_passed < line.n).count() {
            0 | 1 => Self::Exactly { n_passed, n },
            _ => Self::AtMost { n_passed, n },
        }
    }

    /// Returns it in a few words: `118 of 120 (98.3 %)`.
    pub fn words(self) -> String {
        let of = |n_passed: usize, n: usize| match n {
            0 => format!("{n_passed} of {n}"),
            _ => format!("{n_passed} of {n} ({})", percent(n_passed as f64 / n as f64)),
        };
        match self {
            Self::Exactly { n_passed, n } => of(n_passed, n),
            Self::AtMost { n_passed, n } => format!("at most {}", of(n_passed, n)),
            Self::NotMeasured => "not measured".to_owned(),
        }
    }
}

/// Returns the sets that checks are of: the known ones in their order, then others as they come.
pub(super) fn sets(checks: &[CheckLine]) -> Vec<&str> {
    let mut found: Vec<&str> = Vec::new();
    for line in checks {
        if !found.contains(&line.set.as_str()) {
            found.push(&line.set);
        }
    }
    found.sort_by_key(|set| SETS.iter().position(|name| name == set).unwrap_or(SETS.len()));
    found
}

/// Writes a section with a table for each set.
pub(super) fn section(out: &mut String, report: &Report) {
    if report.checks.is_empty() {
        return;
    }
    put!(out, "<section id=\"sanity\">\n<h2>Sanity checks</h2>\n");
    for set in sets(&report.checks) {
        put!(
            out,
            "<h3>{} checks</h3>\n<p>Motions that pass all of them: {}.</p>\n<div class=\"scroll\"><table \
             class=\"checks\">\n<thead><tr><th scope=\"col\">check</th><th scope=\"col\">threshold</th><th \
             scope=\"col\">passed</th><th scope=\"col\" class=\"text\">share</th><th scope=\"col\">worst</th><th \
             scope=\"col\" class=\"text\">what the worst says</th></tr></thead>\n<tbody>\n",
            Escaped(&capitalized(set)),
            Escaped(&Passed::of(report, set).words())
        );
        for line in report.checks.iter().filter(|line| line.set == set) {
            row(out, line);
        }
        put!(out, "</tbody></table></div>\n");
    }
    put!(out, "</section>\n");
}

fn row(out: &mut String, line: &CheckLine) {
    let CheckLine { check, threshold, n, n_passed, worst_value, worst_message, .. } = line;
    let is_passed_by_all = n_passed == n;
    let class = if is_passed_by_all { "good" } else { "bad" };
    put!(
        out,
        "<tr class=\"{class}\"><th scope=\"row\">{}</th><td>{}</td><td>{n_passed} of {n}</td><td \
         class=\"share\">",
        Escaped(&words(check)),
        short(*threshold)
    );
    if *n > 0 {
        let share = *n_passed as f64 / *n as f64;
        put!(
            out,
            "<svg class=\"share-bar\" width=\"{BAR_PX}\" height=\"10\" aria-hidden=\"true\"><rect \
             width=\"{BAR_PX}\" height=\"10\" class=\"rest\"/><rect width=\"{:.1}\" height=\"10\" \
             class=\"part\"/></svg> {}",
            share.min(1.0) * BAR_PX,
            Escaped(&percent(share))
        );
    } else {
        put!(out, "–");
    }
    put!(
        out,
        "</td><td>{}</td><td class=\"text\">{}</td></tr>\n",
        number(*worst_value),
        Escaped(worst_message)
    );
}

/// Returns a text with its first letter as a capital.
fn capitalized(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or_else(String::new, |first| first.to_uppercase().chain(rest).collect())
}

#[cfg(test)]
mod tests {
    use super::super::Metric;
    use super::super::example::{check, metric};
    use super::*;

    fn passed(report: &Report, set: &str) -> String {
        Passed::of(report, set).words()
    }

    #[test]
    fn who_passed_all_is_told_as_exactly_as_it_is_known() {
        let mut report = Report {
            checks: vec![
                check("reference", "phase", 10, 9),
                check("reference", "jerk", 10, 10),
                check("strict", "velocity", 10, 4),
                check("strict", "jerk", 10, 7),
            ],
            ..Report::default()
        };
        assert_eq!(passed(&report, "reference"), "9 of 10 (90 %)");
        assert_eq!(passed(&report, "strict"), "at most 4 of 10 (40 %)");
        assert_eq!(passed(&report, "other"), "not measured");
        let of = |split: &str, rate: f64, n: i64| Metric {
            n,
            ..metric("generated", split, "pass_rate", "strict", Some(rate))
        };
        report.metrics = vec![of("held_out", 0.5, 4), of("all", 0.3, 10)];
        assert_eq!(passed(&report, "strict"), "3 of 10 (30 %)");
    }

    #[test]
    fn sets_are_never_mixed() {
        let checks = ["strict", "mine", "reference", "strict"].map(|set| check(set, "jerk", 4, 3));
        assert_eq!(sets(&checks), ["reference", "strict", "mine"]);
        let report = Report { checks: checks.to_vec(), ..Report::default() };
        let mut out = String::new();
        section(&mut out, &report);
        assert_eq!(out.matches("<table").count(), 3);
        let headings: Vec<&str> = out.split("<h3>").skip(1).map(|rest| &rest[..6]).collect();
        assert_eq!(headings, ["Refere", "Strict", "Mine c"]);
    }

    #[test]
    fn a_check_is_a_row_with_a_bar() {
        let line = CheckLine {
            set: "strict".to_owned(),
            stage: String::new(),
            by_construction: false,
            check: "phase_monotonic".to_owned(),
            threshold: 0.05,
            n: 8,
            n_passed: 6,
            worst_value: f64::INFINITY,
            worst_message: "<b>&\"'".to_owned(),
        };
        let mut out = String::new();
        row(&mut out, &line);
        assert_eq!(
            out,
            "<tr class=\"bad\"><th scope=\"row\">phase monotonic</th><td>0.05</td><td>6 of 8</td><td \
             class=\"share\"><svg class=\"share-bar\" width=\"90\" height=\"10\" \
             aria-hidden=\"true\"><rect width=\"90\" height=\"10\" class=\"rest\"/><rect width=\"67.5\" \
             height=\"10\" class=\"part\"/></svg> 75 %</td><td>inf</td><td \
             class=\"text\">&lt;b&gt;&amp;&quot;&#39;</td></tr>\n"
        );
        out.clear();
        row(&mut out, &CheckLine { n: 0, n_passed: 0, ..line });
        assert!(out.contains("<td class=\"share\">–</td>"));
    }
}
