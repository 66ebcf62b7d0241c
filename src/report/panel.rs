//! The head of the page: the verdicts, and what limits them.

use askama::Template;

use super::names::words;
use super::numbers::{MISSING, interval};
use super::verdicts::{VerdictView, measured, shown};
use super::{Outcome, Report, VerdictTest, ordered};

/// The verdicts, lost ones first, and the caveats below them.
#[derive(Template)]
#[template(path = "report/templates/verdicts.html")]
pub(super) struct VerdictsSection<'a> {
    verdicts: Vec<VerdictCard<'a>>,
    notes: &'a [String],
}

/// A verdict with its tests.
struct VerdictCard<'a> {
    outcome: Outcome,
    question: String,
    songs: String,
    reason: String,
    counts: String,
    tests: Vec<TestRow<'a>>,
}

struct TestRow<'a> {
    name: String,
    statistic: &'a str,
    outcome: Outcome,
    measured: String,
    interval: Option<String>,
    wanted: String,
    against: &'a str,
    message: &'a str,
}

impl<'a> VerdictsSection<'a> {
    /// Takes the verdicts and notes of a report.
    pub fn new(report: &'a Report) -> Self {
        let verdicts = shown(report).iter().map(VerdictCard::new).collect();
        Self { verdicts, notes: &report.notes }
    }
}

impl<'a> VerdictCard<'a> {
    fn new(verdict: &VerdictView<'a>) -> Self {
        let tests = Outcome::ALL
            .into_iter()
            .flat_map(|outcome| verdict.with(outcome).into_iter().map(move |test| (test, outcome)))
            .map(|(test, outcome)| TestRow::new(test, outcome))
            .collect();
        Self {
            outcome: verdict.outcome,
            question: verdict.question.clone(),
            songs: verdict.songs.clone(),
            reason: verdict.reason(),
            counts: verdict.counts(),
            tests,
        }
    }
}

impl<'a> TestRow<'a> {
    fn new(test: &'a VerdictTest, outcome: Outcome) -> Self {
        let ends = test.finite().and(test.ci_low.zip(test.ci_high));
        let wanted = test.wanted();
        Self {
            name: words(&test.test),
            statistic: &test.statistic,
            outcome,
            measured: measured(test),
            interval: ends
                .and_then(|(low, high)| ordered(low, high))
                .map(|(low, high)| interval(low, high)),
            wanted: if wanted.is_empty() { MISSING.to_owned() } else { wanted },
            against: &test.against,
            message: &test.message,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Verdict;
    use crate::report::example::{test, verdict};

    fn panel(verdicts: Vec<Verdict>, notes: &[&str]) -> String {
        let notes = notes.iter().map(|note| (*note).to_owned()).collect();
        let report = Report { verdicts, notes, ..Report::default() };
        format!("{}\n", VerdictsSection::new(&report))
    }

    #[test]
    fn a_lost_verdict_says_why_and_shows_its_tests() {
        let lost = VerdictTest {
            ci_low: Some(0.41),
            ci_high: Some(0.62),
            against: "held-out real motion 0.98".to_owned(),
            message: "Head down <b>.".to_owned(),
            ..test("share_upright", Outcome::Lost, 0.515, 0.25)
        };
        let won = test("finite", Outcome::Won, 0.125, 0.25);
        let told = panel(vec![verdict("sound", "validation", Outcome::Won, vec![won, lost])], &[]);
        let (first, _) = told.split_once("</article>").expect("an article");
        assert_eq!(
            first,
            "<section id=\"verdicts\" aria-label=\"Verdicts\">\n<article class=\"verdict lost\">\n<h2><span \
             class=\"badge lost\"><span aria-hidden=\"true\">✗</span> LOST</span> Is it sound? <small>songs \
             that its checkpoints were chosen on</small></h2>\n<p>Head down \
             &lt;b&gt;.</p>\n<details>\n<summary>2 tests: 1 lost, 1 won</summary>\n<div \
             class=\"scroll\"><table class=\"tests\">\n<thead><tr><th scope=\"col\">test</th><th \
             scope=\"col\" class=\"text\">outcome</th><th scope=\"col\">value</th><th scope=\"col\">must \
             be</th><th scope=\"col\" class=\"text\">held against</th></tr></thead>\n<tbody>\n<tr><th \
             scope=\"row\">share upright <small>what is measured</small></th><td class=\"word\"><span \
             class=\"badge lost\"><span aria-hidden=\"true\">✗</span> LOST</span></td><td>0.515 m <span \
             class=\"interval\">[0.41, 0.62]</span></td><td>at most 0.25 m</td><td class=\"text\">held-out \
             real motion 0.98 <small>Head down &lt;b&gt;.</small></td></tr>\n<tr><th scope=\"row\">finite \
             <small>what is measured</small></th><td class=\"word\"><span class=\"badge won\"><span \
             aria-hidden=\"true\">✓</span> won</span></td><td>0.125 m</td><td>at most 0.25 m</td><td \
             class=\"text\"> <small></small></td></tr>\n</tbody></table></div>\n</details>\n"
        );
    }

    #[test]
    fn notes_stand_below_the_verdicts_and_are_not_green() {
        let told = panel(Vec::new(), &["The best of 8 <candidates>.", "Over-locking."]);
        let (verdicts, notes) = told.split_once("<ul class=\"notes\">\n").expect("notes");
        assert_eq!(verdicts.matches("<article class=\"verdict open\">").count(), 4);
        assert_eq!(verdicts.matches("<p>Not measured.</p>").count(), 4);
        assert_eq!(
            notes,
            "<li>The best of 8 &lt;candidates&gt;.</li>\n<li>Over-locking.</li>\n</ul>\n</section>\n"
        );
        assert!(!told.contains("won") && !told.contains("good"));
    }
}
