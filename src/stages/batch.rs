//! Items of a store that are done and committed in batches: what ingest, extract, library and generate share.
//!
//! A stage plans its items, cuts them into batches by the stable hash of their names, does them on the threads of a
//! [`pool`](super::pool), and commits each batch whole: its rows, its failures and the items that it settles.

use super::failure::Failure;
use crate::store::tables::FailureRow;
use crate::store::{
    Commit, Item, Ledger, Location, PartWriter, Row, SettledItem, StoreError, TableSchema,
    TimestampUs,
};

/// Returns how many batches items are cut into: enough for the number of items and for what they weigh.
///
/// A power of two, so that shards in powers of two hold whole batches.
pub fn n_batches(by_count: usize, by_weight: u64) -> u64 {
    (by_count as u64).max(by_weight).max(1).next_power_of_two()
}

/// What the batches of a job share.
#[derive(Clone, Copy)]
pub struct BatchJob<'a> {
    pub store: &'a Location,
    /// Name of the stage, as tables and commits spell it.
    pub stage: &'static str,
    /// Digest of the parameters with which items are settled.
    pub params_hash: &'a str,
    /// Where the items come from, as commits name it.
    pub origin: &'a str,
    /// What was settled before.
    pub ledger: &'a Ledger,
}

impl<'a> BatchJob<'a> {
    /// Returns what is known of an item that was settled with the parameters of this job.
    pub fn known(&self, id: &str) -> Option<&'a SettledItem> {
        self.ledger.get(id).filter(|known| known.params_hash == self.params_hash)
    }

    /// Returns whether an item failed when it was last settled, with whatever parameters.
    pub fn has_failed(&self, id: &str) -> bool {
        self.ledger.get(id).is_some_and(|known| known.item.failure.is_some())
    }

    /// Returns whether the store has rows of an item, made with whatever parameters.
    pub fn has_rows(&self, id: &str) -> bool {
        self.ledger.get(id).is_some_and(|known| known.item.succeeded())
    }

    /// Starts the commit of a batch.
    pub fn start(&self) -> BatchCommit<'a> {
        let commit = Commit::new(self.store, self.stage, self.params_hash, self.origin);
        BatchCommit { job: *self, commit, failures: Vec::new() }
    }

    /// Removes the failures of items that are gone.
    ///
    /// Rows of items that succeeded stay: a store loses no record because a file went away.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn forget_failures(&self, is_gone: impl Fn(&str) -> bool) -> Result<(), StoreError> {
        let mut commit = self.start();
        for id in self.ledger.failed(self.origin).into_iter().filter(|id| is_gone(id)) {
            commit.forget(id);
        }
        commit.publish()
    }
}

/// The commit of a batch: rows, settled items, and the failures among them.
pub struct BatchCommit<'a> {
    job: BatchJob<'a>,
    commit: Commit<'a>,
    failures: Vec<FailureRow>,
}

