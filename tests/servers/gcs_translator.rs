//! The XML API of Google Cloud Storage on top of an S3 server.
//!
//! The two dialects share their documents and differ in headers: `x-goog-…` for `x-amz-…`,
//! generations for entity tags, and a deletion of nothing is an error. A generation is derived from
//! the entity tag, so storing the same bytes again does not change it, unlike on the real service.
//! Old generations are not kept, like on a bucket without versioning.

use super::http::{Exchange, Headers, Response, Service};
use super::moto::AUTHORIZATION;
use std::fmt::Write;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::sync::{Mutex, PoisonError};

const IF_GENERATION: &str = "x-goog-if-generation-match";

#[derive(Default)]
pub struct GcsTranslator {
    /// The S3 server knows no conditional copy, so conditional requests go one by one.
    conditional: Mutex<()>,
}

impl Service for GcsTranslator {
    fn serve(&self, exchange: &mut Exchange<'_>) -> io::Result<()> {
        let request = &mut exchange.request;
        let target = std::mem::take(&mut request.target);
        let (path, query) = target.split_once('?').unwrap_or((&target, ""));
        let path = s3_path(path);
        let mut query: Vec<_> = query.split('&').filter(|pair| !pair.is_empty()).collect();
        let generation = take_parameter(&mut query, "generation");
        request.target = join(&path, &query);
        let is_part = query.iter().any(|pair| pair.starts_with("partNumber="));
        let is_upload = query.iter().any(|pair| pair.starts_with("uploadId="));
        let is_object = path.trim_start_matches('/').contains('/');
        let precondition = request.headers.take(IF_GENERATION);
        to_s3_headers(&mut request.headers);

        if let Some(wanted) = generation {
            let found = current(exchange, &path)?;
            if found.is_none_or(|found| found.generation != wanted) {
                return exchange.refuse(404, "NoSuchKey", "No such object generation.");
            }
        }
        if exchange.request.method == "DELETE" && is_object && !is_upload {
            // S3 calls the deletion of a missing object a success.
            if current(exchange, &path)?.is_none() {
                return exchange.refuse(404, "NoSuchKey", "The specified key does not exist.");
            }
        }
        let _one_at_a_time = precondition
            .as_ref()
            .map(|_| self.conditional.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some(wanted) = precondition {
            let found = current(exchange, &path)?;
            let holds = match &found {
                Some(found) => found.generation == wanted,
                None => wanted == "0",
            };
            if !holds {
                return exchange.refuse(412, "PreconditionFailed", "Generation does not match.");
            }
            // The server tests again at the moment it writes, against writers without conditions.
            match found {
                Some(found) => exchange.request.headers.set("if-match", found.etag),
                None => exchange.request.headers.set("if-none-match", "*"),
            }
        }
        exchange.forward(|response| to_gcs_headers(response, is_part))
    }
}

struct Current {
    etag: String,
    generation: String,
}

/// What the store holds at `path` now.
fn current(exchange: &Exchange<'_>, path: &str) -> io::Result<Option<Current>> {
    let mut headers = Headers::default();
    headers.set("host", exchange.request.headers.get("host").unwrap_or("127.0.0.1"));
    headers.set("authorization", AUTHORIZATION);
    let response = exchange.ask("HEAD", path, headers)?;
    let etag = response.headers.get("etag").filter(|_| response.status == 200);
    Ok(etag.map(|etag| Current { etag: etag.to_owned(), generation: generation(etag) }))
}

/// A positive 63-bit number, as the real service uses. 0 means that there is no object.
fn generation(etag: &str) -> String {
    let mut hasher = DefaultHasher::new();
    etag.trim_matches('"').hash(&mut hasher);
    ((hasher.finish() >> 1) | 1).to_string()
}

fn to_s3_headers(headers: &mut Headers) {
    for (name, value) in &mut headers.0 {
        if let Some(rest) = name.strip_prefix("x-goog-") {
            if rest == "copy-source" {
                *value = s3_path(value);
            }
            *name = format!("x-amz-{rest}");
        }
    }
    // The token is Google's, and stays here.
    headers.set("authorization", AUTHORIZATION);
}

fn to_gcs_headers(response: &mut Response, is_part: bool) {
    let headers = &mut response.headers;
    for (name, _) in &mut headers.0 {
        if let Some(rest) = name.strip_prefix("x-amz-meta-") {
            *name = format!("x-goog-meta-{rest}");
        }
    }
    headers.0.retain(|(name, _)| !name.starts_with("x-amz"));
    if !is_part && let Some(generation) = headers.get("etag").map(generation) {
        headers.set("x-goog-generation", generation);
        headers.set("x-goog-metageneration", "1");
    }
}

/// `/bucket/key` in the encoding that S3 clients use. Google's clients encode all but letters and
/// digits, slashes within the key included.
fn s3_path(path: &str) -> String {
    let mut encoded = String::from("/");
    for byte in percent_decode(path.trim_start_matches('/')).bytes() {
        match byte {
            b'/' | b'-' | b'.' | b'_' | b'~' => encoded.push(byte.into()),
            _ if byte.is_ascii_alphanumeric() => encoded.push(byte.into()),
            _ => write!(encoded, "%{byte:02X}").expect("a String takes all text"),
        }
    }
    encoded
}

pub fn percent_decode(text: &str) -> String {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((&byte, after)) = rest.split_first() {
        let digits = after.get(..2).filter(|_| byte == b'%');
        let code = digits
            .and_then(|digits| str::from_utf8(digits).ok())
            .and_then(|digits| u8::from_str_radix(digits, 16).ok());
        bytes.push(code.unwrap_or(byte));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn take_parameter(query: &mut Vec<&str>, name: &str) -> Option<String> {
    let value = |pair: &str| pair.strip_prefix(name)?.strip_prefix('=').map(str::to_owned);
    let at = query.iter().position(|pair| value(pair).is_some())?;
    value(query.remove(at))
}

fn join(path: &str, query: &[&str]) -> String {
    if query.is_empty() { path.to_owned() } else { format!("{path}?{}", query.join("&")) }
}
