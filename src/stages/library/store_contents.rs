//! What a store knows: songs, captures, and the phrases that were constructed before.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::songs::{Song, SongFiles, slug, slug_of};
use super::split::TRAIN;
use crate::stages::Stage as _;
use crate::stages::beats::{self, BeatSource};
use crate::stages::extract::Extract;
use crate::stages::failure::{Failure, FailureKind};
use crate::store::tables::{ExtractionRow, PhraseRow};
use crate::store::{Location, Row, StoreError, StoreSnapshot, outdated_features};

/// The songs, captures and phrases of a store.
#[derive(Debug, Default)]
pub struct StoreContents {
    /// Phrases with audio and features.
    pub songs: BTreeMap<String, Song>,
    /// Phrases with audio, but without features.
    pub n_without_features: usize,
    /// Phrases with motion and without audio that were not constructed, and their digests.
    pub captures: BTreeMap<String, String>,
    /// Constructed phrases with the URLs of their songs, by the part of their name that stands for the
    /// song.
    pub constructed: BTreeMap<String, BTreeMap<String, String>>,
    /// What stands for the songs of constructed phrases that do not tell which music they are to: release 0.1 did
    /// not write it.
    pub unidentified: BTreeSet<String>,
    /// Names of all other phrases, and their sources.
    pub others: HashMap<String, String>,
}

impl StoreContents {
    /// Reads the tables of a store; an empty one knows nothing.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read(store: &StoreSnapshot) -> Result<Self, StoreError> {
        let mut known = Self::default();
        let mut with_audio: BTreeMap<String, PhraseRow> = BTreeMap::new();
        each(store, |row: PhraseRow| {
            if row.is_constructed() {
                let slug = slug_of(&row.phrase_id).to_owned();
                if row.song_hash.is_none() {
                    known.unidentified.insert(slug.clone());
                }
                let phrases_of_song = known.constructed.entry(slug);
                phrases_of_song.or_default().insert(row.phrase_id, row.source);
                return;
            }
            known.others.insert(row.phrase_id.clone(), row.source.clone());
            if row.audio_url.is_some() {
                with_audio.insert(row.phrase_id.clone(), row);
            } else if row.has_motion {
                known.captures.insert(row.phrase_id, row.content_hash);
            }
        })?;
        let mut extracted: BTreeMap<String, usize> = BTreeMap::new();
        each(store, |row: ExtractionRow| {
            let n_frames = usize::try_from(row.n_frames).unwrap_or(0);
            extracted.insert(row.phrase_id, n_frames);
        })?;
        let outdated = outdated_features(store, with_audio.values())?;
        let mut beats = beats::of_phrases(store, |id| with_audio.contains_key(id))?;
        // Other features of the same file have another digest of parameters.
        let extract = store.ledger(Extract::NAME)?;
        for (id, row) in with_audio {
            let (Some(&n_frames), Some(url)) = (extracted.get(&id), row.audio_url.clone()) else {
                known.n_without_features += 1;
                continue;
            };
            let known_beats = beats.remove(&id).unwrap_or_default();
            // Rows of release 0.1 do not say it; they are the tracker's where there is audio.
            let beat_source = known_beats.source().unwrap_or(BeatSource::Tracker);
            let unread_list =
                row.beats_url.as_ref().filter(|_| beat_source != BeatSource::BeatsFile);
            let is_outdated = outdated.contains(&id);
            let problem = match unread_list {
                Some(list) => Some(unread(&id, list)),
                None => is_outdated.then(|| with_old_features(&id, store.store())),
            };
            let params_hash = extract.get(&id).map_or("", |settled| &settled.params_hash);
            let slug = slug(&id);
            let song = Song {
                is_unidentified: row.song_hash.is_some() && known.unidentified.contains(&slug),
                slug,
                url,
                fingerprint: format!("store {} {params_hash}", row.content_hash),
                split: TRAIN,
                problem,
                files: SongFiles::Store {
                    n_frames,
                    song_hash: row.song_hash.clone(),
                    beats: known_beats.in_bars(&row),
                    n_beats: known_beats.times_s().len(),
                    beat_source,
                },
                id: id.clone(),
            };
            known.songs.insert(id, song);
        }
        Ok(known)
    }
}

/// Returns why a song is left alone whose beat list was ingested by release 0.1, which kept its place alone.
fn unread(id: &str, list: &str) -> Failure {
    let message = format!(
        "{id}: the store does not have the beats of {list}, which an older motiongen ingested; run ingest \
         again, then extract and library"
    );
    Failure::new(FailureKind::Version, id, message)
}

/// Returns why a song is left alone whose file was replaced since its features were extracted.
fn with_old_features(id: &str, store: &Location) -> Failure {
    let message = format!(
        "{id}: its features are of a file that was replaced since; run motiongen extract --store {store} first"
    );
    Failure::new(FailureKind::StaleFeatures, id, message)
}

/// Visits the rows of a table without holding all of them.
fn each<R: Row>(store: &StoreSnapshot, mut visit: impl FnMut(R)) -> Result<(), StoreError> {
    let table = store.table(R::schema())?;
    for batch in table.batches() {
        let rows = R::from_batch(&batch?).unwrap_or_default();
        rows.into_iter().for_each(&mut visit);
    }
    Ok(())
}
