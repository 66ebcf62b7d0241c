//! `plot motion`: pictures of motion files, phrases and generated motions, and every mistake with them.

use std::path::Path;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::write;
use motiongen::store::tables::{self, BeatRow, GenerationRow};
use motiongen::store::{Commit, Item, Label, Ledger, Location, Row as _, TimestampUs};
use ndarray::Array2;

use crate::support::files::{Frame, coherent, trajectory};
use crate::support::plots::{self, svg, text};
use crate::support::{Dir, ingest};

/// Draws, and returns the summary.
#[track_caller]
fn drawn(arguments: &[&str]) -> String {
    plots::drawn("motion", arguments)
}

/// Returns the sentence with which the program refuses.
#[track_caller]
fn refusal(arguments: &[&str]) -> String {
    plots::refusal("motion", arguments)
}

/// Commits rows as a stage does; the item is the phrase or the motion.
fn publish(mut commit: Commit<'_>, ledger: &Ledger, ids: &[String]) {
    for id in ids {
        let item =
            Item { id: id.clone(), fingerprint: id.clone(), input_hash: id.clone(), failure: None };
        commit.settle(item, ledger);
    }
    commit.publish().expect("published");
}

/// Commits generated motions of a phrase, each the second of two candidates.
pub fn commit_generated(store: &Path, run: &str, phrase: &str, motions: &[(i32, Vec<Frame>)]) {
    let known = crate::support::phrases(store);
    let content_hash = known.get(phrase).map(|row| row.content_hash.clone()).unwrap_or_default();
    let store = Location::local(store).expect("a folder");
    let ledger = Ledger::read(&store, "generate").expect("commits");
    let mut commit = Commit::new(&store, "generate", "", "phrases");
    let (mut rows, mut ids) = (Vec::new(), Vec::new());
    for (sample, frames) in motions {
        let id = format!("{run}/{phrase}/{sample}");
        let labels =
            [Label::Text(run.to_owned()), Label::Text(phrase.to_owned()), Label::Number(*sample)];
        let values = frames.as_flattened().to_vec();
        let frames = Array2::from_shape_vec((frames.len(), MOTION_DIM), values).expect("rows");
        let part = commit.part(tables::GENERATED, tables::generated).expect("a part");
        part.write_labelled_frames(&id, &labels, frames.view()).expect("frames");
        for candidate in 0..2 {
            let content_hash = Some(content_hash.clone());
            rows.push(GenerationRow {
                content_hash,
                ..generation(run, phrase, *sample, candidate)
            });
        }
        ids.push(id);
    }
    let schema = GenerationRow::schema;
    commit.part(schema().name, schema).expect("a part").write_rows(&rows).expect("rows");
    publish(commit, &ledger, &ids);
}

fn generation(run: &str, phrase: &str, sample: i32, candidate: i32) -> GenerationRow {
    GenerationRow {
        generation: format!("{run}/{phrase}/{sample}"),
        run: run.to_owned(),
        phrase_id: phrase.to_owned(),
        sample,
        candidate,
        selected: candidate == 1,
        seed: -1,
        model: "demo".to_owned(),
        weights: "0".repeat(64),
        engine: "eager".to_owned(),
        sampler: "ddim".to_owned(),
        n_steps: 20,
        guidance: 2.5,
        eta: Some(0.0),
        primed_by: None,
        n_frames: 31,
        n_windows: 1,
        score: Some(0.875),
        checks_passed: 7,
        n_checks: 8,
        locking: Some(0.25),
        velocity_error: 0.125,
        control_error_mm: None,
        control_error_deg: None,
        constraints: None,
        generate_s: 1.0,
        real_time_factor: 0.5,
        settings: None,
        content_hash: Some(String::new()),
        n_dancers: Some(1),
        consistency: None,
        time: TimestampUs(0),
    }
}

/// Commits beats of a phrase every half second.
pub fn commit_beats(store: &Path, phrase: &str, n_beats: i32) {
    let store = Location::local(store).expect("a folder");
    let ledger = Ledger::read(&store, "extract").expect("commits");
    let mut commit = Commit::new(&store, "extract", "", "phrases");
    let beats: Vec<BeatRow> = (0..n_beats)
        .map(|beat| BeatRow {
            phrase_id: phrase.to_owned(),
            beat,
            frame: 15 * beat,
            time_s: f64::from(beat) / 2.0,
            number: None,
            source: Some("tracker".to_owned()),
        })
        .collect();
    let schema = BeatRow::schema;
    commit.part(schema().name, schema).expect("a part").write_rows(&beats).expect("rows");
    publish(commit, &ledger, &[phrase.to_owned()]);
}

