//! Clients for remote storage: credentials, endpoints, retries, time limits, concurrency.

use std::collections::HashMap;
use std::future::Future;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::azure::{AzureConfigKey, MicrosoftAzureBuilder};
use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey};
use object_store::limit::LimitStore;
use object_store::{BackoffConfig, ClientConfigKey, ObjectStore, RetryConfig};
use url::Url;

use super::counted::{CountedMemory, Traffic};

/// How patiently and how widely a remote store is used.
#[derive(Clone, Debug, PartialEq)]
pub struct ClientOptions {
    /// Requests under way at once.
    pub n_requests: usize,
    /// Time that one request may take, body included, in seconds.
    pub request_timeout_s: f64,
    /// Times that a throttled (429), failed (5xx) or broken request is tried again.
    pub max_retries: usize,
}

impl Default for ClientOptions {
    fn default() -> Self {
        // 32 requests stay below the ramp-up limits of the large providers; a range is 8 MiB, so
        // 60 s is a stall at any useful rate.
        Self { n_requests: 32, request_timeout_s: 60.0, max_retries: 10 }
    }
}

impl ClientOptions {
    fn retry(&self) -> RetryConfig {
        RetryConfig {
            // object_store draws each pause uniformly between the first and `base` times the last
            // one (decorrelated jitter), so that many workers do not return at once.
            backoff: BackoffConfig {
                init_backoff: Duration::from_millis(100),
                max_backoff: Duration::from_secs(15),
                base: 2.0,
            },
            max_retries: self.max_retries,
            retry_timeout: Duration::from_secs(180),
        }
    }

    fn timeout(&self) -> String {
        format!("{} ms", (self.request_timeout_s * 1000.0).round().max(1.0))
    }
}

/// Builds the client of a remote URL; an error is a reason that completes `location "…" …`.
pub(crate) fn build(url: &Url, options: &ClientOptions) -> Result<Arc<dyn ObjectStore>, String> {
    let bucket = url.host_str().unwrap_or_default();
    let needs = |e: object_store::Error| format!("cannot be opened ({e})");
    if bucket.is_empty() {
        return Err(format!("has no bucket or container name after {}://", url.scheme()));
    }
    let (retry, timeout) = (options.retry(), options.timeout());
    let store: Box<dyn ObjectStore> = match url.scheme() {
        "gs" => Box::new(
            GoogleCloudStorageBuilder::from_env()
                .with_bucket_name(bucket)
                .with_retry(retry)
                .with_config(GoogleConfigKey::Client(ClientConfigKey::Timeout), timeout)
                .build()
                .map_err(needs)?,
        ),
        "s3" => {
            let mut builder = AmazonS3Builder::from_env()
                .with_bucket_name(bucket)
                .with_retry(retry)
                .with_config(AmazonS3ConfigKey::Client(ClientConfigKey::Timeout), timeout);
            // Somebody who names an http:// endpoint has chosen it.
            if builder
                .get_config_value(&AmazonS3ConfigKey::Endpoint)
                .is_some_and(|endpoint| endpoint.starts_with("http://"))
            {
                builder = builder.with_allow_http(true);
            }
            Box::new(builder.build().map_err(needs)?)
        }
        "az" => Box::new(
            MicrosoftAzureBuilder::from_env()
                .with_container_name(bucket)
                .with_retry(retry)
                .with_config(AzureConfigKey::Client(ClientConfigKey::Timeout), timeout)
                .build()
                .map_err(needs)?,
        ),
        "memory" => return Ok(memory(bucket)),
        other => return Err(format!("has the unknown scheme {other}://")),
    };
    Ok(Arc::new(LimitStore::new(store, options.n_requests.max(1))))
}

/// Returns the in-process store of that name; every opening of one name sees the same objects.
fn memory(name: &str) -> Arc<CountedMemory> {
    static STORES: OnceLock<Mutex<HashMap<String, Arc<CountedMemory>>>> = OnceLock::new();
    let mut stores = STORES
        .get_or_init(Mutex::default)
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner);
    Arc::clone(stores.entry(name.to_owned()).or_default())
}

/// Returns what was asked so far of the store `memory://NAME` of this process.
pub fn memory_traffic(name: &str) -> Traffic {
    memory(name).counters.traffic()
}

/// Returns the runtime on which all remote requests of the process run.
pub(crate) fn runtime() -> &'static tokio::runtime::Runtime {
    static RUNTIME: OnceLock<tokio::runtime::Runtime> = OnceLock::new();
    RUNTIME.get_or_init(|| {
        tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("store-io")
            .enable_all()
            .build()
            .expect("invariant: the operating system can start two threads")
    })
}

/// Runs one request to its end; the rooms above the store are synchronous.
pub(crate) fn block_on<F: Future>(future: F) -> F::Output {
    runtime().block_on(future)
}
