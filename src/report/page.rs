//! Writes the page.

use askama::Template;
use base64::display::Base64Display;
use base64::engine::general_purpose::{GeneralPurpose, STANDARD};

use super::against::AgainstSection;
use super::dial::DialSection;
use super::panel::VerdictsSection;
use super::sanity::SanitySection;
use super::tables::{self, MetricsSections};
use super::{Report, WorstMotion};

const STYLE: &str = include_str!("templates/page.css");

/// The page. Every value is escaped but for those that the template marks as safe: the style, and sections, which
/// are templates themselves.
#[derive(Template)]
#[template(path = "report/templates/page.html")]
struct Page<'a> {
    title: &'a str,
    style: &'static str,
    facts: &'a [(String, String)],
    verdicts: VerdictsSection<'a>,
    /// Ids and headings of the sections that are there.
    links: Vec<(&'static str, &'static str)>,
    sanity: Option<SanitySection<'a>>,
    metrics: Option<MetricsSections<'a>>,
    dial: Option<DialSection<'a>>,
    against: Option<AgainstSection<'a>>,
    worst: &'a [WorstMotion],
}

/// Returns the report as HTML that is complete in itself. The same report gives the same text.
///
/// Whatever comes from outside is text there, and pictures are images: nothing can become markup or script.
pub fn page(report: &Report) -> String {
    let page = Page {
        title: &report.title,
        style: STYLE,
        facts: &report.facts,
        verdicts: VerdictsSection::new(report),
        links: links(report),
        sanity: SanitySection::new(report),
        metrics: MetricsSections::new(report),
        dial: DialSection::new(report),
        against: report.against.as_ref().map(|other| AgainstSection::new(report, other)),
        worst: &report.worst,
    };
    let mut out = page.render().expect("invariant: a string takes all that is written to it");
    out.push('\n');
    out
}

/// Returns links to the sections that are there.
fn links(report: &Report) -> Vec<(&'static str, &'static str)> {
    let mut links = Vec::new();
    if !report.checks.is_empty() {
        links.push(("sanity", "Sanity checks"));
    }
    if !report.metrics.is_empty() {
        links.push((tables::SUBJECTS_ID, tables::SUBJECTS_HEADING));
    }
    links.extend(tables::sections(report).iter().map(|section| (section.id(), section.heading())));
    if report.dial.len() > 1 {
        links.push(("consistency", "What consistency does"));
    }
    if report.against.is_some() {
        links.push(("against", "Comparison"));
    }
    if !report.worst.is_empty() {
        links.push(("worst", "Worst motions"));
    }
    links
}

impl WorstMotion {
    /// Returns the picture for an image, in which nothing can run or be asked of a network.
    fn svg_base64(&self) -> Base64Display<'_, 'static, GeneralPurpose> {
        Base64Display::new(self.svg.as_bytes(), &STANDARD)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::report::example::{example, metric, with_interval};
    use crate::report::names::SUBJECTS;
    use crate::report::{
        BY_CONSTRUCTION, CheckLine, ComparedRun, DialRun, Metric, Outcome, PairedNumber, Verdict,
        VerdictTest,
    };

    #[test]
    fn every_section_is_there() {
        let page = page(&example());
        assert!(!page.contains("{{") && !page.contains("{%") && page.ends_with("\n</html>\n"));
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

    /// Writes the page of all subjects for a look at it:
    /// `MOTIONGEN_PAGE=tests/golden/report/example.html cargo test --lib example_page -- --ignored`.
    #[test]
    #[ignore = "writes a file"]
    fn example_page_to_look_at() {
        let file = std::env::var_os("MOTIONGEN_PAGE").expect("MOTIONGEN_PAGE names a file");
        std::fs::write(file, page(&of_all_subjects())).expect("written");
    }

    #[test]
    fn the_page_is_the_one_that_is_kept() {
        let kept = include_str!("../../tests/golden/report/example.html");
        let page = page(&of_all_subjects());
        for (line, (found, wanted)) in (1..).zip(page.lines().zip(kept.lines())) {
            assert_eq!(found, wanted, "line {line}");
        }
        assert_eq!(page.len(), kept.len());
    }

    /// Returns the example with some numbers of every subject.
    fn of_all_subjects() -> Report {
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
        report
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
            dial: [-1.0, 1.0]
                .map(|consistency| DialRun {
                    run: own(),
                    consistency,
                    is_this: consistency > 0.0,
                    metrics: metrics.clone(),
                })
                .into(),
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
