//! Bytes to text: UTF-8 or any ASCII superset as it is, UTF-16 turned into UTF-8.

use std::borrow::Cow;

/// Bytes of padding that some programs leave behind a text: NUL and Ctrl-Z.
const PADDING: [u8; 2] = [0x00, 0x1a];

/// Returns the text without byte order mark and padding, and whether it was UTF-16.
pub fn text_of(bytes: &[u8]) -> (Cow<'_, [u8]>, bool) {
    let (text, was_utf16) = match bytes {
        [0xff, 0xfe, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => utf16(rest, u16::from_be_bytes),
        // Without a mark: the first letter is ASCII, and half of it is 0.
        [first, 0, _, 0, ..] if first.is_ascii_graphic() => utf16(bytes, u16::from_le_bytes),
        [0, first, 0, _, ..] if first.is_ascii_graphic() => utf16(bytes, u16::from_be_bytes),
        _ => (Cow::Borrowed(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)), false),
    };
    let end = text.iter().rposition(|b| !PADDING.contains(b) && !b.is_ascii_whitespace());
    let end = end.map_or(0, |last| last + 1);
    let text = match text {
        Cow::Borrowed(text) => Cow::Borrowed(&text[..end]),
        Cow::Owned(mut text) => {
            text.truncate(end);
            Cow::Owned(text)
        }
    };
    (text, was_utf16)
}

fn utf16(bytes: &[u8], unit: fn([u8; 2]) -> u16) -> (Cow<'_, [u8]>, bool) {
    let units = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
    let text: String =
        char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect();
    (Cow::Owned(text.into_bytes()), true)
}
