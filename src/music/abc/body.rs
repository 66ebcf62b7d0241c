//! The notes of a tune, measure by measure as they are written.

mod bars;
mod notes;

use super::AbcError;
use super::cursor::Cursor;
use super::header::Header;
use crate::music::harmony::Chord;

/// Fields that may stand in a line of their own among the notes; letters of notes are none.
const BODY_FIELDS: &str = "HIKLMmNOPQRrSsTUVWwXZ+";

/// A note as it is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WrittenNote {
    /// From the begin of its measure, in ticks.
    pub onset: u32,
    pub duration: u32,
    pub pitch: u8,
    pub is_tied: bool,
}

/// The notes and chords between two bar lines.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measure {
    pub line: usize,
    pub ticks: u32,
    pub notes: Vec<WrittenNote>,
    pub chords: Vec<(u32, Chord)>,
    /// After `|:`.
    pub begins_repeat: bool,
    /// Before `:|`.
    pub ends_repeat: bool,
    /// After a double bar or a repeat.
    pub begins_part: bool,
    /// Bit n is set where it belongs to the n-th ending.
    pub endings: u32,
}

/// Reads the lines after the header.
pub fn measures(lines: &[(usize, &str)], header: &Header) -> Result<Vec<Measure>, AbcError> {
    let mut reader = Reader::new(header.clone());
    let mut voice: Option<String> = None;
    let mut is_other_voice = false;
    for &(number, line) in lines {
        let line = line.split('%').next().unwrap_or("");
        let trimmed = line.trim_start();
        let is_field = trimmed.chars().next().is_some_and(|c| BODY_FIELDS.contains(c))
            && trimmed[1..].starts_with(':');
        if is_field {
            if let Some(name) = trimmed.strip_prefix("V:") {
                let name = name.split_whitespace().next().unwrap_or("").to_owned();
                is_other_voice = *voice.get_or_insert_with(|| name.clone()) != name;
            } else {
                reader.field(trimmed, number)?;
            }
        } else if !is_other_voice {
            reader.line(line, number)?;
        }
    }
    reader.finish()
}

struct Reader {
    header: Header,
    measures: Vec<Measure>,
    measure: Measure,
    /// Alterations of letters in this measure.
    altered: Vec<(char, i32)>,
    /// Letter, octave and pitch of what sounded last, and of that from which a tie leads on.
    sounded: Vec<(char, i32, i32)>,
    tied: Vec<(char, i32, i32)>,
    /// The factor of the next note's length, of a broken rhythm.
    broken: Option<(u32, u32)>,
    /// A tuplet under way: p notes in the time of q, and how many are left.
    tuplet: Option<(u32, u32, u32)>,
    /// Notes of the last sound: their number, and its length, for `>` and `-`.
    last: (usize, u32),
    endings: u32,
    n_notes: usize,
}

impl Reader {
    fn new(header: Header) -> Self {
        Self {
            header,
            measures: Vec::new(),
            measure: Measure { begins_part: true, ..Measure::default() },
            altered: Vec::new(),
            sounded: Vec::new(),
            tied: Vec::new(),
            broken: None,
            tuplet: None,
            last: (0, 0),
            endings: 0,
            n_notes: 0,
        }
    }

    fn field(&mut self, text: &str, line: usize) -> Result<(), AbcError> {
        let before = self.header.meter;
        if text.starts_with(['K', 'L', 'M']) {
            self.header.read(text, line)?;
        }
        if self.header.meter != before { Err(AbcError::MeterChange { line }) } else { Ok(()) }
    }

