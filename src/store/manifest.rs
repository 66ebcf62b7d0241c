//! Manifests: what a commit says of itself, as `commits/<stage>/<key>.json` has it.

use serde::{Deserialize, Serialize};

use super::StoreError;
use super::location::{ListedObject, Location};

/// Layout of the manifests of stages; raised when a field changes its meaning.
pub(super) const MANIFEST_FORMAT: u32 = 1;
/// Layout of the manifests of compaction, whose items have the rank of the commits that settled them.
pub(super) const COMPACTED_FORMAT: u32 = 2;
/// Folder of the manifests.
pub(super) const FOLDER: &str = "commits";
const SUFFIX: &str = ".json";

/// One commit: the parts that it adds and the items that it settles.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    pub format: u32,
    pub stage: String,
    pub key: String,
    /// One more than the highest sequence among the commits that it replaces; 0 if none.
    pub sequence: u64,
    pub program: String,
    pub params_hash: String,
    /// Where the items' inputs came from, as a URL.
    pub origin: String,
    pub parts: Vec<Part>,
    pub items: Vec<Item>,
    /// Which commits settled the items, where compaction rewrote them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compacted: Option<Compacted>,
}

/// Where the items of a compaction's commit come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Compacted {
    /// One more than the highest generation among the commits that were rewritten; 0 stands for none.
    pub generation: u32,
    /// The commits that settled the items.
    pub commits: Vec<Header>,
    /// Which of them settled each item.
    pub of: Vec<u32>,
}

/// The properties that all items of a commit share.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Header {
    pub key: String,
    pub sequence: u64,
    pub program: String,
    pub params_hash: String,
    pub origin: String,
}

/// A part of a table, as its commit describes it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    pub table: String,
    pub schema_version: u32,
    /// Path below the store.
    pub path: String,
    pub n_rows: u64,
    pub n_bytes: u64,
}

/// An item settled by a commit.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Item {
    pub id: String,
    /// What the storage said of the item's inputs, without reading them.
    pub fingerprint: String,
    /// Digest of the inputs' content.
    pub input_hash: String,
    /// Digest of the failure (kind and message); `None` when the item succeeded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

impl Item {
    /// Returns an item without rows in the store, which is new when it comes again.
    pub fn forgotten(id: &str) -> Self {
        // Neither text can be a digest of anything.
        let (fingerprint, input_hash) = (String::new(), String::new());
        Self { id: id.to_owned(), fingerprint, input_hash, failure: None }
    }

    /// Returns whether the item has rows in its stage's tables.
    pub fn succeeded(&self) -> bool {
        self.failure.is_none() && !self.input_hash.is_empty()
    }
}

/// The order of what commits say of an item: the highest counts.
///
/// The commit that settled the item comes first, so that a compaction, which repeats what was said, never
/// outranks what was said after it; of two copies of the same word the later generation counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Rank<'a> {
    pub sequence: u64,
    pub key: &'a str,
    pub generation: u32,
    pub commit: &'a str,
}

impl Rank<'_> {
    pub fn new<'a>(header: &'a Header, generation: u32, commit: &'a str) -> Rank<'a> {
        Rank { sequence: header.sequence, key: &header.key, generation, commit }
    }
}

impl Manifest {
    /// Parses a manifest that lies at `place`.
    pub(super) fn parse(bytes: &[u8], place: &str) -> Result<Self, StoreError> {
        let damaged = |reason: String| StoreError::Manifest { place: place.to_owned(), reason };
        let manifest: Manifest =
            serde_json::from_slice(bytes).map_err(|e| damaged(e.to_string()))?;
        if !(MANIFEST_FORMAT..=COMPACTED_FORMAT).contains(&manifest.format) {
            let (found, supported) = (manifest.format, COMPACTED_FORMAT);
            return Err(StoreError::ManifestFormat { place: place.to_owned(), found, supported });
        }
        if let Some(Compacted { commits, of, .. }) = &manifest.compacted {
            let (n_items, n_of) = (manifest.items.len(), of.len());
            if n_items != n_of {
                return Err(damaged(format!("{n_items} items have {n_of} commits")));
            }
            if let Some(i) = of.iter().find(|i| **i as usize >= commits.len()) {
                return Err(damaged(format!("commit {i} of {} is named", commits.len())));
            }
        }
        Ok(manifest.with_each_item_once())
    }

