//! Groups of dancers in parts: written and read back, beside soloists of the version before groups.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use motiongen::store::tables::{self, GENERATED};
use motiongen::store::{
    Commit, Item, ItemTables, Label, Ledger, Location, Snapshot, StoreError, TableSchema, compact,
    vacuum, write_delta_logs,
};
use ndarray::{Array3, Axis};
use proptest::prelude::*;

use super::{backends, chain, paths, read};

/// Motion as it was before groups: without a dancer.
fn version_1() -> TableSchema {
    let mut table = TableSchema { version: 1, ..tables::motion() };
    table.columns.retain(|column| column.name != "dancer");
    table.sorted_by = &["phrase_id", "frame"];
    table
}

/// Frames that tell apart phrase, dancer, frame and channel.
fn group(n_dancers: usize, n_frames: usize, seed: u32) -> Array3<f32> {
    Array3::from_shape_fn((n_dancers, n_frames, 25), |(dancer, t, i)| {
        seed as f32 * 31.0 + dancer as f32 * 7.0 + t as f32 * 0.125 + i as f32 * 0.001
    })
}

fn commit(location: &Location, schema: fn() -> TableSchema, groups: &[(&str, Array3<f32>)]) {
    let known = Ledger::read(location, "ingest").expect("commits");
    let mut commit = Commit::new(location, "ingest", "rules", "file:///source");
    for (id, frames) in groups {
        let part = commit.part(tables::MOTION, schema).expect("a part");
        part.write_group(id, frames.view()).expect("written");
        let input_hash = format!("{id} of {}", frames.sum());
        let item =
            Item { id: (*id).to_owned(), fingerprint: String::new(), input_hash, failure: None };
        commit.settle(item, &known);
    }
    commit.publish().unwrap_or_else(|e| panic!("{}", chain(&e)));
}

fn all_groups(location: &Location) -> BTreeMap<String, Array3<f32>> {
    let table = Snapshot::take(location, tables::motion()).expect("a table");
    let known = Ledger::read(location, "ingest").expect("commits");
    let wanted: BTreeSet<String> = known.ids().map(str::to_owned).collect();
    let mut found = BTreeMap::new();
    let visited = table.visit_groups(&wanted, |id, frames| {
        assert!(found.insert(id.to_owned(), frames).is_none(), "{id} comes twice");
        Ok::<_, StoreError>(())
    });
    visited.unwrap_or_else(|e| panic!("{}", chain(&e)));
    found
}

#[test]
fn groups_lie_beside_soloists_of_the_version_before_and_compact_makes_them_one() {
    for backend in &backends("groups")[..2] {
        let location = &backend.location;
        let groups = [("b", group(3, 41, 2)), ("d", group(16, 5, 4))];
        commit(location, version_1, &[("a", group(1, 57, 1)), ("c", group(1, 13, 3))]);
        commit(location, tables::motion, &groups);
        commit(location, tables::motion, &[("e", group(1, 23, 5))]);
        let expected: BTreeMap<String, Array3<f32>> = [
            ("a", group(1, 57, 1)),
            ("b", group(3, 41, 2)),
            ("c", group(1, 13, 3)),
            ("d", group(16, 5, 4)),
            ("e", group(1, 23, 5)),
        ]
        .into_iter()
        .map(|(id, frames)| (id.to_owned(), frames))
        .collect();
        let check = |when: &str| {
            assert!(all_groups(location) == expected, "{backend}, {when}");
            for (id, frames) in &expected {
                let item = ItemTables::take(location, id).expect("an item");
                let found = item.group(tables::motion()).expect("frames").expect("some");
                assert!(found == *frames, "{backend}, {when}: {id}");
            }
        };
        check("as written");
        let versions = || -> Vec<u32> {
            let table = Snapshot::take(location, tables::motion()).expect("a table");
            table.parts().iter().map(|live| live.part.schema_version).collect()
        };
        let mut before = versions();
        before.sort_unstable();
        assert_eq!(before, [1, 2, 2]);
        let done = compact(location, false, &|_, _| false).expect("compacted");
        assert_eq!((done.n_parts_old, done.n_parts_new), (3, 1));
        assert_eq!(done.n_rows, 57 + 3 * 41 + 13 + 16 * 5 + 23);
        assert_eq!(versions(), [2]);
        check("compacted");
        assert_eq!(write_delta_logs(location).expect("logs"), [tables::MOTION]);
        let log = paths(location, "motion/_delta_log").remove(0);
        let log = String::from_utf8(read(location, &log)).expect("text");
        // The schema is JSON within JSON; the order of its keys is that of the build.
        let schema = log
            .lines()
            .map(|line| serde_json::from_str::<serde_json::Value>(line).expect("JSON"))
            .find_map(|action| action["metaData"]["schemaString"].as_str().map(str::to_owned))
            .expect("a schema");
        let schema: serde_json::Value = serde_json::from_str(&schema).expect("JSON");
        let fields = schema["fields"].as_array().expect("columns");
        let dancer = fields.iter().find(|field| field["name"] == "dancer").expect("a column");
        assert_eq!((&dancer["type"], &dancer["nullable"]), (&"integer".into(), &false.into()));
        vacuum(location, Duration::ZERO, false).expect("removed");
        check("vacuumed");
    }
}

