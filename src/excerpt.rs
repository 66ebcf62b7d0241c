//! Excerpts of foreign bytes and texts, for messages.

/// Characters of a foreign text that a message quotes.
const MAX_QUOTED_CHARS: usize = 40;
/// Bytes that a preview looks at, and those of them that it lists where they are no text.
const MAX_BYTES: usize = 24;
const MAX_LISTED_BYTES: usize = 8;

/// Quotes the text that the bytes start with, up to the first line's end, or lists the first bytes
/// in hexadecimal when that text is shorter than a format's marker.
pub fn preview(bytes: &[u8]) -> String {
    let start = &bytes[..bytes.len().min(MAX_BYTES)];
    let n_text = start.iter().take_while(|byte| matches!(byte, b' '..=b'~' | b'\t')).count();
    if n_text >= 4 || n_text == bytes.len() {
        return format!("{:?}", String::from_utf8_lossy(&start[..n_text]));
    }
    let listed = start.iter().take(MAX_LISTED_BYTES);
    let hex: Vec<String> = listed.map(|byte| format!("{byte:02x}")).collect();
    format!("bytes {}", hex.join(" "))
}

/// Shortens foreign text so that a hostile header cannot flood a message.
pub fn clip(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTED_CHARS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_quoted_and_other_bytes_are_listed() {
        assert_eq!(preview(b"RIFF\x01\x02"), "\"RIFF\"");
        assert_eq!(preview(b"RIF\x01\x02"), "bytes 52 49 46 01 02");
        assert_eq!(preview(b"hi"), "\"hi\"");
        assert_eq!(preview(b""), "\"\"");
        assert_eq!(preview(&[0xff; 30]), "bytes ff ff ff ff ff ff ff ff");
        assert_eq!(preview(&[b'a'; 30]), format!("{:?}", "a".repeat(24)));
    }

    #[test]
    fn long_text_is_cut_between_characters() {
        assert_eq!(clip(&"é".repeat(40)), "é".repeat(40));
        assert_eq!(clip(&"é".repeat(41)), format!("{}…", "é".repeat(40)));
    }
}
