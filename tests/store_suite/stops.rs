//! A commit, a compaction or a vacuum may stop at any of its writes: nothing is lost, and the same work run again completes it.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use futures::future::BoxFuture;
use futures::stream::BoxStream;
use futures::{FutureExt as _, StreamExt as _};
use motiongen::store::{
    Commit, Location, Row as _, StoreError, compact, tables::BeatRow, tables::FailureRow, vacuum,
};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};

use super::catalogue::{StageContents, history};
use super::commits::{STAGE, item, ledger, outcome};
use super::compaction::said;

/// A store in memory that accepts the first writes and refuses all later ones.
#[derive(Debug)]
struct Stopping {
    inner: Arc<InMemory>,
    writes: Arc<Writes>,
}

/// How many writes are accepted, and how many were requested.
#[derive(Debug)]
struct Writes {
    n_allowed: usize,
    n_asked: AtomicUsize,
}

impl Writes {
    fn ask(&self) -> Result<()> {
        if self.n_asked.fetch_add(1, Ordering::Relaxed) < self.n_allowed {
            return Ok(());
        }
        Err(Error::Generic { store: "stopping", source: "it was stopped".into() })
    }

    fn has_stopped(&self) -> bool {
        self.n_asked.load(Ordering::Relaxed) > self.n_allowed
    }
}

impl fmt::Display for Stopping {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

impl ObjectStore for Stopping {
    fn put_opts<'a, 'b, 'c>(
        &'a self,
        location: &'b Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> BoxFuture<'c, Result<PutResult>>
    where
        'a: 'c,
        'b: 'c,
        Self: 'c,
    {
        let asked = self.writes.ask();
        async move {
            asked?;
            self.inner.put_opts(location, payload, options).await
        }
        .boxed()
    }

    fn put_multipart_opts<'a, 'b, 'c>(
        &'a self,
        location: &'b Path,
        options: PutMultipartOptions,
    ) -> BoxFuture<'c, Result<Box<dyn MultipartUpload>>>
    where
        'a: 'c,
        'b: 'c,
        Self: 'c,
    {
        let asked = self.writes.ask();
        async move {
            asked?;
            self.inner.put_multipart_opts(location, options).await
        }
        .boxed()
    }

    fn get_opts<'a, 'b, 'c>(
        &'a self,
        location: &'b Path,
        options: GetOptions,
    ) -> BoxFuture<'c, Result<GetResult>>
    where
        'a: 'c,
        'b: 'c,
        Self: 'c,
    {
        self.inner.get_opts(location, options)
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let writes = Arc::clone(&self.writes);
        let allowed = locations.map(move |path| path.and_then(|path| writes.ask().map(|()| path)));
        self.inner.delete_stream(allowed.boxed())
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    fn list_with_delimiter<'a, 'b, 'c>(
        &'a self,
        prefix: Option<&'b Path>,
    ) -> BoxFuture<'c, Result<ListResult>>
    where
        'a: 'c,
        'b: 'c,
        Self: 'c,
    {
        self.inner.list_with_delimiter(prefix)
    }

    fn copy_opts<'a, 'b, 'c, 'd>(
        &'a self,
        from: &'b Path,
        to: &'c Path,
        options: CopyOptions,
    ) -> BoxFuture<'d, Result<()>>
    where
        'a: 'd,
        'b: 'd,
        'c: 'd,
        Self: 'd,
    {
        let asked = self.writes.ask();
        async move {
            asked?;
            self.inner.copy_opts(from, to, options).await
        }
        .boxed()
    }
}

fn location_of(memory: &Arc<InMemory>) -> Location {
    Location::with_client("memory://stopped", Arc::clone(memory) as Arc<dyn ObjectStore>, "st")
}

type Work = fn(&Location) -> std::result::Result<(), StoreError>;

fn compacts(location: &Location) -> std::result::Result<(), StoreError> {
    compact(location, false, &|_, _| false).map(|_| ())
}

fn vacuums(location: &Location) -> std::result::Result<(), StoreError> {
    vacuum(location, Duration::ZERO, false).map(|_| ())
}

/// Replaces an item in one table, and gives it rows in another.
fn commits(location: &Location) -> std::result::Result<(), StoreError> {
    let mut commit = Commit::new(location, STAGE, "rules", "source");
    commit.part("failures", FailureRow::schema)?.write_rows(&[outcome("i00", "anew")])?;
    let (phrase_id, source) = ("i00".to_owned(), None);
    let beat = BeatRow { phrase_id, beat: 0, frame: 3, time_s: 0.1, number: None, source };
    commit.part("beats", BeatRow::schema)?.write_rows(&[beat])?;
    commit.settle(item("i00", "anew"), &ledger(location));
    commit.publish().map(|_| ())
}

/// Runs `work` on copies of a store and stops it after 0, 1, 2, … writes; returns how many writes it takes in all.
///
/// After every stop a reader sees the store either as it was before or as it is when the work is done. The same work,
/// run again without a stop, ends in the same state as work that never stopped.
fn stopped_everywhere(memory: &InMemory, work: Work) -> usize {
    let whole = Arc::new(memory.fork());
    let before = said(&location_of(&whole));
    work(&location_of(&whole)).expect("nobody stops it");
    let after = said(&location_of(&whole));
    for n_allowed in 0.. {
        let copy = Arc::new(memory.fork());
        let writes = Arc::new(Writes { n_allowed, n_asked: AtomicUsize::new(0) });
        let stopping = Stopping { inner: Arc::clone(&copy), writes: Arc::clone(&writes) };
        let stopping = Location::with_client("memory://stopped", Arc::new(stopping), "st");
        let ended = work(&stopping);
        let location = location_of(&copy);
        let found: StageContents = said(&location);
        assert!(found == before || found == after, "after {n_allowed} writes: {found:?}");
        assert!(
            ended.is_err() || found == after,
            "after {n_allowed} writes it says that it is done"
        );
        if ended.is_err() {
            work(&location).unwrap_or_else(|e| panic!("again after {n_allowed} writes: {e}"));
            assert_eq!(said(&location), after, "again after {n_allowed} writes");
        }
        if !writes.has_stopped() {
            return n_allowed;
        }
    }
    unreachable!("work ends")
}

#[test]
fn a_stop_at_any_write_loses_nothing() {
    for seed in 1..5 {
        let memory = Arc::new(InMemory::new());
        history(&location_of(&memory), 31 * seed, 17);
        // A part, a manifest and a catalogue.
        assert_eq!(stopped_everywhere(&memory, compacts), 3, "seed {seed}");
        assert_eq!(stopped_everywhere(&memory, commits), 3, "seed {seed}");
        compacts(&location_of(&memory)).expect("compacted");
        let n_writes = stopped_everywhere(&memory, vacuums);
        // At least a manifest and a part of each of 17 commits but those that settle nothing new.
        assert!(n_writes > 20, "seed {seed}: {n_writes}");
    }
}
