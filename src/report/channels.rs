//! One bar for each channel: how far its values are from those of the ground truth.

use super::Metric;
use super::chart::{color_class, told};
use super::html::{Escaped, put};
use super::names::{HELD_OUT_TRUTH, OWN, words};
use super::numbers::{number, value};
use super::rows::Row;

/// Sizes in CSS pixels.
const WIDTH_PX: f64 = 520.0;
const NAMES_PX: f64 = 150.0;
const VALUES_PX: f64 = 52.0;
const ROW_PX: f64 = 17.0;
const FOOT_PX: f64 = 16.0;
const BAR_PX: f64 = 6.0;

/// Writes the channels of one split as a figure with a bar for what was generated and one for held-out real
/// motion; where neither has numbers, for every subject that has.
pub(super) fn bars(out: &mut String, rows: &[&Row], caption: &str) {
    let shown = shown(rows);
    let shown_values = |row: &Row| -> Vec<Option<f64>> {
        shown.iter().map(|subject| row.of(subject).and_then(Metric::finite)).collect()
    };
    let longest = rows.iter().flat_map(|row| shown_values(row)).flatten().fold(0.0, f64::max);
    let room = WIDTH_PX - NAMES_PX - VALUES_PX;
    let length = |x: f64| if longest > 0.0 { (x / longest).max(0.0) * room } else { 0.0 };
    let bottom = rows.len() as f64 * ROW_PX;
    let height = bottom + FOOT_PX;
    put!(out, "<figure><figcaption>{}", Escaped(caption));
    for subject in &shown {
        put!(
            out,
            " <span class=\"key {}\">{}</span>",
            color_class(subject),
            Escaped(&words(subject))
        );
    }
    put!(
        out,
        "</figcaption><div class=\"scroll\"><svg class=\"bars\" width=\"{WIDTH_PX}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH_PX} {height}\" role=\"img\"><title>{}</title>",
        Escaped(caption)
    );
    for (i, row) in rows.iter().enumerate() {
        let top = i as f64 * ROW_PX;
        let baseline = top + 12.0;
        let all: Vec<String> = row.cells.iter().flatten().map(|metric| told(metric)).collect();
        put!(
            out,
            "<g><title>{}: {}</title><text x=\"{}\" y=\"{baseline}\" class=\"end\">{}</text>",
            Escaped(&words(row.variant)),
            Escaped(&all.join("; ")),
            NAMES_PX - 6.0,
            Escaped(&words(row.variant))
        );
        let values = shown_values(row);
        for (j, (subject, value)) in shown.iter().zip(&values).enumerate() {
            let y = top + 2.0 + j as f64 * BAR_PX;
            put!(
                out,
                "<rect x=\"{NAMES_PX}\" y=\"{y}\" width=\"{:.1}\" height=\"{BAR_PX}\" class=\"{}\"/>",
                value.map_or(0.0, length),
                color_class(subject)
            );
        }
        let end = values.iter().flatten().map(|x| length(*x)).fold(0.0, f64::max);
        put!(
            out,
            "<text x=\"{:.1}\" y=\"{baseline}\">{}</text></g>",
            NAMES_PX + end + 5.0,
            value(values.first().copied().flatten())
        );
    }
    put!(out, "<path class=\"axis\" d=\"M{NAMES_PX} 0V{bottom}\"/>");
    put!(out, "<text x=\"{NAMES_PX}\" y=\"{:.1}\">0</text>", height - 3.0);
    put!(
        out,
        "<text x=\"{}\" y=\"{:.1}\" class=\"end\">{}</text></svg></div></figure>\n",
        NAMES_PX + room,
        height - 3.0,
        number(longest)
    );
}

/// Returns whose bars are drawn.
fn shown<'a>(rows: &[&Row<'a>]) -> Vec<&'a str> {
    let mut occur: Vec<&str> = Vec::new();
    for metric in rows.iter().flat_map(|row| row.cells.iter().flatten()) {
        if !occur.contains(&metric.subject.as_str()) {
            occur.push(&metric.subject);
        }
    }
    let wanted: Vec<&str> =
        [OWN, HELD_OUT_TRUTH].into_iter().filter(|subject| occur.contains(subject)).collect();
    if wanted.is_empty() { occur.into_iter().take(1).collect() } else { wanted }
}

#[cfg(test)]
mod tests {
    use super::super::example::metric;
    use super::super::rows::{rows, subjects};
    use super::*;

    fn figure(metrics: &[Metric]) -> String {
        let rows = rows(metrics, &subjects(metrics));
        let mut out = String::new();
        bars(&mut out, &rows.iter().collect::<Vec<_>>(), "unseen music");
        out
    }

    fn of(subject: &str, channel: &str, value: Option<f64>) -> Metric {
        metric(subject, "all", "channel_distance", channel, value)
    }

    #[test]
    fn bars_are_as_long_as_their_numbers() {
        let told = figure(&[
            of("generated", "velocity_x", Some(0.4)),
            of("held_out_truth", "velocity_x", Some(0.1)),
            of("mean_motion", "velocity_x", Some(9.0)),
            of("generated", "style_0", None),
            of("held_out_truth", "style_0", Some(0.2)),
        ]);
        // 318 px for 0.4.
        let bar = |y: f64, width: &str, subject: &str| {
            format!(
                "<rect x=\"150\" y=\"{y}\" width=\"{width}\" height=\"6\" class=\"of-{subject}\"/>"
            )
        };
        for wanted in [
            bar(2.0, "318.0", "generated"),
            bar(8.0, "79.5", "held-out-truth"),
            bar(19.0, "0.0", "generated"),
            bar(25.0, "159.0", "held-out-truth"),
            "<text x=\"473.0\" y=\"12\">0.400</text>".to_owned(),
            "<text x=\"314.0\" y=\"29\">–</text>".to_owned(),
            "<title>velocity x: generated: 0.400; mean motion: 9.00; held out truth: 0.100</title>"
                .to_owned(),
        ] {
            assert!(told.contains(&wanted), "{wanted} in {told}");
        }
        assert_eq!(told.matches("<rect").count(), 4);
    }

    #[test]
    fn without_the_two_whoever_has_numbers_is_drawn() {
        let told = figure(&[of("retrieval", "x", Some(0.0)), of("mean_motion", "x", Some(0.0))]);
        assert_eq!(told.matches("<rect").count(), 1);
        assert!(told.contains("width=\"0.0\" height=\"6\" class=\"of-retrieval\""));
    }
}
