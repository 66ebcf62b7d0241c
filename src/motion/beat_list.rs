//! The beats file that may lie beside a song, as the programs of the field write it.
//!
//! One beat per line: its time, and its number in the bar if known. Read are the lists of madmom and
//! `mir_eval` (one or two columns), of `numpy.savetxt` (numbers as `1.000e+00`), label tracks of Audacity (begin,
//! end, label, with tabs), and columns with commas or semicolons between them, under a header or not.

use super::phase::{Beats, BeatsError, MAX_BEATS_PER_BAR};

/// Most lines a beats file may have.
pub const MAX_BEATS_LINES: usize = 1_000_000;

const SHOWN_CHARS: usize = 40;
/// First words of a header.
const HEADERS: [&str; 12] = [
    "t",
    "time",
    "times",
    "time_s",
    "time(s)",
    "times_s",
    "beat",
    "beats",
    "beat_time",
    "onset",
    "seconds",
    "start",
];
/// Labels of a downbeat and of any other beat.
const DOWNBEATS: [&str; 5] = ["downbeat", "down", "db", "bar", "d"];
const BEATS: [&str; 2] = ["beat", "b"];

/// The mark beside a time.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Mark {
    Nothing,
    Number(i64),
    Downbeat,
    Beat,
}

impl Beats {
    /// Reads a beats file: one beat per line, `time_s` or `time_s beat_number`, `#` comments.
    ///
    /// Columns stand apart by spaces, tabs, commas or semicolons; a label track of Audacity has a begin, an
    /// end and a label, of which begin and label are read. A label is a number, a bar and a number (`12.3`),
    /// `downbeat`, `beat` or nothing. Blank lines and a header are skipped. Errors: [`BeatsError::Line`] with
    /// the line number and its first 40 characters, [`BeatsError::TooLong`], [`BeatsError::NoDownbeat`] where
    /// beats are numbered and none is 1, and those of [`Beats::new`].
    pub fn parse(text: &str) -> Result<Self, BeatsError> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let format = Format::of(text);
        let mut times_s: Vec<f64> = Vec::new();
        let mut marks: Vec<Mark> = Vec::new();
        for (i, raw) in text.lines().enumerate() {
            if i >= MAX_BEATS_LINES {
                return Err(BeatsError::TooLong { limit: MAX_BEATS_LINES });
            }
            let refuse = |expected| {
                let text = raw.trim().chars().take(SHOWN_CHARS).collect();
                BeatsError::Line { line: i + 1, text, expected }
            };
            let Some(fields) = format.fields(raw) else { continue };
            if times_s.is_empty() && is_header(fields[0]) {
                continue;
            }
            let time_s = format.number(fields[0]).ok_or_else(|| refuse(format.expected()))?;
            if !time_s.is_finite() || time_s < 0.0 {
                return Err(refuse("a finite time of at least 0 s"));
            }
            if times_s.last().is_some_and(|&previous_s| time_s <= previous_s) {
                return Err(refuse("a time later than the beat before"));
            }
            let mark = format.mark(time_s, &fields).map_err(|expected| {
                let is_alone = matches!((marks.last(), fields.len()), (Some(Mark::Nothing), 2));
                refuse(if is_alone { "no beat number, like the beats before" } else { expected })
            })?;
            match (marks.last(), mark) {
                (Some(Mark::Number(_)), Mark::Number(_)) | (None, _) => {}
                (Some(_), Mark::Number(_)) => {
                    return Err(refuse("no beat number, like the beats before"));
                }
                (Some(Mark::Number(_)), _) => {
                    return Err(refuse("a beat number, like the beats before"));
                }
                _ => {}
            }
            times_s.push(time_s);
            marks.push(mark);
        }
        let numbers = numbers_of(&marks);
        let has_downbeat = numbers.as_ref().is_none_or(|numbers| numbers.contains(&1));
        let beats = Self::new(times_s, numbers, None)?;
        // The highest number would be a guess at the bar.
        if has_downbeat { Ok(beats) } else { Err(BeatsError::NoDownbeat) }
    }
}

