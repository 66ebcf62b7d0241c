//! Commits: how finished work becomes visible, whole and once.
//!
//! A batch of items writes its parts first and then one manifest, `commits/<stage>/<key>.json`,
//! with create-if-absent; readers trust manifests only. The key is a digest of everything that
//! determines the bytes: program version, parameters, each item's input and outcome, and the
//! commits that it replaces. Two processes that do the same work therefore write the same names,
//! and an item done again supersedes its earlier rows by a higher sequence number, not by a clock.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::StoreError;
use super::digest::{digest, digest_texts};
use super::location::{Listed, Location, Put};
use super::part::{FinishedPart, PartWriter};
use super::schema::TableSchema;

/// Layout of manifests; raised when a field changes its meaning.
const MANIFEST_FORMAT: u32 = 1;
const FOLDER: &str = "commits";
/// Hexadecimal digits of a key: 128 bits.
const KEY_DIGITS: usize = 32;

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
    /// Returns an item that the store has no rows of any more, and whose next sight is news.
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

/// What a store knows of one stage's items.
#[derive(Debug, Default)]
pub struct Ledger {
    items: HashMap<String, Settled>,
}

/// The latest word on an item.
#[derive(Clone, Debug)]
pub struct Settled {
    pub item: Item,
    pub params_hash: String,
    pub origin: String,
    key: String,
    sequence: u64,
}

impl Ledger {
    /// Reads what `stage` has committed in `store`.
    ///
    /// # Errors
    /// [`StoreError`] when commits cannot be read.
    pub fn read(store: &Location, stage: &str) -> Result<Self, StoreError> {
        let manifests = manifests(store, Some(stage))?;
        let settled = |(id, (manifest, item)): (&str, (&Manifest, &Item))| {
            let settled = Settled {
                item: item.clone(),
                params_hash: manifest.params_hash.clone(),
                origin: manifest.origin.clone(),
                key: manifest.key.clone(),
                sequence: manifest.sequence,
            };
            (id.to_owned(), settled)
        };
        Ok(Self { items: latest(&manifests).into_iter().map(settled).collect() })
    }

    /// Returns the items from `origin` that failed last time, in order of id.
    pub fn failed(&self, origin: &str) -> Vec<&str> {
        let failed = |s: &&Settled| s.item.failure.is_some() && s.origin == origin;
        let mut ids: Vec<_> =
            self.items.values().filter(failed).map(|s| s.item.id.as_str()).collect();
        ids.sort_unstable();
        ids
    }

    /// Returns the items that anything is known of, in no order.
    pub fn ids(&self) -> impl Iterator<Item = &str> {
        self.items.keys().map(String::as_str)
    }

    pub fn get(&self, id: &str) -> Option<&Settled> {
        self.items.get(id)
    }
}

/// Returns the latest word on every item of one stage: by sequence, ties by key.
fn latest(manifests: &[Manifest]) -> HashMap<&str, (&Manifest, &Item)> {
    let mut ordered: Vec<_> = manifests.iter().collect();
    ordered.sort_by(|a, b| (a.sequence, &a.key).cmp(&(b.sequence, &b.key)));
    let items = ordered.into_iter().flat_map(|m| m.items.iter().map(move |item| (m, item)));
    // Later entries replace earlier ones of the same name.
    items.map(|(manifest, item)| (item.id.as_str(), (manifest, item))).collect()
}

/// A part that a table's readers see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LivePart {
    pub part: Part,
    /// Items whose rows in this part were superseded by a later commit.
    pub superseded: Vec<String>,
}

/// Returns the live parts of every table of a store, tables and parts in order of name.
///
/// # Errors
/// [`StoreError`] when commits cannot be read.
pub fn live_parts(store: &Location) -> Result<BTreeMap<String, Vec<LivePart>>, StoreError> {
    let mut by_stage: BTreeMap<String, Vec<Manifest>> = BTreeMap::new();
    for manifest in manifests(store, None)? {
        by_stage.entry(manifest.stage.clone()).or_default().push(manifest);
    }
    let mut tables: BTreeMap<String, Vec<LivePart>> = BTreeMap::new();
    for manifests in by_stage.values() {
        let latest = latest(manifests);
        for manifest in manifests {
            let is_live = |id: &str| latest.get(id).is_some_and(|(m, _)| m.key == manifest.key);
            let dead = manifest.items.iter().filter(|item| !is_live(&item.id));
            let superseded: Vec<_> = dead.map(|item| item.id.clone()).collect();
            if superseded.len() == manifest.items.len() {
                continue;
            }
            for part in &manifest.parts {
                let live = LivePart { part: part.clone(), superseded: superseded.clone() };
                tables.entry(part.table.clone()).or_default().push(live);
            }
        }
    }
    for parts in tables.values_mut() {
        parts.sort_by(|a, b| a.part.path.cmp(&b.part.path));
    }
    Ok(tables)
}

