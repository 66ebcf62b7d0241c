//! The head of the page: the verdicts, and what limits them.

use super::html::{Escaped, put};
use super::names::words;
use super::numbers::{MISSING, interval};
use super::verdicts::{VerdictView, measured, shown};
use super::{Outcome, Report, VerdictTest, ordered};

/// Writes the verdicts, lost ones first, and the caveats below them.
pub(super) fn section(out: &mut String, report: &Report) {
    put!(out, "<section id=\"verdicts\" aria-label=\"Verdicts\">\n");
    for verdict in shown(report) {
        one(out, &verdict);
    }
    if !report.notes.is_empty() {
        put!(out, "<ul class=\"notes\">\n");
        for note in &report.notes {
            put!(out, "<li>{}</li>\n", Escaped(note));
        }
        put!(out, "</ul>\n");
    }
    put!(out, "</section>\n");
}

fn one(out: &mut String, verdict: &VerdictView) {
    put!(out, "<article class=\"verdict {}\">\n<h2>", verdict.outcome.name());
    badge(out, verdict.outcome);
    put!(out, " {}", Escaped(&verdict.question));
    if !verdict.songs.is_empty() {
        put!(out, " <small>{}</small>", Escaped(&verdict.songs));
    }
    put!(out, "</h2>\n<p>{}</p>\n", Escaped(&verdict.reason()));
    if !verdict.tests.is_empty() {
        put!(
            out,
            "<details>\n<summary>{}</summary>\n<div class=\"scroll\"><table class=\"tests\">\n<thead><tr><th \
             scope=\"col\">test</th><th scope=\"col\" class=\"text\">outcome</th><th \
             scope=\"col\">value</th><th scope=\"col\">must be</th><th scope=\"col\" class=\"text\">held \
             against</th></tr></thead>\n<tbody>\n",
            verdict.counts()
        );
        for outcome in Outcome::ALL {
            for test in verdict.with(outcome) {
                row(out, test, outcome);
            }
        }
        put!(out, "</tbody></table></div>\n</details>\n");
    }
    put!(out, "</article>\n");
}

/// Writes an outcome as a word with a sign; the colour only repeats it.
fn badge(out: &mut String, outcome: Outcome) {
    let sign = match outcome {
        Outcome::Lost => "✗",
        Outcome::Open => "?",
        Outcome::Won => "✓",
    };
    put!(
        out,
        "<span class=\"badge {}\"><span aria-hidden=\"true\">{sign}</span> {}</span>",
        outcome.name(),
        outcome.word()
    );
}

fn row(out: &mut String, test: &VerdictTest, outcome: Outcome) {
    put!(
        out,
        "<tr><th scope=\"row\">{} <small>{}</small></th><td class=\"word\">",
        Escaped(&words(&test.test)),
        Escaped(&test.statistic)
    );
    badge(out, outcome);
    put!(out, "</td><td>{}", Escaped(&measured(test)));
    let ends = test.finite().and(test.ci_low.zip(test.ci_high));
    if let Some((low, high)) = ends.and_then(|(low, high)| ordered(low, high)) {
        put!(out, " <span class=\"interval\">{}</span>", interval(low, high));
    }
    let wanted = test.wanted();
    let wanted = if wanted.is_empty() { MISSING } else { &wanted };
    put!(
        out,
        "</td><td>{}</td><td class=\"text\">{} <small>{}</small></td></tr>\n",
        Escaped(wanted),
        Escaped(&test.against),
        Escaped(&test.message)
    );
}

#[cfg(test)]
mod tests {
    use super::super::Verdict;
    use super::super::example::{test, verdict};
    use super::*;

    fn panel(verdicts: Vec<Verdict>, notes: &[&str]) -> String {
        let notes = notes.iter().map(|note| (*note).to_owned()).collect();
        let mut out = String::new();
        section(&mut out, &Report { verdicts, notes, ..Report::default() });
        out
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
