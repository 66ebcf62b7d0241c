//! The section that compares this run with another one.

use super::comparison::{Pair, Verdict, counts, pairs};
use super::html::{Escaped, put};
use super::names::{music, words};
use super::numbers::{MISSING, difference, interval, value};
use super::{Against, Metric, Report};

/// Writes the section: settings that differ, numbers that differ, and folded away all others.
pub(super) fn section(out: &mut String, report: &Report, against: &Against) {
    let run = Escaped(&against.run);
    put!(out, "<section id=\"against\">\n<h2>Compared with {run}</h2>\n");
    settings(out, against);
    let pairs = pairs(report, against);
    if pairs.is_empty() {
        put!(out, "<p>No number was measured in both runs.</p>\n</section>\n");
        return;
    }
    put!(out, "<p>{}.</p>\n", counts(&pairs));
    let (notable, others): (Vec<Pair>, Vec<Pair>) = pairs.into_iter().partition(Pair::is_notable);
    if notable.is_empty() {
        put!(out, "<p>Nothing differs by more than the intervals.</p>\n");
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

fn settings(out: &mut String, against: &Against) {
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

fn table(out: &mut String, against: &Against, pairs: &[Pair]) {
    put!(
        out,
        "<div class=\"scroll\"><table>\n<thead><tr><th scope=\"col\">metric</th><th scope=\"col\">{}</th>\
         <th scope=\"col\">here</th><th scope=\"col\">difference</th><th scope=\"col\" \
         class=\"text\">verdict</th></tr></thead>\n<tbody>\n",
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
    let class = match pair.verdict {
        Verdict::Better => "text good",
        Verdict::Worse => "text bad",
        _ => "text",
    };
    put!(
        out,
        "<td>{}</td><td class=\"{class}\">{}</td></tr>\n",
        pair.difference.map_or_else(|| MISSING.to_owned(), difference),
        pair.verdict.words()
    );
}

#[cfg(test)]
mod tests {
    use super::super::example::{metric, with_interval};
    use super::*;

    fn told(here: Vec<Metric>, against: &Against) -> String {
        let mut out = String::new();
        section(&mut out, &Report { metrics: here, ..Report::default() }, against);
        out
    }

    #[test]
    fn what_differs_is_seen_and_the_rest_is_folded_away() {
        let of = |x: f64| with_interval(metric("generated", "all", "fid_k", "axes", Some(x)), x, x);
        let jerk = |x| Metric {
            unit: "m/s³".to_owned(),
            ..metric("generated", "held_out", "jerk_mean", "", x)
        };
        let against = Against {
            run: "<old>".to_owned(),
            metrics: vec![of(2.5), jerk(Some(3.0))],
            paired: Vec::new(),
            settings: vec![("steps".to_owned(), "20".to_owned(), "<50>".to_owned())],
        };
        let told = told(vec![of(1.5), jerk(None)], &against);
        let (seen, folded) = told.split_once("<details>").expect("details");
        assert!(seen.contains("<h2>Compared with &lt;old&gt;</h2>"));
        assert!(seen.contains("<p>2 numbers: 1 better, 1 not measured.</p>"));
        assert!(seen.contains(
            "<tr><th scope=\"row\">steps</th><td class=\"text\">20</td><td \
             class=\"text\">&lt;50&gt;</td></tr>"
        ));
        assert!(seen.contains(
            "<tr><th scope=\"row\"><code>fid_k</code> axes <small>all music</small></th><td title=\"n = \
             100\">2.50 <span class=\"interval\">[2.50, 2.50]</span></td><td title=\"n = 100\">1.50 <span \
             class=\"interval\">[1.50, 1.50]</span></td><td>-1.00</td><td class=\"text \
             good\">better</td></tr>"
        ));
        assert!(folded.contains("<summary>The others (1)</summary>"));
        assert!(folded.contains(
            "<small>unseen music, m/s³</small></th><td title=\"n = 100\">3.00</td><td title=\"n = \
             100\">–</td><td>–</td><td class=\"text\">not measured</td>"
        ));
    }

    #[test]
    fn nothing_in_common_is_said_so() {
        let told = told(Vec::new(), &Against { run: "b".to_owned(), ..Against::default() });
        assert_eq!(
            told,
            "<section id=\"against\">\n<h2>Compared with b</h2>\n<p>Both runs have the same settings.</p>\n\
             <p>No number was measured in both runs.</p>\n</section>\n"
        );
    }
}
