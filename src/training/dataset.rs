//! Phrases to learn from: read once from the tables of a store, then at hand in any order.

mod frames;

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use ndarray::{Array2, Array3, ArrayView2};

use crate::audio::FEATURE_DIM;
use crate::motion::phase::DEFAULT_BEATS_PER_BAR;
use crate::motion::{Channel, MOTION_DIM, clock};
use crate::store::tables::{self, PhraseRow};
use crate::store::{
    FrameSpool, Location, Patience, Row as _, StoreError, StoreSnapshot, TableSchema, digest,
    outdated_features,
};
use frames::gather;

/// Motion and features of one phrase may differ by this much: ingest lets a frame pass, the last frame of
/// features is centred on the end of the audio, and both lengths are rounded.
const LENGTH_TOLERANCE_FRAMES: usize = 3;

/// The use of a phrase in training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Split {
    Train,
    Validation,
    Test,
}

impl Split {
    /// Returns the split that the table of phrases calls `name`.
    pub fn of_name(name: &str) -> Option<Self> {
        [Self::Train, Self::Validation, Self::Test].into_iter().find(|split| split.name() == name)
    }

    /// Returns the name that the table of phrases uses.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }
}

/// A phrase that is at hand.
#[derive(Clone, Debug, PartialEq)]
pub struct Phrase {
    pub id: Arc<str>,
    pub split: Split,
    /// Dancers of the motion, 1 of a soloist.
    pub n_dancers: usize,
    pub n_frames: usize,
    /// Beats of a bar.
    pub beats_per_bar: u32,
    /// Identity of the music, where the table of phrases tells it.
    pub song_hash: Option<Arc<str>>,
    /// Name of the style of the motion, where somebody named one.
    pub style_name: Option<Arc<str>>,
    /// Digest of the phrase's files, or of its motion and features.
    pub content_hash: Arc<str>,
    /// Digest of the features: phrases to the same stretch of music have the same.
    pub music: Arc<str>,
    /// Frames of each dancer, which may be more than have features.
    motion_frames: usize,
    motion_row: u64,
    feature_row: u64,
}

impl Phrase {
    /// Returns the clock of frames of the phrase's motion, as it is or stretched, \[T, 25\] → \[T, 10\].
    pub fn clock_of(&self, motion: ArrayView2<f32>) -> Array2<f32> {
        let phase = motion.column(Channel::Phase.range().start);
        let phase: Vec<f64> = phase.iter().map(|&x| f64::from(x)).collect();
        clock(&phase, self.beats_per_bar)
    }
}

fn beats_per_bar(row: &PhraseRow) -> u32 {
    row.beats_per_bar.and_then(|n| u32::try_from(n).ok()).unwrap_or(DEFAULT_BEATS_PER_BAR)
}

/// A phrase that cannot be learned from, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExcludedPhrase {
    pub phrase_id: String,
    pub kind: &'static str,
    pub message: String,
}

impl ExcludedPhrase {
    /// The kind of a phrase that has other dancers than are learned from.
    pub const GROUP: &'static str = "group";

    /// Returns whether nothing is wrong with the phrase: it is for another kind of model.
    pub fn is_for_other_models(&self) -> bool {
        self.kind == Self::GROUP
    }
}

/// Whose motion is learned from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ensemble {
    /// One dancer's.
    Soloists,
    /// That of up to `most` dancers together; a soloist is a group of one.
    Groups { most: usize },
}

impl Ensemble {
    /// Returns why a phrase of this number of dancers is not learned from; the text goes on from "has".
    fn refusal(self, n_dancers: usize) -> Option<String> {
        match self {
            Self::Soloists if n_dancers > 1 => {
                Some(format!("{n_dancers} dancers; a model of one dancer learns from soloists"))
            }
            Self::Groups { most } if n_dancers > most => Some(format!(
                "{n_dancers} dancers, more than the {most} of the largest group that is learned from"
            )),
            _ => None,
        }
    }
}

/// How phrases are read.
#[derive(Clone, Debug)]
pub struct DatasetOptions {
    /// Whose motion is read; phrases of others are left out.
    pub ensemble: Ensemble,
    /// Whether frames are kept in memory rather than in a temporary file.
    pub in_memory: bool,
    pub n_threads: NonZeroUsize,
    /// How long a store that does not answer is waited for.
    pub patience: Patience,
    /// Most training phrases; the same ones whatever else the store holds.
    pub max_train_phrases: Option<usize>,
}

/// Phrases with their motion and features, in order of name.
#[derive(Debug)]
pub struct Dataset {
    phrases: Vec<Phrase>,
    motion: FrameSpool,
    features: FrameSpool,
    fingerprint: String,
}

