//! `view`: pages of motion files, phrases and generated motions, and every mistake with them.

use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use motiongen::motion::MOTION_DIM;
use serde_json::{Value, json};

use crate::plot_motion::{commit_beats, commit_generated};
use crate::support::files::{Frame, coherent, trajectory, wav};
use crate::support::{Dir, Output, finish, ingest, motiongen, run};

fn view(arguments: &[&str]) -> Output {
    run(["view"].iter().chain(arguments))
}

/// Makes a page, and returns the summary.
#[track_caller]
fn made(arguments: &[&str]) -> String {
    let output = view(arguments);
    assert_eq!((output.code, output.stderr.as_str()), (0, ""), "{arguments:?}");
    output.stdout
}

/// Returns the sentence with which the program refuses.
#[track_caller]
fn refusal(arguments: &[&str]) -> String {
    let output = view(arguments);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{arguments:?}: {output:?}");
    let line = output.stderr.lines().next().unwrap_or_default();
    line.strip_prefix("error: ").unwrap_or(line).to_owned()
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

pub fn page(path: &str) -> String {
    std::fs::read_to_string(path).expect("a page")
}

/// Returns what the script of a page reads.
pub fn data(page: &str) -> Value {
    let (_, rest) = page.split_once("id=\"data\">").expect("data");
    let (json, _) = rest.split_once("</script>").expect("the end of the data");
    serde_json::from_str(json).expect("JSON")
}

/// Returns the frames of a sample as the page holds them.
fn frames(data: &Value, sample: usize) -> Vec<Frame> {
    let text = data["samples"][sample]["frames"].as_str().expect("base64");
    let bytes = STANDARD.decode(text).expect("base64");
    let values: Vec<f32> =
        bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    values.as_chunks::<MOTION_DIM>().0.to_vec()
}

/// Returns the bytes of the audio that a page plays, with their media type.
fn audio(page: &str) -> Option<(String, Vec<u8>)> {
    let (_, rest) = page.split_once("<audio id=\"audio\" preload=\"auto\" src=\"data:")?;
    let (uri, _) = rest.split_once('"')?;
    let (mime, base64) = uri.split_once(";base64,")?;
    Some((mime.to_owned(), STANDARD.decode(base64).expect("base64")))
}

#[test]
fn a_page_holds_motion_music_and_beats_and_asks_for_nothing() {
    let dir = Dir::new();
    let dance = coherent(120, 1);
    let file = text(&dir.write("dance.npy", trajectory(&dance)));
    let song = text(&dir.write("song.wav", wav(4.0)));
    let beats = text(&dir.write("song.txt", "0.5\n1.0\n1.5\n"));
    let path = text(&dir.at("pages/dance.html"));
    let flags = ["--motion", &file, "--audio", &song, "--beats", &beats, "--output", &path];
    let summary = made(&flags);
    let html = page(&path);
    let mb = html.len() as f64 / 1e6;
    assert_eq!(summary, format!("1 motion (4.00 s), 3 beats, with audio → {path} ({mb:.2} MB)\n"));
    assert!(html.contains("<title>dance.npy</title>"));
    assert!(!html.contains("http://") && !html.contains("https://"));
    let found = data(&html);
    assert_eq!(found["beats"], json!([0.5, 1.0, 1.5]));
    assert_eq!(frames(&found, 0), dance);
    let (mime, bytes) = audio(&html).expect("audio");
    assert_eq!((mime.as_str(), bytes), ("audio/wav", wav(4.0)));
    // The same bytes again, and nothing else in the folder.
    made(&flags);
    assert_eq!(page(&path), html);
    assert_eq!(std::fs::read_dir(dir.at("pages")).expect("the folder").count(), 1);
}

#[test]
fn a_page_lies_beside_the_motion_unless_told() {
    let dir = Dir::new();
    let file = text(&dir.write("dance.npy", trajectory(&coherent(31, 1))));
    let other = text(&dir.write("b/other.npy", trajectory(&coherent(7, 2))));
    let path = text(&dir.at("dance.html"));
    let summary = made(&["--motion", &file, &other]);
    let start = format!("2 motions (1.03 s), 0 beats, without audio → {path} (");
    assert!(summary.starts_with(&start), "{summary}");
    let html = page(&path);
    assert!(html.contains("<title>dance.npy and 1 more</title>") && audio(&html).is_none());
    let found = data(&html);
    assert_eq!(found["samples"][1]["name"], "other.npy");
    assert_eq!(frames(&found, 1), coherent(7, 2));
}

#[test]
fn beats_are_tracked_where_nobody_says_them() {
    let dir = Dir::new();
    let file = text(&dir.write("dance.npy", trajectory(&coherent(120, 1))));
    let clicks =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/audio/clicks_120bpm.flac");
    made(&["--motion", &file, "--audio", &text(&clicks)]);
    let html = page(&text(&dir.at("dance.html")));
    let found = data(&html);
    let beats = found["beats"].as_array().expect("beats");
    assert!(beats.len() >= 4, "{beats:?}");
    assert_eq!(audio(&html).expect("audio").0, "audio/flac");
    // What cannot be decoded here may still be played by a browser.
    let odd = text(&dir.write("odd.opus", "no audio"));
    let output = view(&["--motion", &file, "--audio", &odd]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("0 beats, with audio"), "{output:?}");
    assert!(output.stderr.contains("no beats are marked: "), "{output:?}");
    // A file beside the audio is asked before the tracker.
    let song = text(&dir.write("song.wav", wav(4.0)));
    dir.write("song.beats.txt", "0.25\n0.75\n");
    made(&["--motion", &file, "--audio", &song]);
    assert_eq!(data(&page(&text(&dir.at("dance.html"))))["beats"], json!([0.25, 0.75]));
}

/// Makes a store with a phrase that has music, beats and generated motions.
fn store(dir: &Dir) -> String {
    dir.write("source/motion/a/walk/trajectory.npy", trajectory(&coherent(61, 1)));
    dir.write("source/audio/a/walk.wav", wav(61.0 / 30.0));
    let store = dir.at("store");
    let output = ingest(&dir.at("source"), &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    commit_beats(&store, "a/walk", 4);
    commit_generated(&store, "base", "a/walk", &[(0, coherent(61, 2)), (3, coherent(31, 3))]);
    text(&store)
}

#[test]
fn a_phrase_brings_its_music_and_its_beats() {
    let dir = Dir::new();
    let store = store(&dir);
    let path = text(&dir.at("walk.html"));
    let flags = ["--store", &store, "--phrase", "a/walk", "--output", &path];
    let summary = made(&flags);
    assert!(summary.starts_with("1 motion (2.03 s), 4 beats, with audio → "), "{summary}");
    let html = page(&path);
    let found = data(&html);
    assert_eq!(frames(&found, 0), coherent(61, 1));
    assert_eq!(found["beats"], json!([0.0, 0.5, 1.0, 1.5]));
    assert_eq!(audio(&html).expect("audio").1, wav(61.0 / 30.0));
    assert_eq!(found["samples"][0]["facts"][0][0], "split");
    let summary = made(&[&flags[..], &["--no-audio"]].concat());
    assert!(summary.contains("4 beats, without audio"), "{summary}");
    // The audio has gone since: a page without it, and why.
    std::fs::remove_file(dir.at("source/audio/a/walk.wav")).expect("the song");
    let output = view(&flags);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("without audio"), "{output:?}");
    assert!(output.stderr.contains("the page has no audio: "), "{output:?}");
}

#[test]
fn generated_motions_are_there_to_choose_from() {
    let dir = Dir::new();
    let store = store(&dir);
    let mut command = motiongen();
    command.args(["view", "--store", &store, "--phrase", "a/walk", "--run", "base"]);
    let output = finish(command.current_dir(dir.path()));
    assert_eq!(output.code, 0, "{output:?}");
    // A phrase may be called what no file can be.
    let summary = "2 motions (2.03 s), 4 beats, with audio → base.a_walk.html (";
    assert!(output.stdout.starts_with(summary), "{output:?}");
    let found = data(&page(&text(&dir.at("base.a_walk.html"))));
    let names = [0, 1].map(|i| found["samples"][i]["name"].as_str().expect("a name"));
    assert_eq!(names, ["sample 0", "sample 3"]);
    assert_eq!(frames(&found, 1), coherent(31, 3));
    let facts = &found["samples"][1]["facts"];
    for fact in [
        ["model", "demo"],
        ["run", "base"],
        ["sampler", "ddim, 20 steps"],
        ["guidance", "2.5"],
        ["seed", "18446744073709551615"],
        ["candidates", "2"],
        ["score", "0.875"],
        ["checks", "7 of 8 passed"],
    ] {
        let is_there = facts.as_array().is_some_and(|facts| facts.contains(&json!(fact)));
        assert!(is_there, "no {fact:?} in {facts}");
    }
    let path = text(&dir.at("one.html"));
    let flags = ["--store", &store, "--phrase", "a/walk", "--run", "base", "--output", &path];
    let summary = made(&[&flags[..], &["--sample", "3"]].concat());
    assert!(summary.starts_with("1 motion (1.03 s), "), "{summary}");
}

#[test]
fn what_cannot_be_shown_is_said_in_a_sentence() {
    let dir = Dir::new();
    let store = store(&dir);
    let file = text(&dir.write("dance.npy", trajectory(&coherent(31, 1))));
    let (html, png) = (text(&dir.at("x.html")), text(&dir.at("x.png")));
    let nowhere = text(&dir.at("nix.wav"));
    let folder = text(dir.path());
    let many: Vec<&str> = std::iter::repeat_n(file.as_str(), 17).collect();
    let many = [&["--motion"], &many[..]].concat();
    let cases: [(&[&str], String); 7] = [
        (
            &["--motion", &file, "--output", &png],
            format!("--output {png} is not named like a page; name it .html"),
        ),
        (
            &["--motion", &file, "--audio", &nowhere],
            format!(
                "{nowhere}: cannot be opened (No such file or directory (os error 2)); check that \
                 it is still there"
            ),
        ),
        (
            &["--motion", &file, "--audio", &folder],
            format!("{folder}: is a folder; name a file in it"),
        ),
        (
            &["--output", &html],
            "nothing to show: give --motion FILE, or --store URL and --phrase ID".to_owned(),
        ),
        (
            &["--store", &store, "--phrase", "a/walks", "--output", &html],
            format!("store {store} has no phrase \"a/walks\"; nearest: a/walk"),
        ),
        (
            &["--store", &store, "--phrase", "a/walk", "--run", "bare", "--output", &html],
            format!("store {store} has no generated motion of run \"bare\"; nearest: base"),
        ),
        (&many, "a page shows up to 16 motions, and --motion names 17; give fewer".to_owned()),
    ];
    for (flags, expected) in cases {
        assert_eq!(refusal(flags), expected, "{flags:?}");
    }
    assert!(!dir.at("x.html").exists() && !dir.at("dance.html").exists());
    let beats = text(&dir.write("beats.txt", "1.0\n0.5\n"));
    let sentence = refusal(&["--motion", &file, "--beats", &beats]);
    assert!(sentence.starts_with(&format!("{beats}: beats line 2 reads `0.5`")), "{sentence}");
    let below_a_file = text(&dir.at("dance.npy/x.html"));
    let sentence = refusal(&["--motion", &file, "--output", &below_a_file]);
    assert!(sentence.starts_with(&format!("while writing {below_a_file}: ")), "{sentence}");
}
