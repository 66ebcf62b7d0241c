//! `library`: what the constructed phrases owe to their music, what the tables and files hold, bad
//! input, and kills at any moment.

mod bad_input;
mod coupling;
mod groups;
mod kill;
mod made;
mod output;
mod store;

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::store::Location;
use motiongen::store::tables::PhraseRow;

use crate::ingest_kill::Contents;
use crate::support::files::{Frame, wav_of};
use crate::support::{Dir, Output, finish, motiongen, phrases, write};

/// A file or folder below `tests/data`.
fn data(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(path)
}

/// Returns `motiongen library` on a store, not yet run.
fn library_command(store: &Path, more: &[impl AsRef<OsStr>]) -> Command {
    let mut command = motiongen();
    command.args(["library", "--store"]).arg(store).args(more);
    command
}

pub fn library(store: &Path, more: &[impl AsRef<OsStr>]) -> Output {
    finish(&mut library_command(store, more))
}

/// Returns the flags that name folders of songs and captures, and others.
pub fn from(songs: &Path, captures: &Path, more: &[&str]) -> Vec<std::ffi::OsString> {
    let mut flags = vec!["--songs".into(), songs.into(), "--captures".into(), captures.into()];
    flags.extend(more.iter().map(std::convert::Into::into));
    flags
}

const RATE_HZ: u32 = 11_025;

/// A song of clicks at `tempo_bpm`, the first at 0.25 s, louder and louder up to its middle.
pub fn clicks(tempo_bpm: f64, duration_s: f64) -> Vec<u8> {
    let n_samples = (duration_s * f64::from(RATE_HZ)) as usize;
    let sample = |i: usize| {
        let time_s = i as f64 / f64::from(RATE_HZ);
        let beat = (time_s - 0.25) * tempo_bpm / 60.0;
        let since_s = (beat - beat.floor()) * 60.0 / tempo_bpm;
        let swell = (std::f64::consts::PI * time_s / duration_s).sin();
        let click = if beat < 0.0 { 0.0 } else { (-60.0 * since_s).exp() };
        ((2.0 * std::f64::consts::PI * 440.0 * time_s).sin() * click * swell * 30_000.0) as i16
    };
    let samples: Vec<u8> = (0..n_samples).flat_map(|i| sample(i).to_le_bytes()).collect();
    wav_of(RATE_HZ, 1, &samples)
}

/// The beats of [`clicks`], numbered in bars.
pub fn beat_list(tempo_bpm: f64, duration_s: f64, beats_per_bar: usize) -> String {
    let n_beats = ((duration_s - 0.25) * tempo_bpm / 60.0) as usize;
    (0..n_beats)
        .map(|i| format!("{} {}\n", 0.25 + i as f64 * 60.0 / tempo_bpm, i % beats_per_bar + 1))
        .collect()
}

/// Writes songs: a waltz and a march with their beats, and one whose beats have to be found.
pub fn write_songs(dir: &Dir) -> PathBuf {
    dir.write("songs/a waltz.wav", clicks(141.3, 9.0));
    dir.write("songs/a waltz.beats.txt", beat_list(141.3, 9.0, 3));
    dir.write("songs/marches/one.wav", clicks(93.7, 11.0));
    dir.write("songs/marches/one.beats.txt", beat_list(93.7, 11.0, 4));
    dir.write("songs/tracked.wav", clicks(120.0, 8.5));
    dir.at("songs")
}

/// Writes three captures of the demo library, one of them a BVH file.
pub fn write_captures(dir: &Dir) -> PathBuf {
    for (from, to) in [
        ("cmu_01_03/trajectory.npy", "captures/cmu.npy"),
        ("humanoid3d_dance_b/trajectory.npy", "captures/more/dance.npy"),
        ("mocapbank/motion.bvh", "captures/more/bank.BVH"),
    ] {
        let bytes = std::fs::read(data("phrases/motion").join(from)).unwrap();
        write(&dir.at(to), bytes);
    }
    dir.at("captures")
}

/// Returns the constructed phrases of a store.
pub fn constructed(store: &Path) -> BTreeMap<String, PhraseRow> {
    phrases(store).into_iter().filter(|(_, row)| row.is_constructed()).collect()
}

fn contents(store: &Path) -> Contents {
    Contents::of(&Location::local(store).unwrap())
}

/// Returns the bytes of every file below a folder.
fn bytes(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    crate::support::tree(folder).into_iter().map(|(path, (bytes, _))| (path, bytes)).collect()
}

fn column(frames: &[Frame], i: usize) -> Vec<f64> {
    frames.iter().map(|frame| f64::from(frame[i])).collect()
}