/// Why there is nothing to learn from.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(
        "store {store} has no phrases with both motion and features; run ingest and extract (or library) \
         on it first"
    )]
    Empty { store: String },
    #[error(
        "store {store} has {n_groups} phrases with both motion and features, all of groups of dancers; a model of \
         one dancer learns from soloists"
    )]
    GroupsAlone { store: String, n_groups: usize },
    #[error(
        "store {store}: split {split} is empty ({n_train} train, {n_validation} validation phrases); {way_out}"
    )]
    EmptySplit {
        store: String,
        split: &'static str,
        n_train: usize,
        n_validation: usize,
        way_out: &'static str,
    },
}

impl Dataset {
    /// Reads all phrases with motion and features.
    ///
    /// Phrases that should have both but do not, or whose frames are not sound, are returned as left
    /// out; phrases that never had music (captures) or never had motion (songs) are none of either.
    /// `notice` hears of every failure of the store that is waited out; `progress` of each part read.
    ///
    /// # Errors
    /// [`DatasetError`] when the store cannot be read or has no such phrases.
    pub fn read(
        store: &Location,
        reading: &DatasetOptions,
        notice: &(dyn Fn(&StoreError, Duration) + Sync),
        progress: &(dyn Fn(usize, usize) + Sync),
    ) -> Result<(Self, Vec<ExcludedPhrase>), DatasetError> {
        let wait = |error: &StoreError, pause| notice(error, pause);
        let snapshot = reading.patience.wait_out(wait, || StoreSnapshot::take(store))?;
        Self::of(&snapshot, reading, notice, progress)
    }

    /// Reads all phrases with motion and features of a snapshot, as [`Dataset::read`] does.
    ///
    /// # Errors
    /// As [`Dataset::read`].
    pub fn of(
        snapshot: &StoreSnapshot,
        reading: &DatasetOptions,
        notice: &(dyn Fn(&StoreError, Duration) + Sync),
        progress: &(dyn Fn(usize, usize) + Sync),
    ) -> Result<(Self, Vec<ExcludedPhrase>), DatasetError> {
        let wait = |error: &StoreError, pause| notice(error, pause);
        let take = |schema: fn() -> TableSchema| {
            reading.patience.wait_out(wait, || snapshot.table(schema()))
        };
        let rows: Vec<PhraseRow> = {
            let table = take(PhraseRow::schema)?;
            reading.patience.wait_out(wait, || table.rows())?
        };
        let rows: BTreeMap<String, PhraseRow> = rows
            .into_iter()
            .filter(|row| row.has_motion)
            .map(|row| (row.phrase_id.clone(), row))
            .collect();
        let outdated =
            reading.patience.wait_out(wait, || outdated_features(snapshot, rows.values()))?;
        let wanted: BTreeSet<String> = rows.keys().cloned().collect();
        let spool = |width| match reading.in_memory {
            true => Ok(FrameSpool::in_memory(width)),
            false => FrameSpool::in_file(width),
        };
        let (motion, features) = (spool(MOTION_DIM)?, spool(FEATURE_DIM)?);
        let tables = [take(tables::motion)?, take(tables::features)?];
        let n_parts = tables.iter().map(|table| table.parts().len()).sum();
        let n_read = AtomicUsize::new(0);
        let count = || progress(n_read.fetch_add(1, Ordering::Relaxed) + 1, n_parts);
        // Features have no dancers.
        let of_music = Ensemble::Soloists;
        let [with_motion, with_features] =
            [(&tables[0], &motion, reading.ensemble), (&tables[1], &features, of_music)].map(
                |(table, spool, ensemble)| {
                    gather(table, spool, &wanted, (reading, ensemble), notice, &count)
                },
            );
        let (mut with_motion, mut with_features) = (with_motion?, with_features?);

        let (mut phrases, mut left_out, mut digests) = (Vec::new(), Vec::new(), Vec::new());
        for (id, row) in rows {
            let pair = (with_motion.remove(&id), with_features.remove(&id));
            let found = match pair {
                (Some(Ok(motion)), Some(Ok(features))) => (motion, features),
                (Some(Err(why)), _) | (_, Some(Err(why))) => {
                    left_out.push(why);
                    continue;
                }
                (Some(Ok(_)), None) if !row.has_audio && !row.has_features => continue,
                (motion, _) => {
                    let (kind, message) = match motion {
                        None => ("no_motion", "has no motion in the table; ingest it again"),
                        Some(_) => ("no_features", "has motion but no features; run extract"),
                    };
                    let message = format!("phrase {id} {message}");
                    left_out.push(ExcludedPhrase { phrase_id: id, kind, message });
                    continue;
                }
            };
            let (motion, features) = found;
            if outdated.contains(&id) {
                let message = format!(
                    "phrase {id} has features of files that were replaced since; run extract again"
                );
                left_out.push(ExcludedPhrase { phrase_id: id, kind: "stale_features", message });
                continue;
            }
            if motion.n_frames.abs_diff(features.n_frames) > LENGTH_TOLERANCE_FRAMES {
                let message = format!(
                    "phrase {id}: motion has {} frames but features have {}; they may differ by \
                     {LENGTH_TOLERANCE_FRAMES}",
                    motion.n_frames, features.n_frames
                );
                left_out.push(ExcludedPhrase { phrase_id: id, kind: "length_mismatch", message });
                continue;
            }
            let Some(split) = Split::of_name(&row.split) else {
                let message = format!(
                    "phrase {id} is in split {:?}; known are train, validation and test",
                    row.split
                );
                left_out.push(ExcludedPhrase { phrase_id: id, kind: "split", message });
                continue;
            };
            digests.push(format!("{id}\n{}\n{}\n{}", row.split, motion.digest, features.digest));
            phrases.push(Phrase {
                id: id.into(),
                split,
                n_dancers: motion.n_dancers,
                n_frames: motion.n_frames.min(features.n_frames),
                beats_per_bar: beats_per_bar(&row),
                song_hash: row.song_hash.map(Into::into),
                style_name: row.style_name.map(Into::into),
                content_hash: row.content_hash.into(),
                music: features.digest.into(),
                motion_frames: motion.n_frames,
                motion_row: motion.row,
                feature_row: features.row,
            });
        }
        if let Some(most) = reading.max_train_phrases {
            keep_train(&mut phrases, &mut digests, most);
        }
        if phrases.is_empty() {
            let store = snapshot.store().to_string();
            let n_groups = left_out.iter().filter(|one| one.is_for_other_models()).count();
            return Err(match n_groups {
                0 => DatasetError::Empty { store },
                n_groups => DatasetError::GroupsAlone { store, n_groups },
            });
        }
        let fingerprint = digest(digests.join("\n").as_bytes());
        Ok((Self { phrases, motion, features, fingerprint }, left_out))
    }

