//! Texts that people read: without the secrets of URLs, and without what steers a terminal.

/// The text in place of a secret.
const CUT: char = '…';

/// Returns a text whose URLs have neither user and password nor a query, where signatures and tokens are.
pub fn redacted(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("://") {
        let (before, after) = rest.split_at(at + 3);
        out.push_str(before);
        let end = after.find(ends_url).unwrap_or(after.len());
        // A text such as `file://` alone has nothing behind it.
        let is_url = before[..at].ends_with(|c: char| c.is_ascii_alphanumeric());
        if is_url {
            push_without_secrets(&after[..end], &mut out);
        } else {
            out.push_str(&after[..end]);
        }
        rest = &after[end..];
    }
    out.push_str(rest);
    out
}

/// Returns a whole text that names a location without its user, password and query.
pub fn redacted_location(text: &str) -> String {
    let Some((scheme, rest)) = text.split_once("://") else { return text.to_owned() };
    let mut out = format!("{scheme}://");
    push_without_secrets(rest, &mut out);
    out
}

/// Returns whether a character ends a URL within a sentence.
fn ends_url(c: char) -> bool {
    c.is_whitespace() || matches!(c, '"' | '\'' | '<' | '>' | '`' | '(' | ')')
}

fn push_without_secrets(url: &str, out: &mut String) {
    let (url, query) = match url.find(['?', '#']) {
        Some(at) => (&url[..at], &url[at..]),
        None => (url, ""),
    };
    let authority = url.split('/').next().unwrap_or_default();
    let is_port = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let user = match (authority.rfind('@'), authority.split_once(':')) {
        (Some(at), _) => Some(at),
        // A password may have a slash that is not encoded.
        (None, Some((_, port))) if !is_port(port) => url.rfind('@'),
        _ => None,
    };
    match user {
        Some(at) => {
            out.push(CUT);
            out.push_str(&url[at..]);
        }
        None => out.push_str(url),
    }
    if let Some(mark) = query.chars().next() {
        out.push(mark);
        if query.len() > 1 {
            out.push(CUT);
        }
    }
}

/// Returns a text on one line in which control characters and those that turn the direction of writing are
/// escaped, such as `\u{1b}`.
pub fn one_line(text: &str) -> String {
    escaped(text, |_| false)
}

/// Returns a text of lines in which control characters other than the ends of lines are escaped.
pub fn lines(text: &str) -> String {
    escaped(text, |c| c == '\n' || c == '\t')
}

fn escaped(text: &str, is_kept: impl Fn(char) -> bool) -> String {
    let steers =
        |c: char| c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        if steers(c) && !is_kept(c) {
            out.extend(c.escape_default());
        } else {
            out.push(c);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn users_passwords_and_signatures_are_cut() {
        for (text, expected) in [
            ("https://host/a.wav?X-Amz-Signature=SECRET", "https://host/a.wav?…"),
            ("read az://c/x?sig=SECRET: refused", "read az://c/x?… refused"),
            ("location \"s3://KEY:SECRET@bucket/a\" is", "location \"s3://…@bucket/a\" is"),
            ("s3://KEY:SEC/RET@bucket/a", "s3://…@bucket/a"),
            ("http://127.0.0.1:9000/a@b/c", "http://127.0.0.1:9000/a@b/c"),
            ("s3://bucket/user@home/x.wav", "s3://bucket/user@home/x.wav"),
            ("file:///a%3F/b#SECRET, then gs://b?k", "file:///a%3F/b#… then gs://b?…"),
            ("no URL: a?b@c", "no URL: a?b@c"),
            ("use file://, gs://", "use file://, gs://"),
            ("a://b://c:d@e", "a://…@e"),
        ] {
            assert_eq!(redacted(text), expected, "{text}");
        }
        assert_eq!(redacted_location("https://h/a b?sig=SECRET"), "https://h/a b?…");
        assert_eq!(redacted_location("no url?a"), "no url?a");
    }

    #[test]
    fn what_steers_a_terminal_is_escaped() {
        let name = "\u{1b}]0;title\u{7}\u{1b}[31mred\n.wav\u{9b}\u{202e}";
        let expected = "\\u{1b}]0;title\\u{7}\\u{1b}[31mred\\n.wav\\u{9b}\\u{202e}";
        assert_eq!(one_line(name), expected);
        assert_eq!(lines("a\tb\n\u{1b}c\r\n"), "a\tb\n\\u{1b}c\\r\n");
        assert_eq!(one_line("ü → “ok”"), "ü → “ok”");
    }

    proptest! {
        #[test]
        fn no_secret_survives_whatever_surrounds_it(
            before in "[ -~]{0,20}",
            user in "[a-z]{0,5}",
            after in "[ -~]{0,20}",
        ) {
            let text = format!("{before} s3://{user}:PASSWORD@host/a?SIGNATURE {after}");
            let cut = redacted(&text);
            prop_assert!(!cut.contains("PASSWORD") && !cut.contains("SIGNATURE"), "{cut}");
        }
    }
}
