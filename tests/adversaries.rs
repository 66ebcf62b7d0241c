//! Motions whose verdict is known, through the real command: real held-out motion wins everything, and each fault
//! loses the verdict that names it. `tests/adversaries/make.py` makes them.

#![expect(clippy::print_stderr, reason = "what was found is printed, for docs/evaluate.md")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::motion::phase::unwrapped;
use motiongen::store::tables::{self, PhraseRow, VerdictRow};
use motiongen::store::{Location, Snapshot, StoreError};
use ndarray::Array2;

use crate::support::{Dir, Output, phrases, rows, run};

const VERDICTS: [&str; 4] = ["sound", "like_real", "follows_music", "varied"];

/// Cases, and the verdicts that they must lose; those that they must win stand behind. Others may end either way.
#[rustfmt::skip]
const CASES: [(&str, &[&str], &[&str]); 14] = [
    ("real",        &[],                                      &VERDICTS),
    ("upside_down", &["sound", "like_real", "follows_music"], &[]),
    ("faster",      &["follows_music"],                       &["varied"]),
    ("jitter",      &["sound", "like_real"],                  &[]),
    ("reversed",    &["follows_music"],                       &["like_real", "varied"]),
    ("beat_early",  &["follows_music"],                       &["sound", "like_real", "varied"]),
    ("other_song",  &["follows_music"],                       &["like_real"]),
    ("one_for_all", &["follows_music", "varied"],             &["sound"]),
    ("mixed_takes", &["sound"],                               &["like_real", "follows_music", "varied"]),
    // Every song has a pose of its own to stand in, so that it may be varied.
    ("still",       &["sound", "like_real", "follows_music"], &[]),
    ("mean",        &VERDICTS,                                &[]),
    ("white_noise", &VERDICTS,                                &[]),
    ("band_noise",  &VERDICTS,                                &[]),
    ("best_of_8",   &["follows_music"],                       &["like_real", "varied"]),
];

/// Frames of a take: sixteen seconds of a song.
const TAKE_FRAMES: usize = 480;

#[track_caller]
pub fn succeeds(output: Output) -> Output {
    assert_eq!(output.code, 0, "{output:?}");
    output
}

pub fn data(folder: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(folder)
}

/// A store with the songs of the demo and a library of them; eight songs were held out.
fn library(dir: &Dir) -> PathBuf {
    let store = dir.at("store");
    succeeds(crate::support::ingest(&data("music"), &store, &["--quiet"]));
    let place = store.display().to_string();
    succeeds(run(["extract", "--quiet", "--store", &place]));
    let captures = data("phrases").display().to_string();
    let held_out = ["--validation-songs=2", "--test-songs=6", "--takes=4"];
    let command = ["library", "--quiet", "--store", &place, "--captures", &captures];
    succeeds(run(command.iter().chain(&held_out)));
    store
}

/// Writes other takes of the held-out songs, and returns the phrases that the songs are.
fn takes(dir: &Dir, store: &Path, folder: &Path) -> Vec<String> {
    let other = dir.at("takes");
    let place = other.display().to_string();
    let (music, captures) =
        (data("music").display().to_string(), data("phrases").display().to_string());
    let length = format!("--phrase-frames={TAKE_FRAMES}");
    let hop = format!("--hop-frames={TAKE_FRAMES}");
    let output = run([
        "library",
        "--quiet",
        "--store",
        &place,
        "--songs",
        &music,
        "--captures",
        &captures,
        &length,
        &hop,
        "--takes=3",
        "--seed=11",
    ]);
    // Songs that are shorter than a take are failures.
    assert_eq!(output.code, 1, "{output:?}");
    let songs: BTreeMap<String, PhraseRow> = phrases(store)
        .into_iter()
        .filter(|(_, row)| !row.is_constructed())
        .filter_map(|(_, row)| Some((row.song_hash.clone()?, row)))
        .collect();
    let held_out: BTreeSet<String> = phrases(store)
        .into_values()
        .filter(|row| row.is_constructed() && row.split != "train")
        .filter_map(|row| row.song_hash)
        .collect();
    let mut found: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (id, row) in phrases(&other) {
        let song = row.song_hash.expect("constructed from a file");
        if row.start_s == Some(0.0) && held_out.contains(&song) {
            found.entry(songs[&song].phrase_id.clone()).or_default().push(id);
        }
    }
    let store = Location::local(&other).expect("a store");
    let table = Snapshot::take(&store, tables::motion()).expect("a table");
    for (number, ids) in found.values().enumerate() {
        let place = folder.join(format!("{number:02}"));
        std::fs::create_dir_all(&place).expect("a folder");
        let names: BTreeSet<String> = ids.iter().cloned().collect();
        assert_eq!(names.len(), 3);
        table
            .visit_items(&names, |id, frames: Array2<f32>| {
                let take = ids.iter().position(|known| known == id).expect("asked for");
                write_array(&place.join(format!("{take}.npy")), &frames);
                let phase: Vec<f64> = frames.column(16).iter().map(|x| f64::from(*x)).collect();
                let bars = unwrapped(&phase).into_iter().map(|x| x as f32).collect();
                let bars = Array2::from_shape_vec((frames.nrows(), 1), bars).expect("a column");
                write_array(&place.join("bars.npy"), &bars);
                Ok::<_, StoreError>(())
            })
            .expect("read");
    }
    found.into_keys().collect()
}