/// How a file stands its columns apart, told by all of its lines.
struct Format {
    /// A comma stands between columns, not for a decimal point.
    has_comma_columns: bool,
    /// Every line has its time twice: labels without text, whose last tab was lost.
    has_times_twice: bool,
}

impl Format {
    fn of(text: &str) -> Self {
        let lines = || text.lines().take(MAX_BEATS_LINES).filter(|line| !line.trim().is_empty());
        let has_comma_columns =
            lines().any(|line| line.contains(", ") || line.contains(',') && line.contains('.'));
        let is_twice = |line: &str| {
            let (a, b) = line.trim().split_once('\t').unwrap_or_default();
            a == b.trim() && a.contains(['.', ',']) && !a.contains(['e', 'E'])
        };
        Self { has_comma_columns, has_times_twice: lines().all(is_twice) }
    }

    /// The columns of a line without comments and quotes; none where there is nothing.
    fn fields<'a>(&self, raw: &'a str) -> Option<Vec<&'a str>> {
        // Audacity writes the frequencies of a label into a line of their own.
        if raw.starts_with('\\') {
            return None;
        }
        let line = raw.split('#').next().unwrap_or("");
        let bare = |field: &'a str| field.trim().trim_matches('"').trim();
        let fields: Vec<&str> = if line.contains('\t') {
            line.split('\t').map(bare).collect()
        } else if line.contains(';') {
            line.split(';').map(bare).collect()
        } else if self.has_comma_columns && line.contains(',') {
            line.split(',').map(bare).collect()
        } else {
            line.split_whitespace().map(bare).collect()
        };
        // The empty label of three columns counts; other empty columns are lost spaces.
        let fields: Vec<&str> = match fields.as_slice() {
            [_, _, _] if line.contains('\t') => fields,
            _ => fields.into_iter().filter(|field| !field.is_empty()).collect(),
        };
        fields.first().is_some_and(|first| !first.is_empty()).then_some(fields)
    }

    /// A number, with a point or a comma.
    fn number(&self, field: &str) -> Option<f64> {
        let is_decimal_comma = !self.has_comma_columns
            && field.matches(',').count() == 1
            && !field.contains('.')
            && !field.ends_with(',');
        match field.parse() {
            Ok(number) => Some(number),
            // `5,1` may be a fifth beat's time and number as well.
            Err(_) if is_decimal_comma => field
                .split_once(',')
                .filter(|(_, places)| places.len() > 1)
                .and_then(|_| field.replacen(',', ".", 1).parse().ok()),
            Err(_) => None,
        }
    }

    fn expected(&self) -> &'static str {
        "a time in seconds"
    }

    /// Returns the mark beside a time.
    fn mark(&self, time_s: f64, fields: &[&str]) -> Result<Mark, &'static str> {
        match fields {
            [_] => Ok(Mark::Nothing),
            [_, _] if self.has_times_twice => Ok(Mark::Nothing),
            [_, second] => match self.number(second) {
                Some(number) => whole(number),
                None => word(second).ok_or("a whole beat number"),
            },
            [_, end, label @ ..] => {
                let is_end = self.number(end).is_some_and(|end_s| end_s >= time_s);
                match label {
                    [label] if is_end => self.label(label),
                    _ => Err("at most two columns, or begin, end and label"),
                }
            }
            [] => Ok(Mark::Nothing),
        }
    }

    /// The label of a label track.
    fn label(&self, label: &str) -> Result<Mark, &'static str> {
        const EXPECTED: &str = "a label that is a beat number, `downbeat`, `beat` or empty";
        if label.is_empty() {
            return Ok(Mark::Nothing);
        }
        match label.split_once('.') {
            // The bar, and the number in it.
            Some((bar, number)) if number.len() < 3 && bar.parse::<u32>().is_ok() => {
                let number: f64 = number.parse().map_err(|_| EXPECTED)?;
                // `1.0` is the number 1.
                if number == 0.0 {
                    whole(bar.parse().map_err(|_| EXPECTED)?)
                } else {
                    whole(number)
                }
            }
            _ => match label.parse() {
                Ok(number) => whole(number),
                Err(_) => word(label).ok_or(EXPECTED),
            },
        }
    }
}

