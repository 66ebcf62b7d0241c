use std::time::Duration;

use super::*;
use crate::store::{Commit, Ledger, compact, vacuum};

const STAGE: &str = "ingest";
const N_ITEMS: usize = 600;

/// Settles all items, and `n_commits` of them again in a commit of its own each, compacts and vacuums; returns what is
/// left.
fn worn(store: &Location, n_commits: usize) -> StageLog {
    let settle = |items: std::ops::Range<usize>, hash: &str, before: &Ledger| {
        let mut commit = Commit::new(store, STAGE, "", "a source");
        for i in items {
            let (id, input_hash) = (format!("item {i:04}"), hash.to_owned());
            let item = Item { id, fingerprint: String::new(), input_hash, failure: None };
            commit.settle(item, before);
        }
        commit.publish().expect("published");
    };
    settle(0..N_ITEMS, "first", &Ledger::default());
    let first = Ledger::read(store, STAGE).expect("a ledger");
    for i in 0..n_commits {
        settle(i..i + 1, "second", &first);
    }
    compact(store, false, &|_, _| false).expect("compacted");
    let removed = vacuum(store, Duration::ZERO, false).expect("vacuumed");
    assert_eq!(removed.paths.len(), n_commits + 1, "{removed:?}");
    StageLog::read(store, STAGE).expect("a log")
}

#[test]
fn readers_of_rows_parse_no_more_for_more_commits_that_settled_them() {
    let parsed = |n_commits: usize| {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Location::local(folder.path()).expect("a store");
        let log = worn(&store, n_commits);
        let catalogue = log.catalogue.as_ref().expect("a catalogue");
        assert_eq!((catalogue.meta.commits.len(), log.newer.len()), (1, 0));
        assert_eq!(log.state().expect("states").len(), 1);
        assert_eq!(log.places().expect("places").n_items(), N_ITEMS);
        assert!(!log.may_have("phrases"));
        let of_rows = catalogue.n_parsed_bytes();
        let mut settled_by: HashMap<String, usize> = HashMap::new();
        log.visit(|word| *settled_by.entry(word.header.key.clone()).or_default() += 1)
            .expect("words");
        assert_eq!(settled_by.len(), n_commits + 1);
        let of_words = catalogue.n_parsed_bytes();
        (of_rows, of_words - of_rows)
    };
    let (once, twice) = (parsed(150), parsed(300));
    // The number of commits has as many digits.
    assert!(once.0 < 1000 && twice.0.abs_diff(once.0) < 10, "{once:?}, {twice:?}");
    assert!(twice.1 < once.1 * 11 / 5 && once.1 > 150 * 32, "{once:?}, {twice:?}");
}
