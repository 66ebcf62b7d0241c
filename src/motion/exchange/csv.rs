//! Motion as text: one line per frame, `frame,time_s` and the 25 channels by name.
//!
//! Numbers are the shortest that are read back bit for bit; lines end with `\n`. What is not finite
//! is written `NaN`, `inf` and `-inf`, as Python, R and Julia read it.

use std::io::{self, Write};

use ndarray::{Array2, ArrayView2, ArrayView3, Axis};

use crate::motion::channels::{CHANNEL_NAMES, MOTION_DIM};
use crate::units::{FPS, frames_to_s};

/// Columns before the channels: the number of the frame, and its time in seconds.
const LEADING: [&str; 2] = ["frame", "time_s"];
/// The column that tells the dancers of a group apart.
const DANCER: &str = "dancer";
const N_COLUMNS: usize = LEADING.len() + MOTION_DIM;

/// Times may be off by half a frame, so that they may be rounded but of no other rate.
const TIME_TOLERANCE_S: f64 = 0.5 / FPS;

const SHOWN_CHARS: usize = 40;

/// Why a text was refused; lines and columns count from 1.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CsvError {
    /// Not even a header.
    #[error(
        "csv has no lines, expected one that names {N_COLUMNS} columns; write the motion again"
    )]
    Empty,
    /// More or fewer values than columns.
    #[error(
        "csv line {line} has {found} values, expected {N_COLUMNS}; write frame, time and 25 \
         channels with commas between them"
    )]
    Width { line: usize, found: usize },
    /// Another column than the format has there.
    #[error(
        "csv line {line} column {column} is named `{found}`, expected `{expected}`; name and order \
         the columns as in a csv file of generate"
    )]
    Header { line: usize, column: usize, found: String, expected: &'static str },
    /// A value that is no number.
    #[error(
        "csv line {line} column {column} ({name}) reads `{found}`, expected {expected}; correct \
         the value or remove the file"
    )]
    Number { line: usize, column: usize, name: &'static str, found: String, expected: &'static str },
    /// A frame that is not the next.
    #[error(
        "csv line {line} column 1 (frame) is {found} where {expected} should follow; restore the \
         missing lines, or number the frames anew"
    )]
    Order { line: usize, found: usize, expected: usize },
    /// A time that is not that of the frame.
    #[error(
        "csv line {line} column 2 (time_s) is {time_s} at frame {frame}, expected {expected_s:.4} \
         at {FPS} fps; resample the motion to {FPS} frames a second"
    )]
    Time { line: usize, frame: usize, time_s: f64, expected_s: f64 },
}

/// Returns the line that names the columns, with its end.
pub fn csv_header() -> String {
    let names: Vec<&str> = column_names().collect();
    names.join(",") + "\n"
}

/// Writes motion, `[T, 25]`, with its header.
///
/// # Errors
/// The error of `out`.
pub fn write_csv(frames: ArrayView2<'_, f32>, out: &mut dyn Write) -> io::Result<()> {
    out.write_all(csv_header().as_bytes())?;
    write_csv_rows(frames, 0, out)
}

/// Writes the lines of frames, `[T, 25]`, of which the first has the number `first_frame`: a motion
/// may come in pieces.
///
/// # Errors
/// The error of `out`.
pub fn write_csv_rows(
    frames: ArrayView2<'_, f32>,
    first_frame: usize,
    out: &mut dyn Write,
) -> io::Result<()> {
    for (frame, row) in (first_frame..).zip(frames.rows()) {
        write!(out, "{frame},{:?}", frames_to_s(frame))?;
        for x in row {
            // `{:?}` is as short as `{}` and has an exponent where zeros would be many.
            write!(out, ",{x:?}")?;
        }
        out.write_all(b"\n")?;
    }
    Ok(())
}

/// Returns the line that names the columns of a group, with its end: `dancer` behind frame and time.
pub fn group_csv_header() -> String {
    let mut names: Vec<&str> = column_names().collect();
    names.insert(LEADING.len(), DANCER);
    names.join(",") + "\n"
}

