//! Verdicts as exit codes, splits by the model's card, and motions of any program.

use std::collections::BTreeMap;
use std::path::Path;

use motiongen::motion::npy::write as array;
use motiongen::store::Location;
use motiongen::store::tables::{FailureRow, VerdictRow};
use ndarray::Array2;

use super::*;

/// How the verdicts on held-out songs ended.
fn verdicts(store: &Path, name: &str, split: &str) -> BTreeMap<String, String> {
    let mut found: Vec<VerdictRow> = rows(store);
    found.retain(|row| row.run == name && row.split == split);
    found.into_iter().map(|row| (row.verdict, row.verdict_outcome)).collect()
}

#[test]
fn a_required_verdict_that_is_not_won_is_an_exit_code() {
    let dir = Dir::new();
    let store = make_store(&dir);
    put_locked(&store, "locked");
    // One body for all songs, so that it is varied no more; it follows one song at most.
    let songs = all_names();
    let same: Vec<Motion> = (N_TRAIN..N_TRAIN + N_HELD_OUT)
        .map(|song| Motion { phrase: songs[song].clone(), sample: 0, frames: locked(1, 0) })
        .collect();
    put(&store, "same", &same);
    let output = evaluate(&store, "same", &["--require", "varied"]);
    assert_eq!(output.code, 1, "{output:?}");
    assert!(output.stdout.contains("\n  required verdict varied is lost\n"), "{output:?}");
    assert_eq!(verdicts(&store, "same", "held_out")["varied"], "lost");
    let output = evaluate(&store, "locked", &["--require=all"]);
    assert_eq!(output.code, 1, "{output:?}");
    // Its decoded velocities are those of no body, and its jerk that of no training motion.
    let found = verdicts(&store, "locked", "held_out");
    assert_eq!((found["sound"].as_str(), found["like_real"].as_str()), ("lost", "lost"));
    // It follows the bar, but not as real motion of this store does: shifted by a beat it does as well.
    assert_eq!(found["follows_music"], "lost");
    let shifted = |row: &VerdictRow| row.test == "shifted_bars" && row.split == "held_out";
    let shifted = rows::<VerdictRow>(&store).into_iter().find(shifted).expect("a test");
    assert_eq!(shifted.outcome, "lost", "{}", shifted.message);
    // Without the word, verdicts change no exit code.
    assert_eq!(evaluate(&store, "locked", &[]).code, 0);
}

