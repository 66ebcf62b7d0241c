//! Where a parameter comes from: flag, else environment, else file, else default.

use std::path::PathBuf;
use std::process::Command;

use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, Output, finish, ingest_command, motiongen, motiongen_ingest, phrases};

/// A source whose one phrase only wide limits accept, so that the exit code tells the limits.
fn fast(dir: &Dir) -> (PathBuf, PathBuf) {
    let mut frames = coherent(13, 4);
    frames[6][14] = 15.0;
    dir.write("source/motion/fast/trajectory.npy", trajectory(&frames));
    (dir.at("source"), dir.at("store"))
}

const WIDE: i32 = 0;
const REFERENCE: i32 = 1;

#[test]
fn a_flag_wins_over_the_environment_over_the_file_over_the_default() {
    let dir = Dir::new();
    let (source, store) = fast(&dir);
    let reference = dir.write("reference.toml", "limits = \"reference\"\n");
    let own = dir.write("own.toml", "limits = \"wide\"\n[ingest]\nlimits = \"reference\"\n");
    let wide = dir.write("wide.toml", "[ingest]\nlimits = \"wide\"\n[generate]\nlimits = 3\n");
    let file = |path: &PathBuf| Some(path.to_str().unwrap().to_owned());
    for (flag, variable, file, expected) in [
        (None, None, None, WIDE),
        (None, None, file(&reference), REFERENCE),
        (None, None, file(&own), REFERENCE),
        (None, None, file(&wide), WIDE),
        (None, Some("reference"), None, REFERENCE),
        (None, Some("wide"), file(&reference), WIDE),
        (None, Some("reference"), file(&wide), REFERENCE),
        (Some("reference"), Some("wide"), file(&wide), REFERENCE),
        (Some("wide"), Some("reference"), file(&reference), WIDE),
        (Some("reference"), None, None, REFERENCE),
    ] {
        let mut command = ingest_command(&source, &store, &[]);
        if let Some(limits) = flag {
            command.args(["--limits", limits]);
        }
        if let Some(limits) = variable {
            command.env("MOTIONGEN_LIMITS", limits);
        }
        if let Some(file) = &file {
            command.args(["--config", file]);
        }
        let output = finish(&mut command);
        assert_eq!(output.code, expected, "{flag:?} {variable:?} {file:?}: {output:?}");
    }
}

#[test]
fn the_file_may_hold_every_parameter_and_be_named_by_the_environment() {
    let dir = Dir::new();
    let (source, store) = fast(&dir);
    let config = dir.write(
        "all.toml",
        format!(
            "source = {source:?}\n[ingest]\nstore = {store:?}\nbatch_phrases = 3\n\
             length-tolerance-frames = 2\nworkers = 1\n"
        ),
    );
    for mut command in [motiongen(), motiongen_ingest()] {
        if command.get_program().to_str().unwrap().ends_with("motiongen") {
            command.arg("ingest");
        }
        let output = finish(command.env("MOTIONGEN_CONFIG", &config));
        assert_eq!(output.code, 0, "{output:?}");
        assert_eq!(phrases(&store).into_keys().collect::<Vec<_>>(), ["fast"]);
    }
    let dry = dir.write("dry.toml", "dry_run = true\n");
    let output = with(ingest_command(&source, &dir.at("other"), &[]), &dry);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("would read 1 phrases"), "{}", output.stdout);
    assert!(!dir.at("other").exists());
}

fn with(mut command: Command, config: &PathBuf) -> Output {
    finish(command.arg("--config").arg(config))
}

#[test]
fn a_file_that_makes_no_sense_is_refused_with_a_sentence() {
    let dir = Dir::new();
    let (source, store) = fast(&dir);
    let path = dir.at("bad.toml");
    let place = path.display();
    for (text, sentence) in [
        (
            "[ingest]\nstor = \"x\"\n",
            format!(
                "error: configuration {place}: [ingest] has no key \"stor\"; nearest: store; \
                 ingest knows "
            ),
        ),
        (
            "[ingest]\nlimits = \"wild\"\n",
            "error: invalid value 'wild' for '--limits <LIMITS>'\n  [possible values: wide, \
             reference]\n"
                .to_owned(),
        ),
        (
            "batch_phrases = 0\n",
            "error: invalid value '0' for '--batch-phrases <N>': number would be zero for \
             non-zero type\n"
                .to_owned(),
        ),
        (
            "[ingest.limits]\nspin = 3\n",
            format!("error: configuration {place}: [ingest] limits cannot be a table\n"),
        ),
        ("limits = wide\n", format!("error: configuration {place}: is not TOML: ")),
    ] {
        dir.write("bad.toml", text);
        let output = with(ingest_command(&source, &store, &[]), &path);
        assert_eq!(output.code, 2, "{text}: {output:?}");
        assert!(output.stderr.starts_with(&sentence), "{text}: {}", output.stderr);
        assert!(!store.exists());
    }
    let output = with(ingest_command(&source, &store, &[]), &dir.at("gone.toml"));
    assert_eq!(output.code, 2);
    assert_eq!(
        output.stderr,
        format!(
            "error: configuration {}: could not be read: No such file or directory (os error 2)\n",
            dir.at("gone.toml").display()
        )
    );
}
