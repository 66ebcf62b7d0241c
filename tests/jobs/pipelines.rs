//! The pipelines: stamps by content, and what exit codes do to them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, SystemTime};

use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, Output, phrases};

/// A folder of pipelines with a program of our own: it does what the file `code` says, and keeps its arguments.
fn fake(dir: &Dir) -> PathBuf {
    let script = format!(
        "#!/bin/sh\necho \"$@\" >> {0}/calls\nmkdir -p {0}/store/commits\nexit $(cat {0}/code)\n",
        dir.path().display()
    );
    let program = dir.write("motiongen", script);
    use std::os::unix::fs::PermissionsExt as _;
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("a program");
    program
}

fn n_calls(dir: &Dir) -> usize {
    std::fs::read_to_string(dir.at("calls")).map_or(0, |calls| calls.lines().count())
}

fn make(dir: &Dir, program: &Path, more: &[&str]) -> Output {
    let mut command = Command::new("make");
    command.current_dir(env!("CARGO_MANIFEST_DIR")).env_remove("MAKEFLAGS").env_remove("MAKELEVEL");
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("MOTIONGEN") {
            command.env_remove(name);
        }
    }
    command.args(["-f", "pipelines/ingest.mk"]);
    let pair = |name: &str, value: &Path| format!("{name}={}", value.display());
    command.args([
        pair("SOURCE", &dir.at("s")),
        pair("STORE", &dir.at("store")),
        pair("OUT", &dir.at("out")),
        pair("MOTIONGEN", program),
    ]);
    let output = command.args(more).output().expect("make");
    Output {
        code: output.status.code().expect("a code"),
        stdout: String::from_utf8(output.stdout).expect("UTF-8"),
        stderr: String::from_utf8(output.stderr).expect("UTF-8"),
    }
}

fn stamps(dir: &Dir) -> Vec<String> {
    let entries = std::fs::read_dir(dir.at("out/stamps")).into_iter().flatten().flatten();
    let mut names: Vec<String> =
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.retain(|name| name.ends_with(".done"));
    names.sort();
    names
}

#[test]
fn exit_codes_decide_whether_a_stage_is_stamped() {
    let dir = Dir::new();
    let program = fake(&dir);
    dir.write("s/a.wav", "a");
    // Stopped: no stamp, and make says so.
    dir.write("code", "75");
    let output = make(&dir, &program, &[]);
    assert_ne!(output.code, 0, "{output:?}");
    assert!(output.stderr.contains(": stopped before it was done; run make again to go on\n"));
    assert!(stamps(&dir).is_empty());
    dir.write("code", "2");
    assert_ne!(make(&dir, &program, &[]).code, 0);
    assert!(stamps(&dir).is_empty());
    // Some items failed: the pipeline goes on, and tries again next time.
    dir.write("code", "1");
    for n in 3..5 {
        let output = make(&dir, &program, &[]);
        assert_eq!(output.code, 0, "{output:?}");
        assert!(
            output.stderr.contains(": some items failed (see above); going on, "),
            "{output:?}"
        );
        assert!(stamps(&dir).is_empty());
        assert_eq!(n_calls(&dir), n);
    }
    dir.write("code", "0");
    assert_eq!(make(&dir, &program, &[]).code, 0);
    assert_eq!((stamps(&dir), n_calls(&dir)), (vec!["shard-0-of-1.done".to_owned()], 5));
    let output = make(&dir, &program, &[]);
    assert!(output.stdout.contains("ingest: everything is up to date\n"), "{output:?}");
    assert_eq!(n_calls(&dir), 5);
}

fn date(folder: &Path, time: SystemTime) {
    for entry in walkdir::WalkDir::new(folder).into_iter().flatten() {
        if entry.file_type().is_file() {
            let file = std::fs::File::options().write(true).open(entry.path()).expect("a file");
            file.set_modified(time).expect("dated");
        }
    }
}

/// The clock was ten minutes ahead when the stamps were written, or behind.
#[test]
fn stamps_compare_content_and_not_clocks() {
    let dir = Dir::new();
    let program = fake(&dir);
    dir.write("code", "0");
    dir.write("s/a.wav", "a");
    assert_eq!(make(&dir, &program, &[]).code, 0);
    assert_eq!(n_calls(&dir), 1);
    let now = SystemTime::now();
    for time in [now + Duration::from_secs(600), now - Duration::from_secs(600)] {
        date(&dir.at("out"), time);
        make(&dir, &program, &[]);
    }
    assert_eq!(n_calls(&dir), 1, "only clocks moved");
    for (i, time) in
        [now + Duration::from_secs(600), now - Duration::from_secs(600)].iter().enumerate()
    {
        date(&dir.at("out"), *time);
        dir.write(format!("s/new {i}.wav"), "b");
        assert_eq!(make(&dir, &program, &[]).code, 0);
        assert_eq!(n_calls(&dir), 2 + i, "a new file is seen");
    }
    // Another program, other flags.
    std::fs::write(&program, std::fs::read_to_string(&program).expect("text") + "# newer\n")
        .expect("written");
    make(&dir, &program, &[]);
    assert_eq!(n_calls(&dir), 4);
    make(&dir, &program, &["FLAGS=--workers 1"]);
    assert_eq!(n_calls(&dir), 5);
}

/// The same with the program itself.
#[test]
fn a_file_that_comes_while_stamps_are_of_the_future_is_ingested() {
    let dir = Dir::new();
    let program = PathBuf::from(env!("CARGO_BIN_EXE_motiongen"));
    dir.write("s/motion/a/trajectory.npy", trajectory(&coherent(31, 1)));
    let output = make(&dir, &program, &["SHARDS=4"]);
    assert_eq!(output.code, 0, "{output:?}");
    date(&dir.at("out"), SystemTime::now() + Duration::from_secs(600));
    dir.write("s/motion/b/trajectory.npy", trajectory(&coherent(31, 2)));
    assert_eq!(make(&dir, &program, &["SHARDS=4"]).code, 0);
    assert_eq!(phrases(&dir.at("store")).into_keys().collect::<Vec<_>>(), ["a", "b"]);
}