#[test]
fn a_model_that_is_not_there_leaves_the_split_unknown() {
    let dir = Dir::new();
    let store = make_store(&dir);
    put_locked(&store, "locked");
    std::fs::remove_dir_all(store.join("models")).expect("removed");
    let output = evaluate(&store, "locked", &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let splits: std::collections::BTreeSet<String> = metrics(&store, "locked")
        .into_keys()
        .filter(|[subject, ..]| subject == "generated")
        .map(|[_, split, ..]| split)
        .collect();
    assert_eq!(splits.into_iter().collect::<Vec<_>>(), ["unknown"]);
    assert!(output.stdout.contains("Nobody knows which of these songs model m learned from"));
}

fn motion_file(frames: &Array2<f32>) -> Vec<u8> {
    array(&[frames.nrows(), frames.ncols()], frames.as_slice().expect("in order"))
}

#[test]
fn motions_of_any_program_are_evaluated_and_what_is_none_is_listed() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let songs = all_names();
    let folder = dir.at("theirs");
    for (song, id) in songs.iter().enumerate().skip(N_TRAIN) {
        let name = format!("theirs/{id}.npy");
        dir.write(name, motion_file(&locked(song, 0)));
    }
    dir.write("theirs/nobody.npy", motion_file(&locked(0, 0)));
    dir.write(format!("theirs/{}.npy", songs[0]), b"no array");
    let place = store.display().to_string();
    let motions = folder.display().to_string();
    let fixed = ["evaluate", "--quiet", "--store", &place, "--motions", &motions];
    let output = run(fixed);
    // Two files are listed as failures, and the others evaluated.
    assert_eq!(output.code, 1, "{output:?}");
    assert!(output.stdout.contains("  5 motions (42.8 s) evaluated;"), "{output:?}");
    let mut failed: Vec<(String, String)> =
        rows::<FailureRow>(&store).into_iter().map(|row| (row.phrase_id, row.kind)).collect();
    failed.sort();
    assert_eq!(failed.len(), 2, "{failed:?}");
    assert_eq!(failed[0].0, "theirs/nobody.npy");
    let found = metrics(&store, "theirs");
    let r2 = value(&found, ["generated", "unknown", "locking_r2", "per_song"]);
    assert!(r2 > Some(0.99), "{r2:?}");
    // They say a phase of their own, which is the music's.
    assert!(value(&found, ["generated", "unknown", "phase_error", ""]) < Some(1e-6));
    // Again it does nothing; without the two files it is whole, and they leave the table.
    let again = run(fixed);
    assert!(again.stdout.contains("  5 motions (42.8 s), evaluated before\n"), "{again:?}");
    for name in ["nobody".to_owned(), songs[0].clone()] {
        std::fs::remove_file(folder.join(format!("{name}.npy"))).expect("removed");
    }
    let whole = run(fixed);
    assert_eq!(whole.code, 0, "{whole:?}");
    assert_eq!(rows::<FailureRow>(&store).len(), 0);
    // A run of generate is not written over.
    put_locked(&store, "locked");
    let refused = run(fixed.iter().chain(&["--name=locked"]));
    assert_eq!(refused.code, 2);
    let location = Location::local(&store).expect("a store");
    assert_eq!(
        refused.stderr,
        format!(
            "error: store {location} has a run \"locked\" of generate, whose evaluation this one would \
             replace; give another --name\n"
        )
    );
}

#[test]
fn a_required_verdict_of_which_nothing_was_measured_is_an_exit_code() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let song = &all_names()[N_TRAIN];
    // Shorter than a window.
    let short = locked(N_TRAIN, 0).slice(ndarray::s![..37, ..]).to_owned();
    dir.write(format!("short/{song}.npy"), motion_file(&short));
    let place = store.display().to_string();
    let motions = dir.at("short").display().to_string();
    let fixed = ["evaluate", "--quiet", "--store", &place, "--motions", &motions, "--require"];
    let output = run(fixed.iter().chain(&["sound,varied"]));
    assert_eq!(output.code, 1, "{output:?}");
    for verdict in ["sound", "varied"] {
        let line = format!("  required verdict {verdict} is open\n");
        assert!(output.stdout.contains(&line), "{output:?}");
    }
    assert!(!output.stdout.contains("required verdict follows_music"), "{output:?}");
}

#[test]
fn one_value_that_is_not_finite_is_not_sound_however_much_is() {
    let dir = Dir::new();
    let store = make_store(&dir);
    for (song, id) in all_names().iter().enumerate().skip(N_TRAIN) {
        let mut frames = locked(song, 0);
        if song == N_TRAIN {
            let last = frames.nrows() - 1;
            frames[[last, 20]] = f32::NAN;
        }
        dir.write(format!("one_nan/{id}.npy"), motion_file(&frames));
    }
    let place = store.display().to_string();
    let motions = dir.at("one_nan").display().to_string();
    let output = run(["evaluate", "--quiet", "--store", &place, "--motions", &motions]);
    assert_eq!(output.code, 0, "{output:?}");
    let is_finite = |row: &VerdictRow| row.test == "finite" && row.verdict == "sound";
    let found = rows::<VerdictRow>(&store).into_iter().find(is_finite).expect("a test");
    assert_eq!((found.outcome.as_str(), found.value), ("lost", Some(0.8)), "{}", found.message);
    assert_eq!(found.verdict_outcome, "lost");
}
