use super::comparison::{Verdict, pairs, verdict};
use super::numbers::{number, with_interval};
use super::*;

fn metric(subject: &str, name: &str, variant: &str, value: f64, half: f64) -> Metric {
    Metric {
        subject: subject.to_owned(),
        split: "held_out".to_owned(),
        metric: name.to_owned(),
        variant: variant.to_owned(),
        unit: String::new(),
        value: Some(value),
        ci_low: Some(value - half),
        ci_high: Some(value + half),
        n: 7,
        protocol: "seven <songs>".to_owned(),
    }
}

fn report() -> Report {
    let line = |set: &str, check: &str, n_passed: usize| CheckLine {
        set: set.to_owned(),
        check: check.to_owned(),
        threshold: 0.05,
        n: 5,
        n_passed,
        worst_value: 0.0612,
        worst_message: "velocity against position: 0.0612 m/s".to_owned(),
    };
    Report {
        title: "Evaluation of <b>\"a\" & 'b'".to_owned(),
        facts: vec![("model".to_owned(), "demo".to_owned())],
        checks: vec![line("reference", "jerk", 5), line("strict", "velocity", 4)],
        metrics: vec![
            metric("ground_truth", "fid_k", "axes", 0.0, 0.1),
            metric("generated", "fid_k", "axes", 2.5, 0.5),
            metric("generated", "pass_rate", "reference", 1.0, 0.0),
            metric("generated", "pass_rate", "strict", 0.8, 0.1),
            metric("generated", "locking_r2", "per_song", 0.0704, 0.01),
            metric("generated", "locking_wrong_r2", "per_song", 0.0258, 0.01),
            metric("generated", "locking_p", "per_song", 0.005, 0.0),
            metric("generated", "fid_k", "axes_compat", 3.25, 0.5),
            Metric { value: None, ci_low: None, ..metric("generated", "fid_g", "", 0.0, 0.0) },
            metric("generated", "of_its_own", "", 12345.6, 1.0),
        ],
        worst: vec![Worst {
            name: "a & b".to_owned(),
            facts: Vec::new(),
            failed: vec!["too <fast>".to_owned()],
            svg: "<?xml version=\"1.0\"?>\n<svg id=\"picture\"></svg>".to_owned(),
        }],
        against: None,
    }
}

#[test]
fn numbers_have_three_digits_that_count() {
    for (x, text) in [
        (0.0, "0"),
        (1.0, "1"),
        (0.005, "0.005"),
        (0.070_44, "0.0704"),
        (0.123_456, "0.123"),
        (-2.5, "-2.5"),
        (15.049, "15"),
        (302.466, "302"),
        (12_345.6, "12346"),
        (3.14e-5, "3.1e-5"),
        (2.5e7, "2.5e7"),
        (f64::NAN, "–"),
    ] {
        assert_eq!(number(x), text);
    }
    let m = metric("generated", "fid_k", "axes", 2.5, 0.25);
    assert_eq!(with_interval(&m), "2.5 [2.25, 2.75]");
    assert_eq!(with_interval(&Metric { ci_low: None, ..m.clone() }), "2.5");
    assert_eq!(with_interval(&Metric { value: None, ..m }), "–");
}

#[test]
fn the_page_needs_no_network_and_takes_nothing_for_markup() {
    let page = page(&report());
    for foreign in
        ["http://", "https://", "<script", "<b>\"a\"", "<songs>", "<fast>", "<?xml", "{{"]
    {
        assert!(!page.contains(foreign), "{foreign}");
    }
    assert!(page.contains("<h1>Evaluation of &lt;b&gt;&quot;a&quot; &amp; &#39;b&#39;</h1>"));
    assert!(page.contains("<svg id=\"picture\"></svg>"));
    assert!(page.contains("title=\"too few (n = 7); seven &lt;songs&gt;\">–</td>"));
    assert!(page.contains("2.5 <span class=\"interval\">[2, 3]</span>"));
    assert!(page.contains("<td class=\"bad\">4 of 5</td>"));
}

