//! Catalogues: what a stage's manifests say, in one Parquet file that is read in place of them.
//!
//! `catalogue/<stage>/<number>-<digest>.parquet` has one row per item, the latest word on it, sorted by name;
//! its footer lists the commits that it covers, their parts, and the items whose rows in them are dead. Before the
//! footer lie the commits that settled the items, for those who ask. It says nothing that the manifests do not say, so
//! any process may write one, a lost race is harmless, and one that cannot be read is passed over.

mod headers;
mod writer;

use std::collections::{BTreeSet, HashSet};
use std::sync::OnceLock;

use arrow_array::{Array as _, Int32Array, RecordBatch, StringArray};
use parquet::errors::ParquetError;
use serde::{Deserialize, Serialize};

use super::digest::digest;
use super::location::{ListedObject, Location};
use super::manifest::{Header, Item, Part, Rank};
use super::parquet_object::{ParquetObject, WantedItems, names};
use headers::HeaderPlace;

pub(super) use writer::{CatalogueError, write};

/// Layout of catalogues; the first has the headers in its footer, and one of a later layout is passed over.
const FORMAT: u32 = 2;
const FIRST_FORMAT: u32 = 1;
/// Folder of the catalogues.
pub(super) const FOLDER: &str = "catalogue";
const SUFFIX: &str = ".parquet";
/// Catalogues of a stage that are kept: the newest, and the one that readers may have under way.
const N_KEPT: usize = 2;
/// Rows of a row group: what is read to look one item up.
const ROW_GROUP_ROWS: usize = 64 << 10;
/// Bytes that are read of the end of a remote catalogue in one request: its list of commits.
const TAIL_BYTES: u64 = 1 << 20;
/// Texts of the footer.
const META: &str = "motiongen.catalogue";
const META_DIGEST: &str = "motiongen.catalogue_digest";

pub(super) const ITEM: &str = "item";
const COMMIT: &str = "commit";
const HEADER: &str = "settled_by";
const FINGERPRINT: &str = "fingerprint";
const INPUT_HASH: &str = "input_hash";
const FAILURE: &str = "failure";

/// Why a catalogue is of no use.
pub(super) type UnusableReason = String;

/// The content of a catalogue's footer.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Meta {
    format: u32,
    stage: String,
    n_items: u64,
    /// The commits that settled the items, in the first layout.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    headers: Vec<Header>,
    /// Where they are in this one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    header_place: Option<HeaderPlace>,
    /// The commits whose parts hold their rows.
    pub commits: Vec<Entry>,
}

/// A commit, as a catalogue knows it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Entry {
    pub key: String,
    pub generation: u32,
    pub parts: Vec<Part>,
    pub n_items: u64,
    /// Items whose rows in the parts are dead; none are named where all are.
    pub dead: Vec<String>,
    pub is_dead: bool,
}

/// A catalogue that was opened.
pub(super) struct Catalogue {
    pub meta: Meta,
    path: String,
    file: ParquetObject,
    n_headers: usize,
    headers: OnceLock<Vec<Header>>,
}

/// The latest settlement of an item, as a catalogue has it.
#[derive(Clone, Copy, Debug)]
pub(super) struct CatalogueRow<'a> {
    pub item: &'a str,
    pub commit: usize,
    pub header: usize,
}

impl Catalogue {
    /// Opens the newest catalogue of a stage that is good for the manifests that are there.
    ///
    /// `listed` are the catalogues of the stage, `keys` the commits of which there are manifests.
    pub fn newest(
        store: &Location,
        stage: &str,
        listed: &[ListedObject],
        keys: &HashSet<&str>,
    ) -> Option<Self> {
        let mut listed: Vec<_> = listed.iter().filter(|l| is_catalogue(&l.path)).collect();
        listed.sort_by(|a, b| b.path.cmp(&a.path));
        for one in listed.into_iter().take(N_KEPT) {
            match Self::open(store, stage, one).and_then(|found| found.checked(keys)) {
                Ok(catalogue) => return Some(catalogue),
                Err(why) => {
                    let place = store.url_of(&one.path);
                    tracing::info!("{place}: catalogue is passed over: {why}");
                }
            }
        }
        None
    }

