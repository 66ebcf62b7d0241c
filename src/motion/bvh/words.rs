//! The words of a BVH text in order, each with the line it stands on.

use super::{BvhError, BvhNote, SHOWN_CHARS};

/// One word of the text and the line it stands on.
#[derive(Clone, Copy)]
pub struct Word<'a> {
    pub text: &'a [u8],
    pub line: usize,
}

impl Word<'_> {
    pub fn is(&self, keyword: &str) -> bool {
        self.text.eq_ignore_ascii_case(keyword.as_bytes())
    }

    pub fn parse<T: std::str::FromStr>(&self) -> Option<T> {
        std::str::from_utf8(self.text).ok()?.parse().ok()
    }

    pub fn unexpected(&self, expected: &'static str) -> BvhError {
        BvhError::Unexpected { line: self.line, found: self.shown(), expected }
    }

    pub fn shown(&self) -> String {
        // Four bytes hold any character, so the cut cannot fall short of the shown ones.
        let head = &self.text[..self.text.len().min(4 * SHOWN_CHARS)];
        let head: String = String::from_utf8_lossy(head).chars().take(SHOWN_CHARS).collect();
        format!("`{}`", head.escape_default())
    }

    /// The number of a word that has one comma for its decimal point: `0,0333`.
    fn decimal_comma(&self) -> Option<f64> {
        let has = |byte| self.text.iter().filter(|&&b| b == byte).count();
        if has(b',') != 1 || has(b'.') != 0 || self.text.ends_with(b",") {
            return None;
        }
        std::str::from_utf8(self.text).ok()?.replacen(',', ".", 1).parse().ok()
    }
}

/// The words of a text in order, with line numbers, and what was read although it is not as usual.
pub struct Words<'a> {
    rest: &'a [u8],
    pub line: usize,
    pub notes: Vec<BvhNote>,
}

impl<'a> Words<'a> {
    pub fn new(text: &'a [u8]) -> Self {
        Self { rest: text, line: 1, notes: Vec::new() }
    }

    /// Leaves white space behind. A line ends with LF, CRLF or a lone CR.
    fn skip_space(&mut self) {
        let start = self.rest.iter().position(|b| !b.is_ascii_whitespace());
        self.advance(start.unwrap_or(self.rest.len()));
    }

    fn advance(&mut self, n: usize) {
        let (passed, rest) = self.rest.split_at(n);
        let ends_line = |i: usize| match passed[i] {
            b'\n' => true,
            b'\r' => passed.get(i + 1).or(rest.first()) != Some(&b'\n'),
            _ => false,
        };
        self.line += (0..n).filter(|&i| ends_line(i)).count();
        self.rest = rest;
    }

    pub fn next_word(&mut self) -> Option<Word<'a>> {
        // The end of the text is told with the line of the last word.
        let start = self.rest.iter().position(|b| !b.is_ascii_whitespace())?;
        self.advance(start);
        let end = self.rest.iter().position(u8::is_ascii_whitespace).unwrap_or(self.rest.len());
        let (text, rest) = self.rest.split_at(end);
        self.rest = rest;
        Some(Word { text, line: self.line })
    }

    pub fn next(&mut self, expected: &'static str) -> Result<Word<'a>, BvhError> {
        let line = self.line;
        self.next_word().ok_or_else(|| BvhError::Unexpected {
            line,
            found: "the end of the text".to_owned(),
            expected,
        })
    }

    pub fn expect(&mut self, keyword: &str, expected: &'static str) -> Result<(), BvhError> {
        let word = self.next(expected)?;
        if word.is(keyword) { Ok(()) } else { Err(word.unexpected(expected)) }
    }

    /// Reads a label such as `Frame Time:`, with or without spaces between its words, before its colon and
    /// behind it, and without the colon.
    pub fn expect_label(&mut self, words: &[&str], expected: &'static str) -> Result<(), BvhError> {
        self.skip_space();
        let before = self.rest;
        let mut unusual = false;
        for (i, word) in words.iter().enumerate() {
            let spaces = self.spaces();
            unusual |= i > 0 && spaces == 0;
            let found = self.rest.get(..word.len());
            if !found.is_some_and(|found| found.eq_ignore_ascii_case(word.as_bytes())) {
                self.rest = before;
                return Err(self.next(expected)?.unexpected(expected));
            }
            self.rest = &self.rest[word.len()..];
        }
        unusual |= self.spaces() > 0;
        match self.rest.strip_prefix(b":") {
            Some(rest) => self.rest = rest,
            // `Framesize` is another word.
            None if self.rest.first().is_some_and(u8::is_ascii_alphabetic) => {
                self.rest = before;
                return Err(self.next(expected)?.unexpected(expected));
            }
            None => unusual = true,
        }
        unusual |= self.rest.first().is_some_and(|b| !b.is_ascii_whitespace());
        if unusual {
            let end = before.iter().position(|b| matches!(b, b'\n' | b'\r'));
            let text = before[..end.unwrap_or(before.len())].trim_ascii();
            let found = Word { text, line: self.line }.shown();
            self.notes.push(BvhNote::Spelling { line: self.line, found, usual: expected });
        }
        Ok(())
    }

    /// Leaves the spaces and tabs of a line behind; returns how many they were.
    fn spaces(&mut self) -> usize {
        let n = self.rest.iter().take_while(|b| matches!(b, b' ' | b'\t')).count();
        self.rest = &self.rest[n..];
        n
    }

    pub fn number(&mut self, expected: &'static str) -> Result<f64, BvhError> {
        let word = self.next(expected)?;
        self.number_of(&word, expected)
    }

    /// Reads a word as a finite number; a decimal comma is noted once.
    pub fn number_of(&mut self, word: &Word<'_>, expected: &'static str) -> Result<f64, BvhError> {
        let value = match word.parse() {
            Some(value) => value,
            None => {
                let value = word.decimal_comma().ok_or_else(|| word.unexpected(expected))?;
                if !self.notes.iter().any(|note| matches!(note, BvhNote::DecimalComma { .. })) {
                    self.notes.push(BvhNote::DecimalComma { line: word.line });
                }
                value
            }
        };
        if value.is_finite() {
            Ok(value)
        } else {
            Err(BvhError::NonFinite { line: word.line, found: word.shown() })
        }
    }

    /// The rest of the line up to a brace: joint names may hold spaces.
    pub fn name(&mut self) -> String {
        let end = self.rest.iter().position(|&b| matches!(b, b'\n' | b'\r' | b'{'));
        let (name, rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
        self.rest = rest;
        String::from_utf8_lossy(name.trim_ascii()).chars().take(SHOWN_CHARS).collect()
    }
}