/// Returns the parts, by table, that hold whatever rows an item has: those of the latest commit of
/// each stage that settled it.
///
/// # Errors
/// [`StoreError`] when commits cannot be read.
pub fn parts_of(store: &Location, id: &str) -> Result<BTreeMap<String, Vec<Part>>, StoreError> {
    let mut by_stage: BTreeMap<String, Manifest> = BTreeMap::new();
    for manifest in manifests(store, None)? {
        let is_later =
            |known: &Manifest| (manifest.sequence, &manifest.key) > (known.sequence, &known.key);
        let settles = manifest.items.iter().any(|item| item.id == id);
        if settles && by_stage.get(&manifest.stage).is_none_or(is_later) {
            by_stage.insert(manifest.stage.clone(), manifest);
        }
    }
    let mut tables: BTreeMap<String, Vec<Part>> = BTreeMap::new();
    for part in by_stage.into_values().flat_map(|manifest| manifest.parts) {
        tables.entry(part.table.clone()).or_default().push(part);
    }
    Ok(tables)
}

fn manifests(store: &Location, stage: Option<&str>) -> Result<Vec<Manifest>, StoreError> {
    let folder = stage.map_or(FOLDER.to_owned(), |stage| format!("{FOLDER}/{stage}"));
    let mut listed = store.list(&folder)?;
    listed.retain(|l| l.path.ends_with(".json"));
    let mut found = Vec::with_capacity(listed.len());
    for (Listed { path, .. }, bytes) in listed.iter().zip(store.read_many(&listed)?) {
        let damaged = |reason: String| StoreError::Manifest { place: store.url_of(path), reason };
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        if manifest.format != MANIFEST_FORMAT {
            let place = store.url_of(path);
            let (found, supported) = (manifest.format, MANIFEST_FORMAT);
            return Err(StoreError::ManifestFormat { place, found, supported });
        }
        found.push(manifest);
    }
    Ok(found)
}

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

/// What a commit added.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Committed {
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
    pub fn publish(self) -> Result<Committed, StoreError> {
        let sequence = self.replaces.iter().map(|(sequence, _)| sequence + 1).max().unwrap_or(0);
        let key = self.key();
        let program = program();
        let mut committed = Committed::default();
        let mut parts = Vec::new();
        for (table, open) in self.parts {
            let finished = open.writer.finish(&[
                ("schema_version", open.schema_version.to_string()),
                ("table", table.to_owned()),
                ("program", program.clone()),
                ("params_hash", self.params_hash.clone()),
                ("input_hash", input_hash(&self.items)),
            ])?;
            let FinishedPart { file, n_rows } = finished;
            let path = format!("{table}/{key}.parquet");
            let mut n_bytes = file
                .as_file()
                .metadata()
                .map_err(|e| StoreError::io("measure", &self.store.url_of(&path), e))?
                .len();
            if self.store.put_file_new(&path, file)? == Put::AlreadyThere {
                // Failures carry the time at which they happened, so the one that is there may be
                // some bytes longer or shorter.
                n_bytes = self.store.size_bytes(&path)?;
            }
            committed.n_rows += n_rows;
            committed.n_bytes += n_bytes;
            let (table, schema_version) = (table.to_owned(), open.schema_version);
            parts.push(Part { table, schema_version, path, n_rows, n_bytes });
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
        };
        let path = format!("{FOLDER}/{}/{}.json", manifest.stage, manifest.key);
        let text = serde_json::to_vec(&manifest)
            .expect("invariant: a manifest holds only strings and numbers");
        committed.already_there =
            self.store.put_new(&path, Bytes::from(text))? == Put::AlreadyThere;
        Ok(committed)
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

/// Returns the name and version that parts and manifests carry.
fn program() -> String {
    format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"))
}

fn input_hash(items: &[Item]) -> String {
    let lines: String = items.iter().map(|i| format!("{}\n", i.input_hash)).collect();
    digest(lines.as_bytes())
}
