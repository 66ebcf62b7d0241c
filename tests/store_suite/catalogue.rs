//! Catalogues say what the manifests say, are read in place of them, and are never needed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use motiongen::store::{
    Commit, Item, Ledger, Location, PutOutcome, Row as _, StoreSnapshot, checkpoint,
    tables::FailureRow,
};

use super::{Backend, backends, chain, paths, put, read};
use crate::store_suite::commits::{STAGE, commit, item, ledger, outcome, snapshot, visible};

/// Everything that readers see of a stage.
#[derive(Debug, PartialEq)]
pub(super) struct StageContents {
    pub rows: Vec<(String, String)>,
    pub items: BTreeMap<String, (Item, String, u64)>,
    pub parts: Vec<(String, Vec<String>)>,
}

pub(super) fn contents_of(location: &Location) -> StageContents {
    let taken = StoreSnapshot::take(location).unwrap_or_else(|e| panic!("{}", chain(&e)));
    let ledger = taken.ledger(STAGE).expect("a ledger");
    let items = ledger.ids().map(|id| {
        let known = ledger.get(id).expect("an item");
        (id.to_owned(), (known.item.clone(), known.key.clone(), known.sequence))
    });
    let items: BTreeMap<_, _> = items.collect();
    // One item at a time sees what all together see.
    for (id, (item, ..)) in &items {
        let rows: Vec<FailureRow> = taken.item(id).and_then(|i| i.rows()).expect("rows");
        let messages: Vec<_> = rows.iter().map(|row| row.message.as_str()).collect();
        assert_eq!(messages, item.failure.as_deref().into_iter().collect::<Vec<_>>(), "{id}");
    }
    let live = taken.live_parts().expect("parts").remove("failures").unwrap_or_default();
    let parts = live.into_iter().map(|live| {
        let mut dead = live.superseded.to_vec();
        dead.sort();
        (live.part.path, dead)
    });
    StageContents { rows: visible(&snapshot(location)), items, parts: parts.collect() }
}

/// Commits that know of each other or not, some of them forgetting, in an order that `seed` decides.
pub(super) fn history(location: &Location, seed: u64, n: usize) {
    let mut state = seed | 1;
    let mut random = |n: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state % n
    };
    let mut known = Ledger::default();
    for round in 0..n {
        if random(3) > 0 {
            known = ledger(location);
        }
        let mut commit = Commit::new(location, STAGE, &format!("rules {}", random(3)), "source");
        let first = random(23);
        let ids: Vec<String> = (first..first + 1 + random(5)).map(|i| format!("i{i:02}")).collect();
        let is_forgetting = random(7) == 0;
        if is_forgetting {
            ids.iter().for_each(|id| commit.settle(Item::forgotten(id), &known));
        } else {
            let message = |id: &str| format!("{id} of {seed} {round}");
            let rows: Vec<_> = ids.iter().map(|id| outcome(id, &message(id))).collect();
            let part = commit.part("failures", FailureRow::schema).expect("a temporary file");
            part.write_rows(&rows).expect("rows");
            ids.iter().for_each(|id| commit.settle(item(id, &message(id)), &known));
        }
        commit.publish().unwrap_or_else(|e| panic!("{}", chain(&e)));
    }
}

fn catalogues(location: &Location) -> Vec<String> {
    paths(location, "catalogue")
}

fn without_catalogues(location: &Location) {
    for path in catalogues(location) {
        location.remove(&path).expect("removed");
    }
}

#[test]
fn a_catalogue_says_what_the_manifests_say() {
    for seed in 1..9 {
        let Backend { location, .. } = &backends("catalogued").swap_remove(seed as usize % 2);
        let mut n_catalogues = 0;
        for round in 0..5 {
            // The last round leaves manifests that no catalogue covers.
            history(location, seed * 100 + round, if round < 4 { 17 } else { 5 });
            if round < 4 {
                checkpoint(location, &[STAGE]);
            }
            let with = contents_of(location);
            n_catalogues = n_catalogues.max(catalogues(location).len());
            let kept: Vec<_> = catalogues(location)
                .into_iter()
                .map(|path| (path.clone(), read(location, &path)))
                .collect();
            without_catalogues(location);
            assert_eq!(with, contents_of(location), "seed {seed}, round {round}");
            for (path, bytes) in kept {
                put(location, &path, &bytes);
            }
        }
        assert_eq!(n_catalogues, 2, "the last two are kept");
    }
}

#[test]
fn manifests_that_a_catalogue_covers_are_not_read() {
    for backend in &backends("covered") {
        let location = &backend.location;
        history(location, 5, 16);
        checkpoint(location, &[STAGE]);
        commit(location, &ledger(location), &[("last", "1")]);
        assert_eq!(catalogues(location).len(), 1, "{backend}");
        let Some(remote) = &backend.remote else { continue };
        let before = remote.fetched().len();
        let items = ledger(location).ids().count();
        let fetched = remote.fetched().split_off(before);
        let manifests = fetched.iter().filter(|path| path.starts_with("commits/")).count();
        assert_eq!(manifests, 1, "{backend}: {fetched:?}");
        assert!(fetched.len() <= 4 && items > 9, "{backend}: {fetched:?}");
    }
}

#[test]
fn few_commits_have_no_catalogue() {
    let Backend { location, .. } = &backends("few").swap_remove(0);
    history(location, 3, 15);
    checkpoint(location, &[STAGE, "train"]);
    assert_eq!(catalogues(location), [""; 0]);
}

