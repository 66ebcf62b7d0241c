//! The motions that are evaluated, and the music of each.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use anyhow::bail;

use crate::evaluation::locking::since_start;
use crate::evaluation::metrics::Music;
use crate::motion::bar_phase;
use crate::motion::phase::unwrapped;
use crate::stages::beats::{self, PhraseBeats};
use crate::stages::generate::url_of;
use crate::stages::plot::nearest::nearest;
use crate::store::tables::{GenerationRow, PhraseRow};
use crate::store::{Location, Row as _, Snapshot, StoreError, digest};
use crate::training::Split;
use crate::units::{FPS, frames_to_s};

/// Returns the motions of a run that were kept, in order of name, at most `n`: those whose names have the
/// smallest digests, which is no order that phrases have.
///
/// # Errors
/// [`StoreError`], or one sentence where there are none.
pub fn of_run(store: &Location, run: &str, n: Option<usize>) -> anyhow::Result<Vec<GenerationRow>> {
    let mut runs = BTreeSet::new();
    let table = Snapshot::take(store, GenerationRow::schema())?;
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
    if let Some(n) = n.filter(|n| *n < rows.len()) {
        rows.sort_by_cached_key(|row| digest(row.generation.as_bytes()));
        rows.truncate(n);
    }
    rows.sort_by(|a, b| a.generation.cmp(&b.generation));
    Ok(rows)
}

/// What the store says of phrases: their songs, splits and beats.
pub struct Phrases {
    rows: HashMap<String, PhraseRow>,
    /// Number of each song, by the file that it is.
    songs: BTreeMap<String, usize>,
    /// Songs that something was learned from.
    learned: BTreeSet<String>,
    beats: HashMap<String, PhraseBeats>,
}

impl Phrases {
    /// Reads the phrases of a store, and the beats of `wanted`.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read(
        store: &Location,
        wanted: impl FnOnce(&HashMap<String, PhraseRow>) -> BTreeSet<String>,
    ) -> Result<Self, StoreError> {
        let rows: Vec<PhraseRow> = Snapshot::take(store, PhraseRow::schema())?.rows()?;
        let songs: BTreeSet<String> = rows.iter().map(song_of).map(str::to_owned).collect();
        let is_learned = |row: &&PhraseRow| {
            row.has_motion
                && (row.has_features || row.has_audio)
                && row.split == Split::Train.name()
        };
        let learned = rows.iter().filter(is_learned).map(song_of).map(str::to_owned).collect();
        let rows = rows.into_iter().map(|row| (row.phrase_id.clone(), row)).collect();
        let wanted = wanted(&rows);
        let beats = beats::of_phrases(store, |id| wanted.contains(id))?;
        let songs = songs.into_iter().zip(0..).collect();
        Ok(Self { rows, songs, learned, beats })
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

    /// Whether nothing was learned from a phrase's song.
    pub fn is_held_out(&self, phrase_id: &str) -> bool {
        self.rows.get(phrase_id).is_none_or(|row| !self.learned.contains(song_of(row)))
    }

    /// Returns the music of the frames of a phrase, from its beats; none for too few of them.
    pub fn music(&self, phrase_id: &str, n_frames: usize) -> Option<Music> {
        let row = self.rows.get(phrase_id)?;
        let beats = self.beats.get(phrase_id)?.in_bars(row)?;
        let times_s: Vec<f64> = (0..n_frames).map(frames_to_s).collect();
        let bars = unwrapped(&bar_phase(&times_s, &beats));
        Some(Music {
            beats_s: beats.times_s().to_vec(),
            bars: since_start(&bars, self.start_frames(phrase_id)),
            beats_per_bar: beats.beats_per_bar(),
        })
    }

    /// Returns the music of a constructed or captured phrase, of which the bars are known by its phase.
    pub fn music_of_phase(&self, phrase_id: &str, phase: &[f64]) -> Option<Music> {
        let of_beats = self.music(phrase_id, phase.len())?;
        let bars = since_start(&unwrapped(phase), self.start_frames(phrase_id));
        Some(Music { bars, ..of_beats })
    }

    /// Where in its song a phrase begins.
    fn start_frames(&self, phrase_id: &str) -> f64 {
        self.rows.get(phrase_id).and_then(|row| row.start_s).unwrap_or(0.0) * FPS
    }

    /// Returns a digest of the ground truth: of all phrases with motion and music.
    pub fn truth_digest(&self) -> String {
        let mut lines: Vec<String> = self
            .rows
            .values()
            .filter(|row| row.has_motion && (row.has_features || row.has_audio))
            .map(|row| format!("{}\n{}\n{}", row.phrase_id, row.split, row.content_hash))
            .collect();
        lines.sort_unstable();
        digest(lines.join("\n").as_bytes())
    }
}

/// The file that a phrase's song is.
fn song_of(row: &PhraseRow) -> &str {
    if row.is_constructed() { &row.source } else { url_of(row) }
}

/// Returns the part of some music that begins at a frame.
pub fn excerpt(music: &Music, first: usize, n_frames: usize) -> Music {
    let start_s = frames_to_s(first);
    let end = (first + n_frames).min(music.bars.len());
    Music {
        beats_s: music.beats_s.iter().map(|t| t - start_s).collect(),
        bars: music.bars.get(first..end).unwrap_or_default().to_vec(),
        beats_per_bar: music.beats_per_bar,
    }
}
