//! `motiongen train` and `motiongen finetune`, as a user runs them.

mod bad_input;
mod finetune;
mod kill;
mod learns;

use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::write;
use motiongen::store::split_of;
use motiongen::store::tables::TrainingLogRow;
use zip::CompressionMethod;

use crate::support::files::{Member, coherent, npz, trajectory};
use crate::support::{Dir, Output, finish, motiongen, rows, run};

/// A network that learns in milliseconds.
const SMALL: [&str; 15] = [
    "--preset=tiny",
    "--widths=8,12",
    "--num-heads=2",
    "--time-embed-dim=8",
    "--context-dim=8",
    "--decoder-hidden-dim=12",
    "--decoder-blocks=1",
    "--window-frames=24",
    "--prediction=epsilon",
    "--batch-size=5",
    "--decoder-batch-size=3",
    "--learning-rate=3e-3",
    "--threads=2",
    "--store-patience=0",
    "--quiet",
];

/// Features that follow the motion, so that there is something to learn.
pub fn features(frames: &[[f32; MOTION_DIM]]) -> Vec<Member> {
    let n = frames.len();
    let array = |rows: usize, value: &dyn Fn(usize, &[f32; MOTION_DIM]) -> f32| {
        let values: Vec<f32> =
            (0..rows).flat_map(|row| frames.iter().map(move |f| value(row, f))).collect();
        values
    };
    vec![
        ("mel", write(&[128, n], &array(128, &|row, f| 0.1 + 0.3 * f[row % 3]))),
        ("chroma", write(&[12, n], &array(12, &|row, f| 0.5 + 0.4 * f[17 + row % 8]))),
        ("mfcc", write(&[20, n], &array(20, &|row, f| f[3 + row % 3]))),
        ("rms", write(&[n], &array(1, &|_, f| f[4].abs()))),
        ("spectral_centroid", write(&[n], &array(1, &|_, f| f[16]))),
        ("onset_strength", write(&[n], &array(1, &|_, f| f[16] * f[16]))),
    ]
}

/// Names of `n` phrases that the stable hash puts into a split.
fn names(split: &str, n: usize) -> Vec<String> {
    (0..).map(|i| format!("phrase {i:03}")).filter(|id| split_of(id) == split).take(n).collect()
}

/// Writes phrases of 19 to 67 frames with motion and features, 13 to train and 3 to validate.
fn write_source(folder: &Path) {
    let all = names("train", 13).into_iter().chain(names("validation", 3));
    for (i, id) in all.enumerate() {
        let frames = coherent(19 + 16 * (i % 4), i as u32);
        crate::support::write(
            &folder.join(format!("motion/{id}/trajectory.npy")),
            trajectory(&frames),
        );
        let features = npz(&features(&frames), CompressionMethod::Deflated);
        crate::support::write(&folder.join(format!("audio_features/{id}/features.npz")), features);
    }
}

/// Makes a store of phrases that can be trained on.
pub fn make_store(dir: &Dir) -> PathBuf {
    let (source, store) = (dir.at("source"), dir.at("store"));
    write_source(&source);
    let output = crate::support::ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
    store
}

/// Returns `motiongen train` of the small network, not yet run.
pub fn train_command(store: &Path, run: &str, more: &[&str]) -> Command {
    let mut command = motiongen();
    let flag = |argument: &str| argument.split('=').next().unwrap_or_default().to_owned();
    let given: Vec<_> = more.iter().map(|argument| flag(argument)).collect();
    let usual = SMALL.iter().filter(|argument| !given.contains(&flag(argument)));
    command.arg("train").arg("--store").arg(store).args(["--run", run]).args(usual).args(more);
    command
}

/// Trains the small network.
pub fn train(store: &Path, run: &str, more: &[&str]) -> Output {
    finish(&mut train_command(store, run, more))
}

/// Returns the rows of a run's log, in order.
fn log(store: &Path, run: &str, stage: &str) -> Vec<TrainingLogRow> {
    let mut rows: Vec<TrainingLogRow> = rows(store);
    rows.retain(|row| row.run == run && row.stage == stage);
    rows.sort_by(|a, b| (a.step, &a.kind).cmp(&(b.step, &b.kind)));
    rows
}

/// Returns steps and the bits of their losses.
pub fn losses(store: &Path, run: &str, stage: &str) -> Vec<(i64, Option<u64>)> {
    log(store, run, stage)
        .into_iter()
        .filter(|row| row.kind == "step")
        .map(|row| (row.step, row.loss.map(f64::to_bits)))
        .collect()
}

/// Returns the files of a run's stage that begin with `kind`, oldest step first.
pub fn checkpoints(store: &Path, run: &str, stage: &str, kind: &str) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(store.join("runs").join(run).join(stage)) else {
        return Vec::new();
    };
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.expect("an entry").path()).collect();
    paths.retain(|path| path.file_name().is_some_and(|n| n.to_string_lossy().starts_with(kind)));
    paths.sort();
    paths
}

/// Returns the numbers of a checkpoint: the file behind its header, which tells times.
fn numbers(path: &Path) -> Vec<u8> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let header = u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize;
    bytes[8 + header..].to_vec()
}

/// Returns the numbers of the newest checkpoint, and what it is called.
pub fn newest(store: &Path, run: &str, stage: &str, kind: &str) -> (String, Vec<u8>) {
    let path = checkpoints(store, run, stage, kind).pop().expect("a checkpoint");
    (path.file_name().expect("a name").to_string_lossy().into_owned(), numbers(&path))
}
