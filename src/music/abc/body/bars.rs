//! Bar lines, repeats and endings.

use super::{Measure, Reader};
use crate::music::abc::AbcError;
use crate::music::abc::cursor::Cursor;

impl Reader {
    /// Reads a bar line with its dots, and the ending that may follow.
    pub(super) fn bar_line(&mut self, at: &mut Cursor<'_>, line: usize) -> Result<(), AbcError> {
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
    pub(super) fn ending(&mut self, at: &mut Cursor<'_>) {
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

    /// Ends the measure unless it is empty.
    pub(super) fn end_measure(&mut self, line: usize) {
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
}
