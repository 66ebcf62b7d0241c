//! `motiongen status`: what is left is what the stages themselves would do, told without a byte written.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::generate::modelled;
use crate::library::{beat_list, clicks};
use crate::support::files::wav;
use crate::support::{Dir, Output, finish, ingest, motiongen, tree};
use crate::train::{train, train_command};

fn stage(name: &str, store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg(name).arg("--store").arg(store).args(more);
    command
}

/// Runs the stage and holds it to its promise to write nothing.
#[track_caller]
fn status(store: &Path, more: &[&str]) -> Output {
    let before = tree(store);
    let output = finish(&mut stage("status", store, more));
    assert!(tree(store) == before, "status {more:?} wrote something");
    output
}

/// Returns what is told of a stage, and of its run: done, failed, stale and missing items.
#[track_caller]
fn counts(store: &Path, stage: &str, run: Option<&str>) -> [u64; 4] {
    let output = status(store, &["--summary=json"]);
    let told: Value = serde_json::from_str(&output.stdout).expect("JSON");
    let stages = told["stages"].as_array().expect("stages");
    let is_it = |one: &&Value| one["stage"] == stage && one["run"].as_str() == run;
    let one = stages.iter().find(is_it).unwrap_or_else(|| panic!("no {stage} {run:?}: {told}"));
    let found = ["n_done", "n_failed", "n_stale", "n_missing"]
        .map(|name| one[name].as_u64().expect("a number"));
    assert_eq!(one["n_items"], found.iter().sum::<u64>());
    found
}

/// Returns which of `n` shards a stage would do something in, by its own dry runs.
fn shards_with_work(n: u32, mut dry_run: impl FnMut(&str) -> Command) -> BTreeSet<u32> {
    let has_work = |i: &u32| {
        let mut command = dry_run(&format!("--shard={i}/{n}"));
        let output = finish(command.args(["--dry-run", "--summary=json"]));
        let told: Value = serde_json::from_str(&output.stdout).expect("JSON");
        told["n_todo"].as_u64().expect("a number") > 0
    };
    (0..n).filter(has_work).collect()
}

/// Reads an array specification.
fn numbers(array: &str) -> BTreeSet<u32> {
    let number = |text: &str| text.parse::<u32>().expect("a number");
    let parts = array.trim_end().split(',').filter(|part| !part.is_empty());
    parts
        .flat_map(|part| match part.split_once('-') {
            Some((first, last)) => number(first)..=number(last),
            None => number(part)..=number(part),
        })
        .collect()
}

/// Nine songs, one of which is none.
fn source(dir: &Dir) -> std::path::PathBuf {
    for i in 0..8 {
        dir.write(format!("s/song {i}.wav"), wav(0.3 + 0.1 * f64::from(i)));
    }
    dir.write("s/broken.wav", "no audio");
    dir.at("s")
}

