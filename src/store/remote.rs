//! Objects in remote storage: paths, ranged reads, multipart writes.

use std::path::Path as FsPath;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::path::Path as ObjectPath;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, PutPayload};

use super::location::PutOutcome;

/// Largest object that is sent with one PUT; larger ones go up in parts of this size.
pub const SINGLE_PUT_BYTES: usize = 8 << 20;
/// Parts of one multipart upload that may be under way at once.
const MULTIPART_IN_FLIGHT: usize = 4;
/// Bytes fetched by one ranged GET when a large object is read.
const RANGE_BYTES: u64 = 8 << 20;
/// Times that the creation of an object is repeated when its connection broke, and the pause before
/// the first repetition; the next pauses are longer by as much each.
const BROKEN_PUT_RETRIES: u32 = 4;
const BROKEN_PUT_PAUSE: Duration = Duration::from_millis(100);

/// Joins a `/`-separated path to a prefix; segments are percent-encoded where object_store asks.
pub fn join(prefix: &ObjectPath, path: &str) -> ObjectPath {
    // `parse` keeps a key as the store spells it; only a key that could not have come from a store
    // (an empty segment, `..`) needs encoding.
    let below = ObjectPath::parse(path).unwrap_or_else(|_| ObjectPath::from(path));
    prefix.parts().chain(below.parts()).collect()
}

/// Returns `path` below `prefix`, or `None` when it is not below it.
pub fn relative(prefix: &ObjectPath, path: &ObjectPath) -> Option<String> {
    let rest = path.as_ref().strip_prefix(prefix.as_ref())?;
    Some(rest.trim_start_matches('/').to_owned())
}

pub async fn read_object(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
) -> object_store::Result<Bytes> {
    let size = store.head(path).await?.size;
    read_sized(store, path, size).await
}

/// Reads an object whose size a listing told, in one GET or in ranges of [`RANGE_BYTES`].
pub async fn read_sized(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
    size: u64,
) -> object_store::Result<Bytes> {
    if size <= RANGE_BYTES {
        return store.get(path).await?.bytes().await;
    }
    // Not `get_ranges`, which would join the ranges into one again.
    let mut whole = Vec::with_capacity(size as usize);
    for start in (0..size).step_by(RANGE_BYTES as usize) {
        let end = (start + RANGE_BYTES).min(size);
        whole.extend_from_slice(&store.get_range(path, start..end).await?);
    }
    Ok(Bytes::from(whole))
}

/// Creates an object unless it is there, over connections that may break at any moment.
pub async fn create(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
    bytes: &Bytes,
) -> object_store::Result<PutOutcome> {
    let mut n_broken = 0;
    loop {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        let payload = PutPayload::from_bytes(bytes.clone());
        let error = match store.put_opts(path, payload, options).await {
            Ok(_) => return Ok(PutOutcome::Written),
            Err(object_store::Error::AlreadyExists { .. }) => return Ok(PutOutcome::AlreadyThere),
            Err(error) => error,
        };
        // The store may have acted and its answer been lost; then our bytes are there. The client
        // repeats no request that creates, because only its caller can tell.
        match read_object(store, path).await {
            Ok(there) if there == *bytes => return Ok(PutOutcome::Written),
            Err(object_store::Error::NotFound { .. })
                if is_broken_connection(&error) && n_broken < BROKEN_PUT_RETRIES =>
            {
                n_broken += 1;
                tokio::time::sleep(BROKEN_PUT_PAUSE * n_broken).await;
            }
            _ => return Err(error),
        }
    }
}

/// Returns whether a request failed because its connection did, without an answer of the store.
fn is_broken_connection(error: &object_store::Error) -> bool {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if error.is::<object_store::client::HttpError>() {
            return true;
        }
        cause = error.source();
    }
    false
}

pub async fn upload(
    store: &Arc<dyn ObjectStore>,
    path: &ObjectPath,
    file: &FsPath,
) -> object_store::Result<()> {
    use std::io::Read as _;
    let generic = |source: std::io::Error| object_store::Error::Generic {
        store: "local temporary file",
        source: Box::new(source),
    };
    let mut file = std::fs::File::open(file).map_err(generic)?;
    let upload = store.put_multipart(path).await?;
    let mut writer = object_store::WriteMultipart::new_with_chunk_size(upload, SINGLE_PUT_BYTES);
    let sent = async {
        loop {
            let mut chunk = Vec::with_capacity(SINGLE_PUT_BYTES);
            let mut piece = (&mut file).take(SINGLE_PUT_BYTES as u64);
            if piece.read_to_end(&mut chunk).map_err(generic)? == 0 {
                return writer.wait_for_capacity(0).await;
            }
            writer.wait_for_capacity(MULTIPART_IN_FLIGHT).await?;
            writer.put(Bytes::from(chunk));
        }
    };
    if let Err(e) = sent.await {
        // Parts of an unfinished upload are invisible but stored, and paid for.
        writer.abort().await.ok();
        return Err(e);
    }
    writer.finish().await.map(|_| ())
}