    /// Keeps the last word on items that are named more than once.
    fn with_each_item_once(mut self) -> Self {
        if self.items.windows(2).all(|pair| pair[0].id < pair[1].id) {
            return self;
        }
        let mut last: std::collections::HashMap<&str, usize> = std::collections::HashMap::new();
        last.extend(self.items.iter().enumerate().map(|(i, item)| (item.id.as_str(), i)));
        if last.len() == self.items.len() {
            return self;
        }
        let keep: Vec<bool> = (0..self.items.len())
            .map(|i| last.get(self.items[i].id.as_str()) == Some(&i))
            .collect();
        let (mut of_item, mut of_header) = (keep.iter(), keep.iter());
        self.items.retain(|_| of_item.next().copied().unwrap_or_default());
        if let Some(compacted) = &mut self.compacted {
            compacted.of.retain(|_| of_header.next().copied().unwrap_or_default());
        }
        self
    }

    /// Returns how often what the manifest says was rewritten.
    pub(super) fn generation(&self) -> u32 {
        self.compacted.as_ref().map_or(0, |compacted| compacted.generation)
    }

    /// Returns the commits that settled the items.
    pub(super) fn headers(&self) -> Vec<Header> {
        match &self.compacted {
            Some(compacted) => compacted.commits.clone(),
            None => vec![Header {
                key: self.key.clone(),
                sequence: self.sequence,
                program: self.program.clone(),
                params_hash: self.params_hash.clone(),
                origin: self.origin.clone(),
            }],
        }
    }

    /// Returns which of [`Manifest::headers`] settled item `i`.
    pub(super) fn header_of(&self, i: usize) -> usize {
        self.compacted.as_ref().map_or(0, |compacted| compacted.of[i] as usize)
    }

    /// Returns where the manifest lies below the store.
    pub(super) fn path(&self) -> String {
        format!("{FOLDER}/{}/{}{SUFFIX}", self.stage, self.key)
    }
}

/// Returns the stage and the key of the manifest at a path; none where it is no manifest's.
pub(super) fn stage_and_key(path: &str) -> Option<(&str, &str)> {
    let (stage, name) = path.strip_prefix(FOLDER)?.strip_prefix('/')?.split_once('/')?;
    Some((stage, name.strip_suffix(SUFFIX)?))
}

/// Reads manifests that a listing told of, in that order.
pub(super) fn read(store: &Location, listed: &[ListedObject]) -> Result<Vec<Manifest>, StoreError> {
    let read = store.read_many(listed)?;
    listed
        .iter()
        .zip(read)
        .map(|(listed, bytes)| Manifest::parse(&bytes, &store.url_of(&listed.path)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(items: &[(&str, &str)], more: &str) -> String {
        let item = |(id, hash): &(&str, &str)| {
            format!(r#"{{"id": "{id}", "fingerprint": "", "input_hash": "{hash}"}}"#)
        };
        let items: Vec<String> = items.iter().map(item).collect();
        format!(
            r#"{{"format": 2, "stage": "s", "key": "k", "sequence": 3, "program": "p", "params_hash": "h",
                "origin": "o", "parts": [], "items": [{}]{more}}}"#,
            items.join(", ")
        )
    }

    #[test]
    fn the_last_word_of_a_manifest_on_an_item_counts() {
        let text = manifest(&[("b", "1"), ("a", "1"), ("b", "2")], "");
        let read = Manifest::parse(text.as_bytes(), "m").expect("a manifest");
        let words: Vec<_> = read.items.iter().map(|i| (&*i.id, &*i.input_hash)).collect();
        assert_eq!(words, [("a", "1"), ("b", "2")]);
    }

    #[test]
    fn compactions_name_a_commit_for_every_item() {
        let commits =
            r#"[{"key": "x", "sequence": 0, "program": "", "params_hash": "", "origin": ""}]"#;
        let compacted = |indices: &str| {
            format!(r#", "compacted": {{"generation": 1, "commits": {commits}, "of": {indices}}}"#)
        };
        let items = [("a", "1"), ("b", "1")];
        let parse =
            |indices: &str| Manifest::parse(manifest(&items, &compacted(indices)).as_bytes(), "m");
        assert_eq!(parse("[0, 0]").expect("a manifest").header_of(1), 0);
        let advice = "; move it away and run the stage again";
        for (of, reason) in
            [("[0]", "2 items have 1 commits"), ("[0, 1]", "commit 1 of 1 is named")]
        {
            let expected = format!("m: commit manifest is damaged ({reason}){advice}");
            assert_eq!(parse(of).expect_err(of).to_string(), expected);
        }
    }

    #[test]
    fn paths_of_others_are_no_manifests() {
        assert_eq!(stage_and_key("commits/ingest/00.json"), Some(("ingest", "00")));
        for path in ["commits/ingest/00.txt", "commits/00.json", "phrases/00.json", "commits"] {
            assert_eq!(stage_and_key(path), None, "{path}");
        }
    }
}