#[test]
fn what_is_left_is_what_the_stages_would_do_shard_by_shard() {
    let dir = Dir::new();
    let (source, store) = (source(&dir), dir.at("store"));
    let url = source.display().to_string();
    // Nothing was begun: every shard of the source has work, and the store is not made by asking.
    let array = status(&store, &["--stage=ingest", "--source", &url, "--missing=4"]);
    let ingest_of = |shard: &str| {
        let mut command = stage("ingest", &store, &[shard]);
        command.arg("--source").arg(&source);
        command
    };
    assert_eq!((array.code, array.stderr.as_str()), (75, ""));
    assert_eq!(numbers(&array.stdout), shards_with_work(4, ingest_of));
    assert!(!store.exists());

    // Shard by shard, what is told shrinks as what the stage itself finds.
    for i in [2, 0, 3] {
        finish(&mut ingest_of(&format!("--shard={i}/4")));
        let array =
            status(&store, &["--stage=ingest", "--source", &url, "--missing=4", "--failed"]);
        let left = shards_with_work(4, ingest_of);
        assert_eq!(numbers(&array.stdout), left, "after shard {i}");
        assert!(left.contains(&1), "a shard of several songs");
    }
    assert_eq!(ingest(&source, &store, &[]).code, 1, "the broken one fails");
    assert_eq!(counts(&store, "ingest", None), [8, 1, 0, 0]);
    assert_eq!(counts(&store, "extract", None), [0, 0, 0, 8]);

    // As the array that Slurm would be given again.
    let extract_of = |shard: &str| stage("extract", &store, &[shard]);
    let array = status(&store, &["--stage=extract", "--missing=8"]);
    assert_eq!(array.code, 75);
    assert_eq!(numbers(&array.stdout), shards_with_work(8, extract_of));
    let first = *numbers(&array.stdout).first().expect("a shard");
    assert_eq!(finish(&mut extract_of(&format!("--shard={first}/8"))).code, 0);
    let array = status(&store, &["--stage=extract", "--missing=8"]);
    assert_eq!(numbers(&array.stdout), shards_with_work(8, extract_of));
    assert!(!numbers(&array.stdout).contains(&first) && array.code == 75);
    for i in numbers(&array.stdout) {
        assert_eq!(finish(&mut extract_of(&format!("--shard={i}/8"))).code, 0);
    }
    let array = status(&store, &["--stage=extract", "--missing=8"]);
    assert_eq!((array.code, array.stdout.as_str()), (0, ""));
    assert_eq!(counts(&store, "extract", None), [8, 0, 0, 0]);

    // Only the failed song is left: exit code 1, and its shard where failed items are asked for.
    let output = status(&store, &[]);
    assert_eq!(output.code, 1, "{output:?}");
    let told: Vec<&str> = output.stdout.lines().map(str::trim).collect();
    assert!(
        told[1].starts_with("ingest    8 of 9 phrases done, 1 failed; from file://"),
        "{told:?}"
    );
    assert_eq!(told[2..4], ["extract   8 of 8 phrases done", "nothing is left to do"]);
    let none = status(&store, &["--stage=ingest", "--missing=4"]);
    assert_eq!((none.code, none.stdout.as_str()), (1, ""));
    let failed = status(&store, &["--stage=ingest", "--missing=4", "--failed"]);
    assert_eq!(numbers(&failed.stdout), shards_with_work(4, ingest_of));
    let listed = status(&store, &["--missing", "--failed"]);
    assert_eq!(listed.stdout, "ingest\tfailed\tbroken.wav\n");
}

#[test]
fn links_that_leave_the_source_are_failures_here_too() {
    let dir = Dir::new();
    dir.write("s/own.wav", wav(0.5));
    dir.write("elsewhere/one.wav", wav(0.4));
    dir.write("elsewhere/two.wav", wav(0.6));
    std::os::unix::fs::symlink(dir.at("elsewhere"), dir.at("s/album")).expect("a link");
    let store = dir.at("store");
    assert_eq!(ingest(&dir.at("s"), &store, &[]).code, 1);
    assert_eq!(counts(&store, "ingest", None), [1, 1, 0, 0]);
}

#[test]
fn replaced_files_are_stale_and_touched_ones_only_until_they_are_seen() {
    let dir = Dir::new();
    let (source, store) = (source(&dir), dir.at("store"));
    ingest(&source, &store, &[]);
    assert_eq!(finish(&mut stage("extract", &store, &[])).code, 0);
    dir.write("s/song 3.wav", wav(0.95));
    dir.write("s/new.wav", wav(0.5));
    std::fs::remove_file(dir.at("s/song 5.wav")).expect("removed");
    assert_eq!(counts(&store, "ingest", None), [6, 1, 1, 1]);
    assert_eq!(counts(&store, "extract", None), [8, 0, 0, 0], "it knows what was ingested");
    let listed = status(&store, &["--missing", "--stage=ingest"]);
    assert_eq!(listed.stdout, "ingest\tmissing\tnew.wav\ningest\tstale\tsong 3.wav\n");
    ingest(&source, &store, &[]);
    assert_eq!(counts(&store, "ingest", None), [8, 1, 0, 0]);
    assert_eq!(counts(&store, "extract", None), [7, 0, 1, 1], "the phrase that is gone stays");
    // Other parameters, by which everything is told from then on.
    let tuned = stage("extract", &store, &["--tuning=0.25", "--shard=0/2"]);
    assert_eq!(finish(&mut { tuned }).code, 0);
    let output = status(&store, &["--stage=extract", "--summary=json"]);
    let told: Value = serde_json::from_str(&output.stdout).expect("JSON");
    assert_eq!((&told["outcome"], output.code), (&"work_left".into(), 75));
    let n_done = told["stages"][0]["n_done"].as_u64().expect("a number");
    assert!(0 < n_done && n_done < 9, "{told}");
    // The song that is gone cannot be heard again.
    assert_eq!(finish(&mut stage("extract", &store, &["--tuning=0.25"])).code, 1);
    assert_eq!(counts(&store, "extract", None), [8, 1, 0, 0]);
    let note = "extract last ran with flags that change what it writes, or in another version of motiongen; by those \
                parameters this is told";
    assert!(status(&store, &[]).stdout.contains(note));
}

