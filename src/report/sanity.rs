//! Sanity checks: who passed all of a set, and each check with its worst answer.

use askama::Template;

use super::names::{ALL, OWN, words};
use super::numbers::{number, percent, short};
use super::rows::find;
use super::{BY_CONSTRUCTION, CheckLine, Report};

/// The sets that are known, in the order in which they are shown.
pub(super) const SETS: [&str; 2] = ["reference", "strict"];

/// What is checked, in the order in which it is shown: a stage, and which motion that is.
const STAGES: [(&str, &str); 2] =
    [("raw", "decoded motion, before post-processing"), (FINAL, "motion after post-processing")];
/// The stage of tables that do not name one.
pub(super) const FINAL: &str = "final";

/// Width of a bar for all motions, px.
const BAR_PX: f64 = 90.0;

/// How many motions passed every check of a set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum PassCount {
    Exactly {
        n_passed: usize,
        n: usize,
    },
    /// Each check is known, but not whether they failed for the same motions.
    AtMost {
        n_passed: usize,
        n: usize,
    },
    /// Post-processing makes every check of the set true, so that none tells anything.
    ByConstruction,
    NotMeasured,
}

impl PassCount {
    /// Looks for the pass rate of all motions, `strict_raw` of a set at a stage and `strict` of what it
    /// became in the end, then at the checks of the set that could have failed.
    pub fn of(report: &Report, stage: &str, set: &str) -> Self {
        let stage_variant = format!("{set}_{stage}");
        let named = |variant: &str| find(&report.metrics, OWN, ["pass_rate", variant], ALL);
        let rate = named(&stage_variant).or_else(|| named(set).filter(|_| stage == FINAL));
        if let Some((rate, n)) = rate.and_then(|metric| Some((metric.finite()?, metric.n))) {
            let n_passed = (rate * n as f64).round();
            return Self::Exactly {
                n_passed: n_passed as usize,
                n: usize::try_from(n).unwrap_or(0),
            };
        }
        let is_of = |line: &&CheckLine| line.set == set && stage_of(line) == stage;
        let lines = || report.checks.iter().filter(is_of).filter(|line| !line.by_construction);
        let Some(worst) = lines().min_by_key(|line| line.n_passed) else {
            return match report.checks.iter().any(|line| is_of(&line)) {
                true => Self::ByConstruction,
                false => Self::NotMeasured,
            };
        };
        let CheckLine { n_passed, n, .. } = *worst;
        match lines().filter(|line| line.n_passed < line.n).count() {
            0 | 1 => Self::Exactly { n_passed, n },
            _ => Self::AtMost { n_passed, n },
        }
    }

    /// Returns it in a few words: `118 of 120 (98.3 %)`.
    pub fn words(self) -> String {
        let share_text = |n_passed: usize, n: usize| match n {
            0 => format!("{n_passed} of {n}"),
            _ => format!("{n_passed} of {n} ({})", percent(n_passed as f64 / n as f64)),
        };
        match self {
            Self::Exactly { n_passed, n } => share_text(n_passed, n),
            Self::AtMost { n_passed, n } => format!("at most {}", share_text(n_passed, n)),
            Self::ByConstruction => format!("all are true {BY_CONSTRUCTION}"),
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

/// Returns the stage of a check.
pub(super) fn stage_of(line: &CheckLine) -> &str {
    if line.stage.is_empty() { FINAL } else { &line.stage }
}

/// Returns the stages that checks are of: the known ones in their order, then others as they come.
pub(super) fn stages(checks: &[CheckLine]) -> Vec<&str> {
    let mut found: Vec<&str> = Vec::new();
    for stage in checks.iter().map(stage_of) {
        if !found.contains(&stage) {
            found.push(stage);
        }
    }
    let place = |stage: &str| STAGES.iter().position(|(name, _)| *name == stage);
    found.sort_by_key(|stage| place(stage).unwrap_or(STAGES.len()));
    found
}

/// Returns the checks of a set at a stage.
pub(super) fn lines<'a>(
    report: &'a Report,
    stage: &'a str,
    set: &'a str,
) -> impl Iterator<Item = &'a CheckLine> {
    report.checks.iter().filter(move |line| line.set == set && stage_of(line) == stage)
}

/// A table for each set of checks, of each stage.
#[derive(Template)]
#[template(path = "report/templates/sanity.html")]
pub(super) struct SanitySection<'a> {
    /// Whether post-processing makes a check true.
    has_moot: bool,
    tables: Vec<CheckTable<'a>>,
}