fn write_array(path: &Path, array: &Array2<f32>) {
    let shape: Vec<usize> =
        if array.ncols() == 1 { vec![array.nrows()] } else { vec![array.nrows(), array.ncols()] };
    let values: Vec<f32> = array.iter().copied().collect();
    std::fs::write(path, motiongen::motion::npy::write(&shape, &values)).expect("written");
}

/// Makes the cases, with files named after the songs' phrases.
fn cases(dir: &Dir, takes: &Path, songs: &[String]) -> PathBuf {
    let (made, cases) = (dir.at("made"), dir.at("cases"));
    let python = std::env::var("MOTIONGEN_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/adversaries/make.py");
    let output = Command::new(python).arg(script).args([takes, &made]).output().expect("Python");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    for (case, ..) in CASES {
        for (number, song) in songs.iter().enumerate() {
            let to = cases.join(case).join(format!("{song}.npy"));
            std::fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
            std::fs::rename(made.join(case).join(format!("{number:02}.npy")), to).expect("moved");
        }
    }
    cases
}

/// Outcomes of the verdicts of a name, and the tests that were not won.
fn outcomes(store: &Path, name: &str) -> BTreeMap<String, (String, Vec<String>)> {
    let mut found: BTreeMap<String, (String, Vec<String>)> = BTreeMap::new();
    for row in rows::<VerdictRow>(store).into_iter().filter(|row| row.run == name) {
        let verdict = found.entry(row.verdict).or_insert((row.verdict_outcome, Vec::new()));
        if row.outcome != "won" {
            verdict.1.push(format!("{} ({}): {}", row.test, row.outcome, row.message));
        }
    }
    found
}

#[test]
fn real_motion_wins_and_every_fault_is_named() {
    let dir = Dir::new();
    let store = library(&dir);
    let folder = dir.at("of songs");
    let songs = takes(&dir, &store, &folder);
    assert!(songs.len() >= 6, "{songs:?}");
    let cases = cases(&dir, &folder, &songs);
    let place = store.display().to_string();
    let mut wrong = Vec::new();
    for (case, lost, won) in CASES {
        let motions = cases.join(case).display().to_string();
        let output = run([
            "evaluate",
            "--quiet",
            "--store",
            &place,
            "--motions",
            &motions,
            "--require",
            "all",
        ]);
        let found = outcomes(&store, case);
        for verdict in VERDICTS {
            let (outcome, tests) = &found[verdict];
            eprintln!("{case}: {verdict} {outcome} {tests:#?}");
            let is_wrong = (lost.contains(&verdict) && outcome != "lost")
                || (won.contains(&verdict) && outcome != "won");
            if is_wrong {
                wrong.push(format!("{case}: {verdict} is {outcome}: {tests:?}"));
            }
        }
        let has_won = VERDICTS.iter().all(|verdict| found[*verdict].0 == "won");
        // A required verdict that is not won is exit code 1, and said first.
        assert_eq!(output.code, i32::from(!has_won), "{case}: {output:?}");
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