#[test]
fn runs_of_training_generation_and_evaluation_are_told() {
    let dir = Dir::new();
    let store = modelled(&dir);
    assert_eq!(counts(&store, "train", Some("run")), [2, 0, 0, 0]);
    assert_eq!(counts(&store, "extract", None), [16, 0, 0, 0]);
    assert_eq!(status(&store, &[]).code, 0);

    // What was not begun is left as a whole, where it is asked for.
    for (stage, run) in [("library", "library"), ("train", "night"), ("evaluate", "night")] {
        let told = status(&store, &["--stage", stage, "--missing", "--run=night"]);
        assert_eq!((told.code, told.stdout), (75, format!("{stage}\tmissing\t{run}\n")));
    }
    let asked = ["--stage=generate", "--run=m", "--missing=4"];
    assert_eq!(numbers(&status(&store, &asked).stdout), BTreeSet::from([0, 1, 2, 3]));
    let flags = ["--model=m", "--engine=eager", "--steps=3", "--overlap=7", "--quiet"];
    let generate = |more: &[&str]| {
        let output = finish(stage("generate", &store, &flags).args(more));
        assert_eq!(output.code, 0, "{output:?}");
    };
    generate(&["--samples=2", "--shard=1/4"]);
    let of_shard = |shard: &str| {
        let mut command = stage("generate", &store, &flags);
        command.args(["--samples=2", shard]);
        command
    };
    let left = status(&store, &asked);
    assert_eq!((numbers(&left.stdout), left.code), (shards_with_work(4, of_shard), 75));
    generate(&["--samples=2"]);
    assert_eq!(counts(&store, "generate", Some("m")), [32, 0, 0, 0]);
    assert_eq!(status(&store, &["--samples=3", "--stage=generate"]).code, 75);

    // Evaluated, and then danced to otherwise.
    let evaluate = || finish(&mut stage("evaluate", &store, &["--run=m", "--quick"])).code;
    assert_eq!(status(&store, &["--stage=evaluate"]).code, 75, "every run is to be evaluated");
    assert_eq!(evaluate(), 0);
    assert_eq!(counts(&store, "evaluate", Some("m")), [1, 0, 0, 0]);
    assert_eq!(status(&store, &[]).code, 0);
    generate(&["--samples=2", "--seed=5"]);
    assert_eq!(counts(&store, "evaluate", Some("m")), [0, 0, 1, 0]);
    assert_eq!(evaluate(), 0);
    assert_eq!(status(&store, &[]).code, 0);

    // A model of other weights makes all of its motions anew.
    let anew = ["--steps=6", "--decoder-steps=5", "--warmup-steps=2", "--prediction=x0"];
    assert_eq!(train(&store, "other", &anew).code, 0);
    let exported = ["--run=other", "--model=m", "--force", "--quiet"];
    assert_eq!(finish(&mut stage("export", &store, &exported)).code, 0);
    assert_eq!(counts(&store, "generate", Some("m")), [0, 0, 32, 0]);
    generate(&["--samples=2"]);
    assert_eq!(counts(&store, "generate", Some("m")), [32, 0, 0, 0]);
}

