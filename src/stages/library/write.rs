//! Songs into the store: one commit per song, whole or absent.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::layout::Output;
use super::one::{self, Constructed, Music, dance, nearest_frame};
use super::songs::Song;
use super::{Library, Rules};
use crate::motion::choreography::Repertoire;
use crate::stages::Stage as _;
use crate::stages::failure::{Failure, FailureKind};
use crate::store::tables::{self, BeatRow, CONSTRUCTED, FailureRow, PhraseRow};
use crate::store::{Commit, Item, Ledger, Location, Row as _, StoreError, TimestampUs, digest};
use crate::units::frames_to_s;

/// Writes songs and failures.
pub struct Writer<'a> {
    pub store: &'a Location,
    pub ledger: &'a Ledger,
    pub params_hash: &'a str,
    /// Where the songs come from, as commits name it.
    pub origin: &'a str,
    pub rules: &'a Rules,
    pub repertoire: &'a Repertoire,
    /// Digest of the captures' content.
    pub captures_hash: &'a str,
    /// What the storage says of the captures.
    pub captures_fingerprint: &'a str,
    /// Constructed phrases that the store has, by the URL of their song.
    pub constructed: &'a BTreeMap<String, BTreeSet<String>>,
    /// All other phrases of the store, and their sources.
    pub others: &'a HashMap<String, String>,
    pub output: Option<&'a Output>,
    pub force: bool,
}

/// What became of a song.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    /// So many new phrases.
    Phrases(usize),
    /// So many phrases that the store has already.
    Unchanged(usize),
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

/// Returns whether the store has the phrases of a song, made from these inputs with these parameters.
///
/// A song is committed whole, so its first phrase stands for all.
pub fn is_settled(
    song: &Song,
    ledger: &Ledger,
    params_hash: &str,
    rules: &Rules,
    fingerprint: &str,
) -> bool {
    let is_refused = ledger.get(&song.id).is_some_and(|known| known.item.failure.is_some());
    let first = ledger.get(&one::phrase_id(song, rules, 0, 0));
    !is_refused
        && first.is_some_and(|known| {
            known.params_hash == params_hash
                && known.item.succeeded()
                && known.item.fingerprint == fingerprint
        })
}

