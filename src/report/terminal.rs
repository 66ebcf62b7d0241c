//! The report as text for a terminal.

use std::fmt::Write as _;

use super::comparison::{Pair, counts, family, pairs};
use super::dial;
use super::names::{ALL, music, words};
use super::numbers::{difference, short, value};
use super::rows::{Row, rows, subjects, telling_split};
use super::sanity::{FINAL, PassCount, SETS, lines, sets, stages};
use super::verdicts::shown;
use super::{BY_CONSTRUCTION, CheckLine, ComparedRun, Outcome, Report};

/// No line has more characters.
const MAX_COLUMNS: usize = 120;
/// Space between two columns of a table.
const GAP: &str = "  ";
/// Names of rows have at least so much room, before the last subjects are left out.
const MIN_NAME_COLUMNS: usize = 24;
/// Lines that go on are indented so far.
const INDENT: &str = "      ";
/// Most numbers of a comparison that are listed.
const MAX_PAIRS: usize = 12;

/// Numbers that a terminal shows, by metric and the variant that is preferred; the page has all.
const KEY: [[&str; 2]; 19] = [
    ["pass_rate", "reference"],
    ["pass_rate", "strict"],
    ["window_pass_rate", "strict"],
    ["share_upright", ""],
    ["locking_r2", "per_song"],
    ["locking_p", "per_song"],
    ["coupling_ratio", "per_song"],
    ["beat_alignment_lift", "music_to_motion 0.1 s"],
    ["fid_k", "axes"],
    ["fid_g", ""],
    ["feature_shift", ""],
    ["jerk_ratio", ""],
    ["jerk_mean", ""],
    ["diversity", "axes"],
    ["unison_index", ""],
    ["gmc_correlation", ""],
    ["gmr", ""],
    ["tif", ""],
    ["group_locking", "least_dancer"],
];

/// Returns the report as plain text of at most 120 columns.
pub fn terminal(report: &Report) -> String {
    let mut out = String::new();
    verdicts(&mut out, report);
    out.push('\n');
    sanity(&mut out, report);
    numbers(&mut out, report);
    for line in dial::lines(report) {
        put_wrapped(&mut out, &line);
    }
    if let Some(against) = &report.against {
        compared(&mut out, report, against);
    }
    let lines = out.lines().map(|line| fitted(line.trim_end(), MAX_COLUMNS) + "\n");
    lines.collect()
}

/// Writes a line for each verdict, one for each test that is lost, and the caveats.
fn verdicts(out: &mut String, report: &Report) {
    for verdict in shown(report) {
        let songs = match verdict.songs.as_str() {
            "" => String::new(),
            songs => format!(" ({songs})"),
        };
        let word = verdict.outcome.word();
        put_wrapped(out, &format!("{word:<6}{}{songs} {}", verdict.question, verdict.counts()));
        for test in verdict.with(Outcome::Lost) {
            put_wrapped(out, &format!("{INDENT}{}: {}", words(&test.test), test.sentence()));
        }
    }
    for note in &report.notes {
        put_wrapped(out, &format!("note: {note}"));
    }
}

fn sanity(out: &mut String, report: &Report) {
    let mut all = stages(&report.checks);
    if all.is_empty() {
        all.push(FINAL);
    }
    for stage in all {
        let [reference, strict] = SETS.map(|set| PassCount::of(report, stage, set).words());
        put_line(
            out,
            format_args!("sanity, {stage} motion: reference {reference}, strict {strict}"),
        );
        for set in sets(&report.checks) {
            for line in lines(report, stage, set).filter(|line| line.n_passed < line.n) {
                failed(out, line);
            }
        }
    }
}

fn failed(out: &mut String, line: &CheckLine) {
    let CheckLine { set, check, n, n_passed, threshold, worst_value, worst_message, .. } = line;
    let worst = match worst_message.as_str() {
        "" => format!("{}, threshold {}", short(*worst_value), short(*threshold)),
        message => message.to_owned(),
    };
    let given = if line.by_construction { format!(" ({BY_CONSTRUCTION})") } else { String::new() };
    put_line(
        out,
        format_args!("  {set} {check}{given}: {n_passed} of {n} passed; the worst: {worst}"),
    );
}