    fn line(&mut self, text: &str, line: usize) -> Result<(), AbcError> {
        let mut at = Cursor { rest: text };
        while let Some(c) = at.peek() {
            match c {
                '"' => {
                    at.take();
                    let text = at.skip_past('"').ok_or(AbcError::Open { line, what: "a quote" })?;
                    if let Some(chord) = chord_symbol(&text) {
                        self.measure.chords.push((self.measure.ticks, chord));
                    }
                }
                '{' => {
                    at.skip_past('}').ok_or(AbcError::Open { line, what: "a grace note" })?;
                }
                '!' => {
                    at.take();
                    // Old files break lines with one.
                    if at.rest.contains('!') && !at.rest.trim_start().is_empty() {
                        let end = at.rest.find(['!', '|', ' ']).unwrap_or(0);
                        if at.rest[end..].starts_with('!') {
                            at.rest = &at.rest[end + 1..];
                        }
                    }
                }
                '+' if at.rest[1..].contains('+') => {
                    at.take();
                    at.skip_past('+');
                }
                '|' | ':' => self.bar_line(&mut at, line)?,
                '[' => self.bracket(&mut at, line)?,
                ']' => self.bar_line(&mut at, line)?,
                '(' => {
                    at.take();
                    if let Some(p) = at.number() {
                        self.tuplet(p, &mut at, line)?;
                    }
                }
                '>' | '<' => self.broken_rhythm(&mut at),
                '-' => {
                    at.take();
                    self.tie();
                }
                '^' | '_' | '=' | 'A'..='G' | 'a'..='g' => {
                    let (letter, octave, pitch) = self.pitch(&mut at, line)?;
                    let length = at.length();
                    let ticks = self.ticks(length, line)?;
                    self.sound(&[(letter, octave, pitch)], ticks, line)?;
                }
                'z' | 'x' => {
                    at.take();
                    let length = at.length();
                    let ticks = self.ticks(length, line)?;
                    self.sound(&[], ticks, line)?;
                }
                'Z' | 'X' => {
                    at.take();
                    let n = at.number().unwrap_or(1).clamp(1, 64);
                    self.rest_bars(n, line)?;
                }
                '&' => {
                    // A second voice in this bar.
                    let end = at.rest.find('|').unwrap_or(at.rest.len());
                    at.rest = &at.rest[end..];
                }
                c if c.is_ascii_graphic() || c.is_whitespace() => {
                    // Slurs, decorations, user's symbols and those that ABC reserves.
                    at.take();
                }
                symbol => return Err(AbcError::Symbol { line, symbol }),
            }
        }
        Ok(())
    }

    /// A chord of notes, a field, an ending, or a bar line.
    fn bracket(&mut self, at: &mut Cursor<'_>, line: usize) -> Result<(), AbcError> {
        let mut next = at.rest[1..].chars();
        match (next.next(), next.next()) {
            (Some('|' | ']'), _) => self.bar_line(at, line),
            (Some('1'..='9'), _) => {
                at.take();
                self.end_measure(line);
                self.ending(at);
                Ok(())
            }
            (Some(letter), Some(':')) if letter.is_ascii_alphabetic() => {
                at.take();
                let text = at.skip_past(']').ok_or(AbcError::Open { line, what: "a field" })?;
                self.field(&text, line)
            }
            _ => self.note_chord(at, line),
        }
    }

    fn rest_bars(&mut self, n: u32, line: usize) -> Result<(), AbcError> {
        for i in 0..n {
            self.sound(&[], self.header.meter.ticks(), line)?;
            if i + 1 < n {
                self.end_measure(line);
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Vec<Measure>, AbcError> {
        self.end_measure(0);
        // A sign before the first note, as in `:|`, repeats nothing.
        if self.measures.is_empty() { Err(AbcError::NoNotes) } else { Ok(self.measures) }
    }
}

/// Returns the chord of a text in quotes; annotations begin with a sign for their place.
fn chord_symbol(text: &str) -> Option<Chord> {
    let text = text.trim();
    let rest = text.get(1..).unwrap_or("");
    // Words such as `Da Capo` or `Fine` are no chords.
    let is_word = rest.chars().filter(|c| c.is_lowercase()).count() > 4
        || ["Fine", "Da", "D.", "Coda", "Cho", "Dal", "Segno"].iter().any(|w| text.starts_with(w));
    if text.starts_with(['^', '_', '<', '>', '@']) || is_word { None } else { Chord::parse(text) }
}
