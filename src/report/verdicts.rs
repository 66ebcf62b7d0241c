//! The verdicts as both pages show them: lost ones first, then open ones, then won ones.

use super::meaning::{OF_GROUPS, VERDICTS};
use super::names::{songs, split_order, words};
use super::numbers::{short, value};
use super::{Outcome, Report, Verdict, VerdictTest};

/// Stands for the tests of a verdict that has none.
const NOT_MEASURED: &str = "not measured";

impl Outcome {
    /// Returns the word that is shown; it alone tells the outcome, without any colour.
    pub(super) const fn word(self) -> &'static str {
        match self {
            Self::Lost => "LOST",
            Self::Open | Self::Won => self.name(),
        }
    }

    /// Returns the sign that stands before the word.
    pub(super) const fn sign(self) -> &'static str {
        match self {
            Self::Lost => "✗",
            Self::Open => "?",
            Self::Won => "✓",
        }
    }
}

impl VerdictTest {
    /// Returns the outcome; a win without a number that it rests on is none.
    pub(super) fn settled(&self) -> Outcome {
        match self.outcome {
            Outcome::Won if self.finite().is_none() => Outcome::Open,
            outcome => outcome,
        }
    }

    pub(super) fn finite(&self) -> Option<f64> {
        self.value.filter(|x| x.is_finite())
    }

    /// Returns what the value must be: `at most 0.05 m`.
    pub(super) fn wanted(&self) -> String {
        let limit = self.limit.map_or_else(String::new, short);
        [self.rule.as_str(), &limit, &self.unit].map(str::trim).join(" ").trim().to_owned()
    }

    /// Returns the message, or where there is none a sentence of the parts.
    pub(super) fn sentence(&self) -> String {
        if !self.message.is_empty() {
            return self.message.clone();
        }
        let value = self.finite().map_or_else(|| NOT_MEASURED.to_owned(), short);
        format!("{} {value}, wanted {}", self.statistic, self.wanted()).trim().to_owned()
    }

    /// Returns how far the value is beyond its limit, from 0 to 2, whatever the unit: the distance over the
    /// greater size of the two. 0 where either is missing.
    fn miss(&self) -> f64 {
        let (Some(value), Some(limit)) = (self.finite(), self.limit.filter(|x| x.is_finite()))
        else {
            return 0.0;
        };
        let size = value.abs().max(limit.abs());
        if size > 0.0 { (value / size - limit / size).abs() } else { 0.0 }
    }
}

impl Verdict {
    /// Returns the outcome that all tests bear out: lost by one that is lost, and won only where there are
    /// tests and every one of them is won.
    pub(super) fn settled(&self) -> Outcome {
        let has = |outcome| self.tests.iter().any(|test| test.settled() == outcome);
        if self.outcome == Outcome::Lost || has(Outcome::Lost) {
            Outcome::Lost
        } else if self.outcome == Outcome::Open || has(Outcome::Open) || self.tests.is_empty() {
            Outcome::Open
        } else {
            Outcome::Won
        }
    }
}

/// A verdict as it is shown.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct VerdictView<'a> {
    pub outcome: Outcome,
    /// The question in plain words.
    pub question: String,
    /// Which songs it is about; empty for a verdict that is missing.
    pub songs: String,
    pub tests: &'a [VerdictTest],
}

impl<'a> VerdictView<'a> {
    fn of(verdict: &'a Verdict) -> Self {
        Self {
            outcome: verdict.settled(),
            question: question(&verdict.verdict),
            songs: songs(&verdict.split),
            tests: &verdict.tests,
        }
    }

