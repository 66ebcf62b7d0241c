//! Commits: how finished work becomes visible, whole and once.
//!
//! A batch of items writes its parts first and then one manifest, `commits/<stage>/<key>.json`,
//! with create-if-absent; readers trust manifests only. The key is a digest of everything that
//! determines the bytes: program version, parameters, each item's input and outcome, and the
//! commits that it replaces. Two processes that do the same work therefore write the same names,
//! and an item done again supersedes its earlier rows by a higher sequence number, not by a clock.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;

use super::StoreError;
use super::digest::{digest, digest_texts};
use super::ledger::Ledger;
use super::location::{Location, PutOutcome};
use super::manifest::{Item, MANIFEST_FORMAT, Manifest, Part};
use super::part::{FinishedPart, PartWriter};
use super::schema::TableSchema;

/// Hexadecimal digits of a key: 128 bits.
pub(super) const KEY_DIGITS: usize = 32;

/// A batch of items on its way into the store.
pub struct Commit<'a> {
    store: &'a Location,
    stage: &'static str,
    params_hash: String,
    origin: String,
    parts: BTreeMap<&'static str, OpenPart>,
    items: Vec<Item>,
    replaces: BTreeSet<(u64, String)>,
}

struct OpenPart {
    schema_version: u32,
    writer: PartWriter,
}

/// The rows and bytes that a commit added.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CommitResult {
    pub n_rows: u64,
    pub n_bytes: u64,
    /// Whether another process had made the same commit already.
    pub already_there: bool,
}

impl<'a> Commit<'a> {
    /// Starts a commit of `stage` under parameters whose digest is `params_hash`, for items that
    /// come from `origin`.
    pub fn new(store: &'a Location, stage: &'static str, params_hash: &str, origin: &str) -> Self {
        Self {
            store,
            stage,
            params_hash: params_hash.to_owned(),
            origin: origin.to_owned(),
            parts: BTreeMap::new(),
            items: Vec::new(),
            replaces: BTreeSet::new(),
        }
    }

    /// Returns the writer of this commit's part of a table, started when first asked for.
    ///
    /// # Errors
    /// [`StoreError`] when no temporary file can be made.
    pub fn part(
        &mut self,
        name: &'static str,
        schema: impl FnOnce() -> TableSchema,
    ) -> Result<&mut PartWriter, StoreError> {
        use std::collections::btree_map::Entry;
        match self.parts.entry(name) {
            Entry::Occupied(open) => Ok(&mut open.into_mut().writer),
            Entry::Vacant(vacant) => {
                let schema = schema();
                let file = self.store.temporary(&format!("{name}/part"))?;
                let schema_version = schema.version;
                let writer = PartWriter::new(schema, file)?;
                Ok(&mut vacant.insert(OpenPart { schema_version, writer }).writer)
            }
        }
    }

    /// Settles an item, superseding what `ledger` knew of it. Items come in order of id.
    pub fn settle(&mut self, item: Item, ledger: &Ledger) {
        if let Some(known) = ledger.get(&item.id) {
            self.replaces.insert((known.sequence, known.key.clone()));
        }
        self.items.push(item);
    }

    pub fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// Publishes the parts, then the manifest that makes them visible.
    ///
    /// # Errors
    /// [`StoreError`]; nothing of the commit is visible then.
    pub fn publish(self) -> Result<CommitResult, StoreError> {
        self.publish_manifest().map(|(committed, _)| committed)
    }

    /// Publishes the commit, and adds what it settles to what `ledger` knows.
    ///
    /// # Errors
    /// [`StoreError`]; nothing of the commit is visible then.
    pub fn publish_into(self, ledger: &mut Ledger) -> Result<CommitResult, StoreError> {
        let (committed, manifest) = self.publish_manifest()?;
        ledger.add(&manifest);
        Ok(committed)
    }

    fn publish_manifest(self) -> Result<(CommitResult, Manifest), StoreError> {
        let sequence = self.replaces.iter().map(|(sequence, _)| sequence + 1).max().unwrap_or(0);
        let key = self.key();
        let program = program();
        let mut committed = CommitResult::default();
        let mut parts = Vec::new();
        for (table, open) in self.parts {
            let finished = open.writer.finish(&[
                ("schema_version", open.schema_version.to_string()),
                ("table", table.to_owned()),
                ("program", program.clone()),
                ("params_hash", self.params_hash.clone()),
                ("input_hash", input_hash(&self.items)),
            ])?;
            let part = publish_part(self.store, table, open.schema_version, &key, finished)?;
            committed.n_rows += part.n_rows;
            committed.n_bytes += part.n_bytes;
            parts.push(part);
        }
        let manifest = Manifest {
            format: MANIFEST_FORMAT,
            stage: self.stage.to_owned(),
            key,
            sequence,
            program,
            params_hash: self.params_hash,
            origin: self.origin,
            parts,
            items: self.items,
            compacted: None,
        };
        committed.already_there =
            publish_manifest(self.store, &manifest)? == PutOutcome::AlreadyThere;
        Ok((committed, manifest))
    }

    fn key(&self) -> String {
        let program = program();
        let mut texts = vec![self.stage, &program, &self.params_hash, &self.origin];
        let versions: Vec<_> =
            self.parts.iter().map(|(name, p)| format!("{name} {}", p.schema_version)).collect();
        texts.extend(versions.iter().map(String::as_str));
        texts.push("replaces");
        texts.extend(self.replaces.iter().map(|(_, key)| key.as_str()));
        texts.push("items");
        for item in &self.items {
            texts.push(&item.id);
            texts.push(&item.input_hash);
            texts.push(item.failure.as_deref().unwrap_or_default());
        }
        digest_texts(texts)[..KEY_DIGITS].to_owned()
    }
}

/// Publishes a part of the commit with that key.
pub(super) fn publish_part(
    store: &Location,
    table: &str,
    schema_version: u32,
    key: &str,
    finished: FinishedPart,
) -> Result<Part, StoreError> {
    let FinishedPart { file, n_rows } = finished;
    let path = format!("{table}/{key}.parquet");
    let mut n_bytes = file
        .as_file()
        .metadata()
        .map_err(|e| StoreError::io("measure", &store.url_of(&path), e))?
        .len();
    if store.put_file_new(&path, file)? == PutOutcome::AlreadyThere {
        store.touch(&path);
        // Failures carry the time at which they happened, so the one that is there may be some bytes longer or
        // shorter.
        n_bytes = store.size_bytes(&path)?;
    }
    Ok(Part { table: table.to_owned(), schema_version, path, n_rows, n_bytes })
}

/// Publishes a manifest, whose parts are there.
pub(super) fn publish_manifest(
    store: &Location,
    manifest: &Manifest,
) -> Result<PutOutcome, StoreError> {
    let text =
        serde_json::to_vec(manifest).expect("invariant: a manifest holds only strings and numbers");
    store.put_new(&manifest.path(), Bytes::from(text))
}

/// Returns the name and version that parts and manifests carry.
pub(super) fn program() -> String {
    format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"))
}

pub(super) fn input_hash(items: &[Item]) -> String {
    let lines: String = items.iter().map(|i| format!("{}\n", i.input_hash)).collect();
    digest(lines.as_bytes())
}
