//! This run beside another one.

use super::meaning::is_compat;
use super::names::OWN;
use super::rows::{Row, rows};
use super::{BetterDirection, ComparedRun, Metric, PairedNumber, Report};

/// A paired difference with a lower p, adjusted by Holm, is not put down to chance.
pub(super) const SIGNIFICANT_P: f64 = 0.05;

/// The outcome of comparing two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Change {
    Worse,
    Better,
    Differs,
    /// Paired, and chance may give such a difference.
    NotShown,
    /// Both differ, and no pairing by song tells whether by chance.
    NotPaired,
    Equal,
    NotMeasured,
}

impl Change {
    const ALL: [Self; 7] = [
        Self::Worse,
        Self::Better,
        Self::Differs,
        Self::NotShown,
        Self::NotPaired,
        Self::Equal,
        Self::NotMeasured,
    ];

    pub const fn words(self) -> &'static str {
        match self {
            Self::Worse => "worse",
            Self::Better => "better",
            Self::Differs => "differs",
            Self::NotShown => "no difference shown",
            Self::NotPaired => "not paired",
            Self::Equal => "equal",
            Self::NotMeasured => "not measured",
        }
    }

    /// Returns whether the numbers are shown to differ.
    pub const fn is_notable(self) -> bool {
        matches!(self, Self::Worse | Self::Better | Self::Differs)
    }
}

/// A number of what was generated, in both runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pair<'a> {
    pub there: &'a Metric,
    pub here: &'a Metric,
    /// The difference song by song, of a number that has it.
    pub paired: Option<&'a PairedNumber>,
    /// Here less there: the mean over songs where they are paired.
    pub difference: Option<f64>,
    pub change: Change,
}

impl Pair<'_> {
    /// Returns whether the pair counts; published formulas with a defect do not.
    pub fn is_counted(&self) -> bool {
        !is_compat(&self.here.variant)
    }

    /// Returns whether the pair should be seen first.
    pub fn is_notable(&self) -> bool {
        self.change.is_notable() && self.is_counted()
    }
}

/// Returns the numbers that both runs have: those that differ first, the worse before the better, and
/// otherwise in the order of the tables.
pub(super) fn pairs<'a>(report: &'a Report, against: &'a ComparedRun) -> Vec<Pair<'a>> {
    let there: Vec<Row> = rows(&against.metrics, &[OWN]);
    let counterpart = |here: &Row| {
        let key = |row: &Row<'a>| [row.metric, row.variant, row.split, row.unit];
        let found = there
            .iter()
            .find(|row| key(row) == [here.metric, here.variant, here.split, here.unit])?;
        found.cells[0]
    };
    let paired = |here: &Metric| {
        let is_it = |paired: &&PairedNumber| {
            paired.metric == here.metric
                && paired.variant == here.variant
                && paired.split == here.split
        };
        against.paired.iter().find(is_it).filter(|paired| paired.difference.is_finite())
    };
    let mut pairs: Vec<Pair> = rows(&report.metrics, &[OWN])
        .iter()
        .filter_map(|row| Some((counterpart(row)?, row.cells[0]?)))
        .map(|(there, here)| pair(there, here, paired(here)))
        .collect();
    pairs.sort_by_key(|pair| {
        (!pair.is_notable(), if pair.is_notable() { pair.change } else { Change::NotShown })
    });
    pairs
}

fn pair<'a>(there: &'a Metric, here: &'a Metric, paired: Option<&'a PairedNumber>) -> Pair<'a> {
    let (Some(a), Some(b)) = (there.finite(), here.finite()) else {
        let change = Change::NotMeasured;
        return Pair { there, here, paired: None, difference: None, change };
    };
    let difference = paired.map_or(b - a, |paired| paired.difference);
    let change = match paired {
        _ if difference == 0.0 && a == b => Change::Equal,
        None => Change::NotPaired,
        Some(paired) if difference == 0.0 || !is_significant(paired) => Change::NotShown,
        Some(_) => match (here.better, difference > 0.0) {
            (BetterDirection::Neither, _) => Change::Differs,
            (BetterDirection::Higher, true) | (BetterDirection::Lower, false) => Change::Better,
            (BetterDirection::Higher, false) | (BetterDirection::Lower, true) => Change::Worse,
        },
    };
    Pair { there, here, paired, difference: Some(difference), change }
}

fn is_significant(paired: &PairedNumber) -> bool {
    paired.p_holm.is_some_and(|p| p < SIGNIFICANT_P)
}

/// Returns how many of the pairs that count changed in each way: `4 numbers: 1 worse, 3 better`.
pub(super) fn counts(pairs: &[Pair]) -> String {
    let count = |change: Change| {
        let is_it = |pair: &&Pair| pair.is_counted() && pair.change == change;
        let n = pairs.iter().filter(is_it).count();
        (n > 0).then(|| match change {
            Change::Differs if n > 1 => format!("{n} differ"),
            Change::NotShown => format!("{n} with {}", change.words()),
            _ => format!("{n} {}", change.words()),
        })
    };
    let n = pairs.iter().filter(|pair| pair.is_counted()).count();
    let told: Vec<String> = Change::ALL.into_iter().filter_map(count).collect();
    format!("{n} numbers: {}", told.join(", "))
}

