//! The music that is danced to: songs of a folder, or those that a store has features of.

use std::collections::{BTreeMap, HashMap};
use std::sync::mpsc::SyncSender;

use anyhow::bail;
use ndarray::Array2;

use super::StoreContents;
use super::made::{Performance, Piece};
use crate::motion::Beats;
use crate::stages::beats::BeatSource;
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::ingest::{Layout, Role, plan};
use crate::store::{Content, Source, SourceFile, StoreError, StoreSnapshot, digest, tables};

/// Longest name of a song within the name of a phrase, in bytes; a folder's name may have 255.
const MAX_SLUG_BYTES: usize = 180;

/// A song that was found, not yet read.
#[derive(Clone, Debug)]
pub struct Song {
    /// Its name: the phrase of the store, or the path below the folder.
    pub id: String,
    /// The part of its phrases' names that stands for it.
    pub slug: String,
    /// The audio file, as `source` of its phrases.
    pub url: String,
    /// The fingerprint of its files, known without reading them.
    pub fingerprint: String,
    pub split: &'static str,
    /// Whether the store has phrases of it that do not tell which music they are to, and now could.
    pub is_unidentified: bool,
    /// The reason why it cannot be danced to, where that is known already.
    pub problem: Option<Failure>,
    pub files: SongFiles,
}

/// Where a song's data lie.
#[derive(Clone, Debug)]
pub enum SongFiles {
    /// Features and beats in the store.
    Store {
        n_frames: usize,
        /// Digest of the audio file, as ingest recorded it.
        song_hash: Option<String>,
        /// None where there are too few to tell a tempo.
        beats: Option<Beats>,
        n_beats: usize,
        beat_source: BeatSource,
    },
    Folder {
        audio: SourceFile,
        beat_list: Option<SourceFile>,
    },
    /// None that can be read.
    Missing,
    /// None: it is played from a score.
    Score {
        piece: Piece,
        /// Chooses who plays it, and how.
        seed: u64,
        /// At most.
        duration_s: f64,
    },
}

/// The data of a song as it was read.
pub enum SongInput {
    Features(Result<Array2<f32>, Failure>),
    Files {
        audio: Result<Content, StoreError>,
        beat_list: Option<Result<Content, StoreError>>,
        /// The read-ahead budget of the files, given back when the song is done.
        _permits: Vec<Box<dyn Send>>,
    },
    /// The song has still to be played.
    Unplayed {
        duration_s: f64,
    },
    Performed(Performance),
}

/// Songs that were found.
pub struct Songs {
    /// Where they come from, as commits name it.
    pub origin: String,
    pub songs: Vec<Song>,
    /// Phrases with audio, but without features.
    pub n_without_features: usize,
    place: SongSource,
}

#[derive(Clone)]
enum SongSource {
    Store(StoreSnapshot),
    Folder(Source),
}

impl Songs {
    /// Finds the songs of a store: phrases with audio whose features extract has.
    ///
    /// # Errors
    /// When there is none and one is needed.
    pub fn of_store(
        snapshot: &StoreSnapshot,
        known: &mut StoreContents,
        is_needed: bool,
    ) -> anyhow::Result<Self> {
        let store = snapshot.store();
        if known.songs.is_empty() && is_needed {
            let hint = match known.n_without_features {
                0 => {
                    format!("run first: motiongen ingest --source MUSIC --store {store}, and then")
                }
                n => format!("{n} phrases with audio wait for"),
            };
            bail!(
                "store {store} has no songs: no phrase has audio and features; {hint} motiongen \
                 extract --store {store}; or name a folder of music with --songs, or have some composed with \
                 --compose"
            );
        }
        let songs = std::mem::take(&mut known.songs);
        Ok(Self {
            origin: super::FROM_STORE.to_owned(),
            songs: songs.into_values().collect(),
            n_without_features: known.n_without_features,
            place: SongSource::Store(snapshot.clone()),
        })
    }

    /// Finds every audio file below a folder, and the beat lists beside them.
    ///
    /// # Errors
    /// When the folder cannot be listed or has no audio.
    pub fn of_folder(source: Source, known: &StoreContents) -> anyhow::Result<Self> {
        let plan = plan(source.list()?, Layout::Library);
        if plan.phrases.is_empty() {
            bail!(
                "songs folder {}: no audio among {} files; name the folder of your music (WAV, AIFF, \
                 FLAC, MP3, Ogg Vorbis, Opus, M4A or AAC)",
                source.location(),
                plan.ignored.len()
            );
        }
        let mut songs = Vec::with_capacity(plan.phrases.len());
        for planned in plan.phrases {
            let file = |role: Role| planned.files.iter().find(|(r, _)| *r == role);
            let file = |role: Role| file(role).map(|(_, file)| file.clone());
            let mut problem = planned.problem.as_deref().cloned();
            let audio = file(Role::Audio).unwrap_or_else(|| {
                let message = format!("{} is no audio file; remove it", planned.id);
                let failure = Failure::new(FailureKind::NotAFile, &planned.id, message);
                problem.get_or_insert(failure);
                SourceFile { path: planned.id.clone(), size_bytes: 0, fingerprint: String::new() }
            });
            let beat_list = file(Role::Beats);
            let slug = slug(&planned.id);
            let list_fingerprint = beat_list.as_ref().map_or("none", |f| &f.fingerprint);
            songs.push(Song {
                url: source.location().url_of(&planned.id),
                is_unidentified: known.unidentified.contains(&slug),
                slug,
                fingerprint: format!("files {} {list_fingerprint}", audio.fingerprint),
                split: super::split::TRAIN,
                problem,
                files: SongFiles::Folder { audio, beat_list },
                id: planned.id,
            });
        }
        let origin = source.location().url().to_owned();
        Ok(Self { origin, songs, n_without_features: 0, place: SongSource::Folder(source) })
    }

