//! The table `beats`: how its rows are made, and which of them count.
//!
//! ingest writes the beats of a beat list, extract those that it found, library those of constructed phrases. A
//! phrase may have rows of two sources for a while, when its beat list came after its features: the better
//! source counts, for every stage that asks here.

use std::collections::HashMap;

use crate::motion::Beats;
use crate::store::tables::{BeatRow, PhraseRow};
use crate::store::{ItemTables, Row as _, StoreError, StoreSnapshot};
use crate::units::s_to_frames;

/// `beats_per_bar_source` of a bar whose beats were not counted.
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
    /// The score that library played the song from.
    Composed,
}

impl BeatSource {
    const ALL: [Self; 4] = [Self::Tracker, Self::Features, Self::BeatsFile, Self::Composed];

    /// Returns the source as the column `source` of `beats` spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tracker => "tracker",
            Self::Features => "features",
            Self::BeatsFile => "beats_file",
            Self::Composed => "composed",
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
        let stated = row.beats_per_bar.and_then(|n| u32::try_from(n).ok());
        let is_default = row.beats_per_bar_source.as_deref() == Some(DEFAULT);
        // The beat numbers of a whole song are better than the default; those of an excerpt may lack the highest.
        let is_guess = is_default && !row.is_constructed() && self.is_numbered();
        self.counted(stated.filter(|_| !is_guess), is_default, row.tempo_bpm)
    }

    fn counted(
        &self,
        stated: Option<u32>,
        is_default: bool,
        tempo_bpm: Option<f64>,
    ) -> Option<Beats> {
        let (mut times_s, mut numbers) = (self.times_s.clone(), self.numbers.clone());
        let beats_per_bar = match &numbers {
            // A row that is older than the beats says nothing of them.
            Some(numbers) => {
                stated.filter(|n| numbers.iter().all(|number| *number <= i64::from(*n)))
            }
            None => stated.filter(|_| !is_default),
        };
        if let (&[time_s], Some(&[number]), Some(beats_per_bar), Some(tempo_bpm)) =
            (times_s.as_slice(), numbers.as_deref(), beats_per_bar, tempo_bpm)
        {
            times_s.push(time_s + 60.0 / tempo_bpm);
            numbers = Some(vec![number, number % i64::from(beats_per_bar) + 1]);
        }
        Beats::new(times_s, numbers, beats_per_bar).ok()
    }

    /// Tempo of the beats, 60 / median interval, beats/min; none for fewer than two.
    pub fn tempo_bpm(&self) -> Option<f64> {
        Beats::new(self.times_s.clone(), None, None).ok().map(|beats| beats.tempo_bpm())
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
    store: &StoreSnapshot,
    is_wanted: impl Fn(&str) -> bool,
) -> Result<HashMap<String, PhraseBeats>, StoreError> {
    let mut found: HashMap<String, Vec<KnownBeat>> = HashMap::new();
    let table = store.table(BeatRow::schema())?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::{BeatsPerBarSource, bar_phase};

    fn beat(
        beat: i32,
        time_s: f64,
        number: Option<i64>,
        source: impl Into<Option<BeatSource>>,
    ) -> KnownBeat {
        KnownBeat { beat, time_s, number, source: source.into() }
    }

    #[test]
    fn the_best_source_counts_and_its_beats_are_in_order() {
        use BeatSource::{BeatsFile, Features, Tracker};
        let tracked = || vec![beat(0, 0.3, None, Tracker), beat(1, 0.9, None, Tracker)];
        let listed = || vec![beat(1, 0.5, Some(2), BeatsFile), beat(0, 0.1, Some(1), BeatsFile)];
        let found = PhraseBeats::of_rows(tracked().into_iter().chain(listed()).collect());
        let expected = PhraseBeats {
            times_s: vec![0.1, 0.5],
            numbers: Some(vec![1, 2]),
            source: Some(BeatsFile),
        };
        assert_eq!(found, expected);
        let found = PhraseBeats::of_rows(tracked());
        assert_eq!((found.times_s(), found.is_numbered()), (&[0.3, 0.9][..], false));
        // Rows of release 0.1 give way to all others, and are what there is without them.
        let old = || vec![beat(0, 0.4, None, None), beat(1, 1.0, None, None)];
        assert_eq!(PhraseBeats::of_rows(old()).times_s(), [0.4, 1.0]);
        let imported = beat(0, 0.7, None, Features);
        let rows = old().into_iter().chain([imported]).chain(tracked().split_off(2)).collect();
        let found = PhraseBeats::of_rows(rows);
        assert_eq!((found.times_s(), found.source()), (&[0.7][..], Some(Features)));
        assert_eq!(PhraseBeats::of_rows(Vec::new()), PhraseBeats::default());
        for source in BeatSource::ALL {
            assert_eq!(BeatSource::named(source.name()), Some(source));
        }
        assert_eq!(BeatSource::named("drummer"), None);
    }

    #[test]
    fn numbers_count_where_every_beat_has_one() {
        let some = vec![beat(0, 0.1, Some(3), None), beat(1, 0.6, None, None)];
        assert!(!PhraseBeats::of_rows(some).is_numbered());
    }

    #[test]
    fn an_excerpt_keeps_its_place_in_the_bar() {
        let phase = |beats: &Beats, t: f64| bar_phase(&[t], beats)[0];
        let numbered = |beats: &[(f64, i64)]| {
            let row = |(i, &(t, number)): (usize, &(f64, i64))| {
                beat(i as i32, t, Some(number), BeatSource::Tracker)
            };
            PhraseBeats::of_rows(beats.iter().enumerate().map(row).collect())
        };
        // Bars of four, said by the row though the excerpt has no fourth beat, and no first one.
        let excerpt = numbered(&[(0.25, 2), (0.75, 3)]);
        let beats = excerpt.counted(Some(4), true, Some(120.0)).expect("two beats");
        assert_eq!((beats.beats_per_bar(), beats.numbers()), (4, Some(&[2, 3][..])));
        assert!((phase(&beats, 0.25) - 0.25).abs() < 1e-12);
        assert!((phase(&beats, 1.75) - 0.0).abs() < 1e-12);
        // One beat, continued at the tempo of the row.
        let one = numbered(&[(0.5, 3)]);
        let beats = one.counted(Some(3), false, Some(30.0)).expect("a tempo");
        assert_eq!((beats.times_s(), beats.numbers()), (&[0.5, 2.5][..], Some(&[3, 1][..])));
        assert!((phase(&beats, 2.5) - 0.0).abs() < 1e-12);
        assert_eq!(one.counted(Some(3), false, None), None);
        // A row that speaks of shorter bars is older than these numbers.
        let beats = excerpt.counted(Some(2), false, None).expect("two beats");
        assert_eq!(beats.beats_per_bar(), 3);
    }

    #[test]
    fn beats_without_numbers_are_in_bars_that_somebody_said_or_nobody() {
        let rows = vec![beat(0, 0.5, None, None), beat(1, 1.0, None, None)];
        let beats = PhraseBeats::of_rows(rows);
        let source = |beats: Option<Beats>| {
            beats.map(|beats| (beats.beats_per_bar(), beats.beats_per_bar_source()))
        };
        assert_eq!(
            source(beats.counted(Some(4), true, None)),
            Some((4, BeatsPerBarSource::Default))
        );
        assert_eq!(
            source(beats.counted(Some(3), false, None)),
            Some((3, BeatsPerBarSource::Given))
        );
        assert_eq!(PhraseBeats::default().counted(Some(4), true, Some(120.0)), None);
    }

    #[test]
    fn rows_have_the_nearest_frame_and_none_behind_the_last() {
        let beats = [(0.05, Some(4)), (1.04, Some(1)), (2.0, None)];
        let found: Vec<_> = rows("a", beats, 41, BeatSource::Features).collect();
        let to_tuple = |row: &BeatRow| (row.beat, row.frame, row.time_s, row.number);
        let expected = [(0, 2, 0.05, Some(4)), (1, 31, 1.04, Some(1)), (2, 40, 2.0, None)];
        assert_eq!(found.iter().map(to_tuple).collect::<Vec<_>>(), expected);
        assert!(found.iter().all(|row| row.source.as_deref() == Some("features")));
    }
}
