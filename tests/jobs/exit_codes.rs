//! 0 done, 1 items failed, 2 could not run, 75 stopped before it was done; and the same as JSON.

use std::path::Path;

use super::{end, object, signal, stage, start, succeed, wait_until};
use crate::generate::modelled;
use crate::support::files::{coherent, trajectory, wav};
use crate::support::{Dir, finish, ingest_command, motiongen, phrases, run};
use crate::train::{make_store, train_command};

fn commits(store: &Path, stage: &str) -> usize {
    std::fs::read_dir(store.join("commits").join(stage)).map_or(0, Iterator::count)
}

#[test]
fn every_help_names_the_codes() {
    let stages = [
        "ingest", "extract", "library", "train", "finetune", "tokenize", "export", "generate",
        "evaluate", "model", "plot", "view", "query",
    ];
    for stage in stages {
        let help = run([stage, "--help"]).stdout.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(
            help.contains(
                "Exit codes: 0 done, 1 done but some items failed (see the failures table), 2 could not run, 75 \
                 stopped before it was done (SIGTERM, Ctrl-C): the same command goes on."
            ),
            "{stage}: {help}"
        );
    }
}

#[test]
fn ingest_that_is_stopped_keeps_its_batches_and_ends_with_75() {
    let dir = Dir::new();
    let n = 400;
    for i in 0..n {
        dir.write(format!("s/motion/{i:03}/trajectory.npy"), trajectory(&coherent(61, i)));
    }
    let (source, store) = (dir.at("s"), dir.at("store"));
    let flags = ["--batch-phrases=1", "--workers=1", "--summary=json"];
    for name in ["TERM", "INT"] {
        let before = commits(&store, "ingest");
        let mut child = start(ingest_command(&source, &store, &flags));
        wait_until("a commit", || {
            assert!(child.try_wait().expect("a status").is_none(), "it ended too soon");
            commits(&store, "ingest") > before
        });
        signal(name, child.id());
        let (code, stdout, stderr) = end(child);
        assert_eq!(code, Some(75), "SIG{name}: {stdout}{stderr}");
        let told = object(&stdout);
        assert_eq!((&told["outcome"], &told["exit_code"]), (&"stopped".into(), &75.into()));
        // Every batch that was begun is whole.
        let n_done =
            told["n_done"].as_u64().expect("a number") + told["n_unchanged"].as_u64().unwrap();
        assert_eq!(phrases(&store).len() as u64, n_done);
        assert!(n_done < u64::from(n), "it was stopped too late");
    }
    succeed(&mut ingest_command(&source, &store, &flags));
    assert_eq!(phrases(&store).len(), n as usize);
}

#[test]
fn generate_that_is_stopped_ends_with_75() {
    let dir = Dir::new();
    let store = modelled(&dir);
    // Sixteen batches of about ten minutes of motion.
    let flags =
        ["--model=m", "--engine=eager", "--steps=2", "--samples=400", "--overlap=7", "--quiet"];
    let mut child = start(stage("generate", &store, &flags));
    // Once the second batch is there, the stage has looked whether an end is asked for.
    wait_until("two batches", || {
        assert!(child.try_wait().expect("a status").is_none(), "it ended too soon");
        commits(&store, "generate") > 1
    });
    signal("TERM", child.id());
    let (code, stdout, _) = end(child);
    assert_eq!(code, Some(75), "{stdout}");
    assert!(stdout.contains("  stopped as asked; the same command goes on with what is missing"));
}

/// A stage that has nothing to finish ends with 75 at once, and says so.
#[cfg(unix)]
#[test]
fn a_stage_that_waits_for_a_file_is_stopped_at_once() {
    let dir = Dir::new();
    let pipe = dir.at("pipe.wav");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    let picture = dir.at("x.png").display().to_string();
    for name in ["TERM", "INT"] {
        let mut command = motiongen();
        command.args(["plot", "features", "--summary=json", "--output", &picture, "--audio"]);
        command.arg(&pipe);
        let child = start(command);
        wait_until("the listener", || {
            let tasks = std::fs::read_dir(format!("/proc/{}/task", child.id()));
            tasks.is_ok_and(|tasks| {
                tasks.flatten().any(|task| {
                    let name = std::fs::read_to_string(task.path().join("comm"));
                    name.is_ok_and(|name| name.trim() == "signals")
                })
            })
        });
        signal(name, child.id());
        let (code, stdout, stderr) = end(child);
        assert_eq!(code, Some(75), "SIG{name}: {stderr}");
        assert_eq!(stderr, "stopped as asked; the same command goes on with what is missing\n");
        assert_eq!(object(&stdout)["outcome"], "stopped");
    }
}