/// Writes the key numbers as a table for each split, a column for each subject.
fn numbers(out: &mut String, report: &Report) {
    let subjects = subjects(&report.metrics);
    let rows = rows(&report.metrics, &subjects);
    let key: Vec<&Row> = KEY.iter().filter_map(|name| key_row(report, &rows, *name)).collect();
    let mut lines: Vec<Vec<String>> = Vec::new();
    for (i, row) in key.iter().enumerate() {
        if key[..i].iter().any(|before| before.split == row.split) {
            continue;
        }
        lines.push(vec![String::new(); subjects.len() + 1]);
        let names = subjects.iter().map(|subject| words(subject));
        lines.push(std::iter::once(music(row.split)).chain(names).collect());
        lines.extend(key.iter().filter(|other| other.split == row.split).map(|row| cells(row)));
    }
    table(out, &lines);
}

fn cells(row: &Row) -> Vec<String> {
    let mut name = format!("{} {}", row.metric, row.variant).trim_end().to_owned();
    if !row.unit.is_empty() {
        name = format!("{name}, {}", row.unit);
    }
    let values = row.cells.iter().map(|cell| value(cell.and_then(|metric| metric.value)));
    std::iter::once(name).chain(values).collect()
}

/// Returns the row of a key number: of the music that was learned from least, but pass rates of all
/// motions, as the checks are; of the first variant there is where the preferred one is missing.
fn key_row<'a>(
    report: &Report,
    rows: &'a [Row<'a>],
    [metric, variant]: [&str; 2],
) -> Option<&'a Row<'a>> {
    let row_of_variant = |variant: &str| {
        let split = match metric {
            "pass_rate" => ALL,
            _ => telling_split(&report.metrics, [metric, variant]),
        };
        let is_it = |row: &&&Row| row.metric == metric && row.variant == variant;
        let mut found = rows.iter().filter(|row| is_it(&row));
        found.clone().find(|row| row.split == split).or_else(|| found.next())
    };
    let other = || rows.iter().find(|row| row.metric == metric && !row.is_compat());
    row_of_variant(variant).or_else(|| match metric {
        // Sets of checks are not variants of one number.
        "pass_rate" => None,
        _ => row_of_variant(other()?.variant),
    })
}

/// Writes lines of cells, of which the first is a name.
fn table(out: &mut String, lines: &[Vec<String>]) {
    let n_cells = lines.iter().map(Vec::len).max().unwrap_or(0);
    let width = |i: usize| lines.iter().map(|line| line[i].chars().count()).max().unwrap_or(0);
    let mut widths: Vec<usize> = (0..n_cells).map(width).collect();
    let Some(names) = widths.first().copied() else { return };
    let width_of_values =
        |widths: &[usize]| widths[1..].iter().map(|n| n + GAP.len()).sum::<usize>();
    while widths.len() > 2 && names.min(MIN_NAME_COLUMNS) + width_of_values(&widths) > MAX_COLUMNS {
        widths.pop();
    }
    widths[0] = names.min(MAX_COLUMNS.saturating_sub(width_of_values(&widths)));
    for line in lines {
        let mut text = format!("{:<1$}", fitted(&line[0], widths[0]), widths[0]);
        for (cell, width) in line.iter().zip(&widths).skip(1) {
            let _ = write!(text, "{GAP}{cell:>width$}");
        }
        put_line(out, format_args!("{}", text.trim_end()));
    }
    let n_left_out = n_cells - widths.len();
    if n_left_out > 0 {
        put_line(out, format_args!("({n_left_out} more subjects are on the page)"));
    }
}

fn compared(out: &mut String, report: &Report, against: &ComparedRun) {
    let pairs = pairs(report, against);
    out.push('\n');
    if pairs.is_empty() {
        put_line(out, format_args!("compared with {}: no number in common", against.run));
    } else {
        put_line(out, format_args!("compared with {}, {}", against.run, counts(&pairs)));
    }
    if !pairs.is_empty() {
        put_wrapped(out, &format!("  {}", family(against)));
    }
    for (setting, there, here) in &against.settings {
        put_line(out, format_args!("  {setting}: {there} there, {here} here"));
    }
    let notable: Vec<&Pair> = pairs.iter().filter(|pair| pair.is_notable()).collect();
    for pair in notable.iter().take(MAX_PAIRS) {
        let here = pair.here;
        put_line(
            out,
            format_args!(
                "  {:<7}  {}, {}: {} there, {} here ({}, p {}, {} songs)",
                pair.change.words(),
                format!("{} {}", here.metric, here.variant).trim_end(),
                music(&here.split),
                value(pair.there.value),
                value(here.value),
                pair.difference.map_or_else(String::new, difference),
                value(pair.paired.and_then(|paired| paired.p_holm)),
                pair.paired.map_or(0, |paired| paired.n_songs)
            ),
        );
    }
    if notable.len() > MAX_PAIRS {
        put_line(out, format_args!("  and {} more", notable.len() - MAX_PAIRS));
    }
}