/// Makes a store with two phrases, one of which has beats and generated motions, and one refused.
fn store(dir: &Dir) -> String {
    for (id, n_frames) in [("walk", 61), ("waltz", 121)] {
        let path = format!("source/motion/{id}/trajectory.npy");
        dir.write(path, trajectory(&coherent(n_frames, 1)));
    }
    dir.write("source/motion/refused/trajectory.npy", "no array");
    let store = dir.at("store");
    let output = ingest(&dir.at("source"), &store, &[]);
    assert_eq!(output.code, 1, "{output:?}");
    commit_beats(&store, "walk", 9);
    commit_generated(&store, "base", "walk", &[(0, coherent(61, 2)), (3, coherent(31, 3))]);
    commit_generated(&store, "tiny", "waltz", &[(0, coherent(7, 4))]);
    text(&store)
}

#[test]
fn a_file_is_drawn_as_png_and_svg() {
    let dir = Dir::new();
    let file = text(&dir.write("dance.npy", trajectory(&coherent(120, 1))));
    let png = text(&dir.at("pictures/dance.png"));
    let summary = drawn(&["--motion", &file, "--output", &png]);
    assert_eq!(summary, format!("120 frames (4.00 s) → {png} (2000 × 1530 px)\n"));
    let bytes = std::fs::read(&png).expect("a picture");
    assert_eq!(bytes[..8], *b"\x89PNG\r\n\x1a\n");
    let number = |at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
    assert_eq!((number(16), number(20)), (2000, 1530));
    // Nothing else is left in the folder.
    assert_eq!(std::fs::read_dir(dir.at("pictures")).expect("the folder").count(), 1);

    let path = text(&dir.at("dance.SVG"));
    drawn(&["--motion", &file, "--output", &path]);
    let picture = svg(&path);
    for label in [
        "<title>dance.npy</title>",
        "width=\"1000\" height=\"765\"",
        ">120 frames at 30 fps<",
        ">Position<",
        ">Velocity<",
        ">Quaternion<",
        ">Phase<",
        ">Quaternion norm<",
        ">Jerk<",
        ">change of the acceleration; limit 50000<",
        ">time (s)<",
        ">m/s³<",
    ] {
        assert!(picture.contains(label), "no {label} in the picture");
    }
    assert!(!picture.contains("beats") && !picture.contains("NaN"));
    drawn(&["--motion", &file, "--output", &path]);
    assert_eq!(svg(&path), picture, "the same motion, other bytes");
}

#[test]
fn an_excerpt_has_its_own_frames_beats_and_the_times_of_the_file() {
    let dir = Dir::new();
    let file = text(&dir.write("dance.npy", trajectory(&coherent(120, 1))));
    let beats = text(&dir.write("dance.beats.txt", "0.5\n1.0\n1.6\n2.0\n3.5\n"));
    let path = text(&dir.at("a.svg"));
    let flags = ["--motion", &file, "--output", &path, "--panel", "phase,path"];
    let more = ["--start", "1.5", "--duration", "0.7", "--beats", &beats, "--width", "600"];
    let summary = drawn(&[&flags[..], &more].concat());
    assert!(summary.starts_with("21 frames (0.70 s) → "), "{summary}");
    let picture = svg(&path);
    for label in [">2 beats<", ">1.5<", ">Phase<", ">Path<", ">start<", ">x (m)<"] {
        assert!(picture.contains(label), "no {label} in the picture");
    }
    assert!(!picture.contains(">Velocity<") && !picture.contains(">Jerk<"));
}

#[test]
fn what_is_not_finite_is_a_gap() {
    let dir = Dir::new();
    let mut frames = coherent(31, 1);
    frames[7][0] = f32::NAN;
    frames[9] = [f32::NAN; MOTION_DIM];
    let file = text(&dir.write("broken.npy", trajectory(&frames)));
    let path = text(&dir.at("a.svg"));
    let panels = "position,velocity,quaternion,phase,quaternion_norm,jerk,acceleration,\
                  angular_velocity,path";
    drawn(&["--motion", &file, "--output", &path, "--panel", panels]);
    let picture = svg(&path);
    assert!(picture.contains(">26 values not finite<") && !picture.contains("NaN"));
}

#[test]
fn a_phrase_is_drawn_as_its_file_is_and_with_its_beats() {
    let dir = Dir::new();
    let store = store(&dir);
    let (from_file, from_store) = (text(&dir.at("file.svg")), text(&dir.at("store.svg")));
    let file = text(&dir.at("source/motion/waltz/trajectory.npy"));
    drawn(&["--motion", &file, "--output", &from_file]);
    let summary = drawn(&["--store", &store, "--phrase", "waltz", "--output", &from_store]);
    assert!(summary.starts_with("121 frames (4.03 s) → "), "{summary}");
    assert_eq!(svg(&from_store), svg(&from_file).replace(">trajectory.npy<", ">waltz<"));
    drawn(&["--store", &store, "--phrase", "walk", "--output", &from_store]);
    // 61 frames end at 2.0 s.
    assert!(svg(&from_store).contains(">5 beats<"));
}

