//! The report as a page that needs no network.

use std::fmt::Write as _;

use super::comparison::{Pair, Verdict, pairs};
use super::grid::{Grid, GridRow};
use super::meaning::{SECTIONS, is_compat, meaning_of};
use super::numbers::{MISSING, number, value, with_interval, words};
use super::{CheckLine, Metric, OWN, Report, chart};
use crate::view::escaped;

const TEMPLATE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
/// The metric that has a picture instead of rows.
const CHANNELS: &str = "channel_distance";

/// Returns the page as HTML. The same report gives the same text; whatever comes from outside, but for the
/// pictures of motions, is text there.
pub fn page(report: &Report) -> String {
    let mut out = String::new();
    for (i, piece) in TEMPLATE.split("{{").enumerate() {
        let slot = if i == 0 { None } else { piece.split_once("}}") };
        let Some((name, rest)) = slot else {
            out.push_str(piece);
            continue;
        };
        match name {
            "title" => out.push_str(&escaped(&report.title)),
            "style" => out.push_str(STYLE),
            "facts" => facts(&mut out, &report.facts),
            "short" => in_short(&mut out, report),
            "against" => against(&mut out, report),
            "checks" => checks(&mut out, report),
            "metrics" => metrics(&mut out, report),
            "worst" => worst(&mut out, report),
            _ => {}
        }
        out.push_str(rest);
    }
    out
}

fn facts(out: &mut String, facts: &[(String, String)]) {
    out.push_str("<dl class=\"facts\">");
    for (name, text) in facts {
        let _ = write!(out, "<div><dt>{}</dt><dd>{}</dd></div>", escaped(name), escaped(text));
    }
    out.push_str("</dl>\n");
}

/// A few sentences, each with what it rests on.
fn in_short(out: &mut String, report: &Report) {
    let split = report.main_split();
    let find = |subject, metric, variant| {
        report.find(subject, split, metric, variant).and_then(|m: &Metric| m.value)
    };
    let mut lines = Vec::new();
    let rates = ["reference", "strict"].map(|set| find(OWN, "pass_rate", set));
    if let [Some(reference), Some(strict)] = rates {
        lines.push(format!(
            "{} of the motions pass the reference's checks, {} the strict ones too.",
            share(reference),
            share(strict)
        ));
    }
    let music = if split == "held_out" { "music it did not learn from" } else { "its music" };
    let locking = |subject| {
        let of = |metric| find(subject, metric, "per_song");
        Some((of("locking_r2")?, of("locking_wrong_r2")?, of("locking_p")?))
    };
    match locking(OWN) {
        Some((r2, wrong, p)) => {
            let follows = if p < 0.01 { "follows" } else { "is not shown to follow" };
            let mut line = format!(
                "It {follows} the bars of {music}: {} of its vertical velocity repeats with them, {} at wrong \
                 tempi (p = {})",
                share(r2),
                share(wrong),
                number(p)
            );
            match locking("shuffled") {
                Some((r2, wrong, p)) => {
                    let _ = write!(
                        line,
                        "; with the music of another song {} and {} (p = {}).",
                        share(r2),
                        share(wrong),
                        number(p)
                    );
                }
                None => line.push('.'),
            }
            lines.push(line);
        }
        None if !report.metrics.is_empty() => {
            lines.push(
                "Whether it follows the music was not measured: no beats are known.".to_owned(),
            );
        }
        None => {}
    }
    if let Some(own) = find(OWN, "fid_k", "axes") {
        let real = report.find("held_out_truth", split, "fid_k", "axes").and_then(|m| m.value);
        lines.push(format!(
            "Its speeds and accelerations are {} from the ground truth (Fréchet distance), those of held-out \
             real motion {}, of the best constant {}.",
            number(own),
            value(real),
            value(find("mean_motion", "fid_k", "axes"))
        ));
    }
    for line in lines {
        let _ = writeln!(out, "<p>{}</p>", escaped(&line));
    }
}

fn share(x: f64) -> String {
    format!("{} %", number(100.0 * x))
}