impl BatchCommit<'_> {
    /// Returns the writer of the batch's part of a table.
    ///
    /// # Errors
    /// [`StoreError`] when no temporary file can be made.
    pub fn part(
        &mut self,
        name: &'static str,
        schema: impl FnOnce() -> TableSchema,
    ) -> Result<&mut PartWriter, StoreError> {
        self.commit.part(name, schema)
    }

    /// Writes the batch's rows of a table, if it has any.
    ///
    /// # Errors
    /// [`StoreError`] of the temporary file.
    pub fn rows<R: Row>(&mut self, rows: &[R]) -> Result<(), StoreError> {
        if rows.is_empty() {
            return Ok(());
        }
        self.commit.part(R::schema().name, R::schema)?.write_rows(rows)
    }

    /// Settles an item, superseding what was known of it. Items come in order of id.
    pub fn settle(&mut self, item: Item) {
        self.commit.settle(item, self.job.ledger);
    }

    /// Takes an item out of the store.
    pub fn forget(&mut self, id: &str) {
        self.settle(Item::forgotten(id));
    }

    /// Lists a failure; `source` is the file or phrase at fault, as the table names it.
    pub fn list_failure(&mut self, id: &str, source: &str, failure: &Failure) {
        self.failures.push(FailureRow {
            stage: self.job.stage.to_owned(),
            phrase_id: id.to_owned(),
            source: source.to_owned(),
            kind: failure.kind.name().to_owned(),
            message: failure.message.clone(),
            time: TimestampUs::now(),
        });
    }

    /// Publishes the batch, whole; one that settles nothing leaves no trace.
    ///
    /// # Errors
    /// [`StoreError`]; nothing of the batch is visible then.
    pub fn publish(mut self) -> Result<(), StoreError> {
        let mut failures = std::mem::take(&mut self.failures);
        // An item may fail under a name that is made from its own and sorts elsewhere.
        failures.sort_by(|a, b| a.phrase_id.cmp(&b.phrase_id));
        self.rows(&failures)?;
        if self.commit.is_empty() { Ok(()) } else { self.commit.publish().map(|_| ()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::failure::FailureKind;
    use crate::store::tables::BeatRow;
    use crate::store::{ClientOptions, StoreSnapshot};

    const STAGE: &str = "test";

    fn item(id: &str, failure: Option<&Failure>) -> Item {
        let failure = failure.map(Failure::digest);
        Item { id: id.to_owned(), fingerprint: "f".to_owned(), input_hash: "i".to_owned(), failure }
    }

    fn beat(id: &str) -> BeatRow {
        BeatRow {
            phrase_id: id.to_owned(),
            beat: 0,
            frame: 3,
            time_s: 0.1,
            number: None,
            source: None,
        }
    }

    fn failed(store: &Location) -> Vec<(String, String, String)> {
        let snapshot = StoreSnapshot::take(store).expect("commits");
        let rows: Vec<FailureRow> =
            snapshot.table(FailureRow::schema()).expect("a table").rows().expect("rows");
        rows.into_iter().map(|row| (row.phrase_id, row.source, row.message)).collect()
    }

    #[test]
    fn batches_are_as_many_as_their_number_or_their_weight_asks_for() {
        for (by_count, by_weight, expected) in
            [(0, 0, 1), (1, 1, 1), (3, 1, 4), (2, 5, 8), (8, 3, 8), (9, 16, 16)]
        {
            assert_eq!(n_batches(by_count, by_weight), expected, "{by_count}, {by_weight}");
        }
    }

    #[test]
    fn a_batch_is_committed_whole_and_its_failures_are_listed_in_order_and_forgotten() {
        let store = Location::open("memory://batches", &ClientOptions::default()).expect("a store");
        let failure = Failure::new(FailureKind::Layout, "b", "b: is no song");
        let ledger = Ledger::default();
        let job = BatchJob {
            store: &store,
            stage: STAGE,
            params_hash: "p",
            origin: "o",
            ledger: &ledger,
        };
        // What settles nothing leaves no trace, whatever was listed.
        let mut commit = job.start();
        commit.list_failure("z", "url", &failure);
        commit.publish().expect("nothing to publish");
        assert_eq!(store.list("").expect("a listing"), []);

        let mut commit = job.start();
        commit.rows(&[beat("a")]).expect("rows");
        commit.rows::<BeatRow>(&[]).expect("no rows");
        commit.settle(item("a", None));
        // Listed in another order than they are settled in.
        commit.list_failure("b @ o", "url of b", &failure);
        commit.list_failure("a @ o", "url of a", &failure);
        commit.settle(item("a @ o", Some(&failure)));
        commit.settle(item("b @ o", Some(&failure)));
        commit.publish().expect("published");
        let row =
            |id: &str| (format!("{id} @ o"), format!("url of {id}"), "b: is no song".to_owned());
        assert_eq!(failed(&store), [row("a"), row("b")]);

        let ledger = Ledger::read(&store, STAGE).expect("commits");
        let job = BatchJob { ledger: &ledger, ..job };
        assert!(job.known("a").is_some_and(|known| known.item == item("a", None)));
        assert!(job.has_rows("a") && !job.has_failed("a") && job.has_failed("b @ o"));
        assert!(!job.has_rows("c") && !job.has_failed("c"));
        // With other parameters an item is not known, but its failure still is one.
        let other = BatchJob { params_hash: "q", ..job };
        assert!(other.known("a").is_none() && other.has_failed("b @ o") && other.has_rows("a"));
        // From elsewhere nothing is forgotten.
        BatchJob { origin: "elsewhere", ..job }.forget_failures(|_| true).expect("nothing to do");
        assert_eq!(failed(&store).len(), 2);
        job.forget_failures(|id| id == "a @ o").expect("published");
        assert_eq!(failed(&store), [row("b")]);
    }
}
