//! `--dry-run` in every stage: not one byte changes; and `--force` that keeps what it cannot replace.

use std::path::Path;

use super::{object, stage, succeed};
use crate::generate::modelled;
use crate::support::files::{coherent, trajectory, wav};
use crate::support::{Dir, finish, ingest, motiongen, tree};
use crate::train::train;

/// Adds a phrase with motion and a feature file, which is not extracted.
fn add_late_phrase(dir: &Dir, store: &Path) {
    let source = dir.at("source/audio_features");
    let any = std::fs::read_dir(&source).expect("features").flatten().next().expect("a phrase");
    let name = any.file_name().into_string().expect("a name");
    let late = dir.at("late");
    for (from, file) in [("motion", "trajectory.npy"), ("audio_features", "features.npz")] {
        let bytes = std::fs::read(dir.at(format!("source/{from}/{name}/{file}"))).expect("a file");
        crate::support::write(&late.join(from).join("late one").join(file), bytes);
    }
    assert_eq!(ingest(&late, store, &[]).code, 0);
}

#[test]
fn a_dry_run_of_any_stage_changes_not_one_byte() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let done = ["--model=m", "--engine=eager", "--steps=3", "--run=done", "--overlap=7"];
    succeed(&mut stage("generate", &store, &done));
    let tokens = ["--family=tokens", "--preset=tiny", "--window-frames=24", "--steps=2"];
    succeed(&mut stage("train", &store, &[&tokens[..], &["--run=tok", "--batch-size=3"]].concat()));
    add_late_phrase(&dir, &store);
    let at = |path: &str| dir.at(path).display().to_string();
    let song = dir.write("song.wav", wav(1.3)).display().to_string();
    dir.write("new/motion/n/trajectory.npy", trajectory(&coherent(31, 5)));
    dir.write("s.csv", "precious");
    let first = {
        let rows = crate::support::phrases(&store);
        rows.into_keys().next().expect("a phrase")
    };
    let s = store.display().to_string();
    let (new, out, stream) = (at("new"), at("out/deep"), at("s.csv"));
    let small = ["--widths=8,12", "--num-heads=2", "--window-frames=24", "--preset=tiny"];
    let generate = ["generate", "--store", &s, "--model=m", "--engine=eager", "--steps=3"];
    let files = ["generate", "--model", "m", "--store", &s, "--audio", &song, "--overlap=7"];
    let cases: Vec<Vec<&str>> = vec![
        vec!["ingest", "--source", &new, "--store", &s, "--cache", "CACHE"],
        vec!["extract", "--store", &s],
        vec!["extract", "--audio", &song, "--output", &out],
        vec!["library", "--store", &s, "--compose=1", "--output", &out],
        [&["train", "--store", &s, "--run=new", "--max-failed=1"][..], &small].concat(),
        [&["train", "--store", &s, "--run=run", "--force", "--max-failed=1"][..], &small].concat(),
        vec!["finetune", "--store", &s, "--run=run", "--max-failed=1"],
        [&["train", "--store", &s, "--run=new", "--max-failed=1"][..], &tokens].concat(),
        vec!["tokenize", "--store", &s, "--run=tok", "--reconstruct"],
        vec!["export", "--store", &s, "--run=run", "--model=other", "--max-failed=1"],
        [&generate[..], &["--run=new", "--overlap=7"]].concat(),
        [&files[..], &["--output", &out, "--stream", &stream]].concat(),
        vec!["evaluate", "--store", &s, "--run=done", "--report", "REPORT.html"],
        vec!["model", "--store", &s, "--model=m", "--frames=24", "--model-cache", "CACHE"],
        vec!["plot", "motion", "--store", &s, "--phrase", &first, "--output", "PLOT.png"],
        vec!["plot", "features", "--audio", &song, "--output", "PLOT.png"],
        vec!["plot", "training", "--store", &s, "--run=run", "--output", "PLOT.png"],
        vec!["view", "--store", &s, "--phrase", &first, "--output", "VIEW.html"],
        vec!["query", "--store", &s, "select 1 as one from phrases", "--output", "ROWS.csv"],
    ];
    for case in cases {
        let words: Vec<String> = case
            .iter()
            .map(|word| match *word {
                "CACHE" | "REPORT.html" | "PLOT.png" | "VIEW.html" | "ROWS.csv" => at(word),
                word => word.to_owned(),
            })
            .collect();
        let before = tree(dir.path());
        let folders = walkdir::WalkDir::new(dir.path()).into_iter().count();
        let output = finish(motiongen().args(&words).args(["--dry-run", "--summary", "json"]));
        assert_eq!(output.code, 0, "{case:?}: {output:?}");
        let told = object(&output.stdout);
        assert_eq!((&told["stage"], &told["outcome"]), (&case[0].into(), &"done".into()));
        assert!(tree(dir.path()) == before, "{case:?} changed a file");
        let now = walkdir::WalkDir::new(dir.path()).into_iter().count();
        assert_eq!(now, folders, "{case:?} made or removed a folder");
    }
}

/// A run that cannot start leaves the old one whole.
#[test]
fn force_removes_nothing_before_the_new_run_can_start() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let finetuned = ["--run=run", "--steps=2", "--batch-size=3", "--num-steps=2", "--quiet"];
    succeed(&mut stage("finetune", &store, &finetuned));
    add_late_phrase(&dir, &store);
    let runs = tree(&store.join("runs"));
    let log = crate::support::rows::<motiongen::store::tables::TrainingLogRow>(&store).len();
    let refused = train(&store, "run", &["--force", "--steps=3", "--max-failed=0"]);
    assert_eq!(refused.code, 2, "{refused:?}");
    assert!(
        refused.stderr.contains("1 of 17 phrases (5.9 %) cannot be learned from"),
        "{refused:?}"
    );
    let flags = ["--run=run", "--force", "--max-failed=0", "--quiet"];
    let refused = finish(&mut stage("finetune", &store, &flags));
    assert_eq!(refused.code, 2, "{refused:?}");
    assert!(tree(&store.join("runs")) == runs, "a checkpoint is gone");
    let rows = crate::support::rows::<motiongen::store::tables::TrainingLogRow>(&store);
    assert_eq!(rows.len(), log, "rows of the log are gone");
    // Where it can start, it does.
    let anew = ["--force", "--steps=3", "--decoder-steps=2", "--max-failed=0.5"];
    let started = train(&store, "run", &anew);
    assert_eq!(started.code, 1, "one phrase is left out: {started:?}");
    assert!(tree(&store.join("runs")) != runs);
}
