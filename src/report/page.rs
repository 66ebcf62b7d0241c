//! Writes the page.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::html::{Escaped, put};
use super::{Report, WorstMotion, against, panel, sanity, tables};

/// The page, with slots such as `{{title}}`.
const TEMPLATE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");

/// Returns the report as HTML that is complete in itself. The same report gives the same text.
///
/// Whatever comes from outside is text there, and pictures are images: nothing can become markup or script.
pub fn page(report: &Report) -> String {
    let mut out = String::new();
    for (i, piece) in TEMPLATE.split("{{").enumerate() {
        let slot = if i == 0 { None } else { piece.split_once("}}") };
        let Some((name, rest)) = slot else {
            out.push_str(piece);
            continue;
        };
        match name {
            "title" => put!(out, "{}", Escaped(&report.title)),
            "style" => out.push_str(STYLE),
            "facts" => facts(&mut out, &report.facts),
            "verdicts" => panel::section(&mut out, report),
            "links" => links(&mut out, report),
            "sanity" => sanity::section(&mut out, report),
            "metrics" => tables::metrics(&mut out, report),
            "against" => {
                if let Some(other) = &report.against {
                    against::section(&mut out, report, other);
                }
            }
            "worst" => worst(&mut out, &report.worst),
            _ => {}
        }
        out.push_str(rest);
    }
    out
}

fn facts(out: &mut String, facts: &[(String, String)]) {
    if facts.is_empty() {
        return;
    }
    put!(out, "<dl class=\"facts\">\n");
    for (name, text) in facts {
        put!(out, "<div><dt>{}</dt><dd>{}</dd></div>\n", Escaped(name), Escaped(text));
    }
    put!(out, "</dl>\n");
}

/// Writes links to the sections that are there.
fn links(out: &mut String, report: &Report) {
    let mut link = |id: &str, heading: &str| put!(out, "<a href=\"#{id}\">{heading}</a>\n");
    if !report.checks.is_empty() {
        link("sanity", "Sanity checks");
    }
    if !report.metrics.is_empty() {
        link(tables::SUBJECTS_ID, tables::SUBJECTS_HEADING);
    }
    for section in tables::sections(report) {
        link(section.id(), section.heading());
    }
    if report.against.is_some() {
        link("against", "Comparison");
    }
    if !report.worst.is_empty() {
        link("worst", "Worst motions");
    }
}

fn worst(out: &mut String, motions: &[WorstMotion]) {
    if motions.is_empty() {
        return;
    }
    put!(out, "<section id=\"worst\">\n<h2>Worst motions</h2>\n");
    for motion in motions {
        put!(out, "<article class=\"card\">\n<h3>{}</h3>\n", Escaped(&motion.name));
        facts(out, &motion.facts);
        if motion.failed.is_empty() {
            put!(out, "<p>Passes every check.</p>\n");
        } else {
            put!(out, "<ul>\n");
            for message in &motion.failed {
                put!(out, "<li class=\"bad\">{}</li>\n", Escaped(message));
            }
            put!(out, "</ul>\n");
        }
        picture(out, motion);
        put!(out, "</article>\n");
    }
    put!(out, "</section>\n");
}

