//! A line of notes, character by character.

/// Characters of a line, with a look ahead.
pub struct Cursor<'a> {
    pub rest: &'a str,
}

impl Cursor<'_> {
    /// Returns the next character.
    pub fn peek(&self) -> Option<char> {
        self.rest.chars().next()
    }

    /// Takes the next character.
    pub fn take(&mut self) -> Option<char> {
        let c = self.peek()?;
        self.rest = &self.rest[c.len_utf8()..];
        Some(c)
    }

    /// Takes the next character if it is wanted.
    pub fn take_if(&mut self, is_wanted: impl Fn(char) -> bool) -> Option<char> {
        self.peek().filter(|c| is_wanted(*c)).and_then(|_| self.take())
    }

    /// Takes a whole number, at most 9999, if one follows.
    pub fn number(&mut self) -> Option<u32> {
        let mut value: Option<u32> = None;
        while let Some(digit) = self.take_if(|c| c.is_ascii_digit()) {
            let digit = digit.to_digit(10).unwrap_or(0);
            value = Some((value.unwrap_or(0) * 10 + digit).min(9999));
        }
        value
    }

    /// Reads `3`, `/2`, `3/2`, `//`; nothing is 1.
    pub fn length(&mut self) -> (u32, u32) {
        let numerator = self.number().unwrap_or(1);
        let mut denominator = 1;
        while self.take_if(|c| c == '/').is_some() {
            denominator = (denominator * self.number().unwrap_or(2)).clamp(1, 4096);
        }
        (numerator, denominator)
    }

    /// Passes over what leads up to a character.
    pub fn skip_past(&mut self, end: char) -> Option<String> {
        let at = self.rest.find(end)?;
        let skipped = self.rest[..at].to_owned();
        self.rest = &self.rest[at + end.len_utf8()..];
        Some(skipped)
    }
}
