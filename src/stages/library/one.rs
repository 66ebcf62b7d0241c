//! One song: its features and beats become dances, and those phrases.

use std::io::Read as _;
use std::time::Duration;

use ndarray::{Array2, Array3, ArrayView1, Axis, s};
use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::made::{Performance, beats_text};
use super::songs::{Song, SongFiles, SongInput};
use super::{LibraryRules, unreadable};
use crate::audio::BLOCKS;
use crate::motion::choreography::{
    self, BeatGrid, Formation, GroupRules, Repertoire, SongError, Unison, choreograph,
    choreograph_group, group_phrase, n_phrases,
};
use crate::motion::{Beats, BeatsPerBarSource};
use crate::stages::beats::{self, BeatSource};
use crate::stages::extract;
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::ingest::read_beats;
use crate::store::{Content, SourceFile, StoreError, digest};
use crate::units::frames_to_s;

/// Longest time for one song's features.
const TIMEOUT: Duration = Duration::from_secs(900);
/// Longest song, in seconds.
const MAX_DURATION_S: f64 = 24.0 * 3600.0;
/// Length of a group's spans of one kind, at least, in phrases: so that most phrases lie within one.
const SPAN_PHRASES: usize = 3;
/// Least share of a phrase's frames that a formation or a kind of unison needs to be told of it.
const MIN_KIND_SHARE: f64 = 0.75;

/// A song as it is danced to.
pub struct SongMusic {
    /// [T, 163], relative to the whole song.
    pub features: Array2<f32>,
    pub beats: Beats,
    pub beat_source: BeatSource,
    /// Digest of the files that it was read from, or of what stands for them.
    pub input_hash: String,
    /// Digest of the audio file; none where the store does not tell it.
    pub song_hash: Option<String>,
}

/// A phrase as it goes into the tables.
pub struct ConstructedPhrase {
    pub id: String,
    /// Where in the song it begins.
    pub first_frame: usize,
    /// \[N, n, 25\]: of every dancer, one for a soloist.
    pub motion: Array3<f32>,
    /// Of a group, where one holds three quarters of the phrase.
    pub formation: Option<Formation>,
    pub unison: Option<Unison>,
    /// [n, 163].
    pub features: Array2<f32>,
    /// Time from the begin of the phrase, and number in the bar, of every beat in it.
    pub beats: Vec<(f64, u32)>,
    /// The beats after it, up to a downbeat.
    pub later_beats: Vec<(f64, u32)>,
}

impl SongMusic {
    /// Returns where the number of beats in a bar came from, as `phrases` spells it.
    pub fn beats_per_bar_source(&self) -> &'static str {
        if self.beat_source == BeatSource::Composed {
            return self.beat_source.name();
        }
        match self.beats.beats_per_bar_source() {
            BeatsPerBarSource::Given | BeatsPerBarSource::Numbers => self.beat_source.name(),
            BeatsPerBarSource::Default => beats::DEFAULT,
        }
    }

    /// Returns where the tempo came from, as `phrases` spells it.
    pub fn tempo_source(&self) -> &'static str {
        match self.beat_source {
            BeatSource::Tracker => "beat_tracker",
            BeatSource::Features | BeatSource::BeatsFile | BeatSource::Composed => {
                self.beat_source.name()
            }
        }
    }
}

/// Reads a song.
///
/// # Errors
/// A [`Failure`] that names the file.
pub fn read(song: &Song, input: SongInput) -> Result<SongMusic, Failure> {
    match (&song.files, input) {
        (
            SongFiles::Store { beats, n_beats, beat_source, song_hash, .. },
            SongInput::Features(features),
        ) => {
            let (features, input_hash) = (features?, digest(song.fingerprint.as_bytes()));
            let none = || no_beats(song, *n_beats, features.nrows());
            let beats = beats.clone().ok_or_else(none)?;
            let (beat_source, song_hash) = (*beat_source, song_hash.clone());
            Ok(SongMusic { features, beats, beat_source, input_hash, song_hash })
        }
        (
            SongFiles::Folder { audio, beat_list },
            SongInput::Files { audio: content, beat_list: list, .. },
        ) => {
            let mut lines = String::new();
            let list = match (beat_list, list) {
                (Some(file), Some(content)) => {
                    let bytes = small_bytes(file, content)?;
                    lines += &format!("beats {}\n", digest(&bytes));
                    Some(read_beats(&file.path, &bytes)?)
                }
                _ => None,
            };
            let list = list.map(|beats| (beats, BeatSource::BeatsFile));
            listen(song, audio, content, list, lines)
        }
        (SongFiles::Score { .. }, SongInput::Performed(Performance { wav, beats, .. })) => {
            let size_bytes = wav.len() as u64;
            let (path, fingerprint) = (format!("{}.wav", song.id), String::new());
            let audio = SourceFile { path, size_bytes, fingerprint };
            let lines = format!("beats {}\n", digest(beats_text(&beats).as_bytes()));
            let known = Some((beats, BeatSource::Composed));
            listen(song, &audio, Ok(Content::Bytes(wav)), known, lines)
        }
        _ => Err(Failure::new(FailureKind::Unreadable, &song.id, "was not read")),
    }
}