/// Writes the picture as an image, in which nothing can run or be asked of a network.
fn picture(out: &mut String, motion: &WorstMotion) {
    if motion.svg.is_empty() {
        return;
    }
    put!(out, "<div class=\"scroll\"><img alt=\"Plot of {}\" src=\"", Escaped(&motion.name));
    out.push_str("data:image/svg+xml;base64,");
    STANDARD.encode_string(&motion.svg, out);
    out.push_str("\"></div>\n");
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::example::{example, metric, with_interval};
    use super::super::names::SUBJECTS;
    use super::super::{
        BY_CONSTRUCTION, CheckLine, ComparedRun, Metric, Outcome, PairedNumber, Verdict,
        VerdictTest,
    };
    use super::*;

    #[test]
    fn every_slot_is_filled() {
        let page = page(&example());
        let slots: Vec<&str> = TEMPLATE
            .split("{{")
            .skip(1)
            .map(|piece| piece.split_once("}}").expect("an end of the slot").0)
            .collect();
        let wanted = [
            "title", "style", "title", "facts", "verdicts", "links", "sanity", "metrics",
            "against", "worst",
        ];
        assert_eq!(slots, wanted);
        assert!(page.starts_with("<!DOCTYPE html>\n<html lang=\"en\">\n"));
        assert!(page.contains("<title>Evaluation of demo</title>"));
        assert!(page.contains("<h1>Evaluation of demo</h1>"));
        assert!(page.contains("<div><dt>motions</dt><dd>120</dd></div>"));
        let verdicts: Vec<&str> = page
            .split("<article class=\"verdict ")
            .skip(1)
            .filter_map(|rest| rest.split('"').next())
            .collect();
        assert_eq!(verdicts, ["lost", "open", "open", "won"]);
        assert!(page.find("class=\"notes\"") < page.find("<nav"));
        assert!(page.contains(STYLE) && !STYLE.contains("</style"));
        let ids = ["sanity", "subjects", "music", "real", "varied", "sound", "against", "worst"];
        for id in ids {
            assert_eq!(page.matches(&format!("<a href=\"#{id}\">")).count(), 1, "{id}");
            assert_eq!(page.matches(&format!("<section id=\"{id}\">")).count(), 1, "{id}");
        }
        assert_eq!(page.matches("<a ").count(), ids.len());
        for element in [
            "section", "table", "tr", "th", "td", "svg", "g", "article", "div", "details", "h2",
            "small",
        ] {
            let n_open = page.matches(&format!("<{element}>")).count()
                + page.matches(&format!("<{element} ")).count();
            assert_eq!(n_open, page.matches(&format!("</{element}>")).count(), "{element}");
        }
    }

    /// Writes the page of the example for a look at it:
    /// `MOTIONGEN_PAGE=example.html cargo test --lib example_page -- --ignored`.
    #[test]
    #[ignore = "writes a file"]
    fn example_page_to_look_at() {
        let file = std::env::var_os("MOTIONGEN_PAGE").expect("MOTIONGEN_PAGE names a file");
        let mut report = example();
        for (i, (subject, _)) in SUBJECTS.into_iter().enumerate() {
            let x = 0.1 + 0.1 * i as f64;
            let held_out_metric = |name, value| metric(subject, "held_out", name, "", value);
            let coupled =
                with_interval(held_out_metric("coupling_ratio", Some(x)), x - 0.05, x + 0.05);
            let relocked = Metric {
                protocol: format!("the phase was relocked, {BY_CONSTRUCTION}"),
                ..held_out_metric("phase_error", None)
            };
            report.metrics.extend([
                coupled,
                relocked,
                held_out_metric("share_upright", Some(1.1 - x)),
            ]);
        }
        std::fs::write(file, page(&report)).expect("written");
    }

    #[test]
    fn nothing_is_asked_of_a_network_and_nothing_runs() {
        let page = page(&example());
        for request in
            ["http://", "https://", "<script", "@import", "url(", "onload", "//cdn", "<link"]
        {
            assert!(!page.contains(request), "{request}");
        }
        let sources: Vec<&str> = page.split(" src=\"").skip(1).map(|rest| &rest[..14]).collect();
        assert_eq!(sources, ["data:image/svg"]);
    }

    #[test]
    fn the_picture_is_an_image() {
        let page = page(&example());
        // RFC 4648 of `<svg xmlns="http://www.w3.org/2000/svg"/>`.
        let svg = "PHN2ZyB4bWxucz0iaHR0cDovL3d3dy53My5vcmcvMjAwMC9zdmciLz4=";
        let image = format!("<img alt=\"Plot of song 3\" src=\"data:image/svg+xml;base64,{svg}\">");
        assert!(page.contains(&image));
        assert!(page.contains("<li class=\"bad\">Mean jerk: 512</li>"));
    }

    #[test]
    fn an_empty_report_is_a_page() {
        let page = page(&Report::default());
        assert!(!page.contains("<table") && !page.contains("<a ") && !page.contains("{{"));
        assert_eq!(page.matches("Not measured.").count(), 4);
        assert_eq!(page.matches("<section").count(), 1);
    }

    fn test_of(text: &str) -> VerdictTest {
        let own = || text.to_owned();
        VerdictTest {
            test: own(),
            outcome: Outcome::Open,
            statistic: own(),
            value: Some(1.0),
            ci_low: Some(0.5),
            ci_high: Some(1.5),
            unit: own(),
            rule: own(),
            limit: Some(0.5),
            against: own(),
            message: own(),
        }
    }

    /// Returns a report of which every text is the same.
    fn report_of(text: &str) -> Report {
        let own = || text.to_owned();
        let strange = Metric {
            unit: own(),
            protocol: own(),
            variant: own(),
            ..metric(text, text, text, "", Some(1.0))
        };
        let known = Metric {
            variant: own(),
            ..metric("generated", text, "channel_distance", "", Some(1.0))
        };
        let metrics = vec![strange, known];
        Report {
            title: own(),
            facts: vec![(own(), own())],
            verdicts: vec![Verdict {
                verdict: own(),
                split: own(),
                outcome: Outcome::Lost,
                tests: vec![
                    VerdictTest { outcome: Outcome::Lost, ..test_of(text) },
                    test_of(text),
                    VerdictTest { message: String::new(), ..test_of(text) },
                ],
            }],
            notes: vec![own()],
            checks: vec![CheckLine {
                set: own(),
                stage: own(),
                by_construction: true,
                check: own(),
                worst_message: own(),
                ..CheckLine::default()
            }],
            metrics: metrics.clone(),
            worst: vec![WorstMotion {
                name: own(),
                facts: vec![(own(), own())],
                failed: vec![own()],
                svg: own(),
            }],
            against: Some(ComparedRun {
                run: own(),
                paired: vec![PairedNumber {
                    metric: own(),
                    variant: own(),
                    split: own(),
                    difference: 1.0,
                    ..PairedNumber::default()
                }],
                metrics,
                settings: vec![(own(), own(), own())],
            }),
        }
    }

    #[test]
    fn text_from_outside_stays_text() {
        let page = page(&report_of("</style></title><script>alert('1')</script><b>&\"'"));
        assert!(!page.contains("<script") && !page.contains("<b>"));
        assert_eq!(page.matches("</style>").count(), 1);
        assert_eq!(page.matches("</title><style>").count(), 0);
        let told = "&lt;/style&gt;&lt;/title&gt;&lt;script&gt;alert(&#39;1&#39;)&lt;/script&gt;\
                    &lt;b&gt;&amp;&quot;&#39;";
        assert!(page.contains(&format!("<h1>{told}</h1>")));
        assert!(page.contains(&format!("<code>{told}</code>")));
        assert!(page.contains(&format!("; {told}\">1.00</td>")));
        assert!(page.contains(&format!("<li class=\"bad\">{told}</li>")));
        // The verdicts, their tests, the caveats and the stage of a check.
        assert!(
            page.contains(&format!("</span> {told} <small>{told}</small></h2>\n<p>{told}</p>"))
        );
        assert!(page.contains(&format!("<tr><th scope=\"row\">{told} <small>{told}</small></th>")));
        assert!(page.contains(&format!("<td>1.00 {told} <span class=\"interval\">")));
        assert!(page.contains(&format!("<td>{told} 0.5 {told}</td>")));
        assert!(page.contains(&format!("<td class=\"text\">{told} <small>{told}</small></td>")));
        assert!(page.contains(&format!("<ul class=\"notes\">\n<li>{told}</li>")));
        assert!(page.contains(&format!("<h3>{told} checks, {told} <small>")));
        assert!(page.contains(&format!("<img alt=\"Plot of {told}\"")));
    }

    proptest! {
        #[test]
        fn no_text_changes_the_elements_of_the_page(text in any::<String>()) {
            let n_elements = |page: &str| page.matches('<').count();
            // A letter where the text is not empty, which would leave out elements.
            let plain = if text.is_empty() { "" } else { "x" };
            let (found, wanted) = (page(&report_of(&text)), page(&report_of(plain)));
            prop_assert_eq!(n_elements(&found), n_elements(&wanted));
        }
    }
}
