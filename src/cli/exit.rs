//! The one place that prints errors and chooses the exit code.

use std::ffi::OsStr;
use std::process::ExitCode;

use crate::stages::{Summary, one_line, redacted};

/// Done, but some items failed; they are in the `failures` table.
const SOME_FAILED: u8 = 1;
/// Could not run.
const COULD_NOT_RUN: u8 = 2;

/// Prints what a stage did, or why it could not run, and returns the exit code.
#[expect(clippy::print_stderr, reason = "this is where errors are printed")]
pub fn report(outcome: anyhow::Result<Box<dyn Summary>>) -> ExitCode {
    let mut summary = match outcome {
        Ok(summary) => summary,
        Err(error) => {
            eprintln!("error: {}", chain(&error));
            return ExitCode::from(COULD_NOT_RUN);
        }
    };
    if let Err(error) = super::print(summary.as_mut()) {
        // Data are read while they are written.
        let said = match error.get_ref() {
            Some(cause) => on_one_line(&cause.to_string()),
            None => format!("could not write to standard output: {error}"),
        };
        eprintln!("error: {said}");
        return ExitCode::from(COULD_NOT_RUN);
    }
    if summary.n_failed() > 0 { ExitCode::from(SOME_FAILED) } else { ExitCode::SUCCESS }
}

/// Prints clap's own words: help and version end well, a wrong flag could not run.
#[expect(clippy::print_stderr, reason = "this is where errors are printed")]
pub fn usage(error: &clap::Error, configuration: Option<&OsStr>) -> ExitCode {
    // The reader of a help text may be gone; there is nobody left to tell.
    error.print().ok();
    if !error.use_stderr() {
        return ExitCode::SUCCESS;
    }
    if let Some(file) = configuration {
        eprintln!("hint: values that were not typed may come from {}", file.to_string_lossy());
    }
    ExitCode::from(COULD_NOT_RUN)
}

/// Joins an error and its causes, leaving out a cause that its parent has quoted already.
fn chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = on_one_line(&cause.to_string());
        if text.contains(&cause) {
            continue;
        }
        if !text.is_empty() {
            text.push_str(": ");
        }
        text.push_str(&cause);
    }
    text
}

/// Joins the lines of a message, and takes from it what is secret and what steers a terminal.
fn on_one_line(message: &str) -> String {
    let joined = message.lines().map(str::trim).filter(|line| !line.is_empty());
    one_line(&redacted(&joined.collect::<Vec<_>>().join(" ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_is_told_once() {
        let error = anyhow::anyhow!("disk full").context("could not write x").context("stage");
        assert_eq!(chain(&error), "stage: could not write x: disk full");
        let quoted = anyhow::anyhow!("disk full").context("could not write x: disk full");
        assert_eq!(chain(&quoted), "could not write x: disk full");
    }

    #[test]
    fn an_error_is_one_line_without_secrets() {
        let error =
            anyhow::anyhow!("no s3://KEY:SECRET@b/a?sig=SECRET\n  \u{1b}[2Jhere").context("a");
        assert_eq!(chain(&error), "a: no s3://…@b/a?… \\u{1b}[2Jhere");
    }
}
