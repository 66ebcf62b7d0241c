//! What the store promises, on every kind of storage that it opens: memory, a local folder, and
//! `s3://` and `gs://` on loopback.

mod catalogue;
mod commits;
mod compaction;
mod faults;
mod groups;
mod leases;
mod objects;
mod parts;
mod sources;
mod stops;

use std::fmt;
use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use motiongen::store::{ClientOptions, Location, PutOutcome};
use object_store::{BackoffConfig, ObjectStore, RetryConfig};
use tempfile::TempDir;

use crate::servers::gcs_translator::percent_decode;
use crate::servers::{self, Loopback, Scheme};

/// Below which key of its bucket a location lies; encoded in URLs, plain in messages.
const PREFIX: &str = "a folder/ü";

/// One kind of storage with a location that nobody else uses.
struct Backend {
    name: &'static str,
    location: Location,
    remote: Option<Remote>,
    _folder: Option<TempDir>,
}

/// The server behind a remote location.
struct Remote {
    stores: Loopback,
    bucket: String,
}

impl fmt::Display for Backend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

/// Returns an empty location in every kind of storage that this machine can serve.
fn backends(label: &str) -> Vec<Backend> {
    static COUNT: AtomicUsize = AtomicUsize::new(0);
    let name = format!("memory://{label}-{}", COUNT.fetch_add(1, Ordering::Relaxed));
    let memory = Location::open(&name, &ClientOptions::default()).expect("a store in memory");
    let folder = tempfile::tempdir().expect("a temporary folder");
    // The folder itself does not exist yet, as at the first run of a stage.
    let local = Location::local(&folder.path().join(PREFIX)).expect("a local location");
    let mut all = vec![
        Backend { name: "memory", location: memory, remote: None, _folder: None },
        Backend { name: "local", location: local, remote: None, _folder: Some(folder) },
    ];
    all.extend(remote_backends(label, 10));
    all
}

/// Returns an empty location in `s3://` and `gs://`, whose clients try a request again
/// `max_retries` times.
fn remote_backends(label: &str, max_retries: usize) -> Vec<Backend> {
    [("s3", servers::s3()), ("gs", servers::gs())]
        .into_iter()
        .filter_map(|(name, stores)| {
            let stores = stores?;
            let bucket = stores.create_bucket(label);
            let store = client(&stores, &bucket, max_retries);
            let location = Location::with_client(&stores.url(&bucket, PREFIX), store, PREFIX);
            Some(Backend { name, location, remote: Some(Remote { stores, bucket }), _folder: None })
        })
        .collect()
}

/// Returns a client as the store builds it from the environment, but with shorter pauses.
fn client(stores: &Loopback, bucket: &str, max_retries: usize) -> Arc<dyn ObjectStore> {
    let backoff = BackoffConfig {
        init_backoff: Duration::from_millis(3),
        max_backoff: Duration::from_millis(30),
        base: 2.0,
    };
    let retry = RetryConfig { backoff, max_retries, retry_timeout: Duration::from_secs(60) };
    match stores.scheme {
        Scheme::S3 => {
            let builder = stores.s3_builder(bucket).with_retry(retry);
            Arc::new(builder.build().expect("an S3 client"))
        }
        Scheme::Gs => {
            let builder = stores.gcs_builder(bucket).with_retry(retry);
            Arc::new(builder.build().expect("a GCS client"))
        }
    }
}

impl Remote {
    /// Returns the paths below the location of every object that was fetched so far, whole or in
    /// ranges, in the order of the requests.
    fn fetched(&self) -> Vec<String> {
        let folder = format!("/{}/{PREFIX}/", self.bucket);
        let requests = self.stores.requests();
        let gets = requests.iter().filter(|r| r.method == "GET" && !r.target.contains('?'));
        gets.filter_map(|r| Some(percent_decode(&r.target).strip_prefix(&folder)?.to_owned()))
            .collect()
    }
}

/// Returns bytes that do not compress, the same for a seed.
fn noise(n: usize, seed: u64) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut bytes = Vec::with_capacity(n + 8);
    while bytes.len() < n {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        bytes.extend_from_slice(&state.to_le_bytes());
    }
    bytes.truncate(n);
    bytes
}

fn put(location: &Location, path: &str, bytes: &[u8]) -> PutOutcome {
    location
        .put_new(path, Bytes::copy_from_slice(bytes))
        .unwrap_or_else(|e| panic!("{path}: {}", chain(&e)))
}

fn put_file(location: &Location, path: &str, bytes: &[u8]) -> PutOutcome {
    let mut file = location.temporary(path).expect("a temporary file");
    file.write_all(bytes).expect("room for a temporary file");
    location.put_file_new(path, file).unwrap_or_else(|e| panic!("{path}: {}", chain(&e)))
}

fn read(location: &Location, path: &str) -> Vec<u8> {
    location.read(path).unwrap_or_else(|e| panic!("{path}: {}", chain(&e))).to_vec()
}

fn paths(location: &Location, folder: &str) -> Vec<String> {
    let listed = location.list(folder).unwrap_or_else(|e| panic!("{folder}: {}", chain(&e)));
    listed.into_iter().map(|l| l.path).collect()
}

/// Joins an error and its causes.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}
