//! Ledgers: what a store knows of one stage's items.

use std::collections::HashMap;
use std::ops::Deref;
use std::sync::Arc;

use super::StoreError;
use super::location::Location;
use super::manifest::{Header, Item, Manifest};
use super::stage_log::StageLog;

/// The settled items of one stage in a store.
#[derive(Debug, Default)]
pub struct Ledger {
    /// Sorted by id: of a million items a list takes half the memory of a map that repeats their ids.
    settled: Vec<SettledItem>,
    /// Items that were settled since, which take precedence.
    added: HashMap<String, SettledItem>,
}

/// The latest settlement of an item, with the header of the commit that settled it.
#[derive(Clone, Debug)]
pub struct SettledItem {
    pub item: Item,
    header: Arc<Header>,
}

impl Deref for SettledItem {
    type Target = Header;

    fn deref(&self) -> &Header {
        &self.header
    }
}

impl Ledger {
    /// Reads what `stage` has committed in `store`.
    ///
    /// # Errors
    /// [`StoreError`] when commits cannot be read.
    pub fn read(store: &Location, stage: &str) -> Result<Self, StoreError> {
        Self::of(&StageLog::read(store, stage)?)
    }

    pub(super) fn of(log: &StageLog) -> Result<Self, StoreError> {
        Self::of_items(log, |_| true)
    }

    /// Reads what a stage has committed of the items that `is_wanted` names; the others take no memory.
    pub(super) fn of_items(
        log: &StageLog,
        is_wanted: impl Fn(&str) -> bool,
    ) -> Result<Self, StoreError> {
        let mut ledger = Self::default();
        let mut headers: HashMap<Header, Arc<Header>> = HashMap::new();
        log.visit(|word| {
            if !is_wanted(&word.item.id) {
                return;
            }
            let header = match headers.get(word.header) {
                Some(header) => Arc::clone(header),
                None => {
                    let header = Arc::new(word.header.clone());
                    headers.insert(word.header.clone(), Arc::clone(&header));
                    header
                }
            };
            ledger.settled.push(SettledItem { item: word.item, header });
        })?;
        // A log that was read again says everything twice; the later word replaces the same word.
        ledger.settled.reverse();
        ledger.settled.sort_by(|a, b| a.item.id.cmp(&b.item.id));
        ledger.settled.dedup_by(|later, first| later.item.id == first.item.id);
        Ok(ledger)
    }

    /// Adds what a commit settles, which was made with this ledger.
    pub(super) fn add(&mut self, manifest: &Manifest) {
        let headers: Vec<_> = manifest.headers().into_iter().map(Arc::new).collect();
        for (i, item) in manifest.items.iter().enumerate() {
            let header = Arc::clone(&headers[manifest.header_of(i)]);
            self.added.insert(item.id.clone(), SettledItem { item: item.clone(), header });
        }
    }

    /// Returns the items from `origin` that failed last time, in order of id.
    pub fn failed(&self, origin: &str) -> Vec<&str> {
        let failed = |s: &&SettledItem| s.item.failure.is_some() && s.origin == origin;
        let mut ids: Vec<_> = self.iter().filter(failed).map(|s| s.item.id.as_str()).collect();
        ids.sort_unstable();
        ids
    }

    /// Returns the items that anything is known of, in no order.
    pub fn ids(&self) -> impl Iterator<Item = &str> {
        self.iter().map(|settled| settled.item.id.as_str())
    }

    /// Returns the latest word on an item.
    pub fn get(&self, id: &str) -> Option<&SettledItem> {
        let before = || {
            let place =
                self.settled.binary_search_by(|known| known.item.id.as_str().cmp(id)).ok()?;
            self.settled.get(place)
        };
        self.added.get(id).or_else(before)
    }

    /// Returns the latest word on every item, in no order.
    pub fn iter(&self) -> impl Iterator<Item = &SettledItem> {
        let is_latest = |known: &&SettledItem| !self.added.contains_key(&known.item.id);
        self.settled.iter().filter(is_latest).chain(self.added.values())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::{Commit, StoreSnapshot, checkpoint};

    #[test]
    fn a_ledger_of_some_items_says_of_them_what_the_whole_one_says() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Location::local(folder.path()).expect("a store");
        for (n, ids) in [(0, ["a", "b", "c"]), (1, ["b", "d", "e"])] {
            let before = Ledger::read(&store, "ingest").expect("a ledger");
            let mut commit = Commit::new(&store, "ingest", "", "");
            for id in ids {
                let (id, input_hash) = (id.to_owned(), format!("{id}{n}"));
                let item = Item { id, fingerprint: String::new(), input_hash, failure: None };
                commit.settle(item, &before);
            }
            commit.publish().expect("published");
        }
        let known_of = |snapshot: &StoreSnapshot| {
            let ledger = snapshot.ledger_where("ingest", |id| id > "a" && id < "e").expect("read");
            let mut known: Vec<String> = ledger.iter().map(|s| s.item.input_hash.clone()).collect();
            known.sort();
            assert!(ledger.get("a").is_none() && ledger.get("b").is_some());
            known
        };
        let expected = ["b1", "c0", "d1"];
        assert_eq!(known_of(&StoreSnapshot::take(&store).expect("manifests")), expected);
        checkpoint(&store, &["ingest"]);
        assert_eq!(known_of(&StoreSnapshot::take(&store).expect("a catalogue")), expected);
    }
}