#[test]
fn a_catalogue_that_is_damaged_or_of_others_is_passed_over() {
    let Backend { location, .. } = &backends("damaged").swap_remove(0);
    history(location, 11, 20);
    let expected = contents_of(location);
    checkpoint(location, &[STAGE]);
    let path = catalogues(location).pop().expect("a catalogue");
    let bytes = read(location, &path);
    let replace = |bytes: &[u8]| {
        location.remove(&path).expect("removed");
        put(location, &path, bytes);
    };
    for cut in [0, 1, 7, bytes.len() / 2, bytes.len() - 1] {
        replace(&bytes[..cut]);
        assert_eq!(contents_of(location), expected, "cut at {cut}");
    }
    // A list of commits that reads well and says something else.
    let position = |text: &[u8]| bytes.windows(text.len()).position(|window| window == text);
    let (headers, list) = (position(b"{\"runs\":["), position(b"{\"format\":2,"));
    let (headers, list) = headers.zip(list).expect("the commits that settled items, and a list");
    assert!(headers < list, "a reader of rows would parse them");
    for place in (headers..headers + 600).chain(list..bytes.len() - 200).step_by(37) {
        let mut flipped = bytes.clone();
        flipped[place] ^= 0x10;
        replace(&flipped);
        assert_eq!(contents_of(location), expected, "byte {place} of {}", bytes.len());
    }
    // A catalogue of another stage, under a higher number.
    replace(&bytes);
    let other = "catalogue/train/00000009-0123456789abcdef.parquet";
    assert_eq!(put(location, other, &bytes), PutOutcome::Written);
    let mut train = Commit::new(location, "train", "", "run");
    train.settle(item("run/0", "1"), &Ledger::default());
    train.publish().expect("published");
    let ids: Vec<String> =
        Ledger::read(location, "train").expect("a ledger").ids().map(str::to_owned).collect();
    assert_eq!(ids, ["run/0"]);
    assert_eq!(contents_of(location), expected);
}

#[test]
fn a_manifest_that_somebody_removed_counts_no_more() {
    let Backend { location, .. } = &backends("removed").swap_remove(1);
    for i in 0..20 {
        commit(location, &Ledger::default(), &[(&format!("i{i}"), "1")]);
    }
    checkpoint(location, &[STAGE]);
    assert_eq!(visible(&snapshot(location)).len(), 20);
    let manifest = paths(location, "commits").swap_remove(7);
    location.remove(&manifest).expect("removed");
    assert_eq!(visible(&snapshot(location)).len(), 19);
    assert_eq!(ledger(location).ids().count(), 19);
}

#[test]
fn whoever_comes_by_may_write_it_at_the_same_time() {
    for backend in &backends("raced") {
        let location = &backend.location;
        history(location, 21, 24);
        let expected = contents_of(location);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| checkpoint(location, &[STAGE]));
            }
        });
        assert!(!catalogues(location).is_empty(), "{backend}");
        assert_eq!(contents_of(location), expected, "{backend}");
    }
}

#[test]
fn a_catalogue_in_the_layout_of_0_2_is_read_and_carried_on() {
    const INGEST: &str = "ingest";
    let Backend { location, .. } = &backends("layout-of-0-2").swap_remove(0);
    let golden = Location::local(Path::new("tests/golden/catalogue_1")).expect("a location");
    for path in paths(&golden, "commits") {
        put(location, &path, &read(&golden, &path));
    }
    let words = || {
        let ledger = Ledger::read(location, INGEST).expect("a ledger");
        let words = ledger.iter().map(|known| {
            let header = (known.key.clone(), known.sequence, known.origin.clone());
            (known.item.id.clone(), known.item.input_hash.clone(), header)
        });
        words.collect::<BTreeSet<_>>()
    };
    let of_manifests = words();
    let commits: BTreeSet<_> = of_manifests.iter().map(|(_, _, header)| &header.0).collect();
    assert_eq!((of_manifests.len(), commits.len()), (5, 3), "{of_manifests:?}");
    // Manifests that nobody can read are not missed by who reads the catalogue.
    for path in paths(location, "commits") {
        location.remove(&path).expect("removed");
        put(location, &path, b"damaged");
    }
    assert!(Ledger::read(location, INGEST).is_err());
    for path in paths(&golden, "catalogue") {
        put(location, &path, &read(&golden, &path));
    }
    assert_eq!(words(), of_manifests);
    // One of them is settled again, and the next catalogue is of the present layout.
    for i in 0..16 {
        let before = Ledger::read(location, INGEST).expect("a ledger");
        let mut commit = Commit::new(location, INGEST, "", "another source");
        commit.settle(item("phrase_0000003", &format!("{i}")), &before);
        commit.publish().expect("published");
    }
    let expected = words();
    assert_eq!((expected.len(), expected.difference(&of_manifests).count()), (5, 1));
    checkpoint(location, &[INGEST]);
    let newest = catalogues(location).pop().expect("a catalogue");
    let is_in_layout = |path: &str, text: &[u8]| {
        read(location, path).windows(text.len()).any(|window| window == text)
    };
    assert!(newest.contains("/00000002-") && is_in_layout(&newest, b"{\"format\":2,"), "{newest}");
    assert_eq!(words(), expected);
}