fn put_line(out: &mut String, text: std::fmt::Arguments<'_>) {
    out.push_str(&inert(&text.to_string()));
    out.push('\n');
}

/// Writes a text, which goes on below where it is longer than a line.
fn put_wrapped(out: &mut String, text: &str) {
    let n_chars = |text: &str| text.chars().count();
    let mut words = text.split(' ');
    let mut line = words.next().unwrap_or_default().to_owned();
    for word in words {
        if n_chars(&line) + 1 + n_chars(word) > MAX_COLUMNS {
            put_line(out, format_args!("{line}"));
            line = format!("{INDENT}  {word}");
        } else {
            line.push(' ');
            line.push_str(word);
        }
    }
    put_line(out, format_args!("{line}"));
}

/// Returns a text from outside with replacement characters for what would command a terminal.
fn inert(text: &str) -> String {
    let inert_character = |c: char| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c };
    text.chars().map(inert_character).collect()
}

/// Returns a text of at most `n` characters, with `…` for what is cut off.
fn fitted(text: &str, n: usize) -> String {
    if text.chars().count() <= n {
        return text.to_owned();
    }
    text.chars().take(n.saturating_sub(1)).chain(std::iter::once('…')).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::example::{check, example, metric, test, verdict};
    use crate::report::{Metric, VerdictTest};

    /// What stands over the rest where no verdict was measured.
    const ALL_OPEN: &str = "\
open  Is it sound? not measured
open  Is it like real motion? not measured
open  Does it follow its music? not measured
open  Is it varied? not measured
";

    #[test]
    fn a_report_is_a_few_lines() {
        let wanted = "\
LOST  Is it sound? (all songs of the run) 3 tests: 2 lost, 1 won
      upright: 0.31 of the windows are as upright as training motion; held-out real motion has 0.97.
      jerk: The jerk is 4.1 times that of real motion, at most 1.5 is asked.
open  Is it like real motion? not measured
open  Does it follow its music? (songs that nothing was learned from) 2 tests: 1 open, 1 won
won   Is it varied? (songs that nothing was learned from) 1 test: 1 won
note: Nobody knows which songs this model learned from.
note: Each motion is the best of 8 candidates, chosen by R².

sanity, raw motion: reference not measured, strict 31 of 120 (25.8 %)
  strict velocity: 31 of 120 passed; the worst: 512, threshold 404
sanity, final motion: reference 118 of 120 (98.3 %), strict 96 of 120 (80 %)
  reference phase: 118 of 120 passed; the worst: 512, threshold 404
  strict jerk: 96 of 120 passed; the worst: Mean jerk: 512

all music            generated  shuffled  mean motion  held out truth  training truth
pass_rate reference      0.983         –            –               –               –

held-out music       generated  shuffled  mean motion  held out truth  training truth
locking_r2 per_song     0.0990   0.00900            –               –               –
locking_p per_song     0.00500     0.710            –               –               –
fid_k axes                2.50         –         31.2           0.800               –
fid_g                     1.50         –            –               –               –
jerk_mean, m/s³           61.2         –            –               –               –
diversity axes            3.00         –            –               –               –

compared with before, 2 numbers: 1 better, 1 not paired
  1 number is compared song by song; it is called better, worse or different only where p is below 0.05
  steps: 20 there, 50 here
  better   fid_k axes, held-out music: 3.50 there, 2.50 here (-1.00, p 0.0120, 11 songs)
";
        assert_eq!(terminal(&example()), wanted);
    }

    #[test]
    fn an_empty_report_says_that_nothing_was_measured() {
        let sanity = "sanity, final motion: reference not measured, strict not measured\n";
        assert_eq!(terminal(&Report::default()), format!("{ALL_OPEN}\n{sanity}"));
    }

    #[test]
    fn verdicts_are_in_ascii_and_a_long_sentence_goes_on_below() {
        let message = "0.31 of the windows are as upright as those of training motion, where at least \
                       0.92 is asked, which is 0.95 of the 0.97 that held-out real motion has.";
        let lost = VerdictTest {
            message: message.to_owned(),
            ..test("share_upright", Outcome::Lost, 0.31, 0.92)
        };
        let report = Report {
            verdicts: vec![verdict("sound", "unknown", Outcome::Lost, vec![lost])],
            notes: vec!["x".repeat(200)],
            ..Report::default()
        };
        let text = terminal(&report);
        let wanted = "\
LOST  Is it sound? (nobody knows whether these songs were learned from) 1 test: 1 lost
      share upright: 0.31 of the windows are as upright as those of training motion, where at least 0.92 is asked, which
        is 0.95 of the 0.97 that held-out real motion has.
open  Is it like real motion? not measured
";
        assert!(text.starts_with(wanted) && wanted.is_ascii(), "{text}");
        assert!(text.lines().all(|line| line.chars().count() <= 120), "{text}");
    }

    #[test]
    fn lines_are_no_longer_than_a_terminal() {
        let long = "a word and ".repeat(30);
        let mut report = Report {
            checks: vec![CheckLine {
                worst_message: long.clone(),
                ..check("strict", "jerk", 2, 1)
            }],
            metrics: (0..20)
                .map(|i| metric(&format!("visitor number {i}"), "all", "fid_k", "axes", Some(1.0)))
                .collect(),
            ..Report::default()
        };
        report.metrics.push(metric("generated", "all", "diversity", &long, Some(1.0)));
        let lost = VerdictTest { message: long.clone(), ..test(&long, Outcome::Lost, 1.0, 0.5) };
        report.verdicts = vec![verdict(&long, &long, Outcome::Lost, vec![lost])];
        report.notes = vec![long.clone()];
        report.against = Some(ComparedRun {
            run: long.clone(),
            settings: vec![(long.clone(), long.clone(), long)],
            ..ComparedRun::default()
        });
        let text = terminal(&report);
        let lengths: Vec<usize> = text.lines().map(|line| line.chars().count()).collect();
        assert_eq!(lengths.iter().max(), Some(&120), "{text}");
        let head = format!("\nall music{:30}generated  visitor number 0", "");
        assert!(text.contains(&head), "{text}");
        assert!(text.contains("(16 more subjects are on the page)\n"), "{text}");
        assert!(text.contains("\ndiversity a word and a word and a wo…       1.00"), "{text}");
    }

    #[test]
    fn text_from_outside_commands_no_terminal() {
        let hostile = "\u{1b}[2J\nnext";
        let lost =
            VerdictTest { message: hostile.to_owned(), ..test(hostile, Outcome::Lost, 1.0, 0.5) };
        let report = Report {
            verdicts: vec![verdict(hostile, hostile, Outcome::Lost, vec![lost])],
            notes: vec![hostile.to_owned()],
            checks: vec![CheckLine {
                stage: hostile.to_owned(),
                worst_message: hostile.to_owned(),
                ..check("strict", "jerk", 2, 1)
            }],
            metrics: vec![Metric {
                unit: hostile.to_owned(),
                ..metric(hostile, "all", "fid_k", hostile, Some(1.0))
            }],
            against: Some(ComparedRun { run: hostile.to_owned(), ..ComparedRun::default() }),
            ..Report::default()
        };
        let text = terminal(&report);
        assert!(!text.contains('\u{1b}') && !text.contains("\nnext"), "{text}");
        assert_eq!(text.matches("\u{fffd}[2J\u{fffd}next").count(), 11, "{text}");
    }

    #[test]
    fn another_variant_takes_the_place_of_one_that_is_missing() {
        let report = Report {
            metrics: vec![
                metric("generated", "all", "fid_k", "axes_compat", Some(9.0)),
                metric("generated", "all", "fid_k", "markers", Some(1.5)),
                metric("generated", "held_out", "fid_k", "markers", None),
                metric("generated", "all", "pass_rate", "house", Some(0.5)),
            ],
            ..Report::default()
        };
        let wanted = "
sanity, final motion: reference not measured, strict not measured

held-out music  generated
fid_k markers           –
";
        assert_eq!(terminal(&report), format!("{ALL_OPEN}{wanted}"));
    }
}
