//! Songs into the store: one commit per song, whole or absent.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::LibraryRules;
use super::layout::PhraseFolder;
use super::one::{self, SongMusic, dance};
use super::report::PhraseCounts;
use super::rows::{beat_rows, phrase_row};
use super::songs::Song;
use crate::motion::choreography::Repertoire;
use crate::stages::batch::{BatchCommit, BatchJob};
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::item_state::ItemState;
use crate::stages::touched::TouchedContent;
use crate::store::tables::{self, BeatRow, PhraseRow};
use crate::store::{Item, Ledger, SettledItem, StoreError, digest};

/// Writes songs and failures.
pub struct SongWriter<'a> {
    /// Of the songs; captures may come from elsewhere.
    pub batches: BatchJob<'a>,
    pub rules: &'a LibraryRules,
    pub repertoire: &'a Repertoire,
    /// Digest of the captures' content.
    pub captures_hash: &'a str,
    /// What the storage says of the captures.
    pub captures_fingerprint: &'a str,
    /// Constructed phrases that the store has, with the URLs of their songs, by slug.
    pub constructed: &'a BTreeMap<String, BTreeMap<String, String>>,
    /// All other phrases of the store, and their sources.
    pub others: &'a HashMap<String, String>,
    pub output: Option<&'a PhraseFolder>,
    pub force: bool,
    pub seen: &'a TouchedContent,
}

/// The outcome of a song.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SongOutcome {
    /// The new phrases.
    Phrases(PhraseCounts),
    /// The store has its phrases already.
    Unchanged,
}

/// Why a song was not written.
pub enum Refusal {
    Song(Failure),
    Store(anyhow::Error),
}

impl From<Failure> for Refusal {
    fn from(failure: Failure) -> Self {
        Self::Song(failure)
    }
}

impl From<StoreError> for Refusal {
    fn from(error: StoreError) -> Self {
        Self::Store(error.into())
    }
}

/// Returns what is known of a song and all else that determines its phrases, without reading it.
pub fn fingerprint(song: &Song, captures_fingerprint: &str) -> String {
    let known = format!("{}\n{captures_fingerprint}\n{}", song.fingerprint, song.split);
    digest(known.as_bytes())[..32].to_owned()
}

/// Returns what the store has of the phrases of a song, made from these inputs with these parameters.
///
/// A song is committed whole, so its first phrase stands for all.
pub fn state(
    song: &Song,
    first: Option<&SettledItem>,
    (ledger, seen): (&Ledger, &TouchedContent),
    (origin, params_hash): (&str, &str),
    fingerprint: &str,
) -> ItemState {
    if ledger.get(&song.id).is_some_and(|known| known.item.failure.is_some()) {
        return ItemState::Failed;
    }
    ItemState::of(first, |known| {
        !song.is_unidentified
            && known.params_hash == params_hash
            && known.origin == origin
            && (known.item.fingerprint == fingerprint || seen.has(known, origin, fingerprint))
    })
}