/// Writes a group, `[N, T, 25]`, with its header: for every frame a line of each dancer, counted from 0.
///
/// # Errors
/// The error of `out`.
pub fn write_group_csv(group: ArrayView3<'_, f32>, out: &mut dyn Write) -> io::Result<()> {
    out.write_all(group_csv_header().as_bytes())?;
    write_group_csv_rows(group, 0, out)
}

/// Writes the lines of frames of a group, `[N, T, 25]`, of which the first has the number `first_frame`.
///
/// # Errors
/// The error of `out`.
pub fn write_group_csv_rows(
    group: ArrayView3<'_, f32>,
    first_frame: usize,
    out: &mut dyn Write,
) -> io::Result<()> {
    for (frame, dancers) in (first_frame..).zip(group.axis_iter(Axis(1))) {
        for (dancer, row) in dancers.rows().into_iter().enumerate() {
            write!(out, "{frame},{:?},{dancer}", frames_to_s(frame))?;
            for x in row {
                write!(out, ",{x:?}")?;
            }
            out.write_all(b"\n")?;
        }
    }
    Ok(())
}

/// Reads what [`write_csv`] writes; returns the channels, `[T, 25]`.
///
/// Blank lines, spaces around values, CRLF and a byte order mark do not matter; values may be
/// non-finite. The first frame may have any number. Errors: [`CsvError`] for the first line that is
/// not as it should be.
pub fn read_csv(text: &str) -> Result<Array2<f32>, CsvError> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut lines = (1..).zip(text.lines()).filter(|(_, text)| !text.trim().is_empty());
    let (line, header) = lines.next().ok_or(CsvError::Empty)?;
    check_header(line, &fields(line, header)?)?;
    let mut values = Vec::new();
    let mut expected = None;
    for (line, text) in lines {
        let fields = fields(line, text)?;
        let frame: usize = number(line, 0, fields[0], "the number of a frame")?;
        let wanted = expected.unwrap_or(frame);
        if frame != wanted {
            return Err(CsvError::Order { line, found: frame, expected: wanted });
        }
        expected = frame.checked_add(1);
        let time_s: f64 = number(line, 1, fields[1], "a time in seconds")?;
        let expected_s = frames_to_s(frame);
        // Written so that NaN fails.
        let off_s = (time_s - expected_s).abs();
        if off_s.is_nan() || off_s > TIME_TOLERANCE_S {
            return Err(CsvError::Time { line, frame, time_s, expected_s });
        }
        for (column, text) in fields.iter().enumerate().skip(LEADING.len()) {
            values.push(number::<f32>(line, column, text, "a number")?);
        }
    }
    let shape = (values.len() / MOTION_DIM, MOTION_DIM);
    Ok(Array2::from_shape_vec(shape, values).expect("every line brings 25 values"))
}

pub(super) fn column_names() -> impl Iterator<Item = &'static str> {
    LEADING.into_iter().chain(CHANNEL_NAMES)
}

fn check_header(line: usize, found: &[&str]) -> Result<(), CsvError> {
    for (i, (&found, expected)) in found.iter().zip(column_names()).enumerate() {
        if found != expected {
            return Err(CsvError::Header { line, column: i + 1, found: shown(found), expected });
        }
    }
    Ok(())
}

/// Returns the values of a line, as many as there are columns.
fn fields(line: usize, text: &str) -> Result<Vec<&str>, CsvError> {
    let fields: Vec<&str> = text.split(',').map(str::trim).collect();
    if fields.len() == N_COLUMNS {
        Ok(fields)
    } else {
        Err(CsvError::Width { line, found: fields.len() })
    }
}

/// Reads the value of column `i`, counted from 0.
fn number<T: std::str::FromStr>(
    line: usize,
    i: usize,
    text: &str,
    expected: &'static str,
) -> Result<T, CsvError> {
    text.parse().map_err(|_| CsvError::Number {
        line,
        column: i + 1,
        name: column_names().nth(i).unwrap_or_default(),
        found: shown(text),
        expected,
    })
}