    /// Makes a dataset of phrases that are at hand: name, split, motion `[n_frames, 25]` and features
    /// `[n_frames, 163]`.
    ///
    /// Frames are taken as they are; a phrase has as many as the shorter of its two.
    ///
    /// # Errors
    /// [`StoreError`] when the frames cannot be kept.
    ///
    /// # Panics
    /// When frames have another width.
    pub fn in_memory<'a>(
        phrases: impl IntoIterator<Item = (&'a str, Split, Array2<f32>, Array2<f32>)>,
    ) -> Result<Self, StoreError> {
        Self::groups_in_memory(phrases.into_iter().map(|(id, split, motion, features)| {
            (id, split, motion.insert_axis(ndarray::Axis(0)), features)
        }))
    }

    /// Makes a dataset of phrases of groups that are at hand: name, split, motion `[n_dancers, n_frames, 25]` and
    /// features `[n_frames, 163]`, as [`Dataset::in_memory`] does.
    ///
    /// # Errors
    /// [`StoreError`] when the frames cannot be kept.
    ///
    /// # Panics
    /// When frames have another width.
    pub fn groups_in_memory<'a>(
        phrases: impl IntoIterator<Item = (&'a str, Split, Array3<f32>, Array2<f32>)>,
    ) -> Result<Self, StoreError> {
        let (motion, features) =
            (FrameSpool::in_memory(MOTION_DIM), FrameSpool::in_memory(FEATURE_DIM));
        let mut given: Vec<_> = phrases.into_iter().collect();
        given.sort_by_key(|&(id, ..)| id);
        let (mut phrases, mut digests) = (Vec::new(), Vec::new());
        for (id, split, of_motion, of_features) in given {
            let (n_dancers, motion_frames, width) = of_motion.dim();
            let rows = of_motion.as_standard_layout();
            let rows = rows
                .to_shape((n_dancers * motion_frames, width))
                .expect("invariant: as many numbers, in order");
            let digest_of = |frames: ArrayView2<f32>| {
                digest(&frames.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<_>>())
            };
            let (a, b) = (digest_of(rows.view()), digest_of(of_features.view()));
            let a = if n_dancers == 1 { a } else { format!("{n_dancers} dancers {a}") };
            digests.push(format!("{id}\n{}\n{a}\n{b}", split.name()));
            let content_hash = digest(format!("features {b}\nmotion {a}\n").as_bytes());
            phrases.push(Phrase {
                id: id.into(),
                split,
                n_dancers,
                n_frames: motion_frames.min(of_features.nrows()),
                beats_per_bar: DEFAULT_BEATS_PER_BAR,
                song_hash: None,
                style_name: None,
                content_hash: content_hash.into(),
                music: b.into(),
                motion_frames,
                motion_row: motion.append(rows.view())?,
                feature_row: features.append(of_features.view())?,
            });
        }
        let fingerprint = digest(digests.join("\n").as_bytes());
        Ok(Self { phrases, motion, features, fingerprint })
    }