    /// Returns the tests that ended in one way: lost ones the worst first, others as they come.
    pub fn with(&self, outcome: Outcome) -> Vec<&'a VerdictTest> {
        let mut found: Vec<&VerdictTest> =
            self.tests.iter().filter(|test| test.settled() == outcome).collect();
        if outcome == Outcome::Lost {
            found.sort_by(|a, b| b.miss().total_cmp(&a.miss()));
        }
        found
    }

    /// Returns how many tests there are and how they ended: `5 tests: 2 lost, 3 won`.
    pub fn counts(&self) -> String {
        if self.tests.is_empty() {
            return NOT_MEASURED.to_owned();
        }
        let count = |outcome: Outcome| {
            let n = self.with(outcome).len();
            (n > 0).then(|| format!("{n} {}", outcome.name()))
        };
        let told: Vec<String> = Outcome::ALL.into_iter().filter_map(count).collect();
        let tests = if self.tests.len() == 1 { "test" } else { "tests" };
        format!("{} {tests}: {}", self.tests.len(), told.join(", "))
    }

    /// Returns the sentence that says why: of the worst test where the verdict is lost, of the first open
    /// one where it is open.
    pub fn reason(&self) -> String {
        if self.outcome == Outcome::Won {
            return match self.tests.len() {
                1 => "The test that it rests on holds.".to_owned(),
                n => format!("All {n} tests that it rests on hold."),
            };
        }
        match (self.with(self.outcome).first(), self.outcome) {
            (Some(test), _) => test.sentence(),
            (None, Outcome::Lost) => "None of its tests says why.".to_owned(),
            (None, _) if self.tests.is_empty() => "Not measured.".to_owned(),
            (None, _) => "Not enough was measured to tell.".to_owned(),
        }
    }
}

fn question(verdict: &str) -> String {
    let known = VERDICTS.into_iter().chain([OF_GROUPS]).find(|(name, _)| *name == verdict);
    known.map_or_else(|| words(verdict), |(_, section)| section.heading().to_owned())
}

/// Returns the verdicts in the order in which they are shown; of those that every run has, a missing one is
/// open.
pub(super) fn shown(report: &Report) -> Vec<VerdictView<'_>> {
    let order = |name: &str| {
        VERDICTS.iter().position(|(known, _)| *known == name).unwrap_or(VERDICTS.len())
    };
    let is_missing = |name: &&str| report.verdicts.iter().all(|found| found.verdict != **name);
    let missing = VERDICTS.iter().map(|(name, _)| *name).filter(is_missing).map(|name| {
        let (question, songs) = (question(name), String::new());
        (order(name), 0, VerdictView { outcome: Outcome::Open, question, songs, tests: &[] })
    });
    let measured = report.verdicts.iter().map(|verdict| {
        (order(&verdict.verdict), split_order(&verdict.split), VerdictView::of(verdict))
    });
    let mut all: Vec<(usize, usize, VerdictView)> = measured.chain(missing).collect();
    let rank = |outcome| Outcome::ALL.iter().position(|known| *known == outcome);
    all.sort_by_key(|(verdict, split, shown)| (rank(shown.outcome), *verdict, *split));
    all.into_iter().map(|(.., shown)| shown).collect()
}

