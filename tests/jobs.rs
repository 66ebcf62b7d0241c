//! Jobs that can be trusted: exit codes, dry runs, what is done and what is not, and the pipelines around them.

mod cluster;
mod configuration;
mod content;
mod dry_run;
mod exit_codes;
mod one_writer;
mod pipelines;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::support::{Output, finish, motiongen};

/// Longest wait for what must happen; a test that waits so long has failed.
const PATIENCE: Duration = Duration::from_secs(60);

/// Returns `motiongen STAGE --store STORE` with more arguments, not yet run.
fn stage(name: &str, store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg(name).arg("--store").arg(store).args(more);
    command
}

#[track_caller]
fn succeed(command: &mut Command) -> Output {
    let output = finish(command);
    assert_eq!(output.code, 0, "{output:?}");
    output
}

/// Waits until a condition holds.
#[track_caller]
fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let started = Instant::now();
    while !is_so() {
        assert!(started.elapsed() < PATIENCE, "{what}: waited in vain");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Starts a command whose output is kept.
fn start(mut command: Command) -> std::process::Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).stdin(Stdio::null());
    command.spawn().unwrap_or_else(|e| panic!("{command:?}: {e}"))
}

/// Sends a signal to a process.
#[track_caller]
fn signal(name: &str, process: u32) {
    let sent = Command::new("kill").args([&format!("-{name}"), &process.to_string()]).status();
    assert!(sent.expect("kill").success());
}

/// Waits for the end of a child.
#[track_caller]
fn end(child: std::process::Child) -> (Option<i32>, String, String) {
    let output = child.wait_with_output().expect("an end");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// Returns the one JSON object that a program printed, and nothing else.
#[track_caller]
fn object(stdout: &str) -> serde_json::Value {
    assert_eq!(stdout.lines().count(), 1, "one line: {stdout}");
    let value: serde_json::Value = serde_json::from_str(stdout).expect("JSON");
    assert!(value.is_object(), "{value}");
    value
}
