//! What the commits of one stage say: its catalogue, and the manifests that are newer.

mod newest_items;
#[cfg(test)]
mod tests;

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use xxhash_rust::xxh3::xxh3_64;

use super::StoreError;
use super::catalogue::{self, Catalogue, CatalogueError, CatalogueRow, UnusableReason};
use super::location::{ListedObject, Location};
use super::manifest::{self, FOLDER, Header, Item, Manifest, Part, Rank, stage_and_key};
use newest_items::NewestItems;

/// Times that a listing is taken again, where what it told of was gone before it was read.
const RETRIES: usize = 4;
/// Least manifests that a catalogue is written for, and how many of those that it covers come to one that it
/// does not before another is written: all catalogues of a growing store together cost as much as
/// `COVERED_PER_NEWER` of the last one.
const MIN_NEWER: usize = 16;
const COVERED_PER_NEWER: usize = 16;

/// The commits of one stage, as they were when they were listed.
pub(super) struct StageLog {
    store: Location,
    pub stage: String,
    manifests: Vec<ListedObject>,
    catalogues: Vec<ListedObject>,
    catalogue: Option<Catalogue>,
    newer: Vec<Manifest>,
    /// All manifests, read when the catalogue turned out to be of no use.
    all: Mutex<Option<Arc<Vec<Manifest>>>>,
    state: Mutex<Option<Arc<Vec<CommitState>>>>,
    places: Mutex<Option<Arc<CommitsByItem>>>,
}

impl fmt::Debug for StageLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StageLog").field("stage", &self.stage).finish_non_exhaustive()
    }
}

/// A commit and what of it counts.
#[derive(Clone, Debug)]
pub(super) struct CommitState {
    pub key: Arc<str>,
    pub generation: u32,
    pub parts: Vec<Part>,
    pub n_items: u64,
    /// Items whose rows were superseded; none are named where all were.
    pub dead: Arc<Vec<String>>,
    pub is_dead: bool,
}

impl CommitState {
    /// Returns how many of its items count.
    pub fn n_live(&self) -> u64 {
        if self.is_dead { 0 } else { self.n_items - self.dead.len() as u64 }
    }

    /// Returns the size of its parts.
    pub fn n_bytes(&self) -> u64 {
        self.parts.iter().map(|part| part.n_bytes).sum()
    }
}

/// The latest settlement of an item.
pub(super) struct ItemRecord<'a> {
    pub item: Item,
    pub header: &'a Header,
    /// The commit that holds its rows.
    pub commit: &'a str,
}

/// Which commits items are of, by the hash of their names: a commit too many is read in vain, no more.
#[derive(Debug)]
pub(super) struct CommitsByItem {
    keys: Vec<Arc<str>>,
    of: Vec<(u64, u32)>,
}

impl CommitsByItem {
    /// Returns the commits that may hold rows of the items.
    pub fn commits_of<'a>(&self, items: impl IntoIterator<Item = &'a String>) -> HashSet<&str> {
        let mut found = HashSet::new();
        for item in items {
            let hash = xxh3_64(item.as_bytes());
            let first = self.of.partition_point(|(known, _)| *known < hash);
            let same = self.of[first..].iter().take_while(|(known, _)| *known == hash);
            found.extend(same.map(|(_, commit)| &*self.keys[*commit as usize]));
        }
        found
    }

    pub fn n_items(&self) -> usize {
        self.of.len()
    }
}

/// What is read: a catalogue and the manifests behind it, or all manifests.
#[derive(Clone, Copy)]
struct Contents<'a> {
    catalogue: Option<&'a Catalogue>,
    newer: &'a [Manifest],
}

impl StageLog {
    /// Reads the commits of a stage.
    ///
    /// # Errors
    /// [`StoreError`] when a manifest cannot be read.
    pub fn read(store: &Location, stage: &str) -> Result<Self, StoreError> {
        let again = || {
            Ok((
                store.list(&format!("{FOLDER}/{stage}"))?,
                store.list(&format!("{}/{stage}", catalogue::FOLDER))?,
            ))
        };
        let (manifests, catalogues) = again()?;
        Self::of(store, stage, manifests, catalogues, again)
    }