impl Writer<'_> {
    fn start(&self, origin: &str) -> Commit<'_> {
        Commit::new(self.store, Library::NAME, self.params_hash, origin)
    }

    /// Makes and commits the phrases of a song.
    ///
    /// # Errors
    /// [`Refusal`]; nothing of the song is in the store then that was not there before.
    pub fn song(&self, song: &Song, music: &Music) -> Result<Written, Refusal> {
        let input_hash = self.input_hash(song, music);
        let first = self.ledger.get(&one::phrase_id(song, self.rules, 0, 0));
        let is_there = !self.force
            && first.is_some_and(|known| {
                known.params_hash == self.params_hash
                    && known.item.succeeded()
                    && known.item.input_hash == input_hash
            });
        if is_there && self.output.is_none() {
            let n_phrases = self.constructed.get(&song.url).map_or(0, BTreeSet::len);
            return Ok(Written::Unchanged(n_phrases));
        }
        let mut commit = self.start(self.origin);
        let fingerprint = fingerprint(song, self.captures_fingerprint);
        let (mut phrases, mut beats) = (Vec::new(), Vec::new());
        let mut items: Vec<Item> = Vec::new();
        let n_phrases = dance(song, music, self.repertoire, self.rules, |phrase| {
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
            part.write_frames(&phrase.id, phrase.motion.view())?;
            let part = commit.part(tables::FEATURES, tables::features)?;
            part.write_frames(&phrase.id, phrase.features.view())?;
            phrases.push(phrase_row(song, music, &phrase));
            beats.extend(beat_rows(&phrase));
            let (fingerprint, input_hash) = (fingerprint.clone(), input_hash.clone());
            items.push(Item { id: phrase.id, fingerprint, input_hash, failure: None });
            Ok::<(), Refusal>(())
        })?;
        if is_there {
            return Ok(Written::Unchanged(n_phrases));
        }
        let made: BTreeSet<&str> = items.iter().map(|item| item.id.as_str()).collect();
        let mut old: Vec<Item> = self.former(song, &made);
        items.append(&mut old);
        let schema = PhraseRow::schema;
        commit.part(schema().name, schema)?.write_rows(&phrases)?;
        if !beats.is_empty() {
            commit.part(BeatRow::schema().name, BeatRow::schema)?.write_rows(&beats)?;
        }
        self.settle(commit, items)?;
        Ok(Written::Phrases(n_phrases))
    }

    /// Records a song that failed. Its phrases leave the store, except where its files are only out of
    /// reach just now.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn failed_song(&self, song: &Song, failure: &Failure) -> Result<(), StoreError> {
        let is_out_of_reach =
            matches!(failure.kind, FailureKind::Unreadable | FailureKind::DuplicateId);
        let old = if is_out_of_reach { Vec::new() } else { self.former(song, &BTreeSet::new()) };
        self.failures(self.origin, &[(&song.id, &song.url, failure)], old)
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
        let recovered = names.iter().map(String::as_str).filter(|&name| {
            !refused.contains(name)
                && self.ledger.get(name).is_some_and(|known| known.item.failure.is_some())
        });
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
        let mut commit = self.start(origin);
        let mut rows = Vec::new();
        for (name, url, failure) in failed {
            let (found, input_hash) = (Some(failure.digest()), failure.digest());
            let is_known = self.ledger.get(name).is_some_and(|known| {
                known.params_hash == self.params_hash && known.item.failure == found
            });
            if is_known {
                continue;
            }
            rows.push(FailureRow {
                stage: Library::NAME.to_owned(),
                phrase_id: (*name).clone(),
                source: (*url).clone(),
                kind: failure.kind.name().to_owned(),
                message: failure.message.clone(),
                time: TimestampUs::now(),
            });
            let (id, fingerprint) = ((*name).clone(), String::new());
            items.push(Item { id, fingerprint, input_hash, failure: found });
        }
        if !rows.is_empty() {
            rows.sort_by(|a, b| a.phrase_id.cmp(&b.phrase_id));
            commit.part(FailureRow::schema().name, FailureRow::schema)?.write_rows(&rows)?;
        }
        self.settle(commit, items)
    }

    /// Removes the phrases and failures of what is no longer among the songs and captures.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn forget(
        &self,
        origin: &str,
        names: &BTreeSet<String>,
        urls: Option<&BTreeSet<&str>>,
    ) -> Result<usize, StoreError> {
        let failed = self.ledger.failed(origin).into_iter().filter(|id| !names.contains(*id));
        let mut items: Vec<Item> = failed.map(Item::forgotten).collect();
        let is_ours = |id: &&String| {
            let known = self.ledger.get(id);
            known.is_some_and(|known| known.origin == origin && known.item.succeeded())
        };
        let n_failures = items.len();
        if let Some(urls) = urls {
            let gone = self.constructed.iter().filter(|(url, _)| !urls.contains(url.as_str()));
            let ids = gone.flat_map(|(_, ids)| ids).filter(is_ours);
            items.extend(ids.map(|id| Item::forgotten(id)));
        }
        let n_phrases = items.len() - n_failures;
        self.settle(self.start(origin), items)?;
        Ok(n_phrases)
    }

    /// Returns the phrases that the store has of a song and that were not made again, and the song's
    /// failure, as items to be forgotten.
    fn former(&self, song: &Song, made: &BTreeSet<&str>) -> Vec<Item> {
        let has_failed =
            self.ledger.get(&song.id).is_some_and(|known| known.item.failure.is_some());
        let failure = (has_failed && !made.is_empty()).then_some(&song.id);
        let phrases = self.constructed.get(&song.url).into_iter().flatten();
        let phrases = phrases.filter(|id| !made.contains(id.as_str()));
        phrases.chain(failure).map(|id| Item::forgotten(id)).collect()
    }

    fn settle(&self, mut commit: Commit<'_>, mut items: Vec<Item>) -> Result<(), StoreError> {
        items.sort_by(|a, b| a.id.cmp(&b.id));
        for item in items {
            commit.settle(item, self.ledger);
        }
        if commit.is_empty() { Ok(()) } else { commit.publish().map(|_| ()) }
    }

    /// Returns the digest of everything but the parameters that determines a song's phrases.
    fn input_hash(&self, song: &Song, music: &Music) -> String {
        let lines = [song.url.as_str(), song.split, &music.input_hash, self.captures_hash];
        digest(lines.join("\n").as_bytes())
    }

    /// Refuses a name that stands for something else in the store.
    fn refuse_taken(&self, song: &Song, id: &str) -> Result<(), Failure> {
        // The same song may be named by a folder now and by the store before.
        let is_same = self.constructed.get(&song.url).is_some_and(|ids| ids.contains(id));
        let of_another = || {
            let known = self.ledger.get(id).filter(|known| known.item.succeeded())?;
            (known.origin != self.origin && !is_same && !self.force).then_some(&known.origin)
        };
        let Some(from) = self.others.get(id).or_else(of_another) else { return Ok(()) };
        let message = format!(
            "{}: its phrase {id} is in the store already, from {from}; rename the song or use another \
             store",
            song.id
        );
        Err(Failure::new(FailureKind::DuplicateId, &song.id, message))
    }
}

fn phrase_row(song: &Song, music: &Music, phrase: &Constructed) -> PhraseRow {
    let n_frames = phrase.motion.nrows();
    PhraseRow {
        phrase_id: phrase.id.clone(),
        source: song.url.clone(),
        motion_url: None,
        features_url: None,
        audio_url: None,
        beats_url: None,
        motion_bytes: None,
        features_bytes: None,
        audio_bytes: None,
        beats_bytes: None,
        content_hash: content_hash(phrase),
        has_motion: true,
        has_features: true,
        has_audio: false,
        has_beats: !phrase.beats.is_empty(),
        motion_format: Some(CONSTRUCTED.to_owned()),
        audio_codec: None,
        sample_rate_hz: None,
        n_channels: None,
        duration_s: frames_to_s(n_frames),
        n_frames: Some(n_frames as i64),
        n_feature_frames: Some(n_frames as i64),
        split: song.split.to_owned(),
        tempo_bpm: Some(music.beats.tempo_bpm()),
        tempo_source: Some(music.tempo_source.to_owned()),
        beats_per_bar: Some(music.beats.beats_per_bar() as i32),
        beats_per_bar_source: Some(music.beats_per_bar_source().to_owned()),
    }
}

/// Digest over one line `role digest` for features and motion, as for the files of a phrase.
fn content_hash(phrase: &Constructed) -> String {
    let of = |values: &ndarray::Array2<f32>| {
        let bytes: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        digest(&bytes)
    };
    let lines = format!("features {}\nmotion {}\n", of(&phrase.features), of(&phrase.motion));
    digest(lines.as_bytes())
}

fn beat_rows(phrase: &Constructed) -> impl Iterator<Item = BeatRow> + '_ {
    phrase.beats.iter().enumerate().map(|(beat, &(time_s, _))| BeatRow {
        phrase_id: phrase.id.clone(),
        beat: beat as i32,
        frame: nearest_frame(time_s, phrase.motion.nrows()) as i32,
        time_s,
    })
}