    /// Gives songs a problem whose phrases would be called like those of another one.
    pub fn refuse_namesakes(&mut self) {
        let mut taken: HashMap<String, String> = HashMap::new();
        for song in &mut self.songs {
            // Some file systems take both cases for one.
            if let Some(other) = taken.insert(song.slug.to_lowercase(), song.id.clone()) {
                let message = format!(
                    "phrases of {} and of {other} would both be called {}.t…; rename one of them",
                    song.id, song.slug
                );
                let failure = Failure::new(FailureKind::DuplicateId, &song.id, message);
                song.problem.get_or_insert(failure);
            }
        }
    }

    /// Splits off what reads the songs `todo`.
    pub fn feeding(&self, todo: Vec<Song>) -> SongFeed {
        let (made, read) = todo.into_iter().partition(Song::is_made);
        SongFeed { place: self.place.clone(), read, made }
    }
}

impl Song {
    /// Returns whether the song is played here, and not read.
    pub fn is_made(&self) -> bool {
        matches!(self.files, SongFiles::Score { .. })
    }
}

/// Songs on their way to the workers.
pub struct SongFeed {
    place: SongSource,
    read: Vec<Song>,
    made: Vec<Song>,
}

impl SongFeed {
    /// Sends every song with its input until the receiver is dropped.
    ///
    /// # Errors
    /// [`StoreError`] when the table of features cannot be read.
    pub fn run(self, sender: &SyncSender<(Song, SongInput)>) -> Result<(), StoreError> {
        match &self.place {
            _ if self.read.is_empty() => {}
            SongSource::Folder(source) => send_files(source, self.read, sender),
            SongSource::Store(store) => send_features(store, self.read, sender)?,
        }
        for song in self.made {
            let SongFiles::Score { duration_s, .. } = song.files else { continue };
            if sender.send((song, SongInput::Unplayed { duration_s })).is_err() {
                break;
            }
        }
        Ok(())
    }
}

fn send_files(source: &Source, songs: Vec<Song>, sender: &SyncSender<(Song, SongInput)>) {
    let files = songs.iter().flat_map(|song| match &song.files {
        SongFiles::Folder { audio, beat_list } => vec![Some(audio.clone()), beat_list.clone()],
        SongFiles::Store { .. } | SongFiles::Score { .. } | SongFiles::Missing => Vec::new(),
    });
    let mut reader = source.read_in_order(files.flatten().collect());
    for song in songs {
        let SongFiles::Folder { beat_list, .. } = &song.files else { continue };
        let mut permits: Vec<Box<dyn Send>> = Vec::new();
        let mut next = || {
            let gone = || StoreError::NotFound { place: song.url.clone(), hint: "" };
            let (content, permit) = reader.next().unwrap_or_else(|| (Err(gone()), None));
            permits.extend(permit.map(|permit| Box::new(permit) as Box<dyn Send>));
            content
        };
        let audio = next();
        let beat_list = beat_list.as_ref().map(|_| next());
        let input = SongInput::Files { audio, beat_list, _permits: permits };
        if sender.send((song, input)).is_err() {
            break;
        }
    }
}

fn send_features(
    store: &StoreSnapshot,
    songs: Vec<Song>,
    sender: &SyncSender<(Song, SongInput)>,
) -> Result<(), StoreError> {
    let mut missing: BTreeMap<String, Song> =
        songs.into_iter().map(|song| (song.id.clone(), song)).collect();
    let wanted = missing.keys().cloned().collect();
    store.table(tables::features())?.visit_items(&wanted, |id, frames| {
        if let Some(song) = missing.remove(id) {
            // The receiver is dropped when the job has failed; the job reports that itself.
            sender.send((song, SongInput::Features(Ok(frames)))).ok();
        }
        Ok::<_, StoreError>(())
    })?;
    for (id, song) in missing {
        let message = format!("{id}: its features are gone from the store; run extract again");
        let failure = Failure::new(FailureKind::Unreadable, &id, message);
        if sender.send((song, SongInput::Features(Err(failure)))).is_err() {
            break;
        }
    }
    Ok(())
}

/// Returns what stands for a song in the names of its phrases: one name of a folder, no path.
pub fn slug(song: &str) -> String {
    let mut slug: String = song.chars().map(|c| if c == '/' { '-' } else { c }).collect();
    if slug.starts_with('.') {
        // A hidden beat list would be passed over by ingest.
        slug.replace_range(0..1, "_");
    }
    if slug.len() > MAX_SLUG_BYTES {
        let end = (0..=MAX_SLUG_BYTES).rev().find(|&i| slug.is_char_boundary(i)).unwrap_or(0);
        slug.truncate(end);
        slug = format!("{slug}-{}", &digest(song.as_bytes())[..16]);
    }
    slug
}

/// Returns what stands for the song in the name of a phrase, `SLUG.tTAKE.NUMBER`.
pub fn slug_of(phrase: &str) -> &str {
    let take = phrase.rsplit_once('.').map_or(phrase, |(take, _)| take);
    take.rsplit_once(".t").map_or(take, |(slug, _)| slug)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_names_of_folders() {
        assert_eq!(slug("album/a b/ü.ogg"), "album-a b-ü.ogg");
        assert_eq!(slug(".x/y.ogg"), "_x-y.ogg");
        let long = slug(&"ü".repeat(200));
        assert!(long.len() <= MAX_SLUG_BYTES + 17 && long.starts_with("üü"), "{long}");
        assert_ne!(long, slug(&"ü".repeat(201)));
        assert_eq!(slug_of("a.t1.t00.wav.t07.0012"), "a.t1.t00.wav");
    }
}