impl SongWriter<'_> {
    /// Returns the job of items that come from elsewhere than songs may.
    fn batches_of<'b>(&'b self, origin: &'b str) -> BatchJob<'b> {
        BatchJob { origin, ..self.batches }
    }

    /// Makes and commits the phrases of a song.
    ///
    /// # Errors
    /// [`Refusal`]; nothing of the song is in the store then that was not there before.
    pub fn song(&self, song: &Song, music: &SongMusic) -> Result<SongOutcome, Refusal> {
        let input_hash = self.input_hash(song, music);
        let first = self.batches.known(&one::phrase_id(song, self.rules, 0, 0));
        let is_there = !self.force
            && !song.is_unidentified
            && first.is_some_and(|known| {
                known.origin == self.batches.origin
                    && known.item.succeeded()
                    && known.item.input_hash == input_hash
            });
        if is_there {
            // A song that was out of reach for a while kept its phrases, and is not failed any more.
            settle(self.batches.start(), self.recovered(song).into_iter().collect())?;
            self.see(song, first)?;
            if self.output.is_none() {
                return Ok(SongOutcome::Unchanged);
            }
        }
        let mut commit = self.batches.start();
        let fingerprint = fingerprint(song, self.captures_fingerprint);
        let (mut phrases, mut beats) = (Vec::new(), Vec::new());
        let mut items: Vec<Item> = Vec::new();
        let mut counts = PhraseCounts::default();
        dance(song, music, self.repertoire, self.rules, |phrase| {
            self.refuse_taken(song, &phrase.id)?;
            if let Some(output) = self.output {
                output.write(song, music, &phrase).map_err(|e| {
                    Refusal::Store(anyhow::Error::new(e).context("while writing --output"))
                })?;
            }
            if is_there {
                return Ok(());
            }
            let part = commit.part(tables::MOTION, tables::motion)?;
            part.write_group(&phrase.id, phrase.motion.view())?;
            let part = commit.part(tables::FEATURES, tables::features)?;
            part.write_frames(&phrase.id, phrase.features.view())?;
            counts.count(&phrase);
            phrases.push(phrase_row(song, music, &phrase));
            beats.extend(beat_rows(music, &phrase));
            let (fingerprint, input_hash) = (fingerprint.clone(), input_hash.clone());
            items.push(Item { id: phrase.id, fingerprint, input_hash, failure: None });
            Ok::<(), Refusal>(())
        })?;
        if is_there {
            return Ok(SongOutcome::Unchanged);
        }
        let made: BTreeSet<&str> = items.iter().map(|item| item.id.as_str()).collect();
        let old = self.former(song, &made);
        items.extend(old.into_iter().chain(self.recovered(song)));
        commit.rows::<PhraseRow>(&phrases)?;
        commit.rows::<BeatRow>(&beats)?;
        settle(commit, items)?;
        Ok(SongOutcome::Phrases(counts))
    }

    /// Keeps the fingerprint of a song whose phrases the store has, and which is met under another: it or a capture
    /// was touched.
    fn see(&self, song: &Song, first: Option<&SettledItem>) -> Result<(), StoreError> {
        let fingerprint = fingerprint(song, self.captures_fingerprint);
        let Some(known) = first.filter(|known| known.item.fingerprint != fingerprint) else {
            return Ok(());
        };
        let BatchJob { store, origin, .. } = self.batches;
        let mut commit = self.seen.start(store, origin);
        self.seen.settle(known, origin, &fingerprint, &mut commit);
        if commit.is_empty() { Ok(()) } else { commit.publish().map(|_| ()) }
    }

    /// Records a song that failed. Its phrases leave the store, except where its files are only out of
    /// reach just now, its rows too old, or its features not extracted anew yet.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn failed_song(&self, song: &Song, failure: &Failure) -> Result<(), StoreError> {
        let is_out_of_reach = matches!(
            failure.kind,
            FailureKind::Unreadable
                | FailureKind::DuplicateId
                | FailureKind::Version
                | FailureKind::StaleFeatures
        );
        let old = if is_out_of_reach { Vec::new() } else { self.former(song, &BTreeSet::new()) };
        self.failures(self.batches.origin, &[(&song.id, &song.url, failure)], old)
    }

    /// Records captures that failed, and takes back the failures of those that did not.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn captures(
        &self,
        origin: &str,
        names: &BTreeSet<String>,
        failed: &[(String, String, Failure)],
    ) -> Result<(), StoreError> {
        let refused: BTreeSet<&str> = failed.iter().map(|(name, ..)| name.as_str()).collect();
        let recovered = names
            .iter()
            .map(String::as_str)
            .filter(|&name| !refused.contains(name) && self.batches.has_failed(name));
        let recovered: Vec<Item> = recovered.map(Item::forgotten).collect();
        let failed: Vec<_> = failed.iter().map(|(name, url, f)| (name, url, f)).collect();
        self.failures(origin, &failed, recovered)
    }

    /// Commits failures that are news, and other items with them.
    fn failures(
        &self,
        origin: &str,
        failed: &[(&String, &String, &Failure)],
        mut items: Vec<Item>,
    ) -> Result<(), StoreError> {
        let mut commit = self.batches_of(origin).start();
        for (name, url, failure) in failed {
            let (found, input_hash) = (Some(failure.digest()), failure.digest());
            let known = self.batches.known(name);
            if known.is_some_and(|known| known.item.failure == found) {
                continue;
            }
            commit.list_failure(name, url, failure);
            let (id, fingerprint) = ((*name).clone(), String::new());
            items.push(Item { id, fingerprint, input_hash, failure: found });
        }
        settle(commit, items)
    }

    /// Removes the phrases and failures of what is no longer among the songs and captures; returns how
    /// many phrases. Without `slugs`, phrases are left alone.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn forget(
        &self,
        origin: &str,
        names: &BTreeSet<String>,
        slugs: Option<&BTreeSet<&str>>,
    ) -> Result<usize, StoreError> {
        let failed =
            self.batches.ledger.failed(origin).into_iter().filter(|id| !names.contains(*id));
        let mut items: Vec<Item> = failed.map(Item::forgotten).collect();
        let n_failures = items.len();
        if let Some(slugs) = slugs {
            let gone = self.constructed.iter().filter(|(slug, _)| !slugs.contains(slug.as_str()));
            let ids = gone.flat_map(|(_, phrases)| phrases.keys());
            items.extend(ids.filter(|id| self.is_ours(id)).map(|id| Item::forgotten(id)));
        }
        let n_phrases = items.len() - n_failures;
        settle(self.batches_of(origin).start(), items)?;
        Ok(n_phrases)
    }

    /// Returns whether a phrase comes from where the songs of this run come from.
    fn is_ours(&self, id: &str) -> bool {
        self.batches.ledger.get(id).is_some_and(|known| known.origin == self.batches.origin)
    }

    /// Returns the phrases that the store has of a song and that were not made again, as items to be
    /// forgotten.
    fn former(&self, song: &Song, made: &BTreeSet<&str>) -> Vec<Item> {
        let phrases = self.constructed.get(&song.slug).into_iter().flatten();
        let ours = phrases.filter(|(id, url)| **url == song.url || self.is_ours(id));
        let left = ours.filter(|(id, _)| !made.contains(id.as_str()));
        left.map(|(id, _)| Item::forgotten(id)).collect()
    }

    /// Returns the failure of a song, to be forgotten.
    fn recovered(&self, song: &Song) -> Option<Item> {
        self.batches.has_failed(&song.id).then(|| Item::forgotten(&song.id))
    }

    /// Returns the digest of everything but the parameters that determines a song's phrases.
    fn input_hash(&self, song: &Song, music: &SongMusic) -> String {
        let lines = [song.url.as_str(), song.split, &music.input_hash, self.captures_hash];
        digest(lines.join("\n").as_bytes())
    }

    /// Refuses a name that stands for something else in the store.
    fn refuse_taken(&self, song: &Song, id: &str) -> Result<(), Failure> {
        // The same song may be named by a folder now and by the store before.
        let former = self.constructed.get(&song.slug).and_then(|phrases| phrases.get(id));
        let is_same = former.is_some_and(|url| *url == song.url);
        let other_origin = || {
            let known = self.batches.ledger.get(id).filter(|known| known.item.succeeded())?;
            (known.origin != self.batches.origin && !is_same && !self.force)
                .then_some(&known.origin)
        };
        let Some(from) = self.others.get(id).or_else(other_origin) else { return Ok(()) };
        let message = format!(
            "{}: its phrase {id} is in the store already, from {from}; rename the song or use another \
             store",
            song.id
        );
        Err(Failure::new(FailureKind::DuplicateId, &song.id, message))
    }
}

/// Settles items in the order of their names, and publishes.
fn settle(mut commit: BatchCommit<'_>, mut items: Vec<Item>) -> Result<(), StoreError> {
    items.sort_by(|a, b| a.id.cmp(&b.id));
    items.into_iter().for_each(|item| commit.settle(item));
    commit.publish()
}
