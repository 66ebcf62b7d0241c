//! Notes: their pitch, their length in broken rhythms and tuplets, and ties.

use super::{Reader, WrittenNote};
use crate::music::abc::cursor::Cursor;
use crate::music::abc::{AbcError, MAX_NOTES, TICKS_PER_WHOLE};

/// Longest note, in whole notes.
const MAX_WHOLES: u32 = 8;
/// Shortest note, in ticks: 1/256.
const MIN_TICKS: u64 = TICKS_PER_WHOLE as u64 / 256;

impl Reader {
    /// Reads notes in brackets, which sound together.
    pub(super) fn note_chord(&mut self, at: &mut Cursor<'_>, line: usize) -> Result<(), AbcError> {
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
    pub(super) fn pitch(
        &mut self,
        at: &mut Cursor<'_>,
        line: usize,
    ) -> Result<(char, i32, i32), AbcError> {
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
    pub(super) fn ticks(&mut self, length: (u32, u32), line: usize) -> Result<u32, AbcError> {
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
    pub(super) fn sound(
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

    pub(super) fn tie(&mut self) {
        self.tied.clone_from(&self.sounded);
        let n = self.measure.notes.len();
        let last = self.last.0.min(n);
        for note in &mut self.measure.notes[n - last..] {
            note.is_tied = true;
        }
    }

    /// `A>B`: A is half as long again, B half as long; `>>` and `>>>` go on in that way.
    pub(super) fn broken_rhythm(&mut self, at: &mut Cursor<'_>) {
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
    pub(super) fn tuplet(
        &mut self,
        p: u32,
        at: &mut Cursor<'_>,
        line: usize,
    ) -> Result<(), AbcError> {
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
}
