//! The commits that settled the items of a catalogue, as it has them: apart from its footer, because a reader of rows
//! needs none of them, and a store that is updated every day has ever more.

use std::collections::HashMap;
use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::UnusableReason;
use crate::store::digest::digest;
use crate::store::manifest::Header;
use crate::store::parquet_object::ParquetObject;

/// Where in a catalogue the headers lie.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct HeaderPlace {
    pub n_headers: usize,
    offset: u64,
    pub n_bytes: u64,
    digest: String,
}

/// Headers as text. Most of them are of few programs, settings and origins, which are told once.
#[derive(Debug, Default, Serialize, Deserialize)]
struct HeaderText {
    /// Program, digest of the parameters, and origin.
    runs: Vec<(String, String, String)>,
    /// Key, sequence, and which of `runs` the commit is of.
    commits: Vec<(String, u64, usize)>,
}

/// Returns the bytes of headers that lie from `offset` in a file, and the note of where they are.
pub(super) fn encode(headers: &[Header], offset: u64) -> (Vec<u8>, HeaderPlace) {
    let mut text = HeaderText::default();
    let mut runs = HashMap::new();
    for Header { key, sequence, program, params_hash, origin } in headers {
        let run = *runs.entry((program, params_hash, origin)).or_insert_with(|| {
            text.runs.push((program.clone(), params_hash.clone(), origin.clone()));
            text.runs.len() - 1
        });
        text.commits.push((key.clone(), *sequence, run));
    }
    let bytes =
        serde_json::to_vec(&text).expect("invariant: headers hold only strings and numbers");
    let (n_headers, n_bytes) = (headers.len(), bytes.len() as u64);
    let place = HeaderPlace { n_headers, offset, n_bytes, digest: digest(&bytes) };
    (bytes, place)
}

impl HeaderPlace {
    /// Reads the headers out of their catalogue.
    pub fn read(&self, file: &ParquetObject) -> Result<Vec<Header>, UnusableReason> {
        let damaged = || "its list of commits that settled items is damaged".to_owned();
        let end = self.offset.checked_add(self.n_bytes).ok_or_else(damaged)?;
        let range: Range<u64> = self.offset..end;
        let bytes = file.bytes(range).map_err(|e| e.to_string())?;
        if digest(&bytes) != self.digest {
            return Err(damaged());
        }
        let HeaderText { runs, commits } =
            serde_json::from_slice(&bytes).map_err(|e| e.to_string())?;
        if commits.len() != self.n_headers {
            return Err(format!("it has {} of {} commits", commits.len(), self.n_headers));
        }
        let header = |(key, sequence, run): (String, u64, usize)| {
            let (program, params_hash, origin) = runs.get(run).cloned().ok_or_else(damaged)?;
            Ok(Header { key, sequence, program, params_hash, origin })
        };
        commits.into_iter().map(header).collect()
    }
}
