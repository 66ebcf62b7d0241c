//! Groups whose verdict is known, through the real command: each fault loses the test that names it, and real groups do
//! not.

#![expect(clippy::print_stderr, reason = "what was found is printed, for docs/groups.md")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use motiongen::store::tables::{self, MetricRow, PhraseRow, VerdictRow};
use motiongen::store::{Location, Snapshot, StoreError};
use ndarray::{Array2, Array3, ArrayView2, Axis, s};

use crate::adversaries::{data, succeeds};
use crate::support::{Dir, phrases, rows, run};

const N_DANCERS: usize = 3;
/// Frames of a take: sixteen seconds of a song.
const TAKE_FRAMES: &str = "480";

/// Makes the groups of a case out of real ones, one for each song.
type Fault = fn(&[Array3<f32>]) -> Vec<Array3<f32>>;

/// Cases, and tests that they must not win.
const CASES: [(&str, Fault, &[&str]); 7] = [
    ("real", |real| real.to_vec(), &[]),
    ("upside_down", upside_down, &["upright", "other_music"]),
    ("other_song", other_song, &["other_music", "chance"]),
    ("copied", copied, &["own_ways"]),
    ("independent", independent, &["belong_together"]),
    ("touching", touching, &["tif", "stage"]),
    ("off_beat", off_beat, &["every_dancer"]),
];

/// Tests that real groups must win.
const REAL: [&str; 7] =
    ["as_given", "finite", "upright", "tif", "least_separation", "stage", "own_ways"];

fn library(store: &Path, more: &[&str]) -> i32 {
    let place = store.display().to_string();
    let captures = data("phrases").display().to_string();
    let dancers = format!("--dancers={N_DANCERS}");
    let command = ["library", "--quiet", "--store", &place, "--captures", &captures, &dancers];
    run(command.iter().chain(more)).code
}

/// A store with the songs of the demo and a library of groups; eight songs were held out.
fn store_of_groups(dir: &Dir) -> PathBuf {
    let store = dir.at("store");
    let place = store.display().to_string();
    succeeds(crate::support::ingest(&data("music"), &store, &["--quiet"]));
    succeeds(run(["extract", "--quiet", "--store", &place]));
    assert_eq!(library(&store, &["--validation-songs=2", "--test-songs=6", "--takes=2"]), 0);
    store
}

/// Returns other takes of the held-out songs, by the phrases that the songs are.
fn takes(dir: &Dir, store: &Path) -> BTreeMap<String, Array3<f32>> {
    let other = dir.at("takes");
    let music = data("music").display().to_string();
    let length = format!("--phrase-frames={TAKE_FRAMES}");
    let hop = format!("--hop-frames={TAKE_FRAMES}");
    // Songs that are shorter than a take are failures.
    let code = library(&other, &["--songs", &music, &length, &hop, "--takes=1", "--seed=11"]);
    assert_eq!(code, 1);
    let songs: BTreeMap<String, PhraseRow> = phrases(store)
        .into_values()
        .filter(|row| !row.is_constructed())
        .filter_map(|row| Some((row.song_hash.clone()?, row)))
        .collect();
    let held_out: BTreeSet<String> = phrases(store)
        .into_values()
        .filter(|row| row.is_constructed() && row.split != "train")
        .filter_map(|row| row.song_hash)
        .collect();
    let of_song: BTreeMap<String, String> = phrases(&other)
        .into_iter()
        .filter(|(_, row)| row.start_s == Some(0.0))
        .filter_map(|(id, row)| Some((id, row.song_hash?)))
        .filter(|(_, song)| held_out.contains(song))
        .map(|(id, song)| (id, songs[&song].phrase_id.clone()))
        .collect();
    let table = Snapshot::take(&Location::local(&other).expect("a store"), tables::motion());
    let mut found = BTreeMap::new();
    table
        .expect("a table")
        .visit_groups(&of_song.keys().cloned().collect(), |id, frames: Array3<f32>| {
            found.insert(of_song[id].clone(), frames);
            Ok::<_, StoreError>(())
        })
        .expect("groups");
    found
}

