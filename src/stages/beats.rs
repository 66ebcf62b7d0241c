//! The table `beats`: how its rows are made, and which of them count.
//!
//! ingest writes the beats of a beat list, extract those that it found, library those of constructed phrases. A
//! phrase may have rows of two sources for a while, when its beat list came after its features: the better
//! source counts, for every stage that asks here.

use std::collections::HashMap;

use crate::motion::Beats;
use crate::store::tables::{BeatRow, PhraseRow};
use crate::store::{ItemTables, Location, Row as _, Snapshot, StoreError};
use crate::units::s_to_frames;

/// `beats_per_bar_source` of a bar that nobody counted.
pub const DEFAULT: &str = "default";

/// Where beats came from, the better the later.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum BeatSource {
    /// Found in the audio.
    Tracker,
    /// `beat_times` of a feature file.
    Features,
    /// A beat list, which somebody wrote.
    BeatsFile,
}

impl BeatSource {
    const ALL: [Self; 3] = [Self::Tracker, Self::Features, Self::BeatsFile];

    /// Returns the source as the column `source` of `beats` spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tracker => "tracker",
            Self::Features => "features",
            Self::BeatsFile => "beats_file",
        }
    }

    fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|source| source.name() == name)
    }
}

/// Returns the rows of a phrase's beats, given by their times in seconds and their numbers in the bar.
pub fn rows<'a>(
    phrase_id: &'a str,
    beats: impl IntoIterator<Item = (f64, Option<i64>)> + 'a,
    n_frames: usize,
    source: BeatSource,
) -> impl Iterator<Item = BeatRow> + 'a {
    beats.into_iter().enumerate().map(move |(beat, (time_s, number))| BeatRow {
        phrase_id: phrase_id.to_owned(),
        beat: beat as i32,
        frame: nearest_frame(time_s, n_frames) as i32,
        time_s,
        number: number.and_then(|n| i32::try_from(n).ok()),
        source: Some(source.name().to_owned()),
    })
}

/// Returns the beats of a list with the numbers that it has.
pub fn numbered(beats: &Beats) -> impl Iterator<Item = (f64, Option<i64>)> + '_ {
    let number = |i: usize| beats.numbers().and_then(|numbers| numbers.get(i)).copied();
    beats.times_s().iter().enumerate().map(move |(i, &time_s)| (time_s, number(i)))
}

/// Returns the frame of a phrase that is nearest to a time in it.
fn nearest_frame(time_s: f64, n_frames: usize) -> usize {
    (s_to_frames(time_s).round() as usize).min(n_frames.saturating_sub(1))
}

/// The beats of a phrase that count.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhraseBeats {
    times_s: Vec<f64>,
    /// The number of every beat in its bar; none where some are not known.
    numbers: Option<Vec<i64>>,
    /// None where release 0.1 wrote the rows.
    source: Option<BeatSource>,
}

impl PhraseBeats {
    fn of_rows(mut rows: Vec<KnownBeat>) -> Self {
        let source = rows.iter().map(|row| row.source).max().flatten();
        rows.retain(|row| row.source == source);
        rows.sort_by_key(|row| row.beat);
        let numbers: Option<Vec<i64>> = rows.iter().map(|row| row.number).collect();
        let times_s: Vec<f64> = rows.into_iter().map(|row| row.time_s).collect();
        Self { numbers: numbers.filter(|numbers| !numbers.is_empty()), times_s, source }
    }

    /// Times of the beats, s, in order.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    pub fn source(&self) -> Option<BeatSource> {
        self.source
    }

    /// Returns whether it is known where in its bar every beat is.
    pub fn is_numbered(&self) -> bool {
        self.numbers.is_some()
    }

    /// Counts the beats in bars, which are as long as the phrase's row says, else as the highest number says;
    /// `None` for too few beats to tell a tempo.
    ///
    /// One beat is enough where its number is known and the row has a tempo, as of a short excerpt of a slow
    /// song.
    pub fn in_bars(&self, row: &PhraseRow) -> Option<Beats> {
        let (mut times_s, mut numbers) = (self.times_s.clone(), self.numbers.clone());
        let stated = row.beats_per_bar.and_then(|n| u32::try_from(n).ok());
        let beats_per_bar = match &numbers {
            // A row that is older than the beats says nothing of them.
            Some(numbers) => {
                stated.filter(|n| numbers.iter().all(|number| *number <= i64::from(*n)))
            }
            None => stated.filter(|_| row.beats_per_bar_source.as_deref() != Some(DEFAULT)),
        };
        if let (&[time_s], Some(&[number]), Some(beats_per_bar), Some(tempo_bpm)) =
            (times_s.as_slice(), numbers.as_deref(), beats_per_bar, row.tempo_bpm)
        {
            times_s.push(time_s + 60.0 / tempo_bpm);
            numbers = Some(vec![number, number % i64::from(beats_per_bar) + 1]);
        }
        Beats::new(times_s, numbers, beats_per_bar).ok()
    }

    /// Returns a text that tells these beats from all others.
    pub fn describe(&self) -> String {
        format!("{:?} {:?}", self.times_s, self.numbers)
    }
}

/// A row without the name of its phrase.
struct KnownBeat {
    beat: i32,
    time_s: f64,
    number: Option<i64>,
    source: Option<BeatSource>,
}

impl From<&BeatRow> for KnownBeat {
    fn from(row: &BeatRow) -> Self {
        Self {
            beat: row.beat,
            time_s: row.time_s,
            number: row.number.map(i64::from),
            source: row.source.as_deref().and_then(BeatSource::named),
        }
    }
}

/// Reads the beats of the phrases that are wanted; those without beats are left out.
///
/// # Errors
/// [`StoreError`] when the table cannot be read.
pub fn of_phrases(
    store: &Location,
    is_wanted: impl Fn(&str) -> bool,
) -> Result<HashMap<String, PhraseBeats>, StoreError> {
    let mut found: HashMap<String, Vec<KnownBeat>> = HashMap::new();
    let table = Snapshot::take(store, BeatRow::schema())?;
    // Kept without their names, which weigh more than all else.
    table.rows_where(|row: &BeatRow| {
        if is_wanted(&row.phrase_id) {
            found.entry(row.phrase_id.clone()).or_default().push(KnownBeat::from(row));
        }
        false
    })?;
    Ok(found.into_iter().map(|(id, rows)| (id, PhraseBeats::of_rows(rows))).collect())
}

/// Returns the beats of one phrase.
///
/// # Errors
/// [`StoreError`] when the table cannot be read.
pub fn of_item(rows: &ItemTables) -> Result<PhraseBeats, StoreError> {
    let rows: Vec<BeatRow> = rows.rows()?;
    Ok(PhraseBeats::of_rows(rows.iter().map(KnownBeat::from).collect()))
}
