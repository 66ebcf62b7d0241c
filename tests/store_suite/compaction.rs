//! Compaction changes where rows lie and nothing of what they say; vacuum removes what nobody reads.

use std::collections::BTreeMap;
use std::time::Duration;

use motiongen::store::tables::{self, FailureRow};
use motiongen::store::{
    Commit, Compaction, Item, Ledger, Location, Row as _, Snapshot, StoreError, StoreSnapshot,
    checkpoint, compact, vacuum,
};
use ndarray::Array2;

use super::catalogue::{StageContents, contents_of, history};
use super::{Backend, backends, chain, paths, put};
use crate::store_suite::commits::{STAGE, commit, item, ledger, outcome, snapshot, visible};

fn compacted(location: &Location) -> Compaction {
    compact(location, false, &|_, _| false).unwrap_or_else(|e| panic!("{}", chain(&e)))
}

/// Everything but where it lies.
pub(super) fn said(location: &Location) -> StageContents {
    StageContents { parts: Vec::new(), ..contents_of(location) }
}

/// Returns the parts of all tables that are there, whether they count or not.
fn all_parts(location: &Location) -> Vec<String> {
    let mut parts = paths(location, "");
    parts.retain(|path| path.ends_with(".parquet") && !path.starts_with("catalogue/"));
    parts
}

#[test]
fn what_is_said_stays_and_after_vacuum_each_row_is_there_once() {
    for seed in 1..13 {
        let Backend { location, .. } = &backends("compacted").swap_remove(seed as usize % 2);
        for round in 0..3 {
            history(location, seed * 1000 + round, 13);
            if seed % 3 == 0 {
                checkpoint(location, &[STAGE]);
            }
            let before = said(location);
            let would = compact(location, true, &|_, _| false).expect("a plan");
            let listed = paths(location, "");
            let done = compacted(location);
            assert_eq!((would.n_parts_old, would.n_parts_new), (done.n_parts_old, 0));
            assert_ne!(paths(location, ""), listed, "nothing was written");
            assert_eq!(said(location), before, "seed {seed}, round {round}");
            let live = StoreSnapshot::take(location).and_then(|s| s.live_parts()).expect("parts");
            let dead = live.values().flatten().filter(|l| !l.superseded.is_empty()).count();
            assert_eq!((dead, live["failures"].len()), (0, 1), "seed {seed}, round {round}");
            let again = compacted(location);
            assert_eq!((again.n_parts_old, again.n_parts_new), (0, 0), "it is done once");
            // What is young stays.
            assert_eq!(
                vacuum(location, Duration::from_secs(60), false).expect("done").paths.len(),
                0
            );
            let listed = vacuum(location, Duration::ZERO, true).expect("listed");
            let removed = vacuum(location, Duration::ZERO, false).expect("removed");
            assert_eq!(listed, removed);
            assert!(!removed.paths.is_empty());
            assert_eq!(said(location), before, "seed {seed}, round {round}, vacuumed");
            let live = live.into_values().flatten().map(|l| l.part.path).collect::<Vec<_>>();
            assert_eq!(all_parts(location), live, "other engines read the files that are there");
            assert_eq!(paths(location, "commits").len(), 1);
        }
        // The next commit supersedes what compaction wrote as what it was made from.
        let ids: Vec<String> = said(location).items.into_keys().collect();
        commit(location, &ledger(location), &[(&ids[0], "anew")]);
        assert!(visible(&snapshot(location)).contains(&(ids[0].clone(), "anew".to_owned())));
        assert_eq!(said(location).items.len(), ids.len());
    }
}

fn frames(n: usize, start: f32) -> Array2<f32> {
    Array2::from_shape_fn((n, 25), |(t, i)| start + t as f32 + 0.01 * i as f32)
}

fn commit_motion(location: &Location, items: &[(&str, Array2<f32>)]) {
    let known = ledger(location);
    let mut commit = Commit::new(location, STAGE, "rules", "source");
    for (id, frames) in items {
        let part = commit.part(tables::MOTION, tables::motion).expect("a part");
        part.write_frames(id, frames.view()).expect("written");
        let input_hash = format!("{id} of {}", frames[[0, 0]]);
        let fingerprint = String::new();
        let item = Item { id: (*id).to_owned(), fingerprint, input_hash, failure: None };
        commit.settle(item, &known);
    }
    commit.publish().expect("published");
}