/// Returns the value of a test with its unit, as a table has it.
pub(super) fn measured(test: &VerdictTest) -> String {
    format!("{} {}", value(test.value), test.unit).trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::{test, verdict};
    use Outcome::{Lost, Open, Won};

    #[test]
    fn a_verdict_is_won_only_where_every_test_is() {
        let settled_outcome = |outcome: Outcome, tests: &[Outcome]| {
            let tests = tests.iter().map(|outcome| test("t", *outcome, 0.5, 1.0)).collect();
            verdict("varied", "all", outcome, tests).settled()
        };
        let cases: [(Outcome, &[Outcome], Outcome); 9] = [
            (Won, &[Won, Won], Won),
            (Won, &[Won, Open], Open),
            (Won, &[Won, Lost], Lost),
            (Won, &[], Open),
            (Open, &[Won], Open),
            (Open, &[Lost], Lost),
            (Open, &[], Open),
            (Lost, &[Won], Lost),
            (Lost, &[], Lost),
        ];
        for (outcome, tests, wanted) in cases {
            assert_eq!(settled_outcome(outcome, tests), wanted, "{outcome:?} {tests:?}");
        }
        // A win that rests on no number.
        for value in [None, Some(f64::NAN)] {
            let empty = VerdictTest { value, ..test("t", Won, 0.0, 1.0) };
            assert_eq!(empty.settled(), Open);
            assert_eq!(verdict("varied", "all", Won, vec![empty]).settled(), Open);
        }
    }

    #[test]
    fn what_is_lost_comes_first_and_what_is_missing_is_open() {
        let won =
            |name: &str, split: &str| verdict(name, split, Won, vec![test("t", Won, 0.5, 1.0)]);
        let lost =
            |name: &str, split: &str| verdict(name, split, Lost, vec![test("t", Lost, 2.0, 1.0)]);
        let report = Report {
            verdicts: vec![
                won("sound", "all"),
                won("news_item", "held_out"),
                lost("follows_music", "trained_on"),
                lost("follows_music", "held_out"),
                lost("like_real", "unknown"),
            ],
            ..Report::default()
        };
        let found: Vec<String> = shown(&report)
            .iter()
            .map(|shown| format!("{} {} {}", shown.outcome.word(), shown.question, shown.songs))
            .collect();
        let wanted = [
            "LOST Is it like real motion? nobody knows whether these songs were learned from",
            "LOST Does it follow its music? songs that nothing was learned from",
            "LOST Does it follow its music? songs that it was trained on",
            "open Is it varied? ",
            "won Is it sound? all songs of the run",
            "won news item songs that nothing was learned from",
        ];
        assert_eq!(found, wanted);
        let empty = Report::default();
        let all: Vec<_> = shown(&empty).iter().map(|s| (s.outcome, s.counts())).collect();
        assert_eq!(all, vec![(Open, "not measured".to_owned()); 4]);
    }

    #[test]
    fn the_reason_is_that_of_the_worst_test() {
        let reason_for =
            |outcome, tests| VerdictView::of(&verdict("sound", "all", outcome, tests)).reason_of();
        let said = |text: &str, test: VerdictTest| VerdictTest { message: text.to_owned(), ..test };
        let tests = vec![
            said("A little over.", test("a", Lost, 1.1, 1.0)),
            said("Holds.", test("b", Won, 0.5, 1.0)),
            said("Of the wrong sign.", test("c", Lost, -0.2, 0.5)),
            said("By orders.", test("d", Lost, 1e6, 1.0)),
            said("Nothing known.", VerdictTest { limit: None, ..test("e", Lost, 9.0, 1.0) }),
            said("Too few.", VerdictTest { value: None, ..test("f", Open, 0.0, 1.0) }),
        ];
        let (reason, counts, order) = reason_for(Lost, tests);
        assert_eq!(reason, "Of the wrong sign.");
        assert_eq!(counts, "6 tests: 4 lost, 1 open, 1 won");
        assert_eq!(order, ["c", "d", "a", "e"]);

        let empty = VerdictTest { value: None, ..test("f", Open, 0.0, 0.25) };
        let (reason, counts, _) = reason_for(Won, vec![test("b", Won, 0.5, 1.0), empty]);
        assert_eq!(reason, "what is measured not measured, wanted at most 0.25 m");
        assert_eq!(counts, "2 tests: 1 open, 1 won");
        let won = || test("b", Won, 0.5, 1.0);
        assert_eq!(reason_for(Won, vec![won(), won()]).0, "All 2 tests that it rests on hold.");
        let (reason, counts, _) = reason_for(Won, vec![won()]);
        assert_eq!(reason, "The test that it rests on holds.");
        assert_eq!(counts, "1 test: 1 won");
        assert_eq!(reason_for(Lost, vec![won()]).0, "None of its tests says why.");
        assert_eq!(reason_for(Open, vec![won()]).0, "Not enough was measured to tell.");
        assert_eq!(reason_for(Won, Vec::new()).0, "Not measured.");
    }

    impl VerdictView<'_> {
        /// Returns the reason, the counts and the names of the tests that are lost.
        fn reason_of(&self) -> (String, String, Vec<String>) {
            let lost = self.with(Lost).iter().map(|test| test.test.clone()).collect();
            (self.reason(), self.counts(), lost)
        }
    }

    #[test]
    fn outcomes_have_names_in_tables() {
        for outcome in Outcome::ALL {
            assert_eq!(Outcome::named(outcome.name()), Some(outcome));
        }
        assert_eq!([Won, Lost, Open].map(Outcome::name), ["won", "lost", "open"]);
        assert_eq!(Outcome::named("LOST"), None);
        assert_eq!(Outcome::default(), Open);
    }
}