/// Returns what the words of a comparison rest on.
pub(super) fn family(against: &ComparedRun) -> String {
    let n = against.paired.iter().filter(|paired| paired.p_holm.is_some()).count();
    match n {
        0 => "No number is paired song by song, so that none is called better or worse".to_owned(),
        1 => format!(
            "1 number is compared song by song; it is called better, worse or different only where p is \
             below {SIGNIFICANT_P}"
        ),
        n => format!(
            "{n} numbers are compared song by song, and p is Holm's over all of them; one is called better, \
             worse or different only where p is below {SIGNIFICANT_P}"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::{metric, with_interval};

    fn of(name: &str, value: f64) -> Metric {
        metric("generated", "all", name, "", Some(value))
    }

    fn by_song(name: &str, difference: f64, p_holm: Option<f64>) -> PairedNumber {
        PairedNumber {
            metric: name.to_owned(),
            split: "all".to_owned(),
            difference,
            p_holm,
            n_songs: 7,
            ..PairedNumber::default()
        }
    }

    #[test]
    fn a_change_needs_a_pair_that_chance_does_not_give() {
        let cases = [
            ("pass_rate", 0.3, Some(0.04), Change::Better),
            ("pass_rate", -0.3, Some(0.04), Change::Worse),
            ("fid_k", -0.3, Some(0.04), Change::Better),
            ("fid_k", 0.3, Some(0.04), Change::Worse),
            ("diversity", 0.3, Some(0.04), Change::Differs),
            ("coupling_ratio", 0.3, Some(0.04), Change::Differs),
            ("unheard_of", 0.3, Some(0.04), Change::Differs),
            ("fid_k", -0.3, Some(0.05), Change::NotShown),
            ("fid_k", -0.3, Some(f64::NAN), Change::NotShown),
            ("fid_k", -0.3, None, Change::NotShown),
            ("fid_k", 0.0, Some(0.01), Change::NotShown),
        ];
        for (name, difference, p, wanted) in cases {
            let (there, here) = (of(name, 0.5), of(name, 0.9));
            let paired = by_song(name, difference, p);
            let found = pair(&there, &here, Some(&paired));
            assert_eq!(found.change, wanted, "{name} {difference} {p:?}");
            assert_eq!(found.difference, Some(difference));
        }
        // However far apart the intervals are.
        let (there, here) = (of("fid_k", 0.25), with_interval(of("fid_k", 0.75), 0.74, 0.76));
        let apart = pair(&there, &here, None);
        assert_eq!((apart.change, apart.difference), (Change::NotPaired, Some(0.5)));
        assert_eq!(pair(&there, &there, None).change, Change::Equal);
        let none = Metric { value: None, ..here };
        let paired = by_song("fid_k", 0.5, Some(0.01));
        let found = pair(&there, &none, Some(&paired));
        assert_eq!((found.difference, found.change), (None, Change::NotMeasured));
    }

    #[test]
    fn only_what_both_have_is_compared_and_what_differs_comes_first() {
        let other = |m: Metric, split: &str| Metric { split: split.to_owned(), ..m };
        let compat = |value| Metric { variant: "axes_compat".to_owned(), ..of("fid_k", value) };
        let here = vec![
            of("locking_r2", 0.5),
            of("fid_g", 0.5),
            of("pass_rate", 0.5),
            of("only_here", 0.5),
            other(of("jerk_mean", 0.5), "held_out"),
            of("jerk_p95", 0.5),
            compat(0.5),
            metric("shuffled", "all", "locking_r2", "", Some(0.5)),
        ];
        let there = vec![
            of("locking_r2", 0.5),
            of("fid_g", 0.9),
            of("pass_rate", 0.9),
            of("only_there", 0.5),
            other(of("jerk_mean", 0.5), "all"),
            of("jerk_p95", 0.9),
            compat(0.9),
            metric("shuffled", "all", "locking_r2", "", Some(0.7)),
        ];
        let report = Report { metrics: here, ..Report::default() };
        let elsewhere =
            PairedNumber { split: "held_out".to_owned(), ..by_song("jerk_p95", 1.0, None) };
        let compat = PairedNumber {
            variant: "axes_compat".to_owned(),
            ..by_song("fid_k", -0.4, Some(0.01))
        };
        let paired = vec![
            by_song("fid_g", -0.4, Some(0.01)),
            by_song("pass_rate", -0.4, Some(0.02)),
            PairedNumber { p_holm: Some(0.01), ..elsewhere },
            by_song("locking_r2", 0.0, None),
            compat,
        ];
        let against = ComparedRun { metrics: there, paired, ..ComparedRun::default() };
        let pairs = pairs(&report, &against);
        let found: Vec<_> = pairs.iter().map(|p| (p.here.metric.as_str(), p.change)).collect();
        let wanted = [
            ("pass_rate", Change::Worse),
            ("fid_g", Change::Better),
            ("locking_r2", Change::Equal),
            ("fid_k", Change::Better),
            ("jerk_p95", Change::NotPaired),
        ];
        assert_eq!(found, wanted);
        assert_eq!(counts(&pairs), "4 numbers: 1 worse, 1 better, 1 not paired, 1 equal");
        assert_eq!(
            family(&against),
            "4 numbers are compared song by song, and p is Holm's over all of them; one is called better, \
             worse or different only where p is below 0.05"
        );
        let none = ComparedRun::default();
        assert!(family(&none).ends_with("so that none is called better or worse"));
    }
}
