//! The section that compares this run with another one.

use super::comparison::{Change, Pair, counts, family, pairs};
use super::html::{Escaped, put};
use super::names::{music, words};
use super::numbers::{MISSING, difference, interval, value};
use super::{ComparedRun, Metric, Report, ordered};

/// Writes the section: settings that differ, numbers that differ, and folded away all others.
pub(super) fn section(out: &mut String, report: &Report, against: &ComparedRun) {
    let run = Escaped(&against.run);
    put!(out, "<section id=\"against\">\n<h2>Compared with {run}</h2>\n");
    settings(out, against);
    let pairs = pairs(report, against);
    if pairs.is_empty() {
        put!(out, "<p>No number was measured in both runs.</p>\n</section>\n");
        return;
    }
    put!(out, "<p>{}.</p>\n<p>{}.</p>\n", family(against), counts(&pairs));
    let (notable, others): (Vec<Pair>, Vec<Pair>) = pairs.into_iter().partition(Pair::is_notable);
    if notable.is_empty() {
        put!(out, "<p>Nothing is shown to differ.</p>\n");
    } else {
        table(out, against, &notable);
    }
    if !others.is_empty() {
        put!(out, "<details>\n<summary>The others ({})</summary>\n", others.len());
        table(out, against, &others);
        put!(out, "</details>\n");
    }
    put!(out, "</section>\n");
}

fn settings(out: &mut String, against: &ComparedRun) {
    if against.settings.is_empty() {
        put!(out, "<p>Both runs have the same settings.</p>\n");
        return;
    }
    put!(
        out,
        "<div class=\"scroll\"><table>\n<thead><tr><th scope=\"col\">setting</th><th scope=\"col\" \
         class=\"text\">{}</th><th scope=\"col\" class=\"text\">here</th></tr></thead>\n<tbody>\n",
        Escaped(&against.run)
    );
    for (setting, there, here) in &against.settings {
        put!(
            out,
            "<tr><th scope=\"row\">{}</th><td class=\"text\">{}</td><td class=\"text\">{}</td></tr>\n",
            Escaped(setting),
            Escaped(there),
            Escaped(here)
        );
    }
    put!(out, "</tbody></table></div>\n");
}

fn table(out: &mut String, against: &ComparedRun, pairs: &[Pair]) {
    put!(
        out,
        "<div class=\"scroll\"><table>\n<thead><tr><th scope=\"col\">metric</th><th scope=\"col\">{}</th>\
         <th scope=\"col\">here</th><th scope=\"col\">difference</th><th scope=\"col\">p (Holm)</th><th \
         scope=\"col\">songs</th><th scope=\"col\" class=\"text\">change</th></tr></thead>\n<tbody>\n",
        Escaped(&against.run)
    );
    for pair in pairs {
        row(out, pair);
    }
    put!(out, "</tbody></table></div>\n");
}

fn row(out: &mut String, pair: &Pair) {
    let Metric { metric, variant, split, unit, .. } = pair.here;
    put!(out, "<tr><th scope=\"row\"><code>{}</code>", Escaped(metric));
    if !variant.is_empty() {
        put!(out, " {}", Escaped(&words(variant)));
    }
    put!(out, " <small>{}", Escaped(&music(split)));
    if !unit.is_empty() {
        put!(out, ", {}", Escaped(unit));
    }
    put!(out, "</small></th>");
    for metric in [pair.there, pair.here] {
        put!(out, "<td title=\"n = {}\">{}", metric.n, value(metric.value));
        if let Some((low, high)) = metric.interval() {
            put!(out, " <span class=\"interval\">{}</span>", interval(low, high));
        }
        put!(out, "</td>");
    }
    put!(out, "<td>{}", pair.difference.map_or_else(|| MISSING.to_owned(), difference));
    let ends = pair.paired.and_then(|paired| paired.ci_low.zip(paired.ci_high));
    if let Some((low, high)) = ends.and_then(|(low, high)| ordered(low, high)) {
        put!(out, " <span class=\"interval\">{}</span>", interval(low, high));
    }
    let n_songs = pair.paired.map_or_else(|| MISSING.to_owned(), |p| p.n_songs.to_string());
    let class = match pair.change {
        Change::Better => "word good",
        Change::Worse => "word bad",
        _ => "word",
    };
    put!(
        out,
        "</td><td>{}</td><td>{n_songs}</td><td class=\"{class}\">{}</td></tr>\n",
        value(pair.paired.and_then(|paired| paired.p_holm)),
        pair.change.words()
    );
}

#[cfg(test)]
mod tests {
    use super::super::PairedNumber;
    use super::super::example::{metric, with_interval};
    use super::*;

    fn told(here: Vec<Metric>, against: &ComparedRun) -> String {
        let mut out = String::new();
        section(&mut out, &Report { metrics: here, ..Report::default() }, against);
        out
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