#[test]
fn a_training_that_was_stopped_is_left_with_its_step() {
    let dir = Dir::new();
    let store = crate::train::make_store(&dir);
    let long = ["--steps=1000000", "--save-every-steps=1", "--decoder-steps=5"];
    let mut child = train_command(&store, "r", &long).spawn().expect("a training");
    let checkpoints = store.join("runs/r/diffusion");
    let until = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while std::fs::read_dir(&checkpoints).map_or(0, Iterator::count) < 2 {
        assert!(std::time::Instant::now() < until, "no checkpoint came");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let sent = Command::new("kill").args(["-TERM", &child.id().to_string()]).status();
    assert!(sent.expect("kill").success());
    assert_eq!(child.wait().expect("an end").code(), Some(75));
    assert_eq!(counts(&store, "train", Some("r")), [0, 0, 0, 2]);
    let told = status(&store, &["--stage=train", "--missing"]);
    assert_eq!(
        (told.code, told.stdout.as_str()),
        (75, "train\tmissing\tr/diffusion\ntrain\tmissing\tr/decoder\n")
    );
    assert!(status(&store, &[]).stdout.contains(" of 1000000\n"));
    // An end by patience is an end, though steps are left.
    let tired = ["--steps=1000000", "--patience=1", "--validate-every=1", "--decoder-steps=5"];
    let tired = [&tired[..], &["--learning-rate=1e-12", "--force"]].concat();
    assert_eq!(train(&store, "r", &tired).code, 0);
    assert_eq!(counts(&store, "train", Some("r")), [2, 0, 0, 0]);
}

#[test]
fn songs_of_a_library_are_told() {
    let dir = Dir::new();
    for (name, tempo_bpm) in [("one", 93.7), ("two", 120.0), ("three", 141.3)] {
        dir.write(format!("s/{name}.wav"), clicks(tempo_bpm, 9.0));
        dir.write(format!("s/{name}.beats.txt"), beat_list(tempo_bpm, 9.0, 4));
    }
    let store = dir.at("store");
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/phrases/motion");
    for name in ["cmu_01_03", "humanoid3d_dance_b"] {
        let bytes = std::fs::read(data.join(name).join("trajectory.npy")).expect("a capture");
        dir.write(format!("c/motion/{name}/trajectory.npy"), bytes);
    }
    for folder in ["s", "c"] {
        assert_eq!(ingest(&dir.at(folder), &store, &[]).code, 0);
    }
    assert_eq!(finish(&mut stage("extract", &store, &[])).code, 0);
    let library = ["--takes=2", "--test-songs=0"];
    let library = || finish(&mut stage("library", &store, &library));
    let output = library();
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(counts(&store, "library", None), [3, 0, 0, 0]);
    // A capture more: every song is danced to again.
    let bytes = std::fs::read(data.join("mocapbank/motion.bvh")).expect("a capture");
    dir.write("c/motion/bank/motion.bvh", bytes);
    dir.write("s/four.wav", clicks(100.0, 9.0));
    dir.write("s/four.beats.txt", beat_list(100.0, 9.0, 4));
    for folder in ["s", "c"] {
        assert_eq!(ingest(&dir.at(folder), &store, &[]).code, 0);
    }
    assert_eq!(finish(&mut stage("extract", &store, &[])).code, 0);
    assert_eq!(counts(&store, "library", None), [0, 0, 3, 1]);
    assert_eq!(library().code, 0);
    assert_eq!(counts(&store, "library", None), [4, 0, 0, 0]);
    let output = status(&store, &["--stage=library", "--missing=4"]);
    assert_eq!(
        (output.code, output.stderr.as_str()),
        (2, "error: --missing 4: library has no shards; it is run again as a whole\n")
    );
}

#[test]
fn what_cannot_be_told_is_said_in_a_sentence() {
    let dir = Dir::new();
    let (source, store) = (source(&dir), dir.at("store"));
    let place = store.display();
    let none = finish(&mut stage("status", &store, &[]));
    assert_eq!(
        (none.code, none.stderr),
        (
            2,
            format!(
                "error: store {place} has no tables; run first: motiongen ingest --source … --store {place}\n"
            )
        )
    );
    assert!(!store.exists());
    let wrong = finish(&mut stage("status", &store, &["--missing=many"]));
    assert_eq!(wrong.code, 2);
    assert!(wrong.stderr.contains("use the number of shards, such as 16, or items"), "{wrong:?}");
    // A source that is away: what is known of it is not, and nothing is taken for missing.
    ingest(&source, &store, &[]);
    std::fs::rename(&source, dir.at("away")).expect("moved");
    let away = status(&store, &["--stage=ingest"]);
    assert_eq!(away.code, 0, "{away:?}");
    assert!(away.stdout.contains("unknown, the source cannot be listed from here: "), "{away:?}");
    // Two sources: the shards of one at a time.
    dir.write("t/x.wav", wav(0.3));
    ingest(&dir.at("t"), &store, &[]);
    let both = status(&store, &["--stage=ingest", "--missing=2"]);
    assert_eq!(both.code, 2);
    assert!(both.stderr.ends_with("name it with --source\n"), "{both:?}");
}
