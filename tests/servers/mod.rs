//! Object stores on loopback: `s3://` from moto, `gs://` from the same moto behind a translator.
//!
//! ```ignore
//! let Some(stores) = servers::gs() else { return };
//! let bucket = stores.create_bucket("ingest");
//! stores.env().apply(&mut command);
//! command.args(["ingest", "--source", &stores.url(&bucket, "music/")]);
//! stores.inject(Faults { too_many_requests_first: 1, ..Faults::default() });
//! ```
//!
//! Nothing here reaches beyond loopback or reads the user's credentials.

// Each program that includes this module uses another part of it.
#![allow(dead_code)]

pub mod faults;
pub mod gcs_translator;
pub mod http;
pub mod moto;

use faults::{Faults, Front};
use gcs_translator::GcsTranslator;
use http::{Exchange, Proxy, Request, Service};
use moto::Moto;
use object_store::ObjectStore;
use object_store::aws::AmazonS3Builder;
use object_store::gcp::GoogleCloudStorageBuilder;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

const REGION: &str = "us-east-1";
const KEY: &str = "loopback";
const SERVICE_ACCOUNT: &str = "service-account.json";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheme {
    S3,
    Gs,
}

/// A store with its own address, so that its record of requests and its faults are one test's own.
pub struct Loopback {
    pub scheme: Scheme,
    moto: &'static Moto,
    front: Arc<Front>,
    proxy: Proxy,
    directory: tempfile::TempDir,
}

/// An S3 store, or `None` where moto is missing; see [`moto::moto`].
pub fn s3() -> Option<Loopback> {
    Loopback::start(Scheme::S3)
}

/// A Google Cloud Storage store, or `None` where moto is missing; see [`moto::moto`].
pub fn gs() -> Option<Loopback> {
    Loopback::start(Scheme::Gs)
}

/// Hands S3 requests on unchanged.
struct PassThrough;

impl Service for PassThrough {
    fn serve(&self, exchange: &mut Exchange<'_>) -> io::Result<()> {
        exchange.forward(|_| {})
    }
}

impl Loopback {
    fn start(scheme: Scheme) -> Option<Self> {
        let moto = moto::moto()?;
        let dialect: Box<dyn Service> = match scheme {
            Scheme::S3 => Box::new(PassThrough),
            Scheme::Gs => Box::new(GcsTranslator::default()),
        };
        let front = Arc::new(Front::new(dialect));
        let proxy = Proxy::start(moto.address, front.clone()).expect("a port on loopback");
        let directory = tempfile::tempdir().expect("a directory for the service-account file");
        let stores = Self { scheme, moto, front, proxy, directory };
        stores
            .write_service_account(stores.directory.path())
            .expect("the service-account file is written");
        Some(stores)
    }

    /// Creates an empty bucket and returns its name, which starts with `label`: lower-case letters,
    /// digits and hyphens, at most 24 of them.
    pub fn create_bucket(&self, label: &str) -> String {
        self.moto.create_bucket(label)
    }

    pub fn create_named_bucket(&self, name: &str) {
        self.moto.create_named_bucket(name);
    }

    /// `s3://bucket/key` or `gs://bucket/key`.
    pub fn url(&self, bucket: &str, key: &str) -> String {
        match self.scheme {
            Scheme::S3 => format!("s3://{bucket}/{key}"),
            Scheme::Gs => format!("gs://{bucket}/{key}"),
        }
    }

