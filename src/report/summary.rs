//! A report in a few sentences, each with the numbers that it rests on.

use super::Report;
use super::names::{CONTROL, HELD_OUT, HELD_OUT_TRUTH, OWN};
use super::numbers::short;
use super::rows::{find, telling_split};
use super::sanity::{Passed, SETS};

/// Locking with a lower p is not put down to chance.
const SIGNIFICANT_P: f64 = 0.01;
/// Which locking is told: with one fit for a song, which is the strict one, or else for a phrase.
const LOCKING: [&str; 2] = ["per_song", "per_phrase"];
/// Fréchet distances that are told.
const FRECHET: [[&str; 2]; 2] = [["fid_k", "axes"], ["fid_g", ""]];

const NOT_MEASURED: &str = "not measured";

/// What a sentence says of the motions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tone {
    Good,
    Bad,
    /// Too little was measured to say.
    Open,
    /// Numbers to judge for oneself.
    Plain,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sentence {
    pub tone: Tone,
    pub text: String,
}

/// Returns what there is to say.
pub(super) fn in_short(report: &Report) -> [Sentence; 3] {
    [soundness(report), locking(report), realism(report)]
}

fn soundness(report: &Report) -> Sentence {
    let [reference, strict] = SETS.map(|set| Passed::of(report, set).words());
    let text = format!(
        "Motions that pass every reference check: {reference}; every strict check: {strict}."
    );
    Sentence { tone: Tone::Plain, text }
}

/// Whether motion follows the bar, which is so only where it does not follow that of other music.
fn locking(report: &Report) -> Sentence {
    let is_there = |variant: &&str| {
        report.metrics.iter().any(|m| m.metric == "locking_p" && m.variant == **variant)
    };
    let variant = LOCKING.into_iter().find(is_there).unwrap_or(LOCKING[0]);
    let split = telling_split(&report.metrics, ["locking_p", variant]);
    let value = |subject: &str, metric: &str| {
        // A number of other music would be no control.
        let found = find(&report.metrics, subject, [metric, variant], split);
        found.filter(|found| found.split == split).and_then(|found| found.finite())
    };
    let music =
        if split == HELD_OUT { "music that the model did not learn from" } else { "its music" };
    let is_locked = |subject: &str| value(subject, "locking_p").map(|p| p < SIGNIFICANT_P);
    let (tone, text) = match (is_locked(OWN), is_locked(CONTROL)) {
        (None, _) => (Tone::Open, format!("Whether motion follows the bar of {music} is open")),
        (Some(false), _) => {
            (Tone::Bad, format!("Motion is not shown to follow the bar of {music}"))
        }
        (Some(true), Some(false)) => (Tone::Good, format!("Motion follows the bar of {music}")),
        (Some(true), Some(true)) => (
            Tone::Bad,
            format!(
                "Motion is locked to the bar of {music}, but to that of other songs as well, so it does not \
                 follow this music"
            ),
        ),
        (Some(true), None) => (
            Tone::Open,
            format!(
                "Motion is locked to the bar of {music}, but there is no control to hold it against"
            ),
        ),
    };
    let numbers = |subject: &str| {
        let of = |metric| value(subject, metric).map_or_else(|| NOT_MEASURED.to_owned(), short);
        let [r2, wrong, p] = ["locking_r2", "locking_wrong_r2", "locking_p"].map(of);
        if [&r2, &wrong, &p].into_iter().all(|text| text == NOT_MEASURED) {
            return NOT_MEASURED.to_owned();
        }
        format!("R² {r2}, at wrong tempi {wrong}, p {p}")
    };
    let (own, control) = (numbers(OWN), numbers(CONTROL));
    let text = format!("{text} ({own}; with the music of other songs {control}).");
    Sentence { tone, text }
}

