//! What changed between two runs.

use super::meaning::{Better, meaning_of, order_of};
use super::{Against, Metric, OWN, Report};

/// How a number compares with that of another run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The intervals overlap.
    Within,
    Better,
    Worse,
    /// Apart, and nobody can say which is better.
    Differs,
    /// One of the two has no interval.
    Unknown,
}

impl Verdict {
    pub const fn text(self) -> &'static str {
        match self {
            Self::Within => "within the intervals",
            Self::Better => "better",
            Self::Worse => "worse",
            Self::Differs => "differs",
            Self::Unknown => "no interval",
        }
    }
}

/// A number of both runs.
pub struct Pair<'a> {
    pub there: &'a Metric,
    pub here: &'a Metric,
    /// `here - there`.
    pub difference: f64,
    pub verdict: Verdict,
}

/// Returns the numbers of generated motion that both runs have.
pub fn pairs<'a>(report: &'a Report, against: &'a Against) -> Vec<Pair<'a>> {
    let own = |metrics: &'a [Metric]| metrics.iter().filter(|m| m.subject == OWN);
    let mut pairs: Vec<Pair> = own(&report.metrics)
        .filter_map(|here| {
            let there = own(&against.metrics).find(|m| {
                (&m.metric, &m.variant, &m.split) == (&here.metric, &here.variant, &here.split)
            })?;
            let difference = here.value? - there.value?;
            Some(Pair { there, here, difference, verdict: verdict(there, here) })
        })
        .collect();
    pairs.sort_by_key(|pair| order_of(&pair.here.metric));
    pairs
}

/// Compares two numbers by their intervals.
pub fn verdict(there: &Metric, here: &Metric) -> Verdict {
    let ends = |m: &Metric| Some((m.ci_low?, m.ci_high?));
    let (Some(there), Some(here_ends)) = (ends(there), ends(here)) else { return Verdict::Unknown };
    if here_ends.0 <= there.1 && there.0 <= here_ends.1 {
        return Verdict::Within;
    }
    let is_higher = here_ends.0 > there.1;
    match (meaning_of(&here.metric).better, is_higher) {
        (Better::AsReal, _) => Verdict::Differs,
        (Better::Higher, true) | (Better::Lower, false) => Verdict::Better,
        _ => Verdict::Worse,
    }
}
