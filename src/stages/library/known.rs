//! What a store knows: songs, captures, and the phrases that were constructed before.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::songs::{BeatList, Files, Song, slug, slug_of};
use super::split::TRAIN;
use crate::stages::Stage as _;
use crate::stages::extract::Extract;
use crate::store::tables::{BeatRow, ExtractionRow, PhraseRow};
use crate::store::{Ledger, Location, Row, Snapshot, StoreError};

/// What a store knows.
#[derive(Debug, Default)]
pub struct Known {
    /// Phrases with audio and features.
    pub songs: BTreeMap<String, Song>,
    /// Phrases with audio, but without features.
    pub n_without_features: usize,
    /// Phrases with motion and without audio that nobody constructed, and their digests.
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

impl Known {
    /// Reads the tables of a store; an empty one knows nothing.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read(store: &Location) -> Result<Self, StoreError> {
        let mut known = Self::default();
        let mut with_audio: BTreeMap<String, PhraseRow> = BTreeMap::new();
        each(store, |row: PhraseRow| {
            if row.is_constructed() {
                let slug = slug_of(&row.phrase_id).to_owned();
                if row.song_hash.is_none() {
                    known.unidentified.insert(slug.clone());
                }
                let of_song = known.constructed.entry(slug);
                of_song.or_default().insert(row.phrase_id, row.source);
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
        let mut beats: BTreeMap<String, Vec<(i32, f64)>> = BTreeMap::new();
        each(store, |row: BeatRow| {
            if with_audio.contains_key(&row.phrase_id) {
                beats.entry(row.phrase_id).or_default().push((row.beat, row.time_s));
            }
        })?;
        // Other features of the same file have another digest of parameters.
        let extract = Ledger::read(store, Extract::NAME)?;
        for (id, row) in with_audio {
            let (Some(&n_frames), Some(url)) = (extracted.get(&id), row.audio_url) else {
                known.n_without_features += 1;
                continue;
            };
            let mut tracked = beats.remove(&id).unwrap_or_default();
            tracked.sort_by_key(|beat| beat.0);
            let size_bytes = row.beats_bytes.and_then(|n| u64::try_from(n).ok()).unwrap_or(0);
            let beat_list =
                row.beats_url.map(|url| BeatList { source: row.source, url, size_bytes });
            let params_hash = extract.get(&id).map_or("", |settled| &settled.params_hash);
            let slug = slug(&id);
            let song = Song {
                is_unidentified: row.song_hash.is_some() && known.unidentified.contains(&slug),
                slug,
                url,
                fingerprint: format!("store {} {params_hash}", row.content_hash),
                split: TRAIN,
                problem: None,
                files: Files::Store {
                    n_frames,
                    song_hash: row.song_hash,
                    tracked_s: tracked.into_iter().map(|beat| beat.1).collect(),
                    beat_list,
                },
                id: id.clone(),
            };
            known.songs.insert(id, song);
        }
        Ok(known)
    }
}

/// Visits the rows of a table without holding all of them.
fn each<R: Row>(store: &Location, mut visit: impl FnMut(R)) -> Result<(), StoreError> {
    let snapshot = Snapshot::take(store, R::schema())?;
    for batch in snapshot.batches() {
        let rows = R::from_batch(&batch?).unwrap_or_default();
        rows.into_iter().for_each(&mut visit);
    }
    Ok(())
}