/// Hears a song whose beats may be known; `lines` tell what else it was read from.
fn listen(
    song: &Song,
    audio: &SourceFile,
    content: Result<Content, StoreError>,
    known: Option<(Beats, BeatSource)>,
    mut lines: String,
) -> Result<SongMusic, Failure> {
    let rules =
        extract::ExtractRules { tuning: None, max_duration_s: MAX_DURATION_S, timeout: TIMEOUT };
    let mut song_hash = None;
    let see = |hash: &str| {
        song_hash = Some(hash.to_owned());
        lines += &format!("audio {hash}\n");
        true
    };
    let found = extract::extract(extract::Origin::Audio, audio, content, see, &rules)?;
    let (counted, n_beats) = (found.counted_beats(), found.pulse.len());
    let (features, input_hash) = (found.frames, digest(lines.as_bytes()));
    match known {
        Some((beats, beat_source)) => {
            Ok(SongMusic { features, beats, beat_source, input_hash, song_hash })
        }
        None => {
            let beats = counted.ok_or_else(|| no_beats(song, n_beats, features.nrows()))?;
            Ok(SongMusic {
                features,
                beats,
                beat_source: BeatSource::Tracker,
                input_hash,
                song_hash,
            })
        }
    }
}

fn no_beats(song: &Song, n_beats: usize, n_frames: usize) -> Failure {
    refused(song, &SongError::NoBeats { n_beats, duration_s: frames_to_s(n_frames) })
}

/// Reads a file that fits into memory.
pub fn small_bytes(
    file: &SourceFile,
    content: Result<Content, StoreError>,
) -> Result<bytes::Bytes, Failure> {
    match content.map_err(|e| unreadable(&file.path, &e))? {
        Content::Bytes(bytes) => Ok(bytes),
        Content::File(mut open) => {
            let mut bytes = Vec::new();
            open.read_to_end(&mut bytes)
                .map_err(|e| Failure::new(FailureKind::Unreadable, &file.path, e))?;
            Ok(bytes.into())
        }
    }
}

fn refused(song: &Song, error: &SongError) -> Failure {
    let kind = match error {
        SongError::Empty => FailureKind::TooShort,
        SongError::NoBeats { .. } => FailureKind::NoBeats,
        SongError::Tempo { .. } => FailureKind::Tempo,
    };
    Failure::new(kind, &song.id, format!("{}: {error}", song.id))
}

/// Returns the failure of a song that has no room for a phrase.
pub fn too_short(song: &Song, n_frames: usize, phrase_frames: usize) -> Failure {
    let message = format!(
        "{}: has {n_frames} frames ({:.1} s), and a phrase takes {phrase_frames} ({:.1} s); lower \
         --phrase-frames or leave the song out",
        song.id,
        frames_to_s(n_frames),
        frames_to_s(phrase_frames)
    );
    Failure::new(FailureKind::TooShort, &song.id, message)
}

/// Returns the name of a phrase: names of one song sort by take, then by place.
pub fn phrase_id(song: &Song, rules: &LibraryRules, take: u32, index: usize) -> String {
    let digits = (rules.takes.get() - 1).to_string().len().max(2);
    format!("{}.t{take:0digits$}.{index:04}", song.slug)
}

impl ConstructedPhrase {
    pub fn n_dancers(&self) -> usize {
        self.motion.len_of(Axis(0))
    }

    pub fn n_frames(&self) -> usize {
        self.motion.len_of(Axis(1))
    }
}

/// Motion of a phrase, and what is known of it.
type PhraseMotion = (Array3<f32>, Option<Formation>, Option<Unison>);

