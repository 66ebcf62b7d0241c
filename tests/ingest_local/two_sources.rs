//! Two sources for one store.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::write_motion;
use crate::support::files::coherent;
use crate::support::{Dir, failures, ingest, motion, phrases, tree};

/// A store with `a` and `b` from a first source, and a second source with another `a` and a `c`.
fn ingested() -> (Dir, PathBuf, PathBuf, PathBuf) {
    let dir = Dir::new();
    let (first, second, store) = (dir.at("first"), dir.at("second"), dir.at("store"));
    write_motion(&first, "a", 31, 1);
    write_motion(&first, "b", 7, 2);
    write_motion(&second, "a", 31, 5);
    write_motion(&second, "c", 11, 6);
    assert_eq!(ingest(&first, &store, &[]).code, 0);
    (dir, first, second, store)
}

fn url(path: &Path) -> String {
    url::Url::from_file_path(path).unwrap().into()
}

#[track_caller]
fn refuses_the_second(first: &Path, second: &Path, store: &Path) {
    let output = ingest(second, store, &[]);
    assert_eq!(output.code, 1, "{output:?}");
    let (rows, frames) = (phrases(store), motion(store));
    assert_eq!(rows.keys().collect::<Vec<_>>(), ["a", "b", "c"]);
    assert_eq!(
        (rows["a"].source.as_str(), rows["c"].source.as_str()),
        (&*url(first), &*url(second))
    );
    assert_eq!((&frames["a"], &frames["c"]), (&coherent(31, 1), &coherent(11, 6)));
    let failures = failures(store);
    let id = format!("a @ {}", url(second));
    assert_eq!(failures.keys().collect::<Vec<_>>(), [&id]);
    let failure = &failures[&id];
    assert_eq!(failure.kind, "duplicate_id");
    assert_eq!(
        failure.message,
        format!(
            "phrase a is in the store already, from {}, with other content; rename it, ingest it \
             into another store, or replace the other one with --force",
            url(first)
        )
    );
    assert_eq!(failure.source, url(&second.join("motion/a/trajectory.npy")));
}

#[test]
fn the_same_name_with_other_content_is_refused_and_the_first_stays() {
    let (_dir, first, second, store) = ingested();
    refuses_the_second(&first, &second, &store);
    let before = tree(&store);
    refuses_the_second(&first, &second, &store);
    assert_eq!(tree(&store), before);
    // The first source goes on as if nothing had happened.
    assert_eq!(ingest(&first, &store, &[]).code, 0);
    write_motion(&first, "a", 30, 1);
    assert_eq!(ingest(&first, &store, &[]).code, 0);
    assert_eq!(motion(&store)["a"], coherent(30, 1));
}

#[test]
fn other_content_of_the_same_size_and_time_is_refused_all_the_same() {
    let (_dir, first, second, store) = ingested();
    let file = |source: &Path| source.join("motion/a/trajectory.npy");
    let modified = std::fs::metadata(file(&first)).unwrap().modified().unwrap();
    let copy = std::fs::File::options().write(true).open(file(&second)).unwrap();
    copy.set_modified(modified).unwrap();
    refuses_the_second(&first, &second, &store);
}

#[test]
fn a_refusal_goes_away_with_its_cause() {
    for same_time in [false, true] {
        let (_dir, first, second, store) = ingested();
        refuses_the_second(&first, &second, &store);
        // The second becomes a copy of the first: there is nothing to choose between.
        write_motion(&second, "a", 31, 1);
        if same_time {
            let file = |source: &Path| source.join("motion/a/trajectory.npy");
            let modified = std::fs::metadata(file(&first)).unwrap().modified().unwrap();
            let copy = std::fs::File::options().write(true).open(file(&second)).unwrap();
            copy.set_modified(modified).unwrap();
        }
        assert_eq!(ingest(&second, &store, &[]).code, 0);
        assert_eq!(failures(&store), BTreeMap::new(), "same time: {same_time}");
        assert_eq!(phrases(&store)["a"].source, url(&first));
        assert_eq!(motion(&store)["a"], coherent(31, 1));
    }
}

#[test]
fn force_replaces_the_first_and_removes_the_refusal() {
    let (_dir, first, second, store) = ingested();
    refuses_the_second(&first, &second, &store);
    assert_eq!(ingest(&second, &store, &["--force"]).code, 0);
    assert_eq!(failures(&store), BTreeMap::new());
    assert_eq!(phrases(&store)["a"].source, url(&second));
    assert_eq!(motion(&store)["a"], coherent(31, 5));
    // Now the first is the one that comes too late.
    assert_eq!(ingest(&first, &store, &[]).code, 1);
    assert_eq!(failures(&store).into_keys().collect::<Vec<_>>(), [format!("a @ {}", url(&first))]);
    assert_eq!(motion(&store)["a"], coherent(31, 5));
}

#[test]
fn equal_content_from_two_sources_is_one_phrase() {
    let (_dir, first, second, store) = ingested();
    write_motion(&second, "a", 31, 1);
    assert_eq!(ingest(&second, &store, &[]).code, 0);
    assert_eq!(phrases(&store).into_keys().collect::<Vec<_>>(), ["a", "b", "c"]);
    assert_eq!(phrases(&store)["a"].source, url(&first));
    assert_eq!(failures(&store), BTreeMap::new());
}