fn all_frames(location: &Location) -> BTreeMap<String, Array2<f32>> {
    let table = Snapshot::take(location, tables::motion()).expect("a table");
    let wanted = ledger(location).ids().map(str::to_owned).collect();
    let mut found = BTreeMap::new();
    let visited = table.visit_items(&wanted, |id, frames| {
        assert!(found.insert(id.to_owned(), frames).is_none(), "{id} comes twice");
        Ok::<_, StoreError>(())
    });
    visited.unwrap_or_else(|e| panic!("{}", chain(&e)));
    found
}

#[test]
fn items_longer_than_a_row_group_stay_whole_and_in_order() {
    let Backend { location, .. } = &backends("long").swap_remove(0);
    // A row group has 65,536 frames.
    let long = frames(70_001, 7.0);
    commit_motion(location, &[("b", frames(5, 1.0)), ("m", long.clone()), ("z", frames(3, 2.0))]);
    commit_motion(location, &[("a", frames(40_000, 3.0)), ("b", frames(9, 4.0))]);
    commit_motion(location, &[("c", frames(30_000, 5.0))]);
    let before = all_frames(location);
    assert_eq!((before["b"].nrows(), &before["m"]), (9, &long));
    let done = compacted(location);
    assert_eq!((done.n_parts_old, done.n_parts_new), (3, 1), "{done:?}");
    assert_eq!(done.n_rows, 70_001 + 3 + 40_000 + 9 + 30_000);
    assert!(all_frames(location) == before);
    vacuum(location, Duration::ZERO, false).expect("removed");
    assert!(all_frames(location) == before);
}

#[test]
fn whoever_commits_meanwhile_is_not_outranked() {
    let Backend { location, .. } = &backends("meanwhile").swap_remove(0);
    commit(location, &Ledger::default(), &[("a", "1"), ("b", "1")]);
    commit(location, &ledger(location), &[("a", "2")]);
    // Who reads before and writes after a compaction.
    let before = ledger(location);
    compacted(location);
    commit(location, &before, &[("a", "3")]);
    let expected = [("a", "3"), ("b", "1")].map(|(id, m)| (id.to_owned(), m.to_owned()));
    assert_eq!(visible(&snapshot(location)), expected);
    // A compaction of what was there before the last commit, as a slow one would write it.
    let late = backends("late").swap_remove(0).location;
    commit(&late, &Ledger::default(), &[("a", "1"), ("b", "1")]);
    commit(&late, &ledger(&late), &[("a", "2")]);
    compacted(&late);
    let manifest = paths(&late, "commits").into_iter().find(|path| {
        String::from_utf8_lossy(&late.read(path).expect("a manifest")).contains("\"compacted\"")
    });
    let manifest = manifest.expect("a compaction");
    let part = all_parts(&late).pop().expect("a part");
    commit(location, &ledger(location), &[("b", "4")]);
    for path in [&part, &manifest] {
        put(location, path, &late.read(path).expect("an object"));
    }
    let expected = [("a", "3"), ("b", "4")].map(|(id, m)| (id.to_owned(), m.to_owned()));
    assert_eq!(visible(&snapshot(location)), expected);
}

#[test]
fn commits_compactions_and_vacuums_race_and_nothing_is_lost() {
    for backend in &backends("raced-compaction")[..2] {
        let location = &backend.location;
        let is_done = std::sync::atomic::AtomicBool::new(false);
        let is_done = &is_done;
        let order = std::sync::atomic::Ordering::SeqCst;
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| {
                    while !is_done.load(order) {
                        match compact(location, false, &|_, _| false) {
                            // What it read was written anew by the other, and removed.
                            Ok(_)
                            | Err(StoreError::Parquet { .. } | StoreError::NotFound { .. }) => {}
                            Err(e) => panic!("{}", chain(&e)),
                        }
                    }
                });
            }
            scope.spawn(|| {
                while !is_done.load(order) {
                    // Older than any look at the store takes.
                    vacuum(location, Duration::from_millis(1500), false).ok();
                    std::thread::sleep(Duration::from_millis(20));
                }
            });
            let writers: Vec<_> = (0..2)
                .map(|writer| {
                    scope.spawn(move || {
                        for round in 0..90 {
                            let ids: Vec<String> =
                                (0..3).map(|i| format!("w{writer} {}", (round + i) % 7)).collect();
                            let message = format!("round {round}");
                            let outcomes: Vec<_> =
                                ids.iter().map(|id| (id.as_str(), message.as_str())).collect();
                            commit(location, &ledger(location), &outcomes);
                            std::thread::sleep(Duration::from_millis(25));
                        }
                    })
                })
                .collect();
            for writer in writers {
                writer.join().expect("a writer");
            }
            is_done.store(true, order);
        });
        // The last word on each of the seven names that each writer wrote in turn.
        let mut expected = Vec::new();
        for writer in 0..2 {
            for name in 0..7 {
                let last = (0..90).rev().find(|round| (0..3).any(|i| (round + i) % 7 == name));
                let message = format!("round {}", last.expect("a round"));
                expected.push((format!("w{writer} {name}"), message));
            }
        }
        assert_eq!(visible(&snapshot(location)), expected, "{backend}");
        compacted(location);
        vacuum(location, Duration::ZERO, false).expect("removed");
        assert_eq!(visible(&snapshot(location)), expected, "{backend}");
        assert_eq!(all_parts(location).len(), 1, "{backend}");
    }
}