struct CheckTable<'a> {
    set: String,
    stage: String,
    /// Which motion the stage is.
    motion: &'static str,
    passed: String,
    rows: Vec<CheckRow<'a>>,
}

struct CheckRow<'a> {
    class: &'static str,
    name: String,
    threshold: String,
    n_passed: usize,
    n: usize,
    is_moot: bool,
    /// None where nothing was checked.
    bar: Option<ShareBar>,
    worst_value: String,
    worst_message: &'a str,
}

struct ShareBar {
    whole_px: f64,
    part_px: String,
    share: String,
}

impl<'a> SanitySection<'a> {
    /// Takes the checks of a report; none where there are none.
    pub fn new(report: &'a Report) -> Option<Self> {
        if report.checks.is_empty() {
            return None;
        }
        let mut tables = Vec::new();
        for stage in stages(&report.checks) {
            let known = STAGES.iter().find(|(name, _)| *name == stage);
            for set in sets(&report.checks) {
                let rows: Vec<CheckRow> = lines(report, stage, set).map(CheckRow::new).collect();
                if rows.is_empty() {
                    continue;
                }
                tables.push(CheckTable {
                    set: capitalized(set),
                    stage: words(stage),
                    motion: known.map_or("", |(_, motion)| motion),
                    passed: PassCount::of(report, stage, set).words(),
                    rows,
                });
            }
        }
        let has_moot = report.checks.iter().any(|line| line.by_construction);
        Some(Self { has_moot, tables })
    }
}

impl<'a> CheckRow<'a> {
    fn new(line: &'a CheckLine) -> Self {
        let CheckLine { check, threshold, n, n_passed, worst_value, worst_message, .. } = line;
        let share = *n_passed as f64 / *n as f64;
        Self {
            class: match (n_passed == n, line.by_construction) {
                // A failure of what should be true by construction is one all the same.
                (false, _) => "bad",
                (true, true) => "moot",
                (true, false) => "good",
            },
            name: words(check),
            threshold: short(*threshold),
            n_passed: *n_passed,
            n: *n,
            is_moot: line.by_construction,
            bar: (*n > 0).then(|| ShareBar {
                whole_px: BAR_PX,
                part_px: format!("{:.1}", share.min(1.0) * BAR_PX),
                share: percent(share),
            }),
            worst_value: number(*worst_value),
            worst_message,
        }
    }
}

