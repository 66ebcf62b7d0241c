//! This run beside another one.

use super::meaning::is_compat;
use super::names::OWN;
use super::rows::{Row, rows};
use super::{Against, Better, Metric, Report};

/// What two numbers say of each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Verdict {
    Worse,
    Better,
    Differs,
    /// Both differ, and neither has an interval that could tell whether by chance.
    NoInterval,
    Within,
    Equal,
    NotMeasured,
}

impl Verdict {
    pub const fn words(self) -> &'static str {
        match self {
            Self::Worse => "worse",
            Self::Better => "better",
            Self::Differs => "differs",
            Self::NoInterval => "no interval",
            Self::Within => "within the intervals",
            Self::Equal => "equal",
            Self::NotMeasured => "not measured",
        }
    }

    /// Returns whether the numbers differ by more than their intervals.
    pub const fn is_notable(self) -> bool {
        matches!(self, Self::Worse | Self::Better | Self::Differs)
    }
}

/// A number of what was generated, in both runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pair<'a> {
    pub there: &'a Metric,
    pub here: &'a Metric,
    /// Here less there.
    pub difference: Option<f64>,
    pub verdict: Verdict,
}

impl Pair<'_> {
    /// Returns whether the pair counts; published formulas with a defect do not.
    pub fn is_counted(&self) -> bool {
        !is_compat(&self.here.variant)
    }

    /// Returns whether the pair should be seen first.
    pub fn is_notable(&self) -> bool {
        self.verdict.is_notable() && self.is_counted()
    }
}

/// Returns the numbers that both runs have: those that differ first, the worse before the better, and
/// otherwise in the order of the tables.
pub(super) fn pairs<'a>(report: &'a Report, against: &'a Against) -> Vec<Pair<'a>> {
    let there: Vec<Row> = rows(&against.metrics, &[OWN]);
    let counterpart = |here: &Row| {
        let key = |row: &Row<'a>| [row.metric, row.variant, row.split, row.unit];
        let found = there
            .iter()
            .find(|row| key(row) == [here.metric, here.variant, here.split, here.unit])?;
        found.cells[0]
    };
    let mut pairs: Vec<Pair> = rows(&report.metrics, &[OWN])
        .iter()
        .filter_map(|row| Some(pair(counterpart(row)?, row.cells[0]?)))
        .collect();
    pairs.sort_by_key(|pair| {
        (!pair.is_notable(), if pair.is_notable() { pair.verdict } else { Verdict::Within })
    });
    pairs
}

fn pair<'a>(there: &'a Metric, here: &'a Metric) -> Pair<'a> {
    let (Some(a), Some(b)) = (there.finite(), here.finite()) else {
        return Pair { there, here, difference: None, verdict: Verdict::NotMeasured };
    };
    // A number without an interval is a point.
    let (low_a, high_a) = there.interval().unwrap_or((a, a));
    let (low_b, high_b) = here.interval().unwrap_or((b, b));
    let has_interval = there.interval().is_some() || here.interval().is_some();
    let verdict = if a == b {
        Verdict::Equal
    } else if !has_interval {
        Verdict::NoInterval
    } else if low_a <= high_b && low_b <= high_a {
        Verdict::Within
    } else {
        match (here.better, b > a) {
            (Better::Neither, _) => Verdict::Differs,
            (Better::Higher, true) | (Better::Lower, false) => Verdict::Better,
            (Better::Higher, false) | (Better::Lower, true) => Verdict::Worse,
        }
    };
    Pair { there, here, difference: Some(b - a), verdict }
}

/// Returns how many of the pairs that count have each verdict: `4 numbers: 1 worse, 3 better`.
pub(super) fn counts(pairs: &[Pair]) -> String {
    let all = [
        Verdict::Worse,
        Verdict::Better,
        Verdict::Differs,
        Verdict::NoInterval,
        Verdict::Within,
        Verdict::Equal,
        Verdict::NotMeasured,
    ];
    let count = |verdict: Verdict| {
        let is_it = |pair: &&Pair| pair.is_counted() && pair.verdict == verdict;
        let n = pairs.iter().filter(is_it).count();
        (n > 0).then(|| match verdict {
            Verdict::Differs if n > 1 => format!("{n} differ"),
            Verdict::NoInterval => format!("{n} without an interval"),
            _ => format!("{n} {}", verdict.words()),
        })
    };
    let n = pairs.iter().filter(|pair| pair.is_counted()).count();
    let told: Vec<String> = all.into_iter().filter_map(count).collect();
    format!("{n} numbers: {}", told.join(", "))
}

