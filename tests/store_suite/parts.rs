//! Parts: row groups, footers, and reading them the same from everywhere without holding them whole.

use std::collections::BTreeMap;

use arrow_array::cast::AsArray as _;
use arrow_array::types::Float32Type;
use arrow_array::{Array as _, RecordBatch};
use motiongen::motion::MOTION_DIM;
use motiongen::store::tables::motion;
use motiongen::store::{Commit, Item, Ledger, Location, Snapshot};
use ndarray::Array2;
use parquet::file::reader::{FileReader as _, SerializedFileReader};

use super::{backends, chain, paths, read};

/// Rows of a full row group.
const GROUP_ROWS: usize = 65_536;
/// Phrases and their frames: some share a row group, one needs three.
const PHRASES: [(&str, usize); 6] =
    [("a", 30_011), ("b", 35_000), ("c", 1_777), ("d", 140_003), ("e", 1), ("f", 60_000)];

fn frames(id: &str, n_frames: usize) -> Array2<f32> {
    let first = f32::from(id.as_bytes()[0]);
    Array2::from_shape_fn((n_frames, MOTION_DIM), |(i, c)| {
        first + (i % 1013) as f32 * 0.5 + c as f32
    })
}

/// Commits the motion of phrases in one part.
fn commit(location: &Location, phrases: &[(&str, usize)]) {
    let mut commit = Commit::new(location, "ingest", "rules", "file:///source");
    for (id, n_frames) in phrases {
        let part = commit.part("motion", motion).expect("a temporary file");
        part.write_frames(id, frames(id, *n_frames).view()).expect("frames");
        let (fingerprint, input_hash) = (String::new(), id.to_string());
        let item = Item { id: id.to_string(), fingerprint, input_hash, failure: None };
        commit.settle(item, &Ledger::default());
    }
    let committed = commit.publish().unwrap_or_else(|e| panic!("{}", chain(&e)));
    let n_rows: usize = phrases.iter().map(|(_, n)| n).sum();
    assert_eq!(committed.n_rows, n_rows as u64, "{location}");
}

fn snapshot(location: &Location) -> Snapshot {
    Snapshot::take(location, motion()).unwrap_or_else(|e| panic!("{}", chain(&e)))
}

/// Returns all rows as one batch: where a batch ends differs between backends.
fn rows(location: &Location) -> RecordBatch {
    let batches: Result<Vec<_>, _> = snapshot(location).batches().collect();
    let batches = batches.unwrap_or_else(|e| panic!("{}", chain(&e)));
    arrow_select::concat::concat_batches(&motion().arrow(), &batches).expect("one schema")
}

#[test]
fn every_backend_gives_the_bytes_and_rows_of_the_local_one() {
    let small = [("a", 311), ("b", 66_000), ("c", 17)];
    let folder = tempfile::tempdir().expect("a temporary folder");
    let local = Location::local(folder.path()).expect("a location");
    commit(&local, &small);
    let expected = rows(&local);
    assert_eq!(expected.num_rows(), 66_328);
    for backend in backends("batches") {
        commit(&backend.location, &small);
        assert_eq!(paths(&backend.location, ""), paths(&local, ""), "{backend}");
        let part = paths(&local, "motion").remove(0);
        assert!(read(&backend.location, &part) == read(&local, &part), "{backend}: bytes differ");
        assert!(rows(&backend.location) == expected, "{backend}: rows differ");
    }
}

#[test]
fn row_groups_hold_whole_phrases_unless_a_phrase_exceeds_one() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let local = Location::local(folder.path()).expect("a location");
    commit(&local, &PHRASES);
    let path = folder.path().join(paths(&local, "motion").remove(0));
    let reader = SerializedFileReader::new(std::fs::File::open(path).expect("the part"));
    let metadata = reader.expect("a Parquet file").metadata().clone();
    let groups: Vec<_> = metadata.row_groups().iter().map(|g| g.num_rows() as usize).collect();
    // a and b fit together, c waits for d and is cut off by it, the end of d leaves no room for f.
    let (rest, full) = (140_003 - 2 * GROUP_ROWS, GROUP_ROWS);
    assert_eq!(groups, [65_011, 1_777, full, full, rest + 1, 60_000]);
    let key_values: BTreeMap<_, _> = metadata
        .file_metadata()
        .key_value_metadata()
        .expect("a footer")
        .iter()
        .filter_map(|kv| Some((kv.key.strip_prefix("motiongen.")?, kv.value.as_deref()?)))
        .collect();
    assert_eq!(key_values["schema_version"], "2");
    assert_eq!(key_values["table"], "motion");
    assert_eq!(key_values["params_hash"], "rules");
    assert_eq!(key_values["program"], format!("motiongen {}", env!("CARGO_PKG_VERSION")));
    assert_eq!(key_values["input_hash"].len(), 64);
}

#[test]
fn every_frame_of_a_long_phrase_comes_once_and_in_order() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let local = Location::local(folder.path()).expect("a location");
    commit(&local, &PHRASES);
    let mut expected = PHRASES.iter().flat_map(|(id, n)| (0..*n).map(move |i| (*id, i)));
    for batch in snapshot(&local).batches() {
        let batch = batch.expect("a batch");
        let ids = batch.column(0).as_string::<i32>();
        let dancer = batch.column(1).as_primitive::<arrow_array::types::Int32Type>();
        let frame = batch.column(2).as_primitive::<arrow_array::types::Int32Type>();
        let last = batch.column(MOTION_DIM + 2).as_primitive::<Float32Type>();
        for row in 0..batch.num_rows() {
            let (id, i) = expected.next().expect("no more rows than frames");
            let found = (ids.value(row), dancer.value(row), frame.value(row));
            assert_eq!(found, (id, 0, i as i32));
            let value = f32::from(id.as_bytes()[0]) + (i % 1013) as f32 * 0.5 + 24.0;
            assert_eq!(last.value(row), value, "{id} {i}");
        }
    }
    assert_eq!(expected.next(), None);
}

#[test]
fn reading_holds_one_row_group_however_many_there_are() {
    for backend in backends("lazy") {
        let Some(remote) = &backend.remote else { continue };
        commit(&backend.location, &PHRASES);
        let size = snapshot(&backend.location).parts()[0].part.n_bytes;
        let before = remote.stores.requests().len();
        let snapshot = snapshot(&backend.location);
        let mut batches = snapshot.batches();
        let first = batches.next().expect("a batch").expect("readable");
        assert_eq!(first.column(0).as_string::<i32>().value(0), "a", "{backend}");
        assert!(!first.column(0).is_empty() && first.num_rows() < GROUP_ROWS, "{backend}");
        // What was asked of the part so far: its footer and the first of six row groups.
        let requests = remote.stores.requests();
        let ranges = requests[before..].iter().filter_map(|r| r.headers.get("range"));
        let asked: u64 = ranges.map(length).sum();
        assert!(asked > 0 && asked < size / 2, "{backend}: {asked} of {size} bytes");
    }
}

/// Returns the bytes that a header such as `bytes=3-7` asks for.
fn length(range: &str) -> u64 {
    let parse = |text: &str| text.parse::<u64>().expect("a number");
    let (first, last) = range.trim_start_matches("bytes=").split_once('-').expect("a range");
    parse(last) + 1 - parse(first)
}