#[test]
fn parts_of_versions_that_are_not_read_are_left_alone() {
    let Backend { location, .. } = &backends("unknown").swap_remove(0);
    for i in 0..3 {
        commit(location, &Ledger::default(), &[(&format!("i{i}"), "1")]);
    }
    let newer = r#"{"format": 1, "stage": "ingest", "key": "00000000000000000000000000000000",
        "sequence": 0, "program": "p", "params_hash": "h", "origin": "o", "parts": [{"table":
        "failures", "schema_version": 99, "path": "failures/00000000000000000000000000000000.parquet",
        "n_rows": 1, "n_bytes": 3}], "items": [{"id": "x", "fingerprint": "", "input_hash": "h"}]}"#;
    put(location, "commits/ingest/00000000000000000000000000000000.json", newer.as_bytes());
    let done = compacted(location);
    assert_eq!((done.n_parts_old, done.n_parts_new, done.n_unknown), (3, 1, 1));
    let error = Snapshot::take(location, FailureRow::schema()).expect_err("another version");
    assert!(error.to_string().contains("has schema version 99"), "{error}");
}

#[test]
fn files_of_others_and_parts_under_way_stay() {
    let Backend { location, .. } = &backends("others").swap_remove(1);
    for i in 0..3 {
        commit(location, &Ledger::default(), &[(&format!("i{i}"), "1")]);
    }
    compacted(location);
    let under_way = "failures/0123456789abcdef0123456789abcdef.parquet";
    for path in ["failures/mine.parquet", "failures/notes.txt", "notes/a.json", under_way] {
        put(location, path, b"mine");
    }
    let removed = vacuum(location, Duration::ZERO, false).expect("removed");
    assert_eq!(removed.paths.len(), 6, "{removed:?}");
    for path in ["failures/mine.parquet", "failures/notes.txt", "notes/a.json", under_way] {
        assert_eq!(location.read(path).expect(path).as_ref(), b"mine");
    }
    // A day later the part is abandoned.
    let file = location.local_path().expect("a folder").join(under_way);
    let then = std::time::SystemTime::now() - Duration::from_secs(25 * 3600);
    std::fs::File::options()
        .write(true)
        .open(&file)
        .expect("a part")
        .set_modified(then)
        .expect("set");
    let removed = vacuum(location, Duration::ZERO, false).expect("removed");
    assert_eq!(removed.paths, [under_way]);
    assert!(!file.exists());
}

#[test]
fn what_is_forgotten_stays_forgotten() {
    let Backend { location, .. } = &backends("forgotten").swap_remove(0);
    commit(location, &Ledger::default(), &[("a", "1"), ("b", "1")]);
    let mut forget = Commit::new(location, STAGE, "rules", "source");
    forget.settle(Item::forgotten("a"), &ledger(location));
    forget.publish().expect("published");
    compacted(location);
    vacuum(location, Duration::ZERO, false).expect("removed");
    assert_eq!(visible(&snapshot(location)), [("b".to_owned(), "1".to_owned())]);
    let known = ledger(location);
    assert_eq!(known.get("a").map(|known| known.item.clone()), Some(Item::forgotten("a")));
    // And comes back when it is seen again.
    let mut back = Commit::new(location, STAGE, "rules", "source");
    let part = back.part("failures", FailureRow::schema).expect("a part");
    part.write_rows(&[outcome("a", "2")]).expect("rows");
    back.settle(item("a", "2"), &known);
    back.publish().expect("published");
    assert_eq!(visible(&snapshot(location)).len(), 2);
}