    fn open(store: &Location, stage: &str, listed: &ListedObject) -> Result<Self, UnusableReason> {
        let file = ParquetObject::open(store, &listed.path, listed.size_bytes, TAIL_BYTES)
            .map_err(|e| e.to_string())?;
        let text = file.text(META).ok_or("it has no list of commits")?;
        if file.text(META_DIGEST) != Some(digest(text.as_bytes()).as_str()) {
            return Err("its list of commits is damaged".to_owned());
        }
        let mut meta: Meta = serde_json::from_str(text).map_err(|e| e.to_string())?;
        if !(FIRST_FORMAT..=FORMAT).contains(&meta.format) || meta.stage != stage {
            let Meta { format, stage: found, .. } = &meta;
            return Err(format!("it is of format {format} and stage {found}"));
        }
        let headers = OnceLock::new();
        let n_headers = match &meta.header_place {
            Some(place) => place.n_headers,
            None => headers.get_or_init(|| std::mem::take(&mut meta.headers)).len(),
        };
        Ok(Self { meta, path: store.url_of(&listed.path), file, n_headers, headers })
    }

    /// Returns the commits that settled the items; they are read when they are asked for first.
    pub fn headers(&self) -> Result<&[Header], UnusableReason> {
        if let (None, Some(place)) = (self.headers.get(), &self.meta.header_place) {
            let read = place.read(&self.file)?;
            return Ok(self.headers.get_or_init(|| read));
        }
        Ok(self.headers.get().map_or(&[][..], Vec::as_slice))
    }

    /// Refuses a catalogue that counts rows of a commit whose manifest is gone.
    fn checked(self, keys: &HashSet<&str>) -> Result<Self, UnusableReason> {
        let is_gone = |entry: &&Entry| !entry.is_dead && !keys.contains(entry.key.as_str());
        match self.meta.commits.iter().find(is_gone) {
            Some(entry) => Err(format!("commit {} is gone", entry.key)),
            None => Ok(self),
        }
    }

    /// Where the catalogue lies, as a URL.
    pub fn place(&self) -> &str {
        &self.path
    }

    /// Returns how many items the catalogue has.
    pub fn n_items(&self) -> u64 {
        self.meta.n_items
    }

    /// Returns how much of what it says of commits was parsed.
    #[cfg(test)]
    pub fn n_parsed_bytes(&self) -> u64 {
        let list = self.file.text(META).map_or(0, str::len) as u64;
        let headers = self.headers.get().and(self.meta.header_place.as_ref());
        list + headers.map_or(0, |place| place.n_bytes)
    }

    /// Returns the rank of a row, which one of [`Catalogue::headers`] settled.
    pub fn rank<'a>(&'a self, row: CatalogueRow, headers: &'a [Header]) -> Rank<'a> {
        let entry = &self.meta.commits[row.commit];
        Rank::new(&headers[row.header], entry.generation, &entry.key)
    }

    /// Visits the names of all items, in order, and which commits they are of.
    pub fn visit(&self, mut visit: impl FnMut(CatalogueRow)) -> Result<(), UnusableReason> {
        self.batches(WantedItems::All, Some(&[ITEM, COMMIT, HEADER]), |batch| {
            (0..batch.n_rows()).try_for_each(|i| {
                visit(batch.row(i)?);
                Ok(())
            })
        })
    }

    /// Visits all items, in order, with all that is known of them.
    pub fn visit_items(
        &self,
        mut visit: impl FnMut(CatalogueRow, Item),
    ) -> Result<(), UnusableReason> {
        self.batches(WantedItems::All, None, |batch| {
            (0..batch.n_rows()).try_for_each(|i| {
                let (row, item) = (batch.row(i)?, batch.item(i)?);
                visit(row, item);
                Ok(())
            })
        })
    }

