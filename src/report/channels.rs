//! One bar for each channel: how far its values are from those of the ground truth.

use super::Metric;
use super::chart::{SubjectKey, color_class, tenths, told};
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

/// The channels of one split: a bar for what was generated and one for held-out real motion; where neither has
/// numbers, for the first subject that has.
pub(super) struct BarFigure {
    pub caption: String,
    pub shown: Vec<SubjectKey>,
    pub rows: Vec<BarRow>,
    pub width_px: f64,
    pub height_px: f64,
    pub bar_px: f64,
    /// Where names end, bars begin, and the longest bar ends.
    pub names_px: f64,
    pub left_px: f64,
    pub right_px: f64,
    pub bottom_px: f64,
    pub foot: String,
    pub longest: String,
}

/// A channel.
pub(super) struct BarRow {
    pub name: String,
    /// The numbers of all subjects, as a sentence has them.
    pub numbers: String,
    pub baseline_px: f64,
    pub bars: Vec<Bar>,
    /// Where the longer bar ends, and the first one's number.
    pub end: String,
    pub value: String,
}

pub(super) struct Bar {
    pub y_px: f64,
    pub width: String,
    pub class: String,
}

impl BarFigure {
    /// Draws rows of channels.
    pub fn new(rows: &[&Row], caption: &str) -> Self {
        let shown = shown(rows);
        let shown_values = |row: &Row| -> Vec<Option<f64>> {
            shown.iter().map(|subject| row.of(subject).and_then(Metric::finite)).collect()
        };
        let longest = rows.iter().flat_map(|row| shown_values(row)).flatten().fold(0.0, f64::max);
        let room = WIDTH_PX - NAMES_PX - VALUES_PX;
        let length = |x: f64| if longest > 0.0 { (x / longest).max(0.0) * room } else { 0.0 };
        let bottom_px = rows.len() as f64 * ROW_PX;
        let height_px = bottom_px + FOOT_PX;
        let bar_row = |(i, row): (usize, &&Row)| {
            let top = i as f64 * ROW_PX;
            let all: Vec<String> = row.cells.iter().flatten().map(|metric| told(metric)).collect();
            let values = shown_values(row);
            let bars = shown.iter().zip(&values).enumerate();
            let end = values.iter().flatten().map(|x| length(*x)).fold(0.0, f64::max);
            BarRow {
                name: words(row.variant),
                numbers: all.join("; "),
                baseline_px: top + 12.0,
                bars: bars
                    .map(|(j, (subject, value))| Bar {
                        y_px: top + 2.0 + j as f64 * BAR_PX,
                        width: tenths(value.map_or(0.0, length)),
                        class: color_class(subject),
                    })
                    .collect(),
                end: tenths(NAMES_PX + end + 5.0),
                value: value(values.first().copied().flatten()),
            }
        };
        Self {
            caption: caption.to_owned(),
            rows: rows.iter().enumerate().map(bar_row).collect(),
            shown: shown.iter().map(|subject| SubjectKey::new(subject)).collect(),
            width_px: WIDTH_PX,
            height_px,
            bar_px: BAR_PX,
            names_px: NAMES_PX - 6.0,
            left_px: NAMES_PX,
            right_px: NAMES_PX + room,
            bottom_px,
            foot: tenths(height_px - 3.0),
            longest: number(longest),
        }
    }
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
    use super::*;
    use crate::report::example::metric;
    use crate::report::rows::{rows, subjects};

    fn figure(metrics: &[Metric]) -> String {
        let rows = rows(metrics, &subjects(metrics));
        let figure = BarFigure::new(&rows.iter().collect::<Vec<_>>(), "unseen music");
        FigureMarkup { figure }.to_string()
    }

    #[derive(askama::Template)]
    #[template(path = "report/templates/bars.html")]
    struct FigureMarkup {
        figure: BarFigure,
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
    fn without_the_two_the_first_subject_with_numbers_is_drawn() {
        let told = figure(&[of("retrieval", "x", Some(0.0)), of("mean_motion", "x", Some(0.0))]);
        assert_eq!(told.matches("<rect").count(), 1);
        assert!(told.contains("width=\"0.0\" height=\"6\" class=\"of-retrieval\""));
    }
}