fn is_header(field: &str) -> bool {
    let name = field.to_ascii_lowercase();
    let name = name.split(|c: char| c.is_whitespace() || c == ',' || c == ';').next();
    name.is_some_and(|name| HEADERS.contains(&name))
}

fn word(label: &str) -> Option<Mark> {
    let label = label.to_ascii_lowercase();
    if DOWNBEATS.contains(&label.as_str()) {
        Some(Mark::Downbeat)
    } else {
        BEATS.contains(&label.as_str()).then_some(Mark::Beat)
    }
}

/// A beat number, which may be written as `1.0` or `1.000000000000000000e+00`.
fn whole(number: f64) -> Result<Mark, &'static str> {
    if number.fract() != 0.0 || !number.is_finite() {
        Err("a whole beat number")
    } else if (1.0..=f64::from(MAX_BEATS_PER_BAR)).contains(&number) {
        Ok(Mark::Number(number as i64))
    } else {
        Err("a beat number from 1 to 64")
    }
}

/// Numbers in the bar: as they are, or counted from marked downbeats; none where neither is there.
fn numbers_of(marks: &[Mark]) -> Option<Vec<i64>> {
    if let Some(Mark::Number(_)) = marks.first() {
        let number = |mark: &Mark| if let Mark::Number(n) = mark { Some(*n) } else { None };
        return Some(marks.iter().filter_map(number).collect());
    }
    let downbeats: Vec<usize> = (0..marks.len()).filter(|&i| marks[i] == Mark::Downbeat).collect();
    let first = *downbeats.first()?;
    let mut lengths: Vec<usize> = downbeats.windows(2).map(|pair| pair[1] - pair[0]).collect();
    lengths.sort_unstable();
    let count_since = |i: usize| {
        let begun = downbeats.partition_point(|&downbeat| downbeat <= i);
        downbeats.get(begun.checked_sub(1)?).map(|downbeat| i - downbeat)
    };
    // Before the first downbeat the usual bar is counted back, or what is there if that is longer.
    let usual = lengths.get(lengths.len() / 2).copied().unwrap_or(marks.len()).max(first);
    let number = |i: usize| match count_since(i) {
        Some(n) => n + 1,
        None => usual + 1 - (first - i),
    };
    Some((0..marks.len()).map(|i| number(i).min(MAX_BEATS_PER_BAR as usize) as i64).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> (Vec<f64>, Option<Vec<i64>>) {
        let beats = Beats::parse(text).unwrap();
        (beats.times_s().to_vec(), beats.numbers().map(<[i64]>::to_vec))
    }

    fn refusal(text: &str) -> String {
        let said = Beats::parse(text).unwrap_err().to_string();
        said.strip_suffix("; write one beat per line as `time_s` or `time_s beat_number`")
            .map_or(said.clone(), str::to_owned)
    }

    #[test]
    fn lists_of_the_field_are_read() {
        let plain = (vec![0.5, 1.0, 1.5, 2.0], None);
        let waltz = (vec![0.5, 1.0, 1.5, 2.0], Some(vec![3, 1, 2, 3]));
        for (name, text, want) in [
            ("madmom, beats", "0.500\n1.000\n1.500\n2.000\n", &plain),
            ("madmom, downbeats", "0.50\t3\n1.00\t1\n1.50\t2\n2.00\t3\n", &waltz),
            ("mir_eval", "# beats\n0.5\n1.0\n1.5\n2.0", &plain),
            (
                "numpy.savetxt",
                "5.000000000000000000e-01 3.000000000000000000e+00\n\
                 1.000000000000000000e+00 1.000000000000000000e+00\n\
                 1.500000000000000000e+00 2.000000000000000000e+00\n\
                 2.000000000000000000e+00 3.000000000000000000e+00\n",
                &waltz,
            ),
            ("numpy.savetxt, %.2f", "0.50,3.00\n1.00,1.00\n1.50,2.00\n2.00,3.00\n", &waltz),
            (
                "Audacity, numbers",
                "0.500000\t0.500000\t3\n1.000000\t1.000000\t1\n1.500000\t1.500000\t2\n\
                 2.000000\t2.000000\t3\n",
                &waltz,
            ),
            (
                "Audacity, regions, frequencies, CRLF",
                "0.500000\t0.600000\t3\r\n\\\t120.0\t800.0\r\n1.000000\t1.100000\t1\r\n\
                 1.500000\t1.600000\t2\r\n2.000000\t2.100000\t3\r\n",
                &waltz,
            ),
            (
                "Audacity, no text",
                "0.500000\t0.500000\t\n1.000000\t1.000000\t\n1.500000\t1.500000\t\n\
                 2.000000\t2.000000\t\n",
                &plain,
            ),
            (
                "Audacity, no text, tabs lost",
                "0.500000\t0.500000\n1.000000\t1.000000\n1.500000\t1.500000\n\
                 2.000000\t2.000000\n",
                &plain,
            ),
            (
                "Audacity, decimal commas",
                "0,500000\t0,500000\t3\n1,000000\t1,000000\t1\n1,500000\t1,500000\t2\n\
                 2,000000\t2,000000\t3\n",
                &waltz,
            ),
            (
                "Audacity, words",
                "0.5\t0.5\tbeat\n1.0\t1.0\tDownbeat\n1.5\t1.5\tbeat\n2.0\t2.0\tbeat\n",
                &(vec![0.5, 1.0, 1.5, 2.0], Some(vec![4, 1, 2, 3])),
            ),
            ("bars and beats", "0.5\t0.5\t1.3\n1\t1\t2.1\n1.5\t1.5\t2.2\n2\t2\t2.3\n", &waltz),
            ("comma, header", "time,beat\n0.5,3\n1.0,1\n1.5,2\n2,3\n", &waltz),
            ("comma, space, quotes", "\"0.5\", \"3\"\n1, 1\n1.5, 2\n2.0, 3\n", &waltz),
            ("semicolon, header", "t;beat\n0.5;3\n1.0;1\n1.5;2\n2.0;3\n", &waltz),
            ("semicolon, decimal commas", "0,50;3\n1,00;1\n1,50;2\n2,00;3\n", &waltz),
            ("one column, decimal commas", "0,500\n1,000\n1,500\n2,000\n", &plain),
            ("header alone", "Time (s)\n0.5\n1.0\n1.5\n2.0\n", &plain),
        ] {
            assert_eq!(&read(text), want, "{name}");
        }
    }

    #[test]
    fn bars_are_counted_from_marked_downbeats() {
        let marks = "b d b b d b b d b".replace('b', "beat").replace('d', "downbeat");
        let lines = marks.split(' ').enumerate().map(|(i, word)| format!("{i}.5 {word}\n"));
        let (_, numbers) = read(&lines.collect::<String>());
        assert_eq!(numbers, Some(vec![3, 1, 2, 3, 1, 2, 3, 1, 2]));
    }

    #[test]
    fn a_refusal_says_which_line_and_what_is_expected() {
        for (text, want) in [
            ("0.5 1\n1.0 1.5\n", "beats line 2 reads `1.0 1.5`, expected a whole beat number"),
            (
                "0.5 1.0\n1.0 0.0\n",
                "beats line 2 reads `1.0 0.0`, expected a beat number from 1 to 64",
            ),
            (
                "0.5\t0.5\t1\n1.0\t1.0\tchorus\n",
                "beats line 2 reads `1.0\t1.0\tchorus`, expected a label that is a beat number, \
                 `downbeat`, `beat` or empty",
            ),
            (
                "0.5 1 2 3\n",
                "beats line 1 reads `0.5 1 2 3`, expected at most two columns, or begin, end and label",
            ),
            (
                "1.5\t0.5\t1\n",
                "beats line 1 reads `1.5\t0.5\t1`, expected at most two columns, or begin, end and label",
            ),
            ("5,1\n6,2\n", "beats line 1 reads `5,1`, expected a time in seconds"),
            ("0.5 inf\n", "beats line 1 reads `0.5 inf`, expected a whole beat number"),
            ("chorus\n0.5\n1.0\n", "beats line 1 reads `chorus`, expected a time in seconds"),
            ("0.5\ntime\n", "beats line 2 reads `time`, expected a time in seconds"),
        ] {
            assert_eq!(refusal(text), want);
        }
    }
}
