//! The one place that prints errors and summaries, and chooses the exit code.

use std::ffi::{OsStr, OsString};
use std::io::{self, Write};
use std::process::ExitCode;

use serde_json::{Value, json};

use crate::stages::Summary;

/// Done, but some items failed; they are in the `failures` table.
pub const SOME_FAILED: u8 = 1;
/// Could not run.
pub const COULD_NOT_RUN: u8 = 2;
/// Stopped before it was done: EX_TEMPFAIL of sysexits.h, which asks to try again.
pub const STOPPED: u8 = 75;

/// The flag that chooses the form of the summary.
pub const FLAG: &str = "summary";

/// How a stage tells what it did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Form {
    /// For people.
    #[default]
    Text,
    /// One object on standard output, and nothing else there.
    Json,
}

impl Form {
    /// Returns the form that arguments ask for which could not be parsed as a whole.
    pub fn asked(arguments: &[OsString]) -> Self {
        let asked = super::config::value_of(FLAG, arguments);
        if asked.is_some_and(|form| form.eq_ignore_ascii_case("json")) {
            Self::Json
        } else {
            Self::Text
        }
    }
}

/// Prints what a stage did, or why it could not run, and returns the exit code.
#[expect(clippy::print_stderr, reason = "this is where errors are printed")]
pub fn report(stage: &str, form: Form, outcome: anyhow::Result<Box<dyn Summary>>) -> ExitCode {
    let mut summary = match outcome {
        Ok(summary) => summary,
        Err(error) => {
            let error = chain(&error);
            eprintln!("error: {error}");
            if form == Form::Json {
                // Standard error has the sentence already.
                print_object(&could_not_run(stage, &error)).ok();
            }
            return ExitCode::from(COULD_NOT_RUN);
        }
    };
    let (n_failed, is_stopped) = (summary.n_failed(), summary.is_stopped());
    let code = match (is_stopped, n_failed) {
        (true, _) => STOPPED,
        (false, 0) => 0,
        (false, _) => SOME_FAILED,
    };
    let printed = match form {
        Form::Text => print(summary.as_mut()),
        Form::Json => {
            let mut object = outcome_of(stage, code, n_failed);
            if let (Value::Object(all), Value::Object(more)) = (&mut object, summary.figures()) {
                more.into_iter().for_each(|(name, value)| {
                    all.entry(name).or_insert(value);
                });
            }
            print_object(&object)
        }
    };
    if let Err(error) = printed {
        eprintln!("error: could not write to standard output: {error}");
        return ExitCode::from(COULD_NOT_RUN);
    }
    ExitCode::from(code)
}

/// Says that the stage was stopped before anything was under way that could be finished.
#[expect(clippy::print_stderr, reason = "this is where errors are printed")]
pub fn stopped(stage: &str, form: Form) {
    eprintln!("stopped as asked; the same command goes on with what is missing");
    if form == Form::Json {
        // Nobody is left to be told that it could not be written.
        print_object(&outcome_of(stage, STOPPED, 0)).ok();
    }
}

/// Prints clap's own words: help and version end well, a wrong flag could not run.
#[expect(clippy::print_stderr, reason = "this is where errors are printed")]
pub fn usage(
    stage: &str,
    form: Form,
    error: &clap::Error,
    configuration: Option<&OsStr>,
) -> ExitCode {
    // The reader of a help text may be gone; there is nobody left to tell.
    error.print().ok();
    if !error.use_stderr() {
        return ExitCode::SUCCESS;
    }
    if let Some(file) = configuration {
        eprintln!("hint: values that were not typed may come from {}", file.to_string_lossy());
    }
    if form == Form::Json {
        let text = error.to_string();
        let first = text.lines().next().unwrap_or_default();
        let sentence = first.strip_prefix("error: ").unwrap_or(first);
        print_object(&could_not_run(stage, sentence)).ok();
    }
    ExitCode::from(COULD_NOT_RUN)
}

fn outcome_of(stage: &str, code: u8, n_failed: u64) -> Value {
    let outcome = match code {
        0 => "done",
        SOME_FAILED => "items_failed",
        STOPPED => "stopped",
        _ => "could_not_run",
    };
    json!({ "stage": stage, "outcome": outcome, "exit_code": code, "n_failed": n_failed })
}

fn could_not_run(stage: &str, error: &str) -> Value {
    let mut object = outcome_of(stage, COULD_NOT_RUN, 0);
    object["error"] = error.into();
    object
}

/// Flushes what a stage has to say; a reader that went away is not an error.
fn print(summary: &mut dyn Summary) -> io::Result<()> {
    to_stdout(|out| summary.write(out))
}

fn print_object(object: &Value) -> io::Result<()> {
    to_stdout(|out| writeln!(out, "{object}"))
}

fn to_stdout(write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let mut out = io::BufWriter::new(io::stdout().lock());
    match write(&mut out).and_then(|()| out.flush()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written,
    }
}

/// Joins an error and its causes, leaving out a cause that its parent has quoted already.
fn chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
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
    fn an_outcome_has_its_code_and_its_name() {
        let told = |code| outcome_of("ingest", code, 3);
        let expected = |code: u8, name: &str| json!({ "stage": "ingest", "outcome": name, "exit_code": code, "n_failed": 3 });
        assert_eq!(told(0), expected(0, "done"));
        assert_eq!(told(SOME_FAILED), expected(1, "items_failed"));
        assert_eq!(told(COULD_NOT_RUN), expected(2, "could_not_run"));
        assert_eq!(told(STOPPED), expected(75, "stopped"));
    }
}