fn shown(text: &str) -> String {
    text.chars().take(SHOWN_CHARS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array3, s};
    use proptest::prelude::*;

    fn written(frames: &Array2<f32>) -> String {
        let mut bytes = Vec::new();
        write_csv(frames.view(), &mut bytes).expect("memory");
        String::from_utf8(bytes).expect("text")
    }

    fn ramp(n: usize) -> Array2<f32> {
        Array2::from_shape_fn((n, MOTION_DIM), |(t, i)| t as f32 - 0.5 * i as f32)
    }

    /// Replaces the value at a line and a column, both counted from 1.
    fn replaced(text: &str, line: usize, column: usize, value: &str) -> String {
        let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
        let mut fields: Vec<&str> = lines[line - 1].split(',').collect();
        fields[column - 1] = value;
        lines[line - 1] = fields.join(",");
        lines.join("\n")
    }

    fn refusal(text: &str) -> String {
        read_csv(text).expect_err("a mistake").to_string()
    }

    #[test]
    fn the_text_is_as_documented() {
        let mut frames = Array2::zeros((2, MOTION_DIM));
        frames[[0, 0]] = 0.1;
        frames[[1, 1]] = -1.5e-9;
        frames[[1, 24]] = f32::NEG_INFINITY;
        let text = written(&frames);
        let lines: Vec<&str> = text.split('\n').collect();
        assert_eq!(lines.len(), 4);
        assert!(
            lines[0].starts_with("frame,time_s,position_x,position_y,") && !text.contains('\r')
        );
        assert!(
            lines[0].contains(",angular_velocity_z,phase,style_0,")
                && lines[0].ends_with(",style_7")
        );
        assert_eq!(lines[1], format!("0,0.0,0.1{}", ",0.0".repeat(24)));
        let zeros = ",0.0".repeat(22);
        assert_eq!(lines[2], format!("1,{:?},0.0,-1.5e-9{zeros},-inf", 1.0 / 30.0));
        assert_eq!(lines[3], "");
    }

    #[test]
    fn pieces_make_the_same_text_as_the_whole() {
        let frames = ramp(13);
        let mut bytes = csv_header().into_bytes();
        write_csv_rows(frames.slice(s![..5, ..]), 0, &mut bytes).expect("memory");
        write_csv_rows(frames.slice(s![5.., ..]), 5, &mut bytes).expect("memory");
        assert_eq!(String::from_utf8(bytes).expect("text"), written(&frames));
    }

    #[test]
    fn spaces_line_ends_and_blank_lines_do_not_matter() {
        let frames = ramp(7);
        let text = written(&frames).replace(',', " ,\t").replace('\n', "\r\n\r\n");
        assert_eq!(read_csv(&format!("\u{feff}\n{text}")), Ok(frames.clone()));
        // A piece keeps its numbers and may lack its last line end.
        let mut bytes = csv_header().into_bytes();
        write_csv_rows(frames.view(), 1234, &mut bytes).expect("memory");
        let piece = String::from_utf8(bytes).expect("text");
        assert_eq!(read_csv(piece.trim_end()), Ok(frames));
        assert_eq!(read_csv(&csv_header()), Ok(Array2::zeros((0, MOTION_DIM))));
    }

    #[test]
    fn mistakes_are_named_by_line_and_column() {
        let text = written(&ramp(5));
        assert_eq!(
            refusal("\n\n"),
            "csv has no lines, expected one that names 27 columns; write the motion again"
        );
        assert_eq!(
            refusal(&replaced(&text, 4, 9, "0,3")),
            "csv line 4 has 28 values, expected 27; write frame, time and 25 channels with commas \
             between them"
        );
        assert_eq!(
            refusal(&replaced(&text, 1, 3, "x")),
            "csv line 1 column 3 is named `x`, expected `position_x`; name and order the columns as \
             in a csv file of generate"
        );
        assert_eq!(
            refusal(&replaced(&text, 6, 7, "fast")),
            "csv line 6 column 7 (velocity_y) reads `fast`, expected a number; correct the value or \
             remove the file"
        );
        assert_eq!(
            refusal(&replaced(&text, 2, 1, "-1")),
            "csv line 2 column 1 (frame) reads `-1`, expected the number of a frame; correct the \
             value or remove the file"
        );
        assert_eq!(
            refusal(&replaced(&text, 5, 1, "7")),
            "csv line 5 column 1 (frame) is 7 where 3 should follow; restore the missing lines, or \
             number the frames anew"
        );
        // At 60 fps the fourth frame would be at 0.05 s.
        assert_eq!(
            refusal(&replaced(&text, 5, 2, "0.05")),
            "csv line 5 column 2 (time_s) is 0.05 at frame 3, expected 0.1000 at 30 fps; resample \
             the motion to 30 frames a second"
        );
        let no_time = refusal(&replaced(&text, 3, 2, "NaN"));
        assert!(no_time.starts_with("csv line 3 column 2 (time_s) is NaN at frame 1"), "{no_time}");
        let long = refusal(&replaced(&text, 3, 27, &"é".repeat(90)));
        assert!(long.contains(&format!("(style_7) reads `{}`,", "é".repeat(40))), "{long}");
    }

    #[test]
    fn a_group_is_a_line_for_every_dancer_of_every_frame() {
        let group = Array3::from_shape_fn((2, 3, MOTION_DIM), |(n, t, i)| {
            10.0 * n as f32 + t as f32 - 0.5 * i as f32
        });
        let mut bytes = Vec::new();
        write_group_csv(group.view(), &mut bytes).expect("memory");
        let text = String::from_utf8(bytes).expect("text");
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].starts_with("frame,time_s,dancer,position_x,position_y,"), "{}", lines[0]);
        assert_eq!(lines.len(), 1 + 6);
        assert!(lines[1].starts_with("0,0.0,0,0.0,-0.5,"), "{}", lines[1]);
        assert!(lines[4].starts_with("1,0.03333333333333333,1,11.0,10.5,"), "{}", lines[4]);
        // Without the column each dancer's lines are a motion.
        for dancer in 0..2_usize {
            let own = lines.iter().enumerate().filter(|(i, _)| *i == 0 || (i - 1) % 2 == dancer);
            let own: Vec<String> = own
                .map(|(_, line)| {
                    let fields = line.split(',').enumerate().filter(|(k, _)| *k != 2);
                    fields.map(|(_, field)| field).collect::<Vec<_>>().join(",")
                })
                .collect();
            assert_eq!(
                read_csv(&own.join("\n")).expect("a motion"),
                group.slice(s![dancer, .., ..])
            );
        }
        let mut rows = Vec::new();
        write_group_csv_rows(group.slice(s![.., 2.., ..]), 2, &mut rows).expect("memory");
        assert!(text.as_bytes().ends_with(&rows) && rows.starts_with(b"2,"));
        // A reader of one motion names the column that tells of several.
        assert!(read_csv(&text).expect_err("a group").to_string().contains("has 28 values"));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = read_csv(&String::from_utf8_lossy(&bytes));
        }

        #[test]
        fn damaged_files_never_panic(at in 0..400_usize, n in 0..12_usize, patch in "[ -~\n]{0,9}") {
            let mut text = written(&ramp(3)).into_bytes();
            let at = at.min(text.len());
            let end = (at + n).min(text.len());
            text.splice(at..end, patch.into_bytes());
            let _ = read_csv(&String::from_utf8_lossy(&text));
        }

        #[test]
        fn values_come_back_bit_for_bit(
            values in prop::collection::vec(prop::num::f32::ANY, 3 * MOTION_DIM)
        ) {
            let frames = Array2::from_shape_vec((3, MOTION_DIM), values).expect("3 × 25");
            let found = read_csv(&written(&frames)).expect("what was written");
            prop_assert_eq!(found.dim(), frames.dim());
            for (a, b) in found.iter().zip(&frames) {
                // A NaN stays one, whatever its payload.
                prop_assert!(a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()));
            }
        }

        #[test]
        fn reading_never_panics(text in "[a-z0-9,.\\n\\r\u{e9} -]{0,200}") {
            let _ = read_csv(&text);
            let _ = read_csv(&(csv_header() + &text));
        }
    }
}
