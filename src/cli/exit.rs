//! The one place that prints errors and summaries, and chooses the exit code.

use std::ffi::{OsStr, OsString};
use std::io::{self, IsTerminal as _, Write};
use std::process::ExitCode;

use serde_json::{Value, json};

use super::escaped::Escaped;
use super::progress::tell;
use crate::stages::{Summary, lines, one_line, redacted};

/// Done, but some items failed; they are in the `failures` table.
pub const SOME_FAILED: u8 = 1;
/// Could not run.
pub const COULD_NOT_RUN: u8 = 2;
/// Stopped before it was done, or work is left: EX_TEMPFAIL of sysexits.h, which asks to try again.
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
pub fn report(stage: &str, form: Form, outcome: anyhow::Result<Box<dyn Summary>>) -> ExitCode {
    let mut summary = match outcome {
        Ok(summary) => summary,
        Err(error) => {
            let error = chain(&error);
            tell(&format!("error: {error}"));
            if form == Form::Json {
                // Standard error has the sentence already.
                print_object(&could_not_run(stage, &error)).ok();
            }
            return ExitCode::from(COULD_NOT_RUN);
        }
    };
    if !summary.is_told() {
        return ExitCode::SUCCESS;
    }
    let (n_failed, is_stopped) = (summary.n_failed(), summary.is_stopped());
    let has_work_left = summary.has_work_left();
    let code = match (is_stopped || has_work_left, n_failed) {
        (true, _) => STOPPED,
        (false, 0) => 0,
        (false, _) => SOME_FAILED,
    };
    let printed = match form {
        Form::Text => print(summary.as_mut()),
        Form::Json => {
            let mut object = outcome_of(stage, code, n_failed);
            if has_work_left {
                object["outcome"] = "work_left".into();
            }
            if let (Value::Object(all), Value::Object(more)) = (&mut object, summary.figures()) {
                more.into_iter().for_each(|(name, value)| {
                    all.entry(name).or_insert(value);
                });
            }
            print_object(&object)
        }
    };
    if let Err(error) = printed {
        // Data are read while they are written.
        let said = match error.get_ref() {
            Some(cause) => on_one_line(&cause.to_string()),
            None => format!("could not write to standard output: {error}"),
        };
        tell(&format!("error: {said}"));
        return ExitCode::from(COULD_NOT_RUN);
    }
    ExitCode::from(code)
}

/// Says that the stage was stopped before anything was under way that could be finished.
pub fn stopped(stage: &str, form: Form) {
    tell("stopped as asked; the same command goes on with what is missing");
    if form == Form::Json {
        // Standard output is gone when this fails, so that the error cannot be reported.
        print_object(&outcome_of(stage, STOPPED, 0)).ok();
    }
}

/// Prints clap's own words: help and version end well, a wrong flag could not run.
pub fn usage(
    stage: &str,
    form: Form,
    error: &clap::Error,
    configuration: Option<&OsStr>,
) -> ExitCode {
    // The reader of a help text may be gone, and with it the place to report an error.
    error.print().ok();
    if !error.use_stderr() {
        return ExitCode::SUCCESS;
    }
    if let Some(file) = configuration {
        let file = file.to_string_lossy();
        tell(&format!("hint: values that were not typed may come from {file}"));
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

/// Writes what a stage has to say: data as they are, or escaped for a terminal; an account for people escaped.
fn print(summary: &mut dyn Summary) -> io::Result<()> {
    if !summary.is_data() {
        return to_stdout(|out| account(summary, out));
    }
    if !io::stdout().is_terminal() {
        return to_stdout(|out| summary.write(out));
    }
    to_stdout(|out| {
        let mut out = Escaped::new(out);
        summary.write(&mut out).and_then(|()| out.flush())
    })
}

/// Writes an account for people, which names files that may be called anything.
pub fn account(summary: &mut dyn Summary, out: &mut dyn Write) -> io::Result<()> {
    let mut text = Vec::new();
    summary.write(&mut text)?;
    out.write_all(lines(&String::from_utf8_lossy(&text)).as_bytes())?;
    out.flush()
}

fn print_object(object: &Value) -> io::Result<()> {
    to_stdout(|out| writeln!(out, "{object}"))
}

/// Flushes what is written; a reader that went away is not an error.
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
    fn an_outcome_has_its_code_and_its_name() {
        let told = |code| outcome_of("ingest", code, 3);
        let expected = |code: u8, name: &str| json!({ "stage": "ingest", "outcome": name, "exit_code": code, "n_failed": 3 });
        assert_eq!(told(0), expected(0, "done"));
        assert_eq!(told(SOME_FAILED), expected(1, "items_failed"));
        assert_eq!(told(COULD_NOT_RUN), expected(2, "could_not_run"));
        assert_eq!(told(STOPPED), expected(75, "stopped"));
    }

    #[test]
    fn an_error_is_one_line_without_secrets() {
        let error =
            anyhow::anyhow!("no s3://KEY:SECRET@b/a?sig=SECRET\n  \u{1b}[2Jhere").context("a");
        assert_eq!(chain(&error), "a: no s3://…@b/a?… \\u{1b}[2Jhere");
    }
}