/// Returns a text with its first letter as a capital.
fn capitalized(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or_else(String::new, |first| first.to_uppercase().chain(rest).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Metric;
    use crate::report::example::{check, metric};

    fn told(report: &Report) -> String {
        SanitySection::new(report).expect("checks").to_string()
    }

    fn passed(report: &Report, set: &str) -> String {
        PassCount::of(report, "final", set).words()
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
        let pass_rate = |split: &str, rate: f64, n: i64| Metric {
            n,
            ..metric("generated", split, "pass_rate", "strict", Some(rate))
        };
        report.metrics = vec![pass_rate("held_out", 0.5, 4), pass_rate("all", 0.3, 10)];
        assert_eq!(passed(&report, "strict"), "3 of 10 (30 %)");
        // The rate of what came out in the end says nothing of what was decoded.
        assert_eq!(PassCount::of(&report, "raw", "strict"), PassCount::NotMeasured);
        let rate = metric("generated", "all", "pass_rate", "strict_raw", Some(0.25));
        report.metrics.push(Metric { n: 8, ..rate });
        assert_eq!(PassCount::of(&report, "raw", "strict").words(), "2 of 8 (25 %)");
        assert_eq!(passed(&report, "strict"), "3 of 10 (30 %)");
    }

    #[test]
    fn what_is_so_by_construction_counts_in_no_pass_rate_and_is_not_green() {
        let given = |check: CheckLine| CheckLine { by_construction: true, ..check };
        let mut report = Report {
            checks: vec![
                given(check("strict", "velocity", 10, 10)),
                check("strict", "jerk", 10, 7),
                given(check("reference", "phase", 10, 10)),
            ],
            ..Report::default()
        };
        assert_eq!(passed(&report, "strict"), "7 of 10 (70 %)");
        assert_eq!(passed(&report, "reference"), "all are true by construction");
        let mut out = told(&report);
        assert!(out.contains("marked “by construction” and counts in no pass rate"));
        assert!(out.contains(
            "<tr class=\"moot\"><th scope=\"row\">velocity</th><td>404</td><td>10 of 10</td><td \
             class=\"share\">by construction</td>"
        ));
        assert!(!out.contains("class=\"good\""), "{out}");
        // Unless it fails.
        report.checks[0].n_passed = 9;
        out = told(&report);
        assert!(out.contains("<tr class=\"bad\"><th scope=\"row\">velocity</th>"), "{out}");
        assert_eq!(passed(&report, "strict"), "7 of 10 (70 %)");
    }

    #[test]
    fn stages_are_never_mixed() {
        let at = |stage: &str, n_passed| CheckLine {
            stage: stage.to_owned(),
            ..check("strict", "jerk", 9, n_passed)
        };
        let checks = vec![at("", 9), at("draft", 1), at("raw", 2), at("final", 8)];
        assert_eq!(stages(&checks), ["raw", "final", "draft"]);
        let report = Report { checks, ..Report::default() };
        let passed = ["raw", "final", "draft", "other"]
            .map(|stage| PassCount::of(&report, stage, "strict").words());
        assert_eq!(
            passed,
            ["2 of 9 (22.2 %)", "8 of 9 (88.9 %)", "1 of 9 (11.1 %)", "not measured"]
        );
        let out = told(&report);
        let headings: Vec<&str> =
            out.split("<h3>").skip(1).filter_map(|rest| rest.split("</h3>").next()).collect();
        assert_eq!(
            headings,
            [
                "Strict checks, raw <small>decoded motion, before post-processing</small>",
                "Strict checks, final <small>motion after post-processing</small>",
                "Strict checks, draft <small></small>"
            ]
        );
    }

    #[test]
    fn sets_are_never_mixed() {
        let checks = ["strict", "mine", "reference", "strict"].map(|set| check(set, "jerk", 4, 3));
        assert_eq!(sets(&checks), ["reference", "strict", "mine"]);
        let report = Report { checks: checks.to_vec(), ..Report::default() };
        let out = told(&report);
        assert_eq!(out.matches("<table").count(), 3);
        let headings: Vec<&str> = out.split("<h3>").skip(1).map(|rest| &rest[..6]).collect();
        assert_eq!(headings, ["Refere", "Strict", "Mine c"]);
    }

    #[test]
    fn a_check_is_a_row_with_a_bar() {
        let line = CheckLine {
            set: "strict".to_owned(),
            check: "phase_monotonic".to_owned(),
            threshold: 0.05,
            n: 8,
            n_passed: 6,
            worst_value: f64::INFINITY,
            worst_message: "<b>&\"'".to_owned(),
            ..CheckLine::default()
        };
        let row_of = |line: &CheckLine| {
            let out = told(&Report { checks: vec![line.clone()], ..Report::default() });
            let (_, rows) = out.split_once("<tbody>\n").expect("a table");
            rows.split_once("</tbody>").expect("its end").0.to_owned()
        };
        assert_eq!(
            row_of(&line),
            "<tr class=\"bad\"><th scope=\"row\">phase monotonic</th><td>0.05</td><td>6 of 8</td><td \
             class=\"share\"><svg class=\"share-bar\" width=\"90\" height=\"10\" \
             aria-hidden=\"true\"><rect width=\"90\" height=\"10\" class=\"rest\"/><rect width=\"67.5\" \
             height=\"10\" class=\"part\"/></svg> 75 %</td><td>inf</td><td \
             class=\"text\">&lt;b&gt;&amp;&quot;&#39;</td></tr>\n"
        );
        let nothing = row_of(&CheckLine { n: 0, n_passed: 0, ..line });
        assert!(nothing.contains("<td class=\"share\">–</td>"));
    }
}