/// Of Linux.
const O_NONBLOCK: i32 = 0o4000;

/// The second signal does not wait for what is under way.
#[cfg(unix)]
#[test]
fn the_second_signal_ends_a_stage_at_once() {
    use std::os::unix::fs::OpenOptionsExt as _;
    let dir = Dir::new();
    dir.write("s/a.wav", wav(0.4));
    let store = dir.at("store");
    succeed(&mut ingest_command(&dir.at("s"), &store, &[]));
    // A file that is never there to the end.
    std::fs::remove_file(dir.at("s/a.wav")).expect("removed");
    let pipe = dir.at("s/a.wav");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    for (name, expected) in [("TERM", 143), ("INT", 130)] {
        let mut child = start(stage("extract", &store, &["--workers=1"]));
        // A pipe can be opened for writing once somebody reads it; then the stage waits for what is never written.
        let mut open = std::fs::OpenOptions::new();
        open.write(true).custom_flags(O_NONBLOCK);
        let mut writer = open.open(&pipe);
        wait_until("a reader", || {
            assert!(child.try_wait().expect("a status").is_none(), "it ended too soon");
            if writer.is_err() {
                writer = open.open(&pipe);
            }
            writer.is_ok()
        });
        std::thread::sleep(std::time::Duration::from_millis(300));
        signal(name, child.id());
        std::thread::sleep(std::time::Duration::from_millis(200));
        assert!(child.try_wait().expect("a status").is_none(), "the first signal is heeded");
        signal(name, child.id());
        assert_eq!(end(child).0, Some(expected), "SIG{name}");
    }
}

#[test]
fn outcomes_are_told_as_one_object() {
    let dir = Dir::new();
    dir.write("s/motion/a/trajectory.npy", trajectory(&coherent(31, 1)));
    dir.write("s/motion/b/trajectory.npy", "no array");
    let store = dir.at("store");
    let output = finish(&mut ingest_command(&dir.at("s"), &store, &["--summary", "json"]));
    assert_eq!(output.code, 1);
    let told = object(&output.stdout);
    assert_eq!(told["stage"], "ingest");
    assert_eq!(told["outcome"], "items_failed");
    assert_eq!((&told["n_failed"], &told["n_done"]), (&1.into(), &1.into()));
    assert_eq!(told["failures"][0]["item"], "b");
    assert_eq!(told["failures"][0]["kind"], "npy_format");
    // What could not run says why in the object, too.
    let output = finish(stage("query", &store, &["--summary=json"]).arg("select * from nothing"));
    assert_eq!(output.code, 2);
    let told = object(&output.stdout);
    assert_eq!((&told["stage"], &told["outcome"]), (&"query".into(), &"could_not_run".into()));
    let error = told["error"].as_str().expect("a sentence");
    assert_eq!(output.stderr.trim_end(), format!("error: {error}"));
    // Also where the command line itself is wrong, or the variable asks.
    let output = finish(motiongen().args(["ingest", "--sorce=x"]).env("MOTIONGEN_SUMMARY", "json"));
    assert_eq!((output.code, object(&output.stdout)["exit_code"].clone()), (2, 2.into()));
    let output =
        finish(stage("query", &store, &["--summary=json"]).arg("select phrase_id from phrases"));
    assert_eq!(object(&output.stdout)["rows"], serde_json::json!([{ "phrase_id": "a" }]));
}

#[test]
fn a_stream_and_a_summary_do_not_share_standard_output() {
    let dir = Dir::new();
    let song = dir.write("song.wav", wav(0.4)).display().to_string();
    let out = dir.at("out").display().to_string();
    let flags = ["generate", "--audio", &song, "--output", &out, "--summary=json", "--stream"];
    let output = run(flags);
    assert_eq!(output.code, 2);
    assert_eq!(
        output.stderr,
        "error: --stream and --summary json both want standard output; give --stream a file, or leave --summary \
         out\n"
    );
    assert_eq!(object(&output.stdout)["outcome"], "could_not_run");
    assert!(!dir.at("out").exists());
}

#[test]
fn work_goes_on_when_nobody_reads_what_is_told_of_it() {
    let dir = Dir::new();
    let store = make_store(&dir);
    // Every validation is told on standard error, a pipe whose reader is gone.
    let mut child = start(train_command(&store, "r", &["--steps=6", "--decoder-steps=5"]));
    drop(child.stderr.take());
    let (code, stdout, _) = end(child);
    assert_eq!(code, Some(0), "{stdout}");
    assert!(stdout.contains("best validation loss"), "{stdout}");
}
