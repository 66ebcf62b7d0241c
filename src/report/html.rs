//! Text from outside as it stands in HTML.

use std::fmt::{self, Write as _};

/// Text between tags or in a quoted attribute: it can become neither markup nor the end of an attribute.
/// Line breaks and tabs become spaces, other control characters replacement characters.
pub(super) struct Escaped<'a>(pub &'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for c in self.0.chars() {
            match c {
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '&' => f.write_str("&amp;")?,
                '"' => f.write_str("&quot;")?,
                '\'' => f.write_str("&#39;")?,
                '\n' | '\r' | '\t' => f.write_char(' ')?,
                c if c.is_control() => f.write_char(char::REPLACEMENT_CHARACTER)?,
                c => f.write_char(c)?,
            }
        }
        Ok(())
    }
}

/// Writes to a string, which takes all that is written to it.
macro_rules! put {
    ($out:expr, $($text:tt)*) => {{
        use ::std::fmt::Write as _;
        let _ = ::std::write!($out, $($text)*);
    }};
}
pub(super) use put;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_cannot_become_markup() {
        let cases = [
            ("<b>&\"'", "&lt;b&gt;&amp;&quot;&#39;"),
            ("a\nb\tc", "a b c"),
            ("\u{1b}[31m", "\u{fffd}[31m"),
            ("m/s² – ß", "m/s² – ß"),
        ];
        for (text, wanted) in cases {
            assert_eq!(Escaped(text).to_string(), wanted);
        }
    }
}
