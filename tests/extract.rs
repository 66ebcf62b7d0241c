//! `extract`: parity with librosa, tables and feature files, bad input, and kills at any moment.

mod bad_input;
mod files;
mod kill;
mod parity;
mod store;

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use arrow_array::RecordBatch;
use arrow_array::cast::AsArray as _;
use arrow_array::types::{Float32Type, Int32Type};
use motiongen::audio::{FEATURE_DIM, feature_names};
use motiongen::motion::npz::Npz;
use motiongen::store::tables::{self, BeatRow, ExtractionRow};
use motiongen::store::{Location, Row, Snapshot};

use crate::ingest_kill::Contents;
use crate::support::{Output, finish, motiongen, rows};

/// The features of one frame.
pub type Values = [f32; FEATURE_DIM];

/// A file below `tests/golden`.
fn golden(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(path)
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Returns `motiongen extract` on a store, not yet run.
fn extract_command(store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.args(["extract", "--store"]).arg(store).args(more);
    command
}

fn extract(store: &Path, more: &[&str]) -> Output {
    finish(&mut extract_command(store, more))
}

/// Runs `motiongen extract` without a store.
fn extract_files(audio: &[impl AsRef<OsStr>], output: &Path, more: &[&str]) -> Output {
    finish(
        motiongen().args(["extract", "--audio"]).args(audio).arg("--output").arg(output).args(more),
    )
}

/// Returns the frames of batches of `features` by phrase, each phrase's counted from 0 without a gap.
fn features_in(batches: impl Iterator<Item = RecordBatch>) -> BTreeMap<String, Vec<Values>> {
    let mut by_frame = BTreeMap::new();
    for batch in batches {
        let column = |name: &str| batch.column_by_name(name).unwrap();
        let ids = column("phrase_id").as_string::<i32>();
        let frames = column("frame").as_primitive::<Int32Type>();
        let columns: Vec<_> =
            feature_names().map(|(name, _)| column(&name).as_primitive::<Float32Type>()).collect();
        for i in 0..batch.num_rows() {
            let key = (ids.value(i).to_owned(), frames.value(i));
            let values = std::array::from_fn(|k| columns[k].value(i));
            assert!(by_frame.insert(key.clone(), values).is_none(), "{key:?} has two rows");
        }
    }
    let mut by_phrase: BTreeMap<String, Vec<Values>> = BTreeMap::new();
    for ((id, frame), values) in by_frame {
        let of_phrase = by_phrase.entry(id).or_default();
        assert_eq!(usize::try_from(frame), Ok(of_phrase.len()), "frames have a gap");
        of_phrase.push(values);
    }
    by_phrase
}

/// Returns the table `features` of a store.
pub fn features(store: &Path) -> BTreeMap<String, Vec<Values>> {
    let location = Location::local(store).unwrap();
    let snapshot = Snapshot::take(&location, tables::features()).unwrap();
    features_in(snapshot.batches().map(Result::unwrap))
}

/// Returns the table `extractions` by phrase.
fn extractions(store: &Path) -> BTreeMap<String, ExtractionRow> {
    by_id(rows(store), |row: &ExtractionRow| row.phrase_id.clone())
}

/// Returns frame and time of the beats of each phrase that has some, counted from 0 without a gap.
fn beats(store: &Path) -> BTreeMap<String, Vec<(i32, f64)>> {
    let rows = by_id(rows(store), |row: &BeatRow| (row.phrase_id.clone(), row.beat));
    let mut by_phrase: BTreeMap<String, Vec<_>> = BTreeMap::new();
    for ((id, beat), row) in rows {
        let of_phrase = by_phrase.entry(id).or_default();
        assert_eq!(usize::try_from(beat), Ok(of_phrase.len()), "beats have a gap");
        of_phrase.push((row.frame, row.time_s));
    }
    by_phrase
}

fn by_id<R: Row, K: Ord>(rows: Vec<R>, id: impl Fn(&R) -> K) -> BTreeMap<K, R> {
    let n_rows = rows.len();
    let by_id: BTreeMap<_, _> = rows.into_iter().map(|row| (id(&row), row)).collect();
    assert_eq!(by_id.len(), n_rows, "two rows have one key");
    by_id
}

/// Checks that the three tables of extract speak of the same phrases, frames and beats.
#[track_caller]
fn assert_consistent(store: &Path) {
    let (frames, rows, beats) = (features(store), extractions(store), beats(store));
    assert!(frames.keys().eq(rows.keys()), "{:?}, {:?}", frames.keys(), rows.keys());
    for (id, row) in &rows {
        assert_eq!(usize::try_from(row.n_frames), Ok(frames[id].len()), "{id}");
        let n_beats = beats.get(id).map_or(0, Vec::len);
        // Those of audio belong to the features, and `beats` has others.
        if row.n_samples.is_none() {
            assert_eq!(usize::try_from(row.n_beats), Ok(n_beats), "{id}");
        }
        if let Some(n_samples) = row.n_samples {
            assert_eq!(row.n_frames, 1 + n_samples / 1470, "{id}");
            assert_eq!(row.duration_s, n_samples as f64 / 44_100.0, "{id}");
        }
        assert!(frames[id].as_flattened().iter().all(|x| x.is_finite()), "{id}");
    }
    for (id, beats) in &beats {
        // A feature file's beats are taken as they are, and may lie behind its last frame.
        assert!(beats.is_sorted_by(|a, b| a.0 <= b.0 && a.1 < b.1), "{id}: {beats:?}");
        let row = &rows[id];
        assert!(beats.iter().all(|beat| i64::from(beat.0) < row.n_frames), "{id}: {beats:?}");
    }
}

fn contents(store: &Path) -> Contents {
    Contents::of(&Location::local(store).unwrap())
}

/// Copies a store, which then still speaks of the same source.
fn copy(from: &Path, to: &Path) {
    for (path, (bytes, _)) in crate::support::tree(from) {
        crate::support::write(&to.join(path), bytes);
    }
}

/// A feature file's arrays, as numbers and shapes.
struct Archive(Vec<u8>);

impl Archive {
    fn read(path: &Path) -> Self {
        Self(read(path))
    }

    fn keys(&self) -> Vec<String> {
        Npz::open(&self.0).unwrap().keys().to_vec()
    }

    fn f32s(&self, key: &str) -> (Vec<usize>, Vec<f32>) {
        let array = Npz::open(&self.0).unwrap().read_f32(key).unwrap();
        (array.shape, array.values)
    }

    fn f64s(&self, key: &str) -> Vec<f64> {
        Npz::open(&self.0).unwrap().read_f64(key).unwrap().values
    }

    /// The array `features`, [163, T], as frames.
    fn frames(&self) -> Vec<Values> {
        let (shape, values) = self.f32s("features");
        assert_eq!((shape.len(), shape[0]), (2, FEATURE_DIM));
        let n_frames = shape[1];
        (0..n_frames).map(|t| std::array::from_fn(|k| values[k * n_frames + t])).collect()
    }
}
