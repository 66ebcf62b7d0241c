//! Songs that become files, without tables: `--audio`.

use std::collections::BTreeMap;
#[cfg(feature = "pretrained")]
use std::path::Path;
#[cfg(feature = "pretrained")]
use std::process::Command;

#[cfg(feature = "pretrained")]
use super::generations;
use super::modelled;
use crate::support::files::wav;
use crate::support::{Dir, confined, finish, motiongen};
#[cfg(feature = "pretrained")]
use crate::train::make_store;

#[test]
fn a_song_becomes_files_and_a_stream() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let model = store.join("models/m").display().to_string();
    let song = dir.write("song.wav", wav(3.1)).display().to_string();
    let (out, stream) = (dir.at("out"), dir.at("stream.csv").display().to_string());
    let mut command = motiongen();
    command.args(["generate", "--model", &model, "--audio", &song, "--quiet", "--engine=eager"]);
    command.args(["--overlap=7", "--steps=3", "--stream", &stream, "--output"]).arg(&out);
    command.args(["--format", "npy,csv,parquet,bvh,glb,png,svg,html"]);
    let output = finish(&mut command);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("song: 3.1 s of motion in "), "{output:?}");
    let mut sizes = BTreeMap::new();
    for extension in ["npy", "csv", "parquet", "bvh", "glb", "png", "svg", "html"] {
        let bytes = std::fs::read(out.join(format!("song.{extension}"))).expect("a file");
        sizes.insert(extension, bytes.len());
    }
    // 94 frames: a header of 128 bytes and 25 numbers of 4 bytes each.
    assert_eq!(sizes["npy"], 128 + 94 * 25 * 4);
    let csv = std::fs::read_to_string(out.join("song.csv")).expect("text");
    assert_eq!(csv.lines().count(), 95);
    assert_eq!(std::fs::read_to_string(&stream).expect("text").lines().count(), 95);
    // A stream is made whenever it is asked for; without it there is nothing to do.
    std::fs::remove_file(&stream).expect("removed");
    let again = finish(&mut command);
    assert!(again.stdout.contains("  1 motions made ("), "{again:?}");
    assert_eq!(std::fs::read_to_string(&stream).expect("text").lines().count(), 95);
    let mut unstreamed = motiongen();
    let words: Vec<_> = command.get_args().map(ToOwned::to_owned).collect();
    let at = words.iter().position(|word| word == "--stream").expect("the flag");
    unstreamed.args(&words[..at]).args(&words[at + 2..]);
    let again = finish(&mut unstreamed);
    assert!(again.stdout.contains("nothing to do: 1 motions are up to date"), "{again:?}");
}

/// The clock is heard: without it, and with the bars a beat later, the same noise becomes another motion.
#[test]
fn the_clock_is_heard_unless_it_is_withheld() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let model = store.join("models/m").display().to_string();
    let song = dir.write("song.wav", wav(3.1)).display().to_string();
    let dance = |name: &str, beats: &str, more: &[&str]| {
        dir.write("song.beats.txt", beats);
        let out = dir.at(name);
        let mut command = motiongen();
        command.args(["generate", "--model", &model, "--audio", &song, "--quiet", "--overlap=7"]);
        command
            .args(["--engine=eager", "--steps=3", "--format=npy", "--raw", "--output"])
            .arg(&out);
        let output = finish(command.args(more));
        assert_eq!(output.code, 0, "{output:?}");
        std::fs::read(out.join("song.npy")).expect("a motion")
    };
    let list = |first: usize| {
        let line = |i: usize| format!("{} {}\n", 0.25 + 0.5 * i as f64, (i + first) % 4 + 1);
        (0..6).map(line).collect::<String>()
    };
    let heard = dance("heard", &list(0), &[]);
    assert_eq!(heard, dance("again", &list(0), &[]));
    assert_ne!(heard, dance("later", &list(1), &[]));
    let withheld = dance("withheld", &list(0), &["--no-clock"]);
    assert_ne!(heard, withheld);
    // With the clock withheld, other bars change nothing.
    assert_eq!(withheld, dance("withheld_later", &list(1), &["--no-clock"]));
}