#[test]
fn a_lone_part_of_the_version_before_is_written_anew_once() {
    let location = &backends("one-old-part").swap_remove(0).location;
    commit(location, version_1, &[("a", group(1, 57, 1))]);
    let done = compact(location, false, &|_, _| false).expect("compacted");
    assert_eq!((done.n_parts_old, done.n_parts_new), (1, 1));
    let done = compact(location, false, &|_, _| false).expect("compacted");
    assert_eq!((done.n_parts_old, done.n_parts_new), (0, 0));
    assert!(all_groups(location)["a"] == group(1, 57, 1));
}

#[test]
fn who_reads_soloists_is_told_of_a_group() {
    let location = &backends("solo").swap_remove(0).location;
    commit(location, tables::motion, &[("a", group(1, 7, 1)), ("b", group(3, 4, 2))]);
    let table = Snapshot::take(location, tables::motion()).expect("a table");
    let place = location.url_of(&paths(location, "motion").remove(0));
    let expected = format!(
        "table motion: {place} is not a readable Parquet part: Parquet error: b has 3 dancers where one is read"
    );
    let visit = |ids: &[&str]| {
        let wanted = ids.iter().map(|&id| id.to_owned()).collect();
        table.visit_items(&wanted, |_, frames| {
            assert!(frames == group(1, 7, 1).index_axis_move(Axis(0), 0));
            Ok::<_, StoreError>(())
        })
    };
    visit(&["a"]).expect("a soloist");
    assert_eq!(chain(&visit(&["a", "b"]).expect_err("a group")), expected);
    let item = ItemTables::take(location, "b").expect("an item");
    let error = item.frames(tables::motion()).expect_err("a group");
    assert_eq!(chain(&error), expected);
}

#[test]
fn a_group_longer_than_a_row_group_stays_whole_with_its_labels() {
    let location = &backends("long-group").swap_remove(0).location;
    let frames = group(3, 40_001, 1);
    let mut commit = Commit::new(location, "generate", "rules", "file:///source");
    let labels = [Label::Text("run".into()), Label::Text("song".into()), Label::Number(7)];
    let part = commit.part(GENERATED, tables::generated).expect("a part");
    part.write_labelled_group("run/song/7", &labels, frames.view()).expect("written");
    let item = Item {
        id: "run/song/7".to_owned(),
        fingerprint: String::new(),
        input_hash: "h".to_owned(),
        failure: None,
    };
    commit.settle(item, &Ledger::default());
    commit.publish().expect("published");
    let item = ItemTables::take(location, "run/song/7").expect("an item");
    assert!(item.group(tables::generated()).expect("frames") == Some(frames));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn what_is_written_is_read(
        sizes in prop::collection::vec((1..17_usize, 1..90_usize), 1..7),
        seed in 0..1000_u32,
    ) {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let location = Location::local(folder.path()).expect("a location");
        let names: Vec<String> = (0..sizes.len()).map(|i| format!("p{i}")).collect();
        let groups: Vec<(&str, Array3<f32>)> = names
            .iter()
            .zip(&sizes)
            .zip(seed..)
            .map(|((name, &(n, t)), seed)| (name.as_str(), group(n, t, seed)))
            .collect();
        // In two commits, the second of which supersedes a phrase of the first.
        commit(&location, tables::motion, &groups[..groups.len().div_ceil(2)]);
        commit(&location, tables::motion, &groups[groups.len() / 2..]);
        let expected: BTreeMap<String, Array3<f32>> =
            groups.into_iter().map(|(id, frames)| (id.to_owned(), frames)).collect();
        prop_assert!(all_groups(&location) == expected);
    }
}
