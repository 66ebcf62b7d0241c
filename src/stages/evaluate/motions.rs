//! The motions that are evaluated, and the music of each.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use anyhow::bail;

use ndarray::ArrayView2;

use super::foreign;
use crate::audio::BLOCKS;
use crate::evaluation::locking::since_start;
use crate::evaluation::metrics::PhraseMusic;
use crate::motion::choreography::activity;
use crate::motion::phase::unwrapped;
use crate::motion::{Beats, bar_phase};
use crate::stages::beats::{self, PhraseBeats};
use crate::stages::generate::url_of;
use crate::stages::plot::nearest::nearest;
use crate::store::tables::{GenerationRow, PhraseRow};
use crate::store::{Row as _, StoreError, StoreSnapshot, digest};
use crate::training::{Ensemble, Split};
use crate::units::{FPS, frames_to_s};

/// Returns the motions of a run that were kept, in order of name, at most `n`: those whose names have the smallest
/// digests, which is no order that phrases have; and how many of groups are left out. A run that has motions of
/// soloists is measured as theirs; one of groups alone as that of groups.
///
/// # Errors
/// [`StoreError`], or one sentence where there are none.
pub fn of_run(
    snapshot: &StoreSnapshot,
    run: &str,
    n: Option<usize>,
) -> anyhow::Result<(Vec<GenerationRow>, usize)> {
    let store = snapshot.store();
    let mut runs = BTreeSet::new();
    let table = snapshot.table(GenerationRow::schema())?;
    let mut rows: Vec<GenerationRow> = table.rows_where(|row: &GenerationRow| {
        if !runs.contains(&row.run) {
            runs.insert(row.run.clone());
        }
        row.run == run && row.selected
    })?;
    if rows.is_empty() {
        if runs.is_empty() {
            bail!(
                "store {store} has no generated motion; run first: motiongen generate --store {store} \
                 --model NAME"
            );
        }
        let nearest = nearest(run, runs);
        bail!("store {store} has no generated motion of run \"{run}\"; nearest: {nearest}");
    }
    let n_kept = rows.len();
    if rows.iter().any(|row| row.count_dancers() == 1) {
        rows.retain(|row| row.count_dancers() == 1);
    }
    let n_groups = n_kept - rows.len();
    if let Some(n) = n.filter(|n| *n < rows.len()) {
        rows.sort_by_cached_key(|row| digest(row.generation.as_bytes()));
        rows.truncate(n);
    }
    rows.sort_by(|a, b| a.generation.cmp(&b.generation));
    Ok((rows, n_groups))
}

/// Whether generate made motions of a run's name.
///
/// # Errors
/// [`StoreError`].
pub fn has_run(snapshot: &StoreSnapshot, run: &str) -> Result<bool, StoreError> {
    let table = snapshot.table(GenerationRow::schema())?;
    let mut is_there = false;
    table.rows_where(|row: &GenerationRow| {
        is_there |= row.run == run;
        false
    })?;
    Ok(is_there)
}

/// The songs, beats and activities of the store's phrases.
pub struct PhraseIndex {
    rows: HashMap<String, PhraseRow>,
    /// Number of each song.
    songs: BTreeMap<String, usize>,
    beats: HashMap<String, PhraseBeats>,
    /// Activity of the frames of songs, by their file.
    activities: HashMap<String, Vec<f64>>,
    /// Whose real motion is compared with.
    ensemble: Ensemble,
}