fn checks(out: &mut String, report: &Report) {
    for set in ["reference", "strict"] {
        let lines: Vec<&CheckLine> = report.checks.iter().filter(|line| line.set == set).collect();
        if lines.is_empty() {
            continue;
        }
        let _ = write!(
            out,
            "<section><h2>Sanity: {set} checks</h2><div class=\"scroll\"><table><thead><tr><th>check</th>\
             <th>threshold</th><th>passed</th><th></th><th>worst</th><th class=\"text\">its message</th></tr>\
             </thead><tbody>"
        );
        for line in lines {
            let class = if line.n_passed == line.n { "good" } else { "bad" };
            let _ = write!(
                out,
                "<tr><td>{}</td><td>{}</td><td class=\"{class}\">{} of {}</td><td><meter max=\"{}\" \
                 value=\"{}\"></meter></td><td>{}</td><td class=\"text\">{}</td></tr>",
                escaped(&words(&line.check)),
                number(line.threshold),
                line.n_passed,
                line.n,
                line.n,
                line.n_passed,
                number(line.worst_value),
                escaped(&line.worst_message)
            );
        }
        out.push_str("</tbody></table></div></section>\n");
    }
}

fn metrics(out: &mut String, report: &Report) {
    for (section, heading) in SECTIONS.iter().enumerate() {
        let split = report.main_split();
        let grid =
            Grid::new(&report.metrics, section, |m| m.metric != CHANNELS && m.split == split);
        let channels = section == meaning_of(CHANNELS).section && has_channels(report);
        if grid.rows.is_empty() && !channels {
            continue;
        }
        let songs = escaped(&words(split));
        let _ = write!(out, "<section><h2>{} <small>{songs} songs</small></h2>", escaped(heading));
        if !grid.rows.is_empty() {
            table(out, &grid);
        }
        let more =
            Grid::new(&report.metrics, section, |m| m.metric != CHANNELS && m.split != split);
        if !more.rows.is_empty() {
            out.push_str("<details><summary>The same of the other split</summary>");
            table(out, &more);
            out.push_str("</details>");
        }
        if channels {
            let of = |subject: &str| -> Vec<&Metric> {
                let is_it =
                    |m: &&Metric| m.metric == CHANNELS && m.subject == subject && m.split == split;
                report.metrics.iter().filter(is_it).collect()
            };
            let _ = write!(
                out,
                "<h3>Distance of each channel's values from the ground truth's</h3><p>{} Blue: generated; \
                 grey: held-out real motion.</p>{}",
                meaning_of(CHANNELS).text,
                chart::channels(&of(OWN), &of("held_out_truth"))
            );
        }
        out.push_str("</section>\n");
    }
}

fn has_channels(report: &Report) -> bool {
    report.metrics.iter().any(|m| m.metric == CHANNELS && m.subject == OWN)
}

fn table(out: &mut String, grid: &Grid) {
    out.push_str("<div class=\"scroll\"><table><thead><tr><th>metric</th><th></th>");
    for subject in &grid.subjects {
        let _ = write!(out, "<th>{}</th>", escaped(&words(subject)));
    }
    out.push_str("</tr></thead><tbody>");
    let mut last = "";
    let mut is_told = false;
    for row in &grid.rows {
        if is_compat(row.variant) && !std::mem::replace(&mut is_told, true) {
            let _ = write!(
                out,
                "<tr class=\"compat\"><td colspan=\"{}\">Below: the formula that published code computes, \
                 whose parenthesis is misplaced; only for comparison with published numbers.</td></tr>",
                grid.subjects.len() + 2
            );
        }
        let explanation = if row.metric == last { "" } else { meaning_of(row.metric).text };
        last = row.metric;
        line(out, row, explanation);
    }
    out.push_str("</tbody></table></div>");
}

