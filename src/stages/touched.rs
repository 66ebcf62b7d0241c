//! Known content that was seen again under another fingerprint: a file that was only touched is read once.
//!
//! What a commit settles it settles anew, with its rows. So a new fingerprint for old rows has a commit of its own,
//! which has no parts and vouches for the rows of another.

use crate::store::{Commit, Item, Ledger, Location, SettledItem, StoreError, digest_texts};

/// Items whose content a stage has seen again under another fingerprint.
#[derive(Debug)]
pub struct TouchedContent {
    stage: &'static str,
    ledger: Ledger,
}

impl TouchedContent {
    /// Reads what was seen again, as commits of `stage` have it.
    ///
    /// # Errors
    /// [`StoreError`] when commits cannot be read.
    pub fn read(store: &Location, stage: &'static str) -> Result<Self, StoreError> {
        Ok(Self { stage, ledger: Ledger::read(store, stage)? })
    }

    /// Returns whether the content of a settled item was seen at `origin` under a fingerprint.
    pub fn has(&self, known: &SettledItem, origin: &str, fingerprint: &str) -> bool {
        let item = item(known, origin, fingerprint);
        self.ledger.get(&item.id).is_some_and(|seen| seen.item == item)
    }

    /// Starts a commit of items that were seen again.
    pub fn start<'a>(&self, store: &'a Location, origin: &str) -> Commit<'a> {
        Commit::new(store, self.stage, "", origin)
    }

    /// Vouches that the content of a settled item lies at `origin` under a fingerprint.
    pub fn settle(
        &self,
        known: &SettledItem,
        origin: &str,
        fingerprint: &str,
        commit: &mut Commit<'_>,
    ) {
        if !self.has(known, origin, fingerprint) {
            commit.settle(item(known, origin, fingerprint), &self.ledger);
        }
    }
}

/// Returns the item that vouches: its digest is of what was settled and of where it was seen.
fn item(known: &SettledItem, origin: &str, fingerprint: &str) -> Item {
    let settled = &known.item;
    let texts = [settled.input_hash.as_str(), &known.params_hash, origin, fingerprint];
    Item {
        id: format!("{} @ {origin}", settled.id),
        fingerprint: fingerprint.to_owned(),
        input_hash: digest_texts(texts)[..32].to_owned(),
        failure: None,
    }
}
