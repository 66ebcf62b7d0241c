//! Text from outside as it stands in HTML and SVG.
//!
//! `askama.toml` names the escaper; every template uses it for every value that it does not mark as `safe`.

use std::fmt::{self, Write};

use askama::filters::Escaper;

/// Text for a place between tags or in a quoted attribute: it can become neither markup nor the end of an attribute.
///
/// Line breaks and tabs become spaces; other control characters, and what XML 1.0 cannot hold, replacement characters.
#[derive(Clone, Copy, Debug)]
pub struct Escaped<'a>(pub &'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for c in self.0.chars() {
            match c {
                '<' => out.write_str("&lt;")?,
                '>' => out.write_str("&gt;")?,
                '&' => out.write_str("&amp;")?,
                '"' => out.write_str("&quot;")?,
                '\'' => out.write_str("&#39;")?,
                '\n' | '\r' | '\t' => out.write_char(' ')?,
                '\u{fffe}' | '\u{ffff}' => out.write_char(char::REPLACEMENT_CHARACTER)?,
                c if c.is_control() => out.write_char(char::REPLACEMENT_CHARACTER)?,
                c => out.write_char(c)?,
            }
        }
        Ok(())
    }
}

/// Has templates write values as [`Escaped`].
#[derive(Clone, Copy, Debug)]
pub struct EscapedText;

impl Escaper for EscapedText {
    fn write_escaped_str<W: Write>(&self, mut out: W, text: &str) -> fmt::Result {
        write!(out, "{}", Escaped(text))
    }
}

#[cfg(test)]
mod tests {
    use askama::Template;

    #[derive(Template)]
    #[template(source = "{{ text }}", ext = "html")]
    struct EscapedPage<'a> {
        text: &'a str,
    }

    #[test]
    fn text_cannot_become_markup() {
        let cases = [
            ("<b>&\"'", "&lt;b&gt;&amp;&quot;&#39;"),
            ("a\nb\tc", "a b c"),
            ("\u{1b}[31m", "\u{fffd}[31m"),
            ("m/s² – ß", "m/s² – ß"),
            ("a\u{0}b\u{fffe}", "a\u{fffd}b\u{fffd}"),
        ];
        for (text, wanted) in cases {
            assert_eq!(EscapedPage { text }.to_string(), wanted);
        }
    }

    /// Returns every value that a template below a folder marks as safe, with its file.
    fn marked(folder: &std::path::Path, found: &mut Vec<String>) {
        for entry in std::fs::read_dir(folder).expect("a folder of sources") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                marked(&path, found);
            } else if path.extension().is_some_and(|e| e == "html") {
                let text = std::fs::read_to_string(&path).expect("UTF-8");
                let name = path.file_name().expect("a name").to_string_lossy().into_owned();
                let values = text.split("{{").skip(1).filter_map(|rest| rest.split_once("}}"));
                let safe = values.filter(|(value, _)| value.contains("safe"));
                found.extend(safe.map(|(value, _)| format!("{name}: {}", value.trim())));
            }
        }
    }

    #[test]
    fn what_is_not_escaped_is_seen() {
        let mut found = Vec::new();
        marked(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut found);
        found.sort();
        let wanted = [
            // Sections are templates, which escape for themselves.
            "page.html: against|safe",
            "page.html: audio.base64|safe",
            // JSON without any sign of markup.
            "page.html: data|safe",
            "page.html: dial|safe",
            "page.html: metrics|safe",
            "page.html: sanity|safe",
            // Files of this program.
            "page.html: script|safe",
            "page.html: style|safe",
            "page.html: style|safe",
            "page.html: verdicts|safe",
        ];
        assert_eq!(found, wanted);
    }
}