#[cfg(test)]
mod tests {
    use super::super::example::{metric, with_interval};
    use super::*;

    fn of(name: &str, value: f64, interval: Option<(f64, f64)>) -> Metric {
        let plain = metric("generated", "all", name, "", Some(value));
        match interval {
            Some((low, high)) => with_interval(plain, low, high),
            None => plain,
        }
    }

    #[test]
    fn verdicts_follow_intervals_and_which_way_is_better() {
        let near = |x: f64| Some((x - 0.1, x + 0.1));
        let cases = [
            ("pass_rate", (0.5, near(0.5)), (0.6, near(0.6)), Verdict::Within),
            ("pass_rate", (0.5, near(0.5)), (0.8, near(0.8)), Verdict::Better),
            ("pass_rate", (0.8, near(0.8)), (0.5, near(0.5)), Verdict::Worse),
            ("fid_k", (0.8, near(0.8)), (0.5, near(0.5)), Verdict::Better),
            ("fid_k", (0.5, near(0.5)), (0.8, near(0.8)), Verdict::Worse),
            ("diversity", (0.5, near(0.5)), (0.8, near(0.8)), Verdict::Differs),
            ("unheard_of", (0.5, near(0.5)), (0.8, near(0.8)), Verdict::Differs),
            // A point in an interval, and one beyond it.
            ("fid_k", (0.55, None), (0.5, near(0.5)), Verdict::Within),
            ("fid_k", (0.65, None), (0.5, near(0.5)), Verdict::Better),
            ("fid_k", (0.55, None), (0.5, None), Verdict::NoInterval),
            ("fid_k", (0.5, None), (0.5, None), Verdict::Equal),
            // Intervals that are none.
            ("fid_k", (0.55, Some((1.0, 0.0))), (0.5, Some((f64::NAN, 1.0))), Verdict::NoInterval),
        ];
        for (name, there, here, wanted) in cases {
            let (there, here) = (of(name, there.0, there.1), of(name, here.0, here.1));
            assert_eq!(pair(&there, &here).verdict, wanted, "{there:?} {here:?}");
        }
        let (there, here) = (of("fid_k", 0.25, None), of("fid_k", 0.75, None));
        assert_eq!(pair(&there, &here).difference, Some(0.5));
        let none = Metric { value: None, ..here };
        let found = pair(&there, &none);
        assert_eq!((found.difference, found.verdict), (None, Verdict::NotMeasured));
    }

    #[test]
    fn only_what_both_have_is_compared_and_what_differs_comes_first() {
        let near = |x: f64| Some((x - 0.01, x + 0.01));
        let other = |m: Metric, split: &str| Metric { split: split.to_owned(), ..m };
        let here = vec![
            of("locking_r2", 0.5, near(0.5)),
            of("fid_g", 0.5, near(0.5)),
            of("pass_rate", 0.5, near(0.5)),
            of("only_here", 0.5, None),
            other(of("jerk_mean", 0.5, None), "held_out"),
            Metric { variant: "axes_compat".to_owned(), ..of("fid_k", 0.5, near(0.5)) },
            metric("shuffled", "all", "locking_r2", "", Some(0.5)),
        ];
        let there = vec![
            of("locking_r2", 0.5, near(0.5)),
            of("fid_g", 0.9, near(0.9)),
            of("pass_rate", 0.9, near(0.9)),
            of("only_there", 0.5, None),
            other(of("jerk_mean", 0.5, None), "all"),
            Metric { variant: "axes_compat".to_owned(), ..of("fid_k", 0.9, near(0.9)) },
            metric("shuffled", "all", "locking_r2", "", Some(0.7)),
        ];
        let report = Report { metrics: here, ..Report::default() };
        let against = Against { metrics: there, ..Against::default() };
        let pairs = pairs(&report, &against);
        let found: Vec<_> = pairs.iter().map(|p| (p.here.metric.as_str(), p.verdict)).collect();
        let wanted = [
            ("pass_rate", Verdict::Worse),
            ("fid_g", Verdict::Better),
            ("locking_r2", Verdict::Equal),
            ("fid_k", Verdict::Better),
        ];
        assert_eq!(found, wanted);
        assert_eq!(counts(&pairs), "3 numbers: 1 worse, 1 better, 1 equal");
    }
}