    /// Reads the commits of all stages.
    ///
    /// # Errors
    /// [`StoreError`] when a manifest cannot be read.
    pub fn read_all(store: &Location) -> Result<Vec<Self>, StoreError> {
        let manifests = store.list(FOLDER)?;
        if manifests.is_empty() {
            return Ok(Vec::new());
        }
        let catalogues = store.list(catalogue::FOLDER)?;
        let mut stages: Vec<&str> =
            manifests.iter().filter_map(|l| Some(stage_and_key(&l.path)?.0)).collect();
        stages.dedup();
        let read = |stage: &str| {
            let listed_below = |listed: &[ListedObject], folder: &str| -> Vec<ListedObject> {
                let folder = format!("{folder}/{stage}/");
                listed.iter().filter(|l| l.path.starts_with(&folder)).cloned().collect()
            };
            let again = || {
                Ok((
                    store.list(&format!("{FOLDER}/{stage}"))?,
                    store.list(&format!("{}/{stage}", catalogue::FOLDER))?,
                ))
            };
            let found =
                (listed_below(&manifests, FOLDER), listed_below(&catalogues, catalogue::FOLDER));
            Self::of(store, stage, found.0, found.1, again)
        };
        stages.into_iter().map(read).collect()
    }

    fn of(
        store: &Location,
        stage: &str,
        mut manifests: Vec<ListedObject>,
        mut catalogues: Vec<ListedObject>,
        again: impl Fn() -> Result<(Vec<ListedObject>, Vec<ListedObject>), StoreError>,
    ) -> Result<Self, StoreError> {
        for n_tried in 0.. {
            manifests.retain(|l| stage_and_key(&l.path).is_some());
            let keys: HashSet<&str> =
                manifests.iter().filter_map(|l| Some(stage_and_key(&l.path)?.1)).collect();
            let catalogue = Catalogue::newest(store, stage, &catalogues, &keys);
            let covered: HashSet<&str> = catalogue
                .iter()
                .flat_map(|catalogue| &catalogue.meta.commits)
                .map(|entry| entry.key.as_str())
                .collect();
            let is_newer = |l: &&ListedObject| {
                stage_and_key(&l.path).is_some_and(|(_, key)| !covered.contains(key))
            };
            let newer: Vec<ListedObject> = manifests.iter().filter(is_newer).cloned().collect();
            match manifest::read(store, &newer) {
                Ok(newer) => {
                    return Ok(Self {
                        store: store.clone(),
                        stage: stage.to_owned(),
                        manifests,
                        catalogues,
                        catalogue,
                        newer,
                        all: Mutex::default(),
                        state: Mutex::default(),
                        places: Mutex::default(),
                    });
                }
                // It was dead, and is removed.
                Err(StoreError::NotFound { .. }) if n_tried < RETRIES => {
                    (manifests, catalogues) = again()?;
                }
                Err(e) => return Err(e),
            }
        }
        unreachable!("the loop ends by returning")
    }

    /// Runs `read` on the catalogue and what is newer; where the catalogue turns out to be of no use, on all
    /// manifests.
    fn with_contents<T>(
        &self,
        read: impl Fn(Contents) -> Result<T, UnusableReason>,
    ) -> Result<T, StoreError> {
        let mut all = self.all.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if all.is_none() {
            let contents = Contents { catalogue: self.catalogue.as_ref(), newer: &self.newer };
            match (read(contents), &self.catalogue) {
                (Ok(value), _) => return Ok(value),
                (Err(why), catalogue) => {
                    let place = catalogue.as_ref().map_or("", |c| c.place());
                    tracing::warn!("{place}: catalogue is passed over: {why}");
                }
            }
            let read = Arc::new(self.read_manifests()?);
            *self.all.lock().unwrap_or_else(PoisonError::into_inner) = Some(Arc::clone(&read));
            all = Some(read);
        }
        let all = all.unwrap_or_default();
        read(Contents { catalogue: None, newer: &all }).map_err(|reason| {
            let place = self.store.url_of(&format!("{FOLDER}/{}", self.stage));
            StoreError::Manifest { place, reason }
        })
    }

    fn read_manifests(&self) -> Result<Vec<Manifest>, StoreError> {
        let mut listed = self.manifests.clone();
        for n_tried in 0.. {
            match manifest::read(&self.store, &listed) {
                Err(StoreError::NotFound { .. }) if n_tried < RETRIES => {
                    listed = self.store.list(&format!("{FOLDER}/{}", self.stage))?;
                    listed.retain(|l| stage_and_key(&l.path).is_some());
                }
                read => return read,
            }
        }
        unreachable!("the loop ends by returning")
    }