fn line(out: &mut String, row: &GridRow, explanation: &str) {
    let class = if is_compat(row.variant) { " class=\"compat\"" } else { "" };
    let mut name = words(row.metric);
    for more in [row.variant, row.unit].into_iter().filter(|more| !more.is_empty()) {
        let _ = write!(name, ", {}", words(more));
    }
    let _ = write!(out, "<tr{class}><td>{}", escaped(&name));
    if !explanation.is_empty() {
        let _ = write!(out, "<small>{}</small>", escaped(explanation));
    }
    let _ = write!(out, "</td><td>{}</td>", chart::intervals(row));
    for cell in &row.cells {
        let Some(m) = cell else {
            let _ = write!(out, "<td>{MISSING}</td>");
            continue;
        };
        let told = match m.value {
            Some(_) => format!("n = {}; {}", m.n, m.protocol),
            None => format!("too few (n = {}); {}", m.n, m.protocol),
        };
        let class = if m.subject == OWN { " class=\"own\"" } else { "" };
        let text = with_interval(m);
        let text = match text.split_once(" [") {
            Some((value, interval)) => {
                format!("{value} <span class=\"interval\">[{interval}</span>")
            }
            None => text,
        };
        let _ = write!(out, "<td{class} title=\"{}\">{text}</td>", escaped(&told));
    }
    out.push_str("</tr>");
}

fn against(out: &mut String, report: &Report) {
    let Some(against) = &report.against else { return };
    let name = escaped(&against.run);
    let _ = write!(out, "<section><h2>Against run {name}</h2>");
    if against.settings.is_empty() {
        out.push_str("<p>Both were made with the same settings.</p>");
    } else {
        out.push_str("<ul>");
        for (setting, there, here) in &against.settings {
            let _ = write!(
                out,
                "<li>{}: {} there, {} here</li>",
                escaped(setting),
                escaped(there),
                escaped(here)
            );
        }
        out.push_str("</ul>");
    }
    let pairs = pairs(report, against);
    let is_shown = |pair: &&Pair| pair.here.metric != CHANNELS;
    let (changed, same): (Vec<&Pair>, Vec<&Pair>) = pairs
        .iter()
        .filter(is_shown)
        .partition(|pair| !matches!(pair.verdict, Verdict::Within | Verdict::Unknown));
    if changed.is_empty() {
        out.push_str("<p>Nothing differs beyond the intervals.</p>");
    } else {
        compared(out, &name, &changed);
    }
    let _ = write!(out, "<details><summary>{} numbers that do not differ</summary>", same.len());
    compared(out, &name, &same);
    out.push_str("</details></section>\n");
}

fn compared(out: &mut String, name: &str, pairs: &[&Pair]) {
    let _ = write!(
        out,
        "<div class=\"scroll\"><table><thead><tr><th>metric</th><th class=\"text\">songs</th><th>{name}</th>\
         <th>here</th><th>difference</th><th class=\"text\">verdict</th></tr></thead><tbody>"
    );
    for pair in pairs {
        let class = match pair.verdict {
            Verdict::Better => " class=\"text good\"",
            Verdict::Worse => " class=\"text bad\"",
            _ => " class=\"text\"",
        };
        let _ = write!(
            out,
            "<tr><td>{}</td><td class=\"text\">{}</td><td>{}</td><td>{}</td><td>{}</td><td{class}>{}</td></tr>",
            escaped(format!("{} {}", words(&pair.here.metric), words(&pair.here.variant)).trim()),
            escaped(&words(&pair.here.split)),
            with_interval(pair.there),
            with_interval(pair.here),
            number(pair.difference),
            pair.verdict.text()
        );
    }
    out.push_str("</tbody></table></div>");
}

fn worst(out: &mut String, report: &Report) {
    if report.worst.is_empty() {
        return;
    }
    out.push_str("<section><h2>The motions that fail the most</h2>");
    for motion in &report.worst {
        let _ = write!(out, "<div class=\"card\"><h3>{}</h3>", escaped(&motion.name));
        facts(out, &motion.facts);
        if motion.failed.is_empty() {
            out.push_str("<p class=\"good\">It passes every check.</p>");
        } else {
            out.push_str("<ul>");
            for message in &motion.failed {
                let _ = write!(out, "<li class=\"bad\">{}</li>", escaped(message));
            }
            out.push_str("</ul>");
        }
        // An <?xml …?> before it would be text in HTML.
        let start = motion.svg.find("<svg").unwrap_or(0);
        out.push_str(&motion.svg[start..]);
        out.push_str("</div>");
    }
    out.push_str("</section>\n");
}
