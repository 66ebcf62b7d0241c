//! Stores in memory that count what is asked of them, so that tests and embedders see what work costs.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use futures::{FutureExt as _, StreamExt as _};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};

/// Requests to a store so far, and the bytes that they read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    pub n_requests: u64,
    pub read_bytes: u64,
}

/// Requests that were counted.
#[derive(Debug, Default)]
pub(super) struct Counters {
    n_requests: AtomicU64,
    read_bytes: AtomicU64,
}

impl Counters {
    pub fn traffic(&self) -> Traffic {
        Traffic {
            n_requests: self.n_requests.load(Ordering::Relaxed),
            read_bytes: self.read_bytes.load(Ordering::Relaxed),
        }
    }

    fn request(&self) {
        self.n_requests.fetch_add(1, Ordering::Relaxed);
    }
}

/// A store in memory whose requests are counted.
#[derive(Debug, Default)]
pub(super) struct CountedMemory {
    inner: InMemory,
    pub counters: Arc<Counters>,
}

impl fmt::Display for CountedMemory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

/// Keys of a page of a listing, as object stores have it.
const PAGE_KEYS: u64 = 1000;

impl ObjectStore for CountedMemory {
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
        self.counters.request();
        self.inner.put_opts(location, payload, options)
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
        self.counters.request();
        self.inner.put_multipart_opts(location, options)
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
        self.counters.request();
        let is_head = options.head;
        let got = self.inner.get_opts(location, options);
        async move {
            let got = got.await?;
            if !is_head {
                let n_bytes = got.range.end - got.range.start;
                self.counters.read_bytes.fetch_add(n_bytes, Ordering::Relaxed);
            }
            Ok(got)
        }
        .boxed()
    }

    fn get_ranges<'a, 'b, 'c, 'd>(
        &'a self,
        location: &'b Path,
        ranges: &'c [Range<u64>],
    ) -> BoxFuture<'d, Result<Vec<Bytes>>>
    where
        'a: 'd,
        'b: 'd,
        'c: 'd,
        Self: 'd,
    {
        // As the clients of buckets do it, which join ranges that lie near each other.
        object_store::coalesce_ranges(
            ranges,
            move |range| object_store::ObjectStoreExt::get_range(self, location, range),
            object_store::OBJECT_STORE_COALESCE_DEFAULT,
        )
        .boxed()
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let counters = Arc::clone(&self.counters);
        let locations = locations.inspect(move |_| counters.request()).boxed();
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let counters = Arc::clone(&self.counters);
        counters.request();
        let listed = self.inner.list(prefix).enumerate();
        listed
            .map(move |(i, meta)| {
                if i > 0 && (i as u64).is_multiple_of(PAGE_KEYS) {
                    counters.request();
                }
                meta
            })
            .boxed()
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
        self.counters.request();
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
        self.counters.request();
        self.inner.copy_opts(from, to, options)
    }
}
