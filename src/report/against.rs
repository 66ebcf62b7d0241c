//! The section that compares this run with another one.

use askama::Template;

use super::comparison::{Change, Pair, counts, family, pairs};
use super::names::{music, words};
use super::numbers::{MISSING, difference, interval, value};
use super::{ComparedRun, Metric, Report, ordered};

/// Settings that differ, numbers that differ, and folded away all others.
#[derive(Template)]
#[template(path = "report/templates/against.html")]
pub(super) struct AgainstSection<'a> {
    run: &'a str,
    settings: &'a [(String, String, String)],
    /// What the comparison rests on.
    family: String,
    counts: String,
    notable: Vec<PairRow<'a>>,
    others: Vec<PairRow<'a>>,
}

struct PairRow<'a> {
    metric: &'a str,
    variant: String,
    music: String,
    unit: &'a str,
    /// There and here.
    both: [PairNumber; 2],
    difference: String,
    interval: Option<String>,
    p: String,
    n_songs: String,
    class: &'static str,
    change: &'static str,
}

struct PairNumber {
    n: i64,
    value: String,
    interval: Option<String>,
}

impl<'a> AgainstSection<'a> {
    /// Compares a report with another run.
    pub fn new(report: &'a Report, against: &'a ComparedRun) -> Self {
        let pairs = pairs(report, against);
        let (family, counts) = (family(against), counts(&pairs));
        let (notable, others): (Vec<Pair>, Vec<Pair>) =
            pairs.into_iter().partition(Pair::is_notable);
        let rows = |pairs: &[Pair<'a>]| pairs.iter().map(PairRow::new).collect();
        Self {
            run: &against.run,
            settings: &against.settings,
            family,
            counts,
            notable: rows(&notable),
            others: rows(&others),
        }
    }
}

impl<'a> PairRow<'a> {
    fn new(pair: &Pair<'a>) -> Self {
        let Metric { metric, variant, split, unit, .. } = pair.here;
        let written = |(low, high): (f64, f64)| interval(low, high);
        let ends = pair.paired.and_then(|paired| paired.ci_low.zip(paired.ci_high));
        Self {
            metric,
            variant: words(variant),
            music: music(split),
            unit,
            both: [pair.there, pair.here].map(|metric| PairNumber {
                n: metric.n,
                value: value(metric.value),
                interval: metric.interval().map(written),
            }),
            difference: pair.difference.map_or_else(|| MISSING.to_owned(), difference),
            interval: ends.and_then(|(low, high)| ordered(low, high)).map(written),
            p: value(pair.paired.and_then(|paired| paired.p_holm)),
            n_songs: pair.paired.map_or_else(|| MISSING.to_owned(), |p| p.n_songs.to_string()),
            class: match pair.change {
                Change::Better => "word good",
                Change::Worse => "word bad",
                _ => "word",
            },
            change: pair.change.words(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::PairedNumber;
    use crate::report::example::{metric, with_interval};

    fn told(here: Vec<Metric>, against: &ComparedRun) -> String {
        let report = Report { metrics: here, ..Report::default() };
        format!("{}\n", AgainstSection::new(&report, against))
    }

    #[test]
    fn what_differs_is_seen_and_the_rest_is_folded_away() {
        let fid_metric =
            |x: f64| with_interval(metric("generated", "all", "fid_k", "axes", Some(x)), x, x);
        let jerk = |x| Metric {
            unit: "m/s³".to_owned(),
            ..metric("generated", "held_out", "jerk_mean", "", x)
        };
        let against = ComparedRun {
            run: "<old>".to_owned(),
            metrics: vec![fid_metric(2.5), jerk(Some(3.0))],
            paired: vec![PairedNumber {
                metric: "fid_k".to_owned(),
                variant: "axes".to_owned(),
                split: "all".to_owned(),
                difference: -1.25,
                ci_low: Some(-1.75),
                ci_high: Some(-0.75),
                p_holm: Some(0.015),
                n_songs: 9,
            }],
            settings: vec![("steps".to_owned(), "20".to_owned(), "<50>".to_owned())],
        };
        let told = told(vec![fid_metric(1.5), jerk(Some(4.0))], &against);
        let (seen, folded) = told.split_once("<details>").expect("details");
        for wanted in [
            "<h2>Compared with &lt;old&gt;</h2>",
            "<p>1 number is compared song by song; it is called better, worse or different only where p is \
             below 0.05.</p>\n<p>2 numbers: 1 better, 1 not paired.</p>",
            "<tr><th scope=\"row\">steps</th><td class=\"text\">20</td><td \
             class=\"text\">&lt;50&gt;</td></tr>",
            "<tr><th scope=\"row\"><code>fid_k</code> axes <small>all music</small></th><td title=\"n = \
             100\">2.50 <span class=\"interval\">[2.50, 2.50]</span></td><td title=\"n = 100\">1.50 <span \
             class=\"interval\">[1.50, 1.50]</span></td><td>-1.25 <span class=\"interval\">[-1.8, \
             -0.8]</span></td><td>0.0150</td><td>9</td><td class=\"word good\">better</td></tr>",
        ] {
            assert!(seen.contains(wanted), "{wanted} in {seen}");
        }
        assert!(folded.contains("<summary>The others (1)</summary>"));
        assert!(folded.contains(
            "<small>held-out music, m/s³</small></th><td title=\"n = 100\">3.00</td><td title=\"n = \
             100\">4.00</td><td>+1.00</td><td>–</td><td>–</td><td class=\"word\">not paired</td>"
        ));
    }

    #[test]
    fn without_pairs_nothing_is_called_better() {
        let fid_metric =
            |x: f64| with_interval(metric("generated", "all", "fid_k", "axes", Some(x)), x, x);
        let against = ComparedRun {
            run: "b".to_owned(),
            metrics: vec![fid_metric(9.5)],
            ..ComparedRun::default()
        };
        let told = told(vec![fid_metric(1.5)], &against);
        assert!(told.contains("<p>No number is paired song by song, so that none is called"));
        assert!(told.contains("<p>Nothing is shown to differ.</p>"));
        assert!(!told.contains("good") && !told.contains(">better<"), "{told}");
    }

    #[test]
    fn nothing_in_common_is_said_so() {
        let told = told(Vec::new(), &ComparedRun { run: "b".to_owned(), ..ComparedRun::default() });
        assert_eq!(
            told,
            "<section id=\"against\">\n<h2>Compared with b</h2>\n<p>Both runs have the same settings.</p>\n\
             <p>No number was measured in both runs.</p>\n</section>\n"
        );
    }
}