    /// Returns every commit, and what of it counts.
    ///
    /// # Errors
    /// [`StoreError`] when manifests cannot be read.
    pub fn state(&self) -> Result<Arc<Vec<CommitState>>, StoreError> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(state) = &*state {
            return Ok(Arc::clone(state));
        }
        let found = Arc::new(self.with_contents(states)?);
        *state = Some(Arc::clone(&found));
        Ok(found)
    }

    /// Returns whether a commit may have parts of a table.
    pub fn may_have(&self, table: &str) -> bool {
        let entries = self.catalogue.iter().flat_map(|catalogue| &catalogue.meta.commits);
        let parts = entries.flat_map(|entry| &entry.parts);
        parts
            .chain(self.newer.iter().flat_map(|manifest| &manifest.parts))
            .any(|part| part.table == table)
    }

    /// Returns which commits items are of.
    ///
    /// # Errors
    /// [`StoreError`] when manifests cannot be read.
    pub fn places(&self) -> Result<Arc<CommitsByItem>, StoreError> {
        let mut places = self.places.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(places) = &*places {
            return Ok(Arc::clone(places));
        }
        let found = Arc::new(self.with_contents(places_of)?);
        *places = Some(Arc::clone(&found));
        Ok(found)
    }

    /// Visits the latest word on every item, in no order.
    ///
    /// # Errors
    /// [`StoreError`] when manifests cannot be read.
    pub fn visit(&self, mut visit: impl FnMut(ItemRecord)) -> Result<(), StoreError> {
        // A catalogue that breaks off is read again as manifests: the later word replaces the same word.
        let visit = std::cell::RefCell::new(&mut visit);
        self.with_contents(|contents| words(contents, &mut **visit.borrow_mut()))
    }

    /// Returns the parts that hold whatever rows an item has: those of the latest commit that settled it.
    ///
    /// # Errors
    /// [`StoreError`] when manifests cannot be read.
    pub fn parts_of(&self, item: &str) -> Result<Vec<Part>, StoreError> {
        Ok(self.latest(item)?.map(|(_, parts)| parts).unwrap_or_default())
    }

    /// Returns where an item came from when it was last settled.
    ///
    /// # Errors
    /// [`StoreError`] when manifests cannot be read.
    pub fn origin_of(&self, item: &str) -> Result<Option<String>, StoreError> {
        Ok(self.latest(item)?.map(|(header, _)| header.origin))
    }

    /// Returns the header and the parts of the latest commit that settled an item.
    fn latest(&self, item: &str) -> Result<Option<(Header, Vec<Part>)>, StoreError> {
        self.with_contents(|contents| {
            let mut best: Option<(Rank, &Header, &[Part])> = None;
            let headers: Vec<_> = contents.newer.iter().map(Manifest::headers).collect();
            for (manifest, headers) in contents.newer.iter().zip(&headers) {
                let Some(i) = manifest.items.iter().position(|known| known.id == item) else {
                    continue;
                };
                let header = &headers[manifest.header_of(i)];
                let rank = Rank::new(header, manifest.generation(), &manifest.key);
                if best.as_ref().is_none_or(|(known, ..)| rank > *known) {
                    best = Some((rank, header, &manifest.parts));
                }
            }
            if let Some(catalogue) = contents.catalogue
                && let Some((commit, header)) = catalogue.find(item)?
            {
                let headers = catalogue.headers()?;
                let rank = catalogue.rank(CatalogueRow { item, commit, header }, headers);
                if best.as_ref().is_none_or(|(known, ..)| rank > *known) {
                    let parts = catalogue.meta.commits[commit].parts.as_slice();
                    best = Some((rank, &headers[header], parts));
                }
            }
            Ok(best.map(|(_, header, parts)| (header.clone(), parts.to_vec())))
        })
    }

    /// Writes a catalogue if enough manifests came or went since the last one, or any if `now`; returns whether it
    /// did.
    ///
    /// # Errors
    /// [`CatalogueError`]; the store is as it was then.
    pub fn checkpoint(&self, now: bool) -> Result<bool, CatalogueError> {
        let covered = self.catalogue.as_ref().map_or(&[][..], |c| c.meta.commits.as_slice());
        let there: HashSet<&str> =
            self.manifests.iter().filter_map(|l| Some(stage_and_key(&l.path)?.1)).collect();
        let n_gone = covered.iter().filter(|entry| !there.contains(&*entry.key)).count();
        let due = MIN_NEWER.max(covered.len() / COVERED_PER_NEWER);
        if self.newer.len() + n_gone < if now { 1 } else { due } {
            return Ok(false);
        }
        let listed = (&self.catalogues[..], &self.manifests[..]);
        let written = catalogue::write(
            &self.store,
            &self.stage,
            self.catalogue.as_ref(),
            &self.newer,
            listed,
        );
        match written {
            Err(CatalogueError::Unusable(_)) if self.catalogue.is_some() => {
                let all = self.read_manifests()?;
                catalogue::write(&self.store, &self.stage, None, &all, listed)?;
            }
            written => written?,
        }
        Ok(true)
    }
}