    /// The address that clients are given, without a slash at its end.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.proxy.address)
    }

    /// The address of moto itself, behind the proxy.
    pub fn s3_server(&self) -> String {
        format!("http://{}", self.moto.address)
    }

    /// The environment with which another process reaches this store.
    pub fn env(&self) -> Env {
        let pairs = match self.scheme {
            Scheme::S3 => vec![
                ("AWS_ACCESS_KEY_ID", KEY.to_owned()),
                ("AWS_SECRET_ACCESS_KEY", KEY.to_owned()),
                ("AWS_REGION", REGION.to_owned()),
                ("AWS_ENDPOINT", self.endpoint()),
                ("AWS_ALLOW_HTTP", "true".to_owned()),
            ],
            Scheme::Gs => {
                let file = self.directory.path().join(SERVICE_ACCOUNT);
                vec![("GOOGLE_SERVICE_ACCOUNT", file.display().to_string())]
            }
        };
        let mut env = Env(pairs.into_iter().map(|(k, v)| (k.to_owned(), v)).collect());
        env.set("AWS_EC2_METADATA_DISABLED", "true");
        env.set("NO_PROXY", "127.0.0.1,localhost");
        env
    }

    /// A client inside this process, with nothing taken from the environment.
    pub fn client(&self, bucket: &str) -> Arc<dyn ObjectStore> {
        match self.scheme {
            Scheme::S3 => Arc::new(self.s3_builder(bucket).build().expect("an S3 client")),
            Scheme::Gs => Arc::new(self.gcs_builder(bucket).build().expect("a GCS client")),
        }
    }

    /// # Panics
    /// On a `gs://` store, whose address does not speak S3.
    pub fn s3_builder(&self, bucket: &str) -> AmazonS3Builder {
        assert_eq!(self.scheme, Scheme::S3, "this store speaks another dialect");
        AmazonS3Builder::new()
            .with_endpoint(self.endpoint())
            .with_allow_http(true)
            .with_region(REGION)
            .with_access_key_id(KEY)
            .with_secret_access_key(KEY)
            .with_bucket_name(bucket)
    }

    /// # Panics
    /// On an `s3://` store, whose address does not speak the API of Google Cloud Storage.
    pub fn gcs_builder(&self, bucket: &str) -> GoogleCloudStorageBuilder {
        assert_eq!(self.scheme, Scheme::Gs, "this store speaks another dialect");
        GoogleCloudStorageBuilder::new()
            .with_service_account_key(self.service_account_json())
            .with_bucket_name(bucket)
    }

    /// Replaces the faults; `Faults::default()` ends them.
    pub fn inject(&self, faults: Faults) {
        self.front.inject(faults);
    }

    /// Faults injected since [`Loopback::inject`]. Delays do not count.
    pub fn injected(&self) -> usize {
        self.front.injected()
    }

    /// Every request that clients sent to this store so far, faults included.
    pub fn requests(&self) -> Vec<Request> {
        self.front.requests()
    }

    /// The key file that replaces Google's address by this store's and asks for no token.
    pub fn service_account_json(&self) -> String {
        format!(
            "{{\"gcs_base_url\":\"{}\",\"disable_oauth\":true,\
             \"client_email\":\"\",\"private_key\":\"\",\"private_key_id\":\"\"}}",
            self.endpoint()
        )
    }

    /// Writes the key file that [`Loopback::env`] names into another directory too.
    pub fn write_service_account(&self, directory: &Path) -> io::Result<PathBuf> {
        let path = directory.join(SERVICE_ACCOUNT);
        std::fs::write(&path, self.service_account_json())?;
        Ok(path)
    }
}

/// Environment variables for another process.
#[derive(Clone, Debug, Default)]
pub struct Env(pub Vec<(String, String)>);

impl Env {
    pub fn set(&mut self, name: &str, value: &str) {
        self.0.retain(|(key, _)| key != name);
        self.0.push((name.to_owned(), value.to_owned()));
    }

    /// Both stores at once, for a job that reads from one and writes to the other.
    pub fn and(mut self, other: &Self) -> Self {
        other.0.iter().for_each(|(name, value)| self.set(name, value));
        self
    }

    /// Sets the variables, and removes whatever cloud configuration the tests were started with.
    pub fn apply(&self, command: &mut Command) {
        for (name, _) in std::env::vars_os() {
            let ambient = name.to_str().is_some_and(|name| {
                let name = name.to_ascii_uppercase();
                ["AWS_", "GOOGLE_", "AZURE_"].iter().any(|prefix| name.starts_with(prefix))
            });
            if ambient {
                command.env_remove(name);
            }
        }
        command.envs(self.0.iter().map(|(name, value)| (name, value)));
    }
}