    /// Returns the commit that holds what is known of an item, and by which it was settled.
    pub fn find(&self, item: &str) -> Result<Option<(usize, usize)>, UnusableReason> {
        let (mut found, wanted) = (None, BTreeSet::from([item.to_owned()]));
        // The columns of the row group at once, rather than the names first.
        self.batches(WantedItems::Near(&wanted), Some(&[ITEM, COMMIT, HEADER]), |batch| {
            if let Some(i) = batch.items.iter().position(|known| known == Some(item)) {
                let row = batch.row(i)?;
                found = Some((row.commit, row.header));
            }
            Ok(())
        })?;
        Ok(found)
    }

    fn batches(
        &self,
        wanted: WantedItems,
        columns: Option<&[&str]>,
        mut visit: impl FnMut(&CatalogueColumns) -> Result<(), UnusableReason>,
    ) -> Result<(), UnusableReason> {
        let text = |e: ParquetError| e.to_string();
        let mut n_rows = 0;
        for batch in self.file.batches(ITEM, wanted, columns).map_err(text)? {
            let batch = batch.map_err(text)?;
            n_rows += batch.num_rows() as u64;
            visit(&CatalogueColumns::of(&batch, self).ok_or("its columns are others")?)?;
        }
        if matches!(wanted, WantedItems::All) && n_rows != self.meta.n_items {
            return Err(format!("it has {n_rows} of {} items", self.meta.n_items));
        }
        Ok(())
    }
}

/// The columns of a batch of a catalogue.
struct CatalogueColumns<'a> {
    batch: &'a RecordBatch,
    catalogue: &'a Catalogue,
    items: &'a StringArray,
    commits: &'a Int32Array,
    headers: &'a Int32Array,
}

impl<'a> CatalogueColumns<'a> {
    fn of(batch: &'a RecordBatch, catalogue: &'a Catalogue) -> Option<Self> {
        let numbers =
            |name: &str| batch.column_by_name(name)?.as_any().downcast_ref::<Int32Array>();
        let items = names(batch, ITEM).ok()?;
        let (commits, headers) = (numbers(COMMIT)?, numbers(HEADER)?);
        Some(Self { batch, catalogue, items, commits, headers })
    }

    fn n_rows(&self) -> usize {
        self.batch.num_rows()
    }

    fn row(&self, i: usize) -> Result<CatalogueRow<'a>, UnusableReason> {
        let place = |n: i32, len: usize| usize::try_from(n).ok().filter(|n| *n < len);
        let commit = place(self.commits.value(i), self.catalogue.meta.commits.len());
        let header = place(self.headers.value(i), self.catalogue.n_headers);
        match (commit, header) {
            (Some(commit), Some(header)) => {
                Ok(CatalogueRow { item: self.items.value(i), commit, header })
            }
            _ => Err(format!("item {} is of no commit", self.items.value(i))),
        }
    }

    fn item(&self, i: usize) -> Result<Item, UnusableReason> {
        let text = |name: &str| {
            let column = names(self.batch, name).map_err(|e| e.to_string())?;
            Ok::<_, UnusableReason>((!column.is_null(i)).then(|| column.value(i).to_owned()))
        };
        Ok(Item {
            id: self.items.value(i).to_owned(),
            fingerprint: text(FINGERPRINT)?.unwrap_or_default(),
            input_hash: text(INPUT_HASH)?.unwrap_or_default(),
            failure: text(FAILURE)?,
        })
    }
}

/// Returns whether a path is that of a catalogue.
fn is_catalogue(path: &str) -> bool {
    number_of(path).is_some()
}

/// Returns the number of the catalogue at a path.
fn number_of(path: &str) -> Option<u64> {
    let (_, name) = path.rsplit_once('/')?;
    let (number, _) = name.strip_suffix(SUFFIX)?.split_once('-')?;
    number.parse().ok()
}