    /// Refuses a dataset without training or validation phrases.
    ///
    /// # Errors
    /// [`DatasetError::EmptySplit`].
    pub fn check_splits(&self, store: &str) -> Result<(), DatasetError> {
        let [n_train, n_validation] = [Split::Train, Split::Validation].map(|s| self.n_in(s));
        let (split, way_out) = match (n_train, n_validation) {
            (0, _) => ("train", "a store of a handful of phrases may have none: ingest more"),
            (_, 0) => (
                "validation",
                "without it nobody can tell what was learned: ingest more phrases, or build a library \
                 from at least three songs",
            ),
            _ => return Ok(()),
        };
        let store = store.to_owned();
        Err(DatasetError::EmptySplit { store, split, n_train, n_validation, way_out })
    }

    /// Returns all phrases, in order of name.
    pub fn phrases(&self) -> &[Phrase] {
        &self.phrases
    }

    /// Returns how many phrases a split has.
    pub fn n_in(&self, split: Split) -> usize {
        self.phrases.iter().filter(|phrase| phrase.split == split).count()
    }

    /// Returns a digest of everything there is to learn from: names, splits, motion and features.
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// Returns frames of motion of a phrase, of a group those of its first dancer, `[n_frames, 25]`.
    ///
    /// # Errors
    /// [`StoreError`] when the frames at hand cannot be read.
    pub fn motion(
        &self,
        phrase: &Phrase,
        first: usize,
        n_frames: usize,
    ) -> Result<Array2<f32>, StoreError> {
        read(&self.motion, phrase.motion_row + first as u64, [n_frames, MOTION_DIM])
    }

    /// Returns frames of motion of all dancers of a phrase, `[n_dancers, n_frames, 25]`; a soloist is a group of one.
    ///
    /// # Errors
    /// [`StoreError`] when the frames at hand cannot be read.
    pub fn group(
        &self,
        phrase: &Phrase,
        first: usize,
        n_frames: usize,
    ) -> Result<Array3<f32>, StoreError> {
        let mut frames = Array3::zeros((phrase.n_dancers, n_frames, MOTION_DIM));
        for (mut of_dancer, dancer) in frames.outer_iter_mut().zip(0..) {
            let row = phrase.motion_row + dancer * phrase.motion_frames as u64 + first as u64;
            let target = of_dancer.as_slice_mut().expect("new arrays lie in order");
            self.motion.read(row, target)?;
        }
        Ok(frames)
    }

    /// Returns frames of features of a phrase, `[n_frames, 163]`.
    ///
    /// # Errors
    /// [`StoreError`] when the frames at hand cannot be read.
    pub fn features(
        &self,
        phrase: &Phrase,
        first: usize,
        n_frames: usize,
    ) -> Result<Array2<f32>, StoreError> {
        read(&self.features, phrase.feature_row + first as u64, [n_frames, FEATURE_DIM])
    }
}

fn read(spool: &FrameSpool, first: u64, shape: [usize; 2]) -> Result<Array2<f32>, StoreError> {
    let mut frames = Array2::zeros(shape);
    spool.read(first, frames.as_slice_mut().expect("new arrays lie in order"))?;
    Ok(frames)
}

/// Keeps the `most` training phrases whose names have the smallest digests, which is no order that
/// names or sources have.
fn keep_train(phrases: &mut Vec<Phrase>, digests: &mut Vec<String>, most: usize) {
    let mut order: Vec<_> = phrases
        .iter()
        .filter(|phrase| phrase.split == Split::Train)
        .map(|phrase| (digest(phrase.id.as_bytes()), Arc::clone(&phrase.id)))
        .collect();
    order.sort();
    let kept: BTreeSet<_> = order.into_iter().take(most).map(|(_, id)| id).collect();
    let keeps: Vec<bool> = phrases
        .iter()
        .map(|phrase| phrase.split != Split::Train || kept.contains(&phrase.id))
        .collect();
    let mut keep = keeps.iter();
    phrases.retain(|_| keep.next() == Some(&true));
    let mut keep = keeps.iter();
    digests.retain(|_| keep.next() == Some(&true));
}