impl PhraseIndex {
    /// Reads the phrases of a store, and the beats of those that were danced to and of those with real motion.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read<'a>(
        snapshot: &StoreSnapshot,
        danced_to: impl IntoIterator<Item = &'a str>,
    ) -> Result<Self, StoreError> {
        let rows: Vec<PhraseRow> = snapshot.table(PhraseRow::schema())?.rows()?;
        let songs: BTreeSet<String> = rows.iter().map(song_of).map(str::to_owned).collect();
        let with_motion = rows.iter().filter(|row| row.has_motion);
        let mut wanted: BTreeSet<String> = with_motion.map(|row| row.phrase_id.clone()).collect();
        wanted.extend(danced_to.into_iter().map(str::to_owned));
        let rows = rows.into_iter().map(|row| (row.phrase_id.clone(), row)).collect();
        let beats = beats::of_phrases(snapshot, |id| wanted.contains(id))?;
        let songs = songs.into_iter().zip(0..).collect();
        let (activities, ensemble) = (HashMap::new(), Ensemble::Soloists);
        Ok(Self { rows, songs, beats, activities, ensemble })
    }

    /// Chooses whose real motion is compared with: soloists', unless groups are told.
    pub fn hold_against(&mut self, ensemble: Ensemble) {
        self.ensemble = ensemble;
    }

    /// Returns whose real motion is compared with.
    pub fn ensemble(&self) -> Ensemble {
        self.ensemble
    }

    /// Returns the length of a bar of a phrase's music, frames; none where its tempo is not known.
    pub fn bar_frames(&self, phrase_id: &str) -> Option<f64> {
        if let Some(beats) = self.beats(phrase_id) {
            return Some(FPS * 60.0 / beats.tempo_bpm() * f64::from(beats.beats_per_bar()));
        }
        let row = self.row(phrase_id)?;
        Some(FPS * 60.0 / row.tempo_bpm? * f64::from(row.beats_per_bar?))
    }

    /// Returns what the table says of a phrase.
    pub fn row(&self, phrase_id: &str) -> Option<&PhraseRow> {
        self.rows.get(phrase_id)
    }

    /// Returns the phrases that motion of another program can be for, in order of name.
    pub fn foreign_phrases(&self) -> Vec<foreign::ForeignPhrase<'_>> {
        let mut found: BTreeMap<&str, foreign::ForeignPhrase> = BTreeMap::new();
        #[expect(clippy::iter_over_hash_type, reason = "collected into a map that is in order")]
        for (id, row) in &self.rows {
            let n_frames = row.n_feature_frames.and_then(|n| usize::try_from(n).ok());
            let n_frames = n_frames.or(Some((row.duration_s * FPS) as usize));
            found.insert(id, foreign::ForeignPhrase { id, url: url_of(row), n_frames });
        }
        found.into_values().collect()
    }

    /// Returns the beats of a phrase in bars; none for too few of them.
    pub fn beats(&self, phrase_id: &str) -> Option<Beats> {
        self.beats.get(phrase_id)?.in_bars(self.rows.get(phrase_id)?)
    }

    /// Whether some phrase has beats.
    pub fn has_beats(&self) -> bool {
        !self.beats.is_empty()
    }

    /// Returns the number of a phrase's song; phrases of one song have the same.
    pub fn song(&self, phrase_id: &str) -> usize {
        let song = self.rows.get(phrase_id).map(song_of);
        // A phrase that is gone is a song of its own.
        song.and_then(|song| self.songs.get(song)).copied().unwrap_or_else(|| {
            let order = digest(phrase_id.as_bytes());
            usize::from_str_radix(&order[..8], 16).unwrap_or(0) + self.songs.len()
        })
    }

    /// Returns the name of a song, which is the same in every run.
    pub fn song_name(&self, song: usize) -> String {
        let found = self.songs.iter().find(|(_, number)| **number == song);
        found.map_or_else(|| format!("song {song}"), |(name, _)| name.clone())
    }

    /// Returns the phrases that are whole songs of `phrase_ids`: those whose features tell the activity of a song.
    pub fn songs_of<'a>(&self, phrase_ids: impl IntoIterator<Item = &'a str>) -> BTreeSet<String> {
        let wanted: BTreeSet<&str> =
            phrase_ids.into_iter().filter_map(|id| self.rows.get(id)).map(song_of).collect();
        let is_song = |row: &&PhraseRow| !row.is_constructed() && wanted.contains(song_of(row));
        self.rows.values().filter(is_song).map(|row| row.phrase_id.clone()).collect()
    }

    /// Takes in the features of a whole song, `[T, 163]`.
    pub fn add_features(&mut self, phrase_id: &str, features: ArrayView2<f32>) {
        let Some(row) = self.rows.get(phrase_id).filter(|row| !row.is_constructed()) else {
            return;
        };
        let column = |name: &str| {
            let first: usize = BLOCKS.iter().take_while(|b| b.name != name).map(|b| b.len).sum();
            features.column(first).to_vec()
        };
        let found = activity(&column("rms"), &column("onset_strength"));
        self.activities.insert(song_of(row).to_owned(), found);
    }

    /// Returns the music of `n_frames` frames of a phrase, from its beats; none for too few of them.
    pub fn music(&self, phrase_id: &str, n_frames: usize) -> Option<PhraseMusic> {
        let row = self.rows.get(phrase_id)?;
        let beats = self.beats.get(phrase_id)?.in_bars(row)?;
        let times_s: Vec<f64> = (0..n_frames).map(frames_to_s).collect();
        let bars = unwrapped(&bar_phase(&times_s, &beats));
        Some(PhraseMusic {
            beats_s: beats.times_s().to_vec(),
            bars: since_start(&bars, self.start_frames(phrase_id)),
            beats_per_bar: beats.beats_per_bar(),
            activity: self.activity(row, n_frames),
            is_of_motion: false,
        })
    }

    /// Whether a phrase is a whole song.
    pub fn is_song(&self, phrase_id: &str) -> bool {
        self.rows.get(phrase_id).is_some_and(|row| !row.is_constructed())
    }

    /// Returns the music of a phrase with real motion; where its beats are not numbered, its bars are known by the
    /// motion's own phase alone.
    pub fn music_of_real(&self, phrase_id: &str, phase: &[f64]) -> Option<PhraseMusic> {
        let from_beats = self.music(phrase_id, phase.len())?;
        if self.beats.get(phrase_id).is_some_and(PhraseBeats::is_numbered) {
            return Some(from_beats);
        }
        let bars = since_start(&unwrapped(phase), self.start_frames(phrase_id));
        Some(PhraseMusic { bars, is_of_motion: true, ..from_beats })
    }

    fn activity(&self, row: &PhraseRow, n_frames: usize) -> Option<Vec<f64>> {
        let song_activity = self.activities.get(song_of(row))?;
        let first = (row.start_s.unwrap_or(0.0) * FPS).round() as usize;
        song_activity.get(first..first + n_frames).map(<[f64]>::to_vec)
    }

    /// Returns the song of a phrase and the frame of it at which the phrase begins.
    pub fn place(&self, phrase_id: &str) -> (usize, u64) {
        (self.song(phrase_id), self.start_frames(phrase_id).round() as u64)
    }

    /// Where in its song a phrase begins.
    fn start_frames(&self, phrase_id: &str) -> f64 {
        self.rows.get(phrase_id).and_then(|row| row.start_s).unwrap_or(0.0) * FPS
    }

    /// Whether all phrases with real motion were constructed, so that their coupling to the bar is known.
    pub fn is_constructed(&self) -> bool {
        let mut with_music = self.rows.values().filter(|row| self.has_truth(row)).peekable();
        with_music.peek().is_some() && with_music.all(PhraseRow::is_constructed)
    }

    /// Returns a digest of real motion: of all phrases with motion and music.
    pub fn truth_digest(&self) -> String {
        let mut lines: Vec<String> = self
            .rows
            .values()
            .filter(|row| self.has_truth(row))
            .map(|row| format!("{}\n{}\n{}", row.phrase_id, row.split, row.content_hash))
            .collect();
        lines.sort_unstable();
        digest(lines.join("\n").as_bytes())
    }

    /// Whether a phrase has real motion to compare with: groups are no measure of a soloist, nor soloists of groups.
    fn has_truth(&self, row: &PhraseRow) -> bool {
        let is_like = match self.ensemble {
            Ensemble::Soloists => row.count_dancers() == 1,
            Ensemble::Groups { most } => (2..=most).contains(&row.count_dancers()),
        };
        is_like && (row.has_features || row.has_audio)
    }
}

/// Returns the identity of a phrase's song: the digest of its music, or its file where that is not known.
fn song_of(row: &PhraseRow) -> &str {
    let file = || if row.is_constructed() { &row.source } else { url_of(row) };
    row.song_hash.as_deref().unwrap_or_else(file)
}

/// Returns whether a phrase of the ground truth was held out of the reference statistics.
pub fn is_held_out(split: Split) -> bool {
    split != Split::Train
}