/// A half turn about the x axis at the height of the dancer.
fn upside_down(real: &[Array3<f32>]) -> Vec<Array3<f32>> {
    let turned = |group: &Array3<f32>| {
        let mut group = group.clone();
        for mut dancer in group.outer_iter_mut() {
            let height = dancer.column(1).mean().expect("frames");
            for mut row in dancer.outer_iter_mut() {
                (row[1], row[2]) = (2.0 * height - row[1], -row[2]);
                for c in [4, 5, 7, 8, 14, 15] {
                    row[c] = -row[c];
                }
                let q = [row[9], row[10], row[11], row[12]];
                (row[9], row[10], row[11], row[12]) = (-q[1], q[0], -q[3], q[2]);
            }
        }
        group
    };
    real.iter().map(turned).collect()
}

fn other_song(real: &[Array3<f32>]) -> Vec<Array3<f32>> {
    (0..real.len()).map(|i| real[(i + 1) % real.len()].clone()).collect()
}

/// Moves a dancer to the mean place of another.
fn in_place_of(dancer: ArrayView2<f32>, other: ArrayView2<f32>) -> Array2<f32> {
    let mut dancer = dancer.to_owned();
    for c in [0, 2] {
        let shift =
            other.column(c).mean().expect("frames") - dancer.column(c).mean().expect("frames");
        dancer.column_mut(c).mapv_inplace(|x| x + shift);
    }
    dancer
}

/// Groups whose dancer k of song i is that of `from(i, k)`: a song and a dancer.
fn mixed(real: &[Array3<f32>], from: impl Fn(usize, usize) -> (usize, usize)) -> Vec<Array3<f32>> {
    let group = |i: usize| {
        let mut group = real[i].clone();
        for k in 0..group.dim().0 {
            let (song, dancer) = from(i, k);
            let taken = real[song % real.len()].index_axis(Axis(0), dancer);
            let place = in_place_of(taken, real[i].index_axis(Axis(0), k));
            group.index_axis_mut(Axis(0), k).assign(&place);
        }
        group
    };
    (0..real.len()).map(group).collect()
}

fn copied(real: &[Array3<f32>]) -> Vec<Array3<f32>> {
    mixed(real, |i, _| (i, 0))
}

fn independent(real: &[Array3<f32>]) -> Vec<Array3<f32>> {
    mixed(real, |i, k| (i + k, k))
}

fn off_beat(real: &[Array3<f32>]) -> Vec<Array3<f32>> {
    mixed(real, |i, k| (if k == 2 { i + 1 } else { i }, k))
}

/// Everybody 7 times as near to the middle of the group.
fn touching(real: &[Array3<f32>]) -> Vec<Array3<f32>> {
    let drawn = |group: &Array3<f32>| {
        let mut group = group.clone();
        for mut frame in group.axis_iter_mut(Axis(1)) {
            for c in [0, 2] {
                let middle = frame.column(c).mean().expect("dancers");
                frame.column_mut(c).mapv_inplace(|x| middle + (x - middle) / 7.0);
            }
        }
        group
    };
    real.iter().map(drawn).collect()
}

/// Outcomes of the tests of a name, with what they say, and of its verdicts.
fn outcomes(store: &Path, name: &str) -> BTreeMap<String, (String, String)> {
    let mut found = BTreeMap::new();
    for row in rows::<VerdictRow>(store).into_iter().filter(|row| row.run == name) {
        found.insert(row.verdict, (row.verdict_outcome, String::new()));
        found.insert(row.test, (row.outcome, row.message));
    }
    found
}

