//! What the executables say, and with which exit code.

use std::io::pipe;
use std::os::unix::fs::PermissionsExt as _;
use std::process::Stdio;

use super::write_motion;
use crate::support::{
    Dir, MEMORY_BYTES, confined, finish, ingest, ingest_command, motion, motiongen,
    motiongen_ingest, phrases, run,
};

#[test]
fn what_cannot_run_says_why_in_a_sentence() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    write_motion(&source, "a", 5, 1);
    let file = dir.write("file", "no folder");
    let place = |path: &str| dir.at(path).display().to_string();
    let hint = "; use a path, file://, gs://, s3://, az:// or memory://NAME\n";
    let text = |path: &std::path::Path| path.to_str().unwrap().to_owned();
    for (source, store, more, sentence) in [
        (place("gone"), text(&store), &[][..], format!("error: {}: not found\n", place("gone"))),
        (
            text(&file),
            text(&store),
            &[],
            format!("error: {}: could not list: not a directory\n", place("file")),
        ),
        (String::new(), text(&store), &[], format!("error: location \"\" is empty{hint}")),
        (
            text(dir.write("text/notes.txt", "").parent().unwrap()),
            text(&store),
            &[],
            format!(
                "error: source {}: no phrases found among 1 files; expected \
                 motion/ID/trajectory.npy (or motion.bvh, .npz, .npy, .vmd), \
                 audio_features/ID/features.npz, or audio files anywhere\n",
                place("text")
            ),
        ),
        (
            text(&source),
            "ftp://host/store".to_owned(),
            &[],
            format!("error: location \"ftp://host/store\" has the unknown scheme ftp://{hint}"),
        ),
        (
            "http://host/music".to_owned(),
            text(&store),
            &[],
            format!("error: location \"http://host/music\" has the unknown scheme http://{hint}"),
        ),
        (
            text(&source),
            text(&store),
            &["--shard", "3/3"],
            "error: shard \"3/3\" has index 3 but only 3 shards; write it as i/n with 0 <= i < n, \
             or \"auto\"\n"
                .to_owned(),
        ),
        (
            text(&source),
            text(&store),
            &["--shard", "half"],
            "error: shard \"half\" has no \"/\"; write it as i/n with 0 <= i < n, or \"auto\"\n"
                .to_owned(),
        ),
    ] {
        let output = ingest(source.as_ref(), store.as_ref(), more);
        assert_eq!((output.code, output.stderr.as_str()), (2, sentence.as_str()));
        assert_eq!(output.stdout, "");
        assert!(!dir.at("store").exists(), "{sentence}");
    }
}

#[test]
fn a_store_that_cannot_be_written_is_named() {
    let dir = Dir::new();
    let source = dir.at("source");
    write_motion(&source, "a", 5, 1);
    let store = dir.at("store");
    std::fs::create_dir(&store).unwrap();
    std::fs::set_permissions(&store, std::fs::Permissions::from_mode(0o555)).unwrap();
    let output = finish(&mut confined(&ingest_command(&source, &store, &[]), MEMORY_BYTES));
    assert_eq!(output.code, 2, "{output:?}");
    let expected = format!("error: file://{}/", store.display());
    assert!(output.stderr.starts_with(&expected), "{}", output.stderr);
    assert!(output.stderr.ends_with(": Permission denied (os error 13)\n"), "{}", output.stderr);

    let file = dir.write("file", "no folder");
    let output = ingest(&source, &file, &[]);
    assert_eq!(output.code, 2, "{output:?}");
    let expected = format!("error: file://{}/", file.display());
    assert!(output.stderr.starts_with(&expected), "{}", output.stderr);
    assert_eq!(std::fs::read(&file).unwrap(), b"no folder");
}

#[test]
fn a_wrong_or_missing_flag_cannot_run() {
    for (arguments, start) in [
        (&["ingest"][..], "error: the following required arguments were not provided:\n"),
        (&["ingest", "--sauce", "x"], "error: unexpected argument '--sauce' found\n"),
        (&["digest"], "error: unrecognized subcommand 'digest'\n"),
    ] {
        let output = run(arguments);
        assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{arguments:?}");
        assert!(output.stderr.starts_with(start), "{}", output.stderr);
    }
}

#[test]
fn the_front_door_alone_lists_the_stages() {
    let output = run([""; 0]);
    assert_eq!((output.code, output.stderr.as_str()), (0, ""));
    let start = format!(
        "motiongen {}: the stages, in the order of a pipeline\n\n  ingest     bring phrases or a \
         music library into tables\n",
        env!("CARGO_PKG_VERSION")
    );
    assert!(output.stdout.starts_with(&start), "{}", output.stdout);
    assert!(output.stdout.ends_with("\n\nmotiongen STAGE --help tells the rest. For the shell: motiongen completions SHELL, motiongen man \
             [STAGE].\n"));
}

#[test]
fn the_stage_of_its_own_takes_the_arguments_of_the_front_door() {
    let help = |output: crate::support::Output, name: &str| {
        assert_eq!((output.code, output.stderr.as_str()), (0, ""));
        output.stdout.replace(name, "NAME")
    };
    // The front door answers --version for all its stages.
    for (flag, version) in [
        ("--help", "  -V, --version          Print version\n"),
        ("--help-all", "\n  -V, --version\n          Print version\n"),
    ] {
        let own = help(finish(motiongen_ingest().arg(flag)), "motiongen-ingest");
        assert!(own.contains(version), "{own}");
        let of_front_door = help(run(["ingest", flag]), "motiongen ingest");
        assert_eq!(own.replace(version, ""), of_front_door);
    }

    let dir = Dir::new();
    let source = dir.at("source");
    write_motion(&source, "a", 31, 1);
    write_motion(&source, "b/c", 7, 2);
    let (ours, theirs) = (dir.at("ours"), dir.at("theirs"));
    let mut command = motiongen_ingest();
    command.arg("--source").arg(&source).arg("--store").arg(&ours);
    assert_eq!(finish(command.args(["--workers", "2", "-v", "--limits", "wide"])).code, 0);
    assert_eq!(ingest(&source, &theirs, &[]).code, 0);
    assert_eq!(phrases(&ours), phrases(&theirs));
    assert_eq!(motion(&ours), motion(&theirs));
}

#[test]
fn a_reader_that_went_away_is_no_error() {
    let dir = Dir::new();
    let source = dir.at("source");
    write_motion(&source, "a", 5, 1);
    let mut listing = motiongen();
    let mut help = motiongen();
    help.args(["ingest", "--help"]);
    for command in [&mut listing, &mut help, &mut ingest_command(&source, &dir.at("store"), &[])] {
        let (reader, writer) = pipe().unwrap();
        drop(reader);
        let output = command.stdout(writer).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{command:?}: {output:?}");
        assert_eq!(String::from_utf8(output.stderr).unwrap(), "", "{command:?}");
    }
    assert_eq!(phrases(&dir.at("store")).len(), 1);
}