#[test]
fn a_generated_motion_is_drawn() {
    let dir = Dir::new();
    let store = store(&dir);
    let path = text(&dir.at("a.svg"));
    let flags = ["--store", &store, "--phrase", "walk", "--run", "base", "--output", &path];
    let summary = drawn(&flags);
    assert!(summary.starts_with("61 frames (2.03 s) → "), "{summary}");
    let picture = svg(&path);
    assert!(picture.contains("<title>walk by base</title>") && picture.contains(">5 beats<"));
    let summary = drawn(&[&flags[..], &["--sample", "3"]].concat());
    assert!(summary.starts_with("31 frames (1.03 s) → "), "{summary}");
    assert_ne!(svg(&path), picture);
}

#[test]
fn what_cannot_be_drawn_is_said_in_a_sentence() {
    let dir = Dir::new();
    let store = store(&dir);
    let nothing = text(&dir.at("nothing"));
    let folder = text(dir.path());
    let png = text(&dir.at("x.png"));
    let narrow = text(&dir.write("narrow.npy", write(&[7, 24], &[0.5_f32; 7 * 24])));
    let other = text(&dir.write("dance.bvh", "HIERARCHY"));
    let whole = text(&dir.write("dance.npy", trajectory(&coherent(31, 1))));
    let nowhere = text(&dir.at("nix.npy"));
    let cases: [(&[&str], String); 16] = [
        (
            &["--motion", &narrow],
            format!("{narrow} has shape [7, 24], expected [frames, 25]"),
        ),
        (
            &["--motion", &other],
            format!("{other}: is named like no motion; name a .npy or .csv file of 25 channels"),
        ),
        (
            &["--motion", &nowhere],
            format!(
                "{nowhere}: cannot be opened (No such file or directory (os error 2)); check that \
                 it is still there"
            ),
        ),
        (
            &["--motion", &folder],
            format!("{folder}: is named like no motion; name a .npy or .csv file of 25 channels"),
        ),
        (
            &["--motion", &whole, &whole],
            "a plot shows one motion, and --motion names 2; give one".to_owned(),
        ),
        (
            &["--motion", &whole, "--phrase", "walk"],
            "--motion and --phrase walk name two things to show; give one of them".to_owned(),
        ),
        (
            &["--motion", &whole, "--start", "1.1"],
            "--start 1.1 is after the end of dance.npy, whose last frame of 31 is at 1.00 s; begin \
             earlier"
                .to_owned(),
        ),
        (
            &["--phrase", "walk"],
            "--phrase walk is a name in a store; say which with --store".to_owned(),
        ),
        (
            &["--store", &store],
            "nothing to show: give --motion FILE, or --store URL and --phrase ID".to_owned(),
        ),
        (
            &["--store", &store, "--phrase", "wal"],
            format!("store {store} has no phrase \"wal\"; nearest: walk, waltz"),
        ),
        (
            &["--store", &nothing, "--phrase", "walk"],
            format!(
                "store {nothing} has no phrases; run motiongen ingest --source … --store {nothing} \
                 first"
            ),
        ),
        (
            &["--store", &nothing, "--phrase", "walk", "--run", "base"],
            format!(
                "store {nothing} has no generated motion; run motiongen generate --store {nothing} \
                 first"
            ),
        ),
        (
            &["--store", &store, "--phrase", "walk", "--run", "bass"],
            format!("store {store} has no generated motion of run \"bass\"; nearest: base, tiny"),
        ),
        (
            &["--store", &store, "--phrase", "waltz", "--run", "base"],
            format!(
                "store {store}: run \"base\" has no motion for phrase \"waltz\"; nearest: walk"
            ),
        ),
        (
            &["--store", &store, "--phrase", "walk", "--run", "base", "--sample", "1"],
            format!(
                "store {store}: run \"base\" has no sample 1 of phrase \"walk\"; ask for one of its \
                 own: 0, 3"
            ),
        ),
        (
            &["--store", &store, "--phrase", "walk", "--run", "base", "--sample", "0,3"],
            "a plot shows one motion, and --sample names 2; give one".to_owned(),
        ),
    ];
    for (flags, expected) in cases {
        assert_eq!(refusal(&[flags, &["--output", &png]].concat()), expected, "{flags:?}");
    }
    let refused = refusal(&["--store", &store, "--phrase", "refused", "--output", &png]);
    let start =
        format!("store {store} has no motion of phrase \"refused\", since ingest failed on it: ");
    assert!(refused.starts_with(&start), "{refused}");
    let panel = refusal(&["--motion", &whole, "--output", &png, "--panel", "speed"]);
    assert!(panel.contains("panel \"speed\" is unknown; the panels are position, "), "{panel}");
    assert!(!dir.at("x.png").exists());
    let csv = text(&dir.write("bad.csv", "frame,nothing\n0,1\n"));
    let sentence = refusal(&["--motion", &csv, "--output", &png]);
    assert!(sentence.starts_with(&format!("{csv}: ")), "{sentence}");
}
