//! Pictures that the program draws, and refuses to.

use std::path::Path;

use super::{Output, run};

pub fn plot(what: &str, arguments: &[&str]) -> Output {
    run(["plot", what].iter().chain(arguments))
}

/// Draws, and returns the summary.
#[track_caller]
pub fn drawn(what: &str, arguments: &[&str]) -> String {
    let output = plot(what, arguments);
    assert_eq!((output.code, output.stderr.as_str()), (0, ""), "{arguments:?}");
    output.stdout
}

/// Asks for something that cannot be drawn, and returns the sentence that comes back.
#[track_caller]
pub fn refusal(what: &str, arguments: &[&str]) -> String {
    let output = plot(what, arguments);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{arguments:?}: {output:?}");
    let first = output.stderr.lines().next().expect("an error");
    first.strip_prefix("error: ").expect("an error").to_owned()
}

pub fn text(path: &Path) -> String {
    path.to_str().expect("UTF-8").to_owned()
}

pub fn svg(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).expect("a picture")
}

/// Returns width and height of a PNG, as its header has them.
pub fn png_size(path: impl AsRef<Path>) -> (u32, u32) {
    let bytes = std::fs::read(path).expect("a picture");
    assert_eq!(bytes[..8], *b"\x89PNG\r\n\x1a\n");
    let number = |at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
    (number(16), number(20))
}