/// Dances to a whole song as a soloist or as a group; returns what cuts `length` frames from a first one on.
fn danced(
    song: &choreography::Song<'_>,
    repertoire: &Repertoire,
    rules: &LibraryRules,
    seed: u64,
) -> Box<dyn Fn(usize, usize) -> PhraseMotion> {
    let n_dancers = rules.dancers.map_or(1, |range| range.draw(seed));
    if n_dancers == 1 {
        let dance = choreograph(song, repertoire, seed);
        return Box::new(move |first, length| {
            let frames = choreography::phrase(dance.frames.view(), first, length);
            (frames.insert_axis(Axis(0)), None, None)
        });
    }
    let min_span_s = frames_to_s(SPAN_PHRASES * rules.phrase_frames.get());
    let dance = choreograph_group(song, repertoire, &GroupRules { n_dancers, min_span_s, seed });
    Box::new(move |first, length| {
        let phrase = group_phrase(&dance, first, length);
        let (formation, unison) = (phrase.formation, phrase.unison);
        let formation = (formation.1 >= MIN_KIND_SHARE).then_some(formation.0);
        let unison = (unison.1 >= MIN_KIND_SHARE).then_some(unison.0);
        (phrase.frames, formation, unison)
    })
}

/// Dances to a song, take by take, and calls `visit` with every phrase, in the order of their names;
/// returns how many there are.
///
/// The dance of a take depends on the seed, the song's name and the number of the take.
///
/// # Errors
/// A [`Failure`] of the song before the first phrase, or errors of `visit`.
pub fn dance<E: From<Failure>>(
    song: &Song,
    music: &SongMusic,
    repertoire: &Repertoire,
    rules: &LibraryRules,
    mut visit: impl FnMut(ConstructedPhrase) -> Result<(), E>,
) -> Result<usize, E> {
    let n_frames = music.features.nrows();
    let (length, hop) = (rules.phrase_frames.get(), rules.hop_frames.get());
    let per_take = n_phrases(n_frames, length, hop);
    if per_take == 0 {
        return Err(too_short(song, n_frames, length).into());
    }
    let curve = |name: &str| column(&music.features, name).to_vec();
    let heard = choreography::Song::new(&music.beats, &curve("rms"), &curve("onset_strength"))
        .map_err(|e| refused(song, &e))?;
    let grid = heard.grid();
    for take in 0..rules.takes.get() {
        let seed = xxh3_64_with_seed(format!("{}\n{take}", song.id).as_bytes(), rules.seed);
        let cut = danced(&heard, repertoire, rules, seed);
        for index in 0..per_take {
            let first = index * hop;
            let (beats, later_beats) = beats_of(&grid, first, length);
            let (motion, formation, unison) = cut(first, length);
            visit(ConstructedPhrase {
                id: phrase_id(song, rules, take, index),
                first_frame: first,
                motion,
                formation,
                unison,
                features: music.features.slice(s![first..first + length, ..]).to_owned(),
                beats,
                later_beats,
            })?;
        }
    }
    Ok(per_take * rules.takes.get() as usize)
}

/// Beats by their time from the begin of a phrase and their number in the bar.
type NumberedBeats = Vec<(f64, u32)>;

/// Returns the beats of a phrase, and those after it up to the next downbeat, at least one.
fn beats_of(grid: &BeatGrid, first: usize, n_frames: usize) -> (NumberedBeats, NumberedBeats) {
    let (start_s, end_s) = (frames_to_s(first), frames_to_s(first + n_frames));
    let beats = grid.beats();
    let begin = beats.partition_point(|beat| beat.time_s < start_s);
    let end = beats.partition_point(|beat| beat.time_s < end_s);
    let numbered = |beats: &[choreography::Beat]| -> NumberedBeats {
        beats.iter().map(|beat| (beat.time_s - start_s, beat.number)).collect()
    };
    let later = beats[end..].iter().position(|beat| beat.number == 1).map_or(0, |i| i + 1);
    (numbered(&beats[begin..end]), numbered(&beats[end..end + later]))
}

/// Returns the column of a feature that has one.
fn column<'a>(features: &'a Array2<f32>, name: &str) -> ArrayView1<'a, f32> {
    let first: usize = BLOCKS.iter().take_while(|b| b.name != name).map(|b| b.len).sum();
    features.column(first)
}
