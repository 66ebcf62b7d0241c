//! What is not known is refused with the nearest name, wherever it was written.

use super::{stage, succeed};
use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, finish, ingest, motiongen};

#[test]
fn unknown_keys_sections_and_variables_are_refused_with_the_nearest() {
    let dir = Dir::new();
    let store = dir.at("store");
    let path = dir.at("c.toml");
    let place = path.display();
    for (text, sentence) in [
        (
            "sotre = \"x\"\n",
            format!("error: configuration {place}: no stage has a key \"sotre\"; nearest: store\n"),
        ),
        (
            "bogus_key = 3\n",
            format!("error: configuration {place}: no stage has a key \"bogus_key\"; nearest: "),
        ),
        (
            "[ingst]\nlimits = \"wide\"\n",
            format!(
                "error: configuration {place}: has a section [ingst], which is no stage; nearest: ingest; the stages are \
                 ingest, extract, "
            ),
        ),
        // Also in the section of a stage that does not run just now.
        (
            "[train]\nstepz = 3\n",
            format!(
                "error: configuration {place}: [train] has no key \"stepz\"; nearest: steps; train knows "
            ),
        ),
        (
            "[plot.featurs]\nwidth = 400\n",
            format!("error: configuration {place}: [plot] has no key \"featurs\"; nearest: "),
        ),
        (
            "[plot.features]\nwidht = 400\n",
            format!(
                "error: configuration {place}: [plot.features] has no key \"widht\"; nearest: width; "
            ),
        ),
        (
            "ingest = 3\n",
            format!(
                "error: configuration {place}: ingest is a stage; write its keys below [ingest]\n"
            ),
        ),
    ] {
        std::fs::write(&path, text).expect("written");
        let mut command = stage("query", &store, &["--tables", "--config"]);
        let output = finish(command.arg(&path));
        assert_eq!(output.code, 2, "{text}: {output:?}");
        assert!(output.stderr.starts_with(&sentence), "{text}: {}", output.stderr);
    }
    for (name, nearest) in [
        ("MOTIONGEN_FORMTA", "MOTIONGEN_FORMAT"),
        ("MOTIONGEN_STOR", "MOTIONGEN_STORE"),
        ("MOTIONGEN_DEVCE", "MOTIONGEN_DEVICE"),
    ] {
        let mut command = stage("query", &store, &["--tables"]);
        let output = finish(command.env(name, "csv"));
        assert_eq!(output.code, 2, "{output:?}");
        assert_eq!(
            output.stderr,
            format!(
                "error: environment variable {name} is no setting of motiongen; nearest: {nearest}\n"
            )
        );
    }
    // Those of other stages, and those that are read elsewhere, are known to all.
    let known = ["MOTIONGEN_LOG", "MOTIONGEN_DEVICE", "MOTIONGEN_SIMD", "MOTIONGEN_GUIDANCE"];
    let mut command = motiongen();
    command.args(["model", "--preset=tiny"]);
    command.envs(known.map(|name| (name, "auto"))).env("MOTIONGEN_TEST_PYTHON", "python3");
    succeed(&mut command);
}

#[test]
fn switches_in_the_environment_take_what_people_write() {
    let dir = Dir::new();
    dir.write("s/motion/a/trajectory.npy", trajectory(&coherent(31, 1)));
    let (source, store) = (dir.at("s"), dir.at("store"));
    let ingest = |variable: &str| {
        let mut command = motiongen();
        command.arg("ingest").arg("--source").arg(&source).arg("--store").arg(&store);
        finish(command.env("MOTIONGEN_DRY_RUN", variable))
    };
    for on in ["1", "yes", "true", "on", "Yes", "TRUE"] {
        let output = ingest(on);
        assert_eq!(output.code, 0, "{on}: {output:?}");
        assert!(output.stdout.contains("would read 1 phrases"), "{on}: {output:?}");
        assert!(!store.exists());
    }
    for off in ["", "0", "no", "false", "off"] {
        let output = ingest(off);
        assert_eq!(output.code, 0, "{off:?}: {output:?}");
        assert!(!output.stdout.contains("would"), "{off:?}: {output:?}");
    }
    let wrong = ingest("perhaps");
    assert_eq!(wrong.code, 2);
    assert!(
        wrong.stderr.starts_with("error: invalid value 'perhaps' for '--dry-run'"),
        "{wrong:?}"
    );
}

#[test]
fn general_flags_may_stand_before_the_stage() {
    let dir = Dir::new();
    dir.write("s/motion/a/trajectory.npy", trajectory(&coherent(31, 1)));
    let store = dir.at("store");
    assert_eq!(ingest(&dir.at("s"), &store, &[]).code, 0);
    // A file that is called like a stage is still a file.
    dir.write("query", format!("[query]\nstore = {store:?}\nformat = \"csv\"\n"));
    let mut command = motiongen();
    command.current_dir(dir.path()).args(["--config", "query", "-q", "query"]);
    let output = succeed(command.arg("select phrase_id from phrases"));
    assert_eq!(output.stdout, "phrase_id\na\n");
    let mut command = motiongen();
    command.current_dir(dir.path()).args(["--summary=json", "query", "--config=query", "--tables"]);
    assert_eq!(super::object(&succeed(&mut command).stdout)["stage"], "query");
}