#[test]
fn each_fault_of_a_group_loses_the_test_that_names_it() {
    let dir = Dir::new();
    let store = store_of_groups(&dir);
    let takes = takes(&dir, &store);
    assert!(takes.len() >= 5, "{:?}", takes.keys());
    let length = takes.values().map(|group| group.dim().1).min().expect("takes");
    let real: Vec<Array3<f32>> =
        takes.values().map(|group| group.slice(s![.., ..length, ..]).to_owned()).collect();
    let place = store.display().to_string();
    let mut wrong = Vec::new();
    for (case, fault, not_won) in CASES {
        let folder = dir.at(format!("cases/{case}"));
        for (song, group) in takes.keys().zip(fault(&real)) {
            let shape = [group.dim().0, group.dim().1, group.dim().2];
            let values: Vec<f32> = group.iter().copied().collect();
            let to = folder.join(format!("{song}.npy"));
            crate::support::write(&to, motiongen::motion::npy::write(&shape, &values));
        }
        let motions = folder.display().to_string();
        let command = ["evaluate", "--quiet", "--store", &place, "--motions", &motions];
        let output = run(command.iter().chain(&["--require=together"]));
        let found = outcomes(&store, case);
        let has_won = found["together"].0 == "won";
        assert_eq!(output.code, i32::from(!has_won), "{case}: {output:?}");
        for (test, (outcome, message)) in &found {
            eprintln!("{case}: {test} {outcome} {message}");
        }
        for test in not_won {
            if found[*test].0 == "won" {
                wrong.push(format!("{case}: {test} is won: {}", found[*test].1));
            }
        }
        let must_win: &[&str] = if case == "real" { &REAL } else { &[] };
        for test in must_win {
            if found[*test].0 != "won" {
                wrong.push(format!("{case}: {test}: {:?}", found[*test]));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    an_untrained_model_loses(&dir, &store);
}

/// A model after one step, at two degrees of consistency: its verdicts, its baselines, and a page with both.
fn an_untrained_model_loses(dir: &Dir, store: &Path) {
    let place = store.display().to_string();
    let train = ["--family=group", "--preset=tiny", "--window-frames=60", "--batch-size=4"];
    let short = ["--negatives=2", "--steps=1", "--run=raw", "--quiet", "--store", &place];
    succeeds(run(["train"].iter().chain(&train).chain(&short)));
    succeeds(run(["export", "--quiet", "--run=raw", "--model=raw", "--store", &place]));
    let page = dir.at("page.html").display().to_string();
    for (name, gamma) in [("raw", "0"), ("raw-1", "1")] {
        let run_name = format!("--run={name}");
        let gamma = format!("--consistency={gamma}");
        let asked = ["--model=raw", "--dancers=3", "--split=test", "--steps=3", "--overlap=10"];
        let command = ["generate", "--quiet", "--store", &place, &run_name, &gamma];
        succeeds(run(command.iter().chain(&asked)));
        let more = ["--baseline-windows=6", "--report", &page];
        let command = ["evaluate", "--quiet", "--store", &place, &run_name];
        succeeds(run(command.iter().chain(&more)));
        let found = outcomes(store, name);
        for (test, (outcome, message)) in &found {
            eprintln!("{name}: {test} {outcome} {message}");
        }
        for verdict in ["sound", "like_real", "follows_music"] {
            assert_eq!(found[verdict].0, "lost", "{name}: {verdict}");
        }
        assert_ne!(found["together"].0, "won", "{name}");
    }
    let all: Vec<MetricRow> = rows(store);
    let subjects: BTreeSet<&str> = all
        .iter()
        .filter(|row| row.run == "raw" && row.metric == "unison_index")
        .map(|row| row.subject.as_str())
        .collect();
    let expected = ["copied", "generated", "held_out_truth", "independent", "no_music"];
    let expected = expected.into_iter().chain(["training_truth", "untrained"]);
    assert_eq!(subjects, expected.collect::<BTreeSet<&str>>());
    let text = std::fs::read_to_string(&page).expect("a page");
    assert!(text.contains("What consistency does"));
    for row in ["<th scope=\"row\">0</th>", "<th scope=\"row\">1</th>"] {
        assert!(text.contains(row), "{row}");
    }
    assert!(text.contains("<svg class=\"dial\""));
    // Nothing is sampled or measured again.
    let again = ["evaluate", "--quiet", "--store", &place, "--run=raw", "--baseline-windows=6"];
    let output = succeeds(run(again));
    assert!(output.stdout.contains("evaluated before"), "{output:?}");
}