#[test]
fn sections_subjects_and_defective_formulas_have_their_order() {
    let page = page(&report());
    let at = |text: &str| page.find(text).unwrap_or_else(|| panic!("{text} is not there"));
    assert!(at("Sanity: reference checks") < at("Sanity: strict checks"));
    assert!(at("Does it follow the music?") < at("Is it like real motion?"));
    assert!(at("Is it sound?") < at("Other numbers") && at("Other numbers") < at("of its own"));
    assert!(at("<th>generated</th>") < at("<th>ground truth</th>"));
    assert!(at("fid k, axes<") < at("misplaced") && at("misplaced") < at("fid k, axes compat"));
    // A subject without a number of a metric still has its place.
    assert!(page.contains("<td>–</td>"));
}

#[test]
fn the_short_account_rests_on_its_numbers() {
    let told = page(&report());
    assert!(told.contains(
        "100 % of the motions pass the reference&#39;s checks, 80 % the strict ones too."
    ));
    assert!(told.contains(
        "It follows the bars of music it did not learn from: 7.04 % of its vertical velocity repeats with \
         them, 2.58 % at wrong tempi (p = 0.005)."
    ));
    let mut chance = report();
    chance.metrics[6].value = Some(0.04);
    assert!(
        page(&chance).contains("It is not shown to follow the bars of music it did not learn from")
    );
}

#[test]
fn the_terminal_shows_key_numbers_and_who_failed() {
    let mut shown = report();
    shown.metrics.truncate(4);
    assert_eq!(
        terminal(&shown),
        "reference checks: all motions pass 1 of 1\n\
         strict checks: all motions pass 0 of 1\n  \
           velocity: 4 of 5 pass; the worst: velocity against position: 0.0612 m/s\n\
         \n\
         held out              generated  ground truth\n\
         pass rate, reference          1\n\
         pass rate, strict           0.8\n\
         fid k, axes                 2.5             0\n"
    );
}

#[test]
fn runs_are_compared_by_their_intervals() {
    let there = |value: f64, half: f64| metric("generated", "fid_k", "axes", value, half);
    let here = metric("generated", "fid_k", "axes", 2.5, 0.5);
    for (other, expected) in [
        (there(2.9, 0.2), Verdict::Within),
        (there(3.5, 0.2), Verdict::Better),
        (there(1.0, 0.2), Verdict::Worse),
        (Metric { ci_high: None, ..there(1.0, 0.2) }, Verdict::Unknown),
    ] {
        assert_eq!(verdict(&other, &here), expected, "{other:?}");
    }
    let speed = |value| metric("generated", "mean_speed", "", value, 0.1);
    assert_eq!(verdict(&speed(1.0), &speed(2.0)), Verdict::Differs);
    let rate = |value| metric("generated", "pass_rate", "strict", value, 0.05);
    assert_eq!(verdict(&rate(0.5), &rate(0.8)), Verdict::Better);

    let mut report = report();
    report.against = Some(Against {
        run: "before".to_owned(),
        metrics: vec![there(4.0, 0.5), rate(0.85)],
        settings: vec![("guidance".to_owned(), "1".to_owned(), "4".to_owned())],
    });
    let against = report.against.clone().expect("just set");
    let found: Vec<(String, f64)> = pairs(&report, &against)
        .iter()
        .map(|pair| (pair.here.variant.clone(), (pair.difference * 1e3).round() / 1e3))
        .collect();
    assert_eq!(found, [("axes".to_owned(), -1.5), ("strict".to_owned(), -0.05)]);
    let text = terminal(&report);
    assert!(text.ends_with(
        "against run before:\n  guidance: 1 there, 4 here\n  fid k axes: 4 there, 2.5 here (-1.5), better\n"
    ), "{text}");
    assert!(page(&report).contains("<td class=\"text good\">better</td>"));
}