/// How far motion is from real motion, beside other real motion.
fn realism(report: &Report) -> Sentence {
    let of = |name: [&str; 2]| {
        let split = telling_split(&report.metrics, name);
        let [own, truth] = [OWN, HELD_OUT_TRUTH].map(|subject| {
            let found = find(&report.metrics, subject, name, split);
            found.and_then(|m| m.finite()).map_or_else(|| NOT_MEASURED.to_owned(), short)
        });
        let name = name.join(" ");
        format!("{} {own} (held-out real motion {truth})", name.trim_end())
    };
    let text = format!("Fréchet distance from real motion: {}.", FRECHET.map(of).join("; "));
    Sentence { tone: Tone::Plain, text }
}

#[cfg(test)]
mod tests {
    use super::super::example::{example, metric};
    use super::super::{Metric, Report};
    use super::*;

    fn locked(subject: &str, split: &str, p: Option<f64>) -> Vec<Metric> {
        vec![
            metric(subject, split, "locking_r2", "per_song", Some(0.099)),
            metric(subject, split, "locking_wrong_r2", "per_song", Some(0.035)),
            metric(subject, split, "locking_p", "per_song", p),
        ]
    }

    fn said(metrics: Vec<Metric>) -> (Tone, String) {
        let report = Report { metrics, ..Report::default() };
        let Sentence { tone, text } = locking(&report);
        (tone, text)
    }

    #[test]
    fn following_needs_a_control_that_does_not_follow() {
        let of = |own: Option<f64>, control: Option<f64>| {
            said([locked("generated", "all", own), locked("shuffled", "all", control)].concat())
        };
        let (tone, text) = of(Some(0.005), Some(0.71));
        assert_eq!(tone, Tone::Good);
        assert_eq!(
            text,
            "Motion follows the bar of its music (R² 0.099, at wrong tempi 0.035, p 0.005; with the music of \
             other songs R² 0.099, at wrong tempi 0.035, p 0.71)."
        );
        let (tone, text) = of(Some(0.005), Some(0.005));
        assert_eq!(tone, Tone::Bad);
        assert!(text.contains("but to that of other songs as well"), "{text}");
        let (tone, text) = of(Some(0.01), Some(0.5));
        assert_eq!(tone, Tone::Bad);
        assert!(
            text.starts_with("Motion is not shown to follow the bar of its music (R²"),
            "{text}"
        );
        let (tone, text) = of(Some(0.005), None);
        assert_eq!(tone, Tone::Open);
        assert!(text.ends_with("wrong tempi 0.035, p not measured)."), "{text}");
        assert_eq!(of(None, Some(0.5)).0, Tone::Open);
    }

    #[test]
    fn music_that_was_not_learnt_from_tells() {
        let metrics = [
            locked("generated", "all", Some(0.5)),
            locked("generated", "held_out", Some(0.005)),
            locked("shuffled", "held_out", Some(0.6)),
        ];
        let (tone, text) = said(metrics.concat());
        assert_eq!(tone, Tone::Good);
        assert!(text.contains("the bar of music that the model did not learn from"), "{text}");
        // A control of other music is none.
        let other =
            [locked("generated", "held_out", Some(0.005)), locked("shuffled", "all", Some(0.6))];
        let (tone, text) = said(other.concat());
        assert_eq!(tone, Tone::Open);
        assert!(text.ends_with("with the music of other songs not measured)."), "{text}");
    }

    #[test]
    fn what_is_not_measured_is_said_so() {
        let said = in_short(&Report::default()).map(|sentence| sentence.text);
        let wanted = [
            "Motions that pass every reference check: not measured; every strict check: not measured.",
            "Whether motion follows the bar of its music is open (not measured; with the music of other \
             songs not measured).",
            "Fréchet distance from real motion: fid_k axes not measured (held-out real motion not \
             measured); fid_g not measured (held-out real motion not measured).",
        ];
        assert_eq!(said, wanted);
    }

    #[test]
    fn distances_stand_beside_that_of_held_out_motion() {
        let Sentence { tone, text } = realism(&example());
        assert_eq!(tone, Tone::Plain);
        assert_eq!(
            text,
            "Fréchet distance from real motion: fid_k axes 2.5 (held-out real motion 0.8); fid_g 1.5 \
             (held-out real motion not measured)."
        );
    }
}