/// With nothing but the executable and a song.
#[cfg(feature = "pretrained")]
#[test]
fn a_song_is_danced_to_by_the_model_of_the_program() {
    let dir = Dir::new();
    let song = dir.write("song.wav", wav(3.1)).display().to_string();
    let out = dir.at("out");
    let mut command = motiongen();
    command.env_remove("ORT_DYLIB_PATH").env("HOME", dir.at("home"));
    command.args(["generate", "--audio", &song, "--output"]).arg(&out).args(["--quiet"]);
    let output = finish(command.args(["--format", "npy,glb,html"]));
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("model pretrained, eager ("), "{output:?}");
    assert!(!output.stderr.contains("onnxruntime"), "{output:?}");
    for extension in ["npy", "glb", "html"] {
        assert!(out.join(format!("song.{extension}")).exists(), "{extension}");
    }
    assert!(!dir.at("home").exists(), "nothing is written but the output");
    // In a store the model is known by its name.
    let store = make_store(&dir);
    let output = finish(&mut command_of_store(&store));
    assert_eq!(output.code, 0, "{output:?}");
    let generations = generations(&store);
    assert!(generations.iter().all(|row| row.run == "pretrained" && row.model == "pretrained"));
    assert_eq!(generations.len(), 16);
}

/// Five dancers with nothing but the executable and a song, with the model named or not.
#[cfg(feature = "pretrained")]
#[test]
fn five_dance_to_a_song_by_the_model_of_groups_of_the_program() {
    let dir = Dir::new();
    let song = dir.write("song.wav", wav(3.1)).display().to_string();
    let dance = |out: &str, more: &[&str]| {
        let mut command = motiongen();
        command.env_remove("ORT_DYLIB_PATH").env("HOME", dir.at("home"));
        command.args(["generate", "--audio", &song, "--consistency", "0.5", "--quiet"]);
        command.args(["--steps=2", "--format=npy,html", "--output"]).arg(dir.at(out)).args(more);
        let output = finish(&mut command);
        assert_eq!(output.code, 0, "{output:?}");
        let made_by = "model group (family group), 5 dancers, consistency 0.5, eager (";
        assert!(output.stdout.contains(made_by), "{output:?}");
        assert!(dir.at(out).join("song.html").exists());
        std::fs::read(dir.at(out).join("song.npy")).expect("a motion")
    };
    let unnamed = dance("unnamed", &["--dancers=5"]);
    // 94 frames of five dancers: a header of 128 bytes and 25 numbers of 4 bytes each.
    assert_eq!(unnamed.len(), 128 + 5 * 94 * 25 * 4);
    assert_eq!(dance("named", &["--dancers=5", "--model=group"]), unnamed);
    assert!(!dir.at("home").exists(), "nothing is written but the output");
}

#[cfg(feature = "pretrained")]
fn command_of_store(store: &Path) -> Command {
    let mut command = motiongen();
    command.args(["generate", "--quiet", "--steps=2", "--guidance=1", "--store"]).arg(store);
    command
}

#[test]
fn memory_does_not_grow_with_the_track() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let model = store.join("models/m").display().to_string();
    let song = dir.write("long.wav", wav(600.0)).display().to_string();
    let mut command = motiongen();
    command.args(["generate", "--model", &model, "--audio", &song, "--quiet", "--engine=eager"]);
    command
        .args(["--steps=1", "--guidance=1", "--overlap=7", "--format=npy", "--output"])
        .arg(dir.at("out"));
    // Ten minutes are 18,000 frames: 12 MB of features and 2 MB of motion.
    let output = finish(&mut confined(&command, 600 << 20));
    assert_eq!(output.code, 0, "{output:?}");
}
