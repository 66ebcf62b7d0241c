//! The notes of a tune, measure by measure as they are written.

use super::cursor::Cursor;
use super::header::Header;
use super::{AbcError, MAX_NOTES, TICKS_PER_WHOLE};
use crate::music::harmony::Chord;

/// Fields that may stand in a line of their own among the notes; letters of notes are none.
const BODY_FIELDS: &str = "HIKLMmNOPQRrSsTUVWwXZ+";
/// Longest note, in whole notes.
const MAX_WHOLES: u32 = 8;
/// Shortest note, in ticks: 1/256.
const MIN_TICKS: u64 = TICKS_PER_WHOLE as u64 / 256;

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

    fn note_chord(&mut self, at: &mut Cursor<'_>, line: usize) -> Result<(), AbcError> {
        at.take();
        let open = AbcError::Open { line, what: "a chord" };
        let mut tones = Vec::new();
        let mut inner = (1, 1);
        let mut is_tied = false;
        loop {
            match at.peek().ok_or_else(|| open.clone())? {
                ']' => break,
                '^' | '_' | '=' | 'A'..='G' | 'a'..='g' => {
                    let tone = self.pitch(at, line)?;
                    let length = at.length();
                    // The first note's length is the chord's.
                    if tones.is_empty() {
                        inner = length;
                    }
                    tones.push(tone);
                }
                '-' => {
                    at.take();
                    is_tied = true;
                }
                '"' => {
                    at.take();
                    at.skip_past('"').ok_or_else(|| open.clone())?;
                }
                '|' | '[' => return Err(open),
                _ => {
                    at.take();
                }
            }
            if tones.len() > 16 {
                return Err(AbcError::Note { line, what: "chord has more than 16 tones" });
            }
        }
        at.take();
        let outer = at.length();
        let product = (inner.0 * outer.0, (inner.1 * outer.1).clamp(1, 4096));
        let ticks = self.ticks(product, line)?;
        self.sound(&tones, ticks, line)?;
        if is_tied {
            self.tie();
        }
        Ok(())
    }

    /// Reads accidental, letter and octave; returns letter, octave and MIDI note.
    fn pitch(&mut self, at: &mut Cursor<'_>, line: usize) -> Result<(char, i32, i32), AbcError> {
        let mut accidental: Option<i32> = None;
        while let Some(sign) = at.take_if(|c| matches!(c, '^' | '_' | '=')) {
            let step = match sign {
                '^' => 1,
                '_' => -1,
                _ => 0,
            };
            accidental = Some((accidental.unwrap_or(0) + step).clamp(-2, 2));
        }
        let written = at
            .take_if(|c| matches!(c, 'A'..='G' | 'a'..='g'))
            .ok_or(AbcError::Note { line, what: "has an accidental and no letter" })?;
        let letter = written.to_ascii_uppercase();
        let mut octave = if written.is_ascii_lowercase() { 5 } else { 4 };
        while let Some(mark) = at.take_if(|c| matches!(c, '\'' | ',')) {
            octave += if mark == ',' { -1 } else { 1 };
        }
        let class = match letter {
            'C' => 0,
            'D' => 2,
            'E' => 4,
            'F' => 5,
            'G' => 7,
            'A' => 9,
            _ => 11,
        };
        // Alterations hold for the letter in every octave until the bar ends.
        if let Some(alteration) = accidental {
            self.altered.retain(|(of, _)| *of != letter);
            self.altered.push((letter, alteration));
        }
        let tied = self.tied.iter().find(|(l, o, _)| (*l, *o) == (letter, octave));
        let alteration_in = |list: &[(char, i32)]| {
            list.iter().find(|(altered, _)| *altered == letter).map(|(_, alteration)| *alteration)
        };
        let alteration = alteration_in(&self.altered)
            .or_else(|| alteration_in(&self.header.extra))
            .unwrap_or_else(|| self.header.key.alteration(letter));
        let plain = 12 * (octave + 1) + class;
        let pitch = match tied {
            Some((_, _, pitch)) if accidental.is_none() => *pitch,
            _ => plain + alteration,
        };
        if !(0..=127).contains(&pitch) {
            return Err(AbcError::Note { line, what: "is beyond hearing" });
        }
        Ok((letter, octave, pitch))
    }

    /// Returns the ticks of a length, in broken rhythms and tuplets, too.
    fn ticks(&mut self, length: (u32, u32), line: usize) -> Result<u32, AbcError> {
        let (numerator, denominator) = length;
        let mut ticks =
            u64::from(self.header.unit_ticks()) * u64::from(numerator) / u64::from(denominator);
        if let Some((over, under)) = self.broken.take() {
            ticks = ticks * u64::from(over) / u64::from(under);
        }
        if let Some((p, q, left)) = self.tuplet {
            ticks = (ticks * u64::from(q) + u64::from(p) / 2) / u64::from(p);
            self.tuplet = (left > 1).then_some((p, q, left - 1));
        }
        if ticks < MIN_TICKS || ticks > u64::from(MAX_WHOLES * TICKS_PER_WHOLE) {
            return Err(AbcError::Note { line, what: "has no length that can be played" });
        }
        Ok(ticks as u32)
    }

    /// Adds notes that sound together, or a rest.
    fn sound(
        &mut self,
        tones: &[(char, i32, i32)],
        ticks: u32,
        line: usize,
    ) -> Result<(), AbcError> {
        let measure = &mut self.measure;
        if measure.ticks == 0 {
            measure.line = line;
        }
        for &(_, _, pitch) in tones {
            let (onset, duration) = (measure.ticks, ticks);
            let pitch = pitch as u8;
            measure.notes.push(WrittenNote { onset, duration, pitch, is_tied: false });
        }
        measure.ticks = measure.ticks.saturating_add(ticks);
        self.last = (tones.len(), ticks);
        self.tied.clear();
        self.sounded = tones.to_vec();
        self.n_notes += 1;
        if self.n_notes > MAX_NOTES { Err(AbcError::TooLong) } else { Ok(()) }
    }

    fn tie(&mut self) {
        self.tied.clone_from(&self.sounded);
        let n = self.measure.notes.len();
        let last = self.last.0.min(n);
        for note in &mut self.measure.notes[n - last..] {
            note.is_tied = true;
        }
    }

    /// `A>B`: A is half as long again, B half as long; `>>` and `>>>` go on in that way.
    fn broken_rhythm(&mut self, at: &mut Cursor<'_>) {
        let Some(sign) = at.take() else { return };
        let n_more = std::iter::from_fn(|| at.take_if(|c| c == sign)).count();
        // A second sign before the second note says nothing: it would lengthen the first without end.
        if self.broken.is_some() {
            return;
        }
        let n = 1 + n_more.min(2);
        let short = (1, 1 << n);
        let long = ((1 << (n + 1)) - 1, 1 << n);
        let (first, second) = if sign == '>' { (long, short) } else { (short, long) };
        let (n_tones, ticks) = self.last;
        if ticks == 0 || ticks > self.measure.ticks {
            return;
        }
        let changed = ticks * first.0 / first.1;
        let n = self.measure.notes.len();
        for note in &mut self.measure.notes[n - n_tones.min(n)..] {
            note.duration = changed;
        }
        self.measure.ticks = self.measure.ticks - ticks + changed;
        self.last.1 = changed;
        self.broken = Some(second);
    }

    /// `(p:q:r`: p notes in the time of q, for the next r notes.
    fn tuplet(&mut self, p: u32, at: &mut Cursor<'_>, line: usize) -> Result<(), AbcError> {
        if !(2..=9).contains(&p) {
            let what = "is in a tuplet of other than two to nine";
            return Err(AbcError::Note { line, what });
        }
        let usual = match p {
            3 | 6 => 2,
            2 | 4 | 8 => 3,
            _ if self.header.meter.is_compound() => 3,
            _ => 2,
        };
        let mut more = || at.take_if(|c| c == ':').map(|_| at.number());
        let q = more().flatten().unwrap_or(usual).clamp(1, 16);
        let r = more().flatten().unwrap_or(p).clamp(1, 64);
        self.tuplet = Some((p, q, r));
        Ok(())
    }

    /// Reads a bar line with its dots, and the ending that may follow.
    fn bar_line(&mut self, at: &mut Cursor<'_>, line: usize) -> Result<(), AbcError> {
        let mut sign = String::new();
        loop {
            // A bracket belongs to the line only where it leads to one.
            let is_inner = at.rest.starts_with("[|") || at.rest.starts_with("[]");
            match at.peek() {
                Some(c @ ('|' | ':' | ']')) => sign.push(c),
                Some('[') if is_inner => sign.push('['),
                _ => break,
            }
            at.take();
        }
        let dots = sign.matches(':').count();
        let begins =
            sign.ends_with(':') && (sign.len() > 1 && (sign.starts_with(['|', '[']) || dots > 1));
        let ends = sign.starts_with(':');
        // Where the line before it ended the measure already, the sign belongs to that one.
        if self.measure.ticks > 0 {
            self.measure.ends_repeat |= ends;
        } else if let Some(last) = self.measures.last_mut() {
            last.ends_repeat |= ends;
        }
        self.end_measure(line);
        if begins || ends || sign.contains("||") || sign.contains(']') || sign.starts_with("[|") {
            self.measure.begins_part = true;
            // An ending goes on to the next double line.
            self.endings = 0;
            self.measure.endings = 0;
        }
        self.measure.begins_repeat |= begins;
        if at.peek().is_some_and(|c| c.is_ascii_digit()) {
            self.ending(at);
        }
        Ok(())
    }

    /// Reads the numbers of an ending: `1`, `1,3`, `1-2`.
    fn ending(&mut self, at: &mut Cursor<'_>) {
        let mut mask = 0_u32;
        let mut previous = None;
        while let Some(n) = at.number() {
            let n = n.clamp(1, 15);
            let from = previous.take().unwrap_or(n).min(n);
            (from..=n).for_each(|n| mask |= 1 << n);
            match at.peek() {
                Some('-') if at.rest[1..].starts_with(|c: char| c.is_ascii_digit()) => {
                    previous = Some(n);
                    at.take();
                }
                Some(',') if at.rest[1..].starts_with(|c: char| c.is_ascii_digit()) => {
                    at.take();
                }
                _ => break,
            }
        }
        (self.endings, self.measure.endings) = (mask, mask);
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

    /// Ends the measure unless it is empty.
    fn end_measure(&mut self, line: usize) {
        self.altered.clear();
        self.broken = None;
        if self.measure.ticks == 0 {
            self.measure.line = line;
            return;
        }
        let next = Measure { line, endings: self.endings, ..Measure::default() };
        let mut measure = std::mem::replace(&mut self.measure, next);
        measure.chords.retain(|(at, _)| *at < measure.ticks);
        self.measures.push(measure);
        self.last.0 = 0;
        self.last.1 = 0;
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