/// Returns every commit, and what of it counts.
fn states(contents: Contents) -> Result<Vec<CommitState>, UnusableReason> {
    let mut newest = NewestItems::of(contents.newer);
    let mut dead_of_old: HashMap<usize, Vec<String>> = HashMap::new();
    let mut states = Vec::new();
    if let Some(catalogue) = contents.catalogue {
        if !newest.of.is_empty() {
            let mut settled_again = Vec::new();
            catalogue.visit(|CatalogueRow { item, commit, header }| {
                if let Some((&item, &place)) = newest.of.get_key_value(item) {
                    settled_again.push((place, CatalogueRow { item, commit, header }));
                }
            })?;
            // Only these need to know which commits settled the items of the catalogue.
            let headers: &[Header] =
                if settled_again.is_empty() { &[] } else { catalogue.headers()? };
            for (place, row) in settled_again {
                let is_later = newest.rank(place) > catalogue.rank(row, headers);
                let dead = if is_later {
                    dead_of_old.entry(row.commit).or_default()
                } else {
                    &mut newest.dead[place.0]
                };
                dead.push(row.item.to_owned());
            }
        }
        for (i, entry) in catalogue.meta.commits.iter().enumerate() {
            let mut dead = entry.dead.clone();
            dead.extend(dead_of_old.remove(&i).unwrap_or_default());
            let is_dead = entry.is_dead || dead.len() as u64 == entry.n_items;
            states.push(CommitState {
                key: entry.key.as_str().into(),
                generation: entry.generation,
                parts: entry.parts.clone(),
                n_items: entry.n_items,
                dead: Arc::new(if is_dead { Vec::new() } else { dead }),
                is_dead,
            });
        }
    }
    for (manifest, mut dead) in contents.newer.iter().zip(newest.dead) {
        let is_dead = dead.len() == manifest.items.len();
        dead.sort_unstable();
        states.push(CommitState {
            key: manifest.key.as_str().into(),
            generation: manifest.generation(),
            parts: manifest.parts.clone(),
            n_items: manifest.items.len() as u64,
            dead: Arc::new(if is_dead { Vec::new() } else { dead }),
            is_dead,
        });
    }
    Ok(states)
}

fn places_of(contents: Contents) -> Result<CommitsByItem, UnusableReason> {
    let (mut keys, mut of): (Vec<Arc<str>>, _) = (Vec::new(), Vec::new());
    if let Some(catalogue) = contents.catalogue {
        keys.extend(catalogue.meta.commits.iter().map(|entry| Arc::from(entry.key.as_str())));
        of.reserve(usize::try_from(catalogue.n_items()).unwrap_or(0));
        let visited =
            catalogue.visit(|row| of.push((xxh3_64(row.item.as_bytes()), row.commit as u32)));
        visited?;
    }
    for manifest in contents.newer {
        let commit = keys.len() as u32;
        keys.push(manifest.key.as_str().into());
        of.extend(manifest.items.iter().map(|item| (xxh3_64(item.id.as_bytes()), commit)));
    }
    of.sort_unstable();
    Ok(CommitsByItem { keys, of })
}

fn words(contents: Contents, visit: &mut dyn FnMut(ItemRecord)) -> Result<(), UnusableReason> {
    let newest = NewestItems::of(contents.newer);
    let mut outranked: HashSet<&str> = HashSet::new();
    if let Some(catalogue) = contents.catalogue {
        let headers = catalogue.headers()?;
        let visited = catalogue.visit_items(|row, item| {
            if let Some((id, &place)) = newest.of.get_key_value(row.item) {
                if newest.rank(place) > catalogue.rank(row, headers) {
                    return;
                }
                outranked.insert(id);
            }
            let header = &headers[row.header];
            let commit = &catalogue.meta.commits[row.commit].key;
            visit(ItemRecord { item, header, commit });
        });
        visited?;
    }
    #[expect(clippy::iter_over_hash_type, reason = "the words are told in no order")]
    for (id, &place) in &newest.of {
        if !outranked.contains(id) {
            let manifest = &contents.newer[place.0];
            let item = manifest.items[place.1].clone();
            visit(ItemRecord { item, header: newest.header(place), commit: &manifest.key });
        }
    }
    Ok(())
}
