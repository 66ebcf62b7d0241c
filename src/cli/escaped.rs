//! Data on its way to a terminal, which must not be steered by it.

use std::io::{self, Write};

/// First byte of the UTF-8 of U+0080 to U+00BF, of which the lower half are control characters.
const LATIN: u8 = 0xc2;

/// Writes control characters as `\x1b` and the like; ends of lines and tabs stay.
pub struct Escaped<W: Write> {
    out: W,
    /// Whether a [`LATIN`] is held back until it is known what follows.
    holds_latin: bool,
}

impl<W: Write> Escaped<W> {
    pub fn new(out: W) -> Self {
        Self { out, holds_latin: false }
    }

    fn release(&mut self) -> io::Result<()> {
        if std::mem::take(&mut self.holds_latin) { self.out.write_all(&[LATIN]) } else { Ok(()) }
    }
}

impl<W: Write> Write for Escaped<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        for &byte in bytes {
            if self.holds_latin && (0x80..0xa0).contains(&byte) {
                self.holds_latin = false;
                write!(self.out, "\\x{byte:02x}")?;
                continue;
            }
            self.release()?;
            match byte {
                LATIN => self.holds_latin = true,
                b'\n' | b'\t' => self.out.write_all(&[byte])?,
                0..0x20 | 0x7f => write!(self.out, "\\x{byte:02x}")?,
                _ => self.out.write_all(&[byte])?,
            }
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.release()?;
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_shown_and_text_is_left() {
        let mut bytes = Vec::new();
        let mut out = Escaped::new(&mut bytes);
        // The two bytes of U+009B come in two pieces.
        for piece in [&b"a\x1b[2J,\xc2"[..], &b"\x9b,\xc2"[..], &b"\xa0\xc3\xbc\n\t\x7f\r"[..]] {
            out.write_all(piece).unwrap();
        }
        out.flush().unwrap();
        assert_eq!(bytes, b"a\\x1b[2J,\\x9b,\xc2\xa0\xc3\xbc\n\t\\x7f\\x0d");
    }
}
