//! Songs that are made here: composed from a seed or arranged from a tune, and played.

use std::path::Path;
use std::sync::Arc;

#[cfg(feature = "soundfont")]
use anyhow::Context as _;
use anyhow::bail;
use xxhash_rust::xxh3::{xxh3_64, xxh3_64_with_seed};

use super::one::small_bytes;
use super::songs::{Song, SongFiles, slug};
use super::split::TRAIN;
use crate::motion::Beats;
use crate::music::abc::{self, Tune, TuneEntry};
#[cfg(feature = "soundfont")]
use crate::music::soundfont::Instruments;
use crate::music::{self, Score, compose, synth, wav};
#[cfg(feature = "soundfont")]
use crate::stages::failure::guarded;
use crate::stages::failure::{Failure, FailureKind};
use crate::store::{Content, Listing, Source, SourceFile, StoreError, digest, write_file};

/// Ending of the files that tunes are read from.
const TUNE_EXTENSION: &str = "abc";
/// Largest file of tunes that is read, in bytes.
const MAX_FILE_BYTES: u64 = 16 << 20;

/// Where a song's notes come from.
#[derive(Clone, Debug)]
pub enum Piece {
    /// Song number `index` of a seed.
    Composed { seed: u64, index: u64 },
    /// A tune, to which accompaniment is made.
    Tune(Arc<Tune>),
}

/// A song that was played.
pub struct Performance {
    /// A WAV file.
    pub wav: bytes::Bytes,
    /// Every beat with its number in the bar.
    pub beats: Beats,
}

/// Returns the first `n` songs of a seed, named `composed-00017-house-124bpm`.
pub fn composed(n: u32, seed: u64, band: &Band) -> impl Iterator<Item = Song> {
    (0..u64::from(n)).map(move |index| {
        let (style, tempo_bpm) = compose::heading(seed, index);
        let id = format!("composed-{index:05}-{style}-{tempo_bpm:.0}bpm");
        let url = format!("composed:{seed}/{index}");
        Song {
            slug: id.clone(),
            id,
            fingerprint: band.fingerprint(&url),
            split: TRAIN,
            is_unidentified: false,
            problem: None,
            files: SongFiles::Score {
                piece: Piece::Composed { seed, index },
                seed: xxh3_64(url.as_bytes()),
                duration_s: compose::MAX_SONG_S,
            },
            url,
        }
    })
}

/// Finds the tunes of every `.abc` file below a folder; one that cannot be read is a song with a problem.
///
/// # Errors
/// When the folder cannot be listed or has no such file.
pub fn tunes(source: &Source, seed: u64, band: &Band) -> anyhow::Result<Vec<Song>> {
    let Listing { files, .. } = source.list()?;
    let is_tune = |file: &SourceFile| {
        file.path.rsplit_once('.').is_some_and(|(_, e)| e.eq_ignore_ascii_case(TUNE_EXTENSION))
    };
    let files: Vec<SourceFile> = files.into_iter().filter(is_tune).collect();
    if files.is_empty() {
        bail!(
            "tunes folder {}: no .{TUNE_EXTENSION} file anywhere below it; name the folder of your tunes",
            source.location()
        );
    }
    let mut songs = Vec::new();
    for (file, (content, _permit)) in files.iter().zip(source.read_in_order(files.clone())) {
        let url = source.location().url_of(&file.path);
        match tunes_of(file, content) {
            Ok(found) => songs.extend(
                found.into_iter().enumerate().map(|(i, tune)| tune_song(file, &url, i, tune, seed)),
            ),
            Err(failure) => songs.push(song_of_tune(
                (file.path.clone(), url),
                "",
                SongFiles::Missing,
                Some(failure),
            )),
        }
    }
    for song in &mut songs {
        song.fingerprint = band.fingerprint(&song.fingerprint);
    }
    Ok(songs)
}

fn tunes_of(
    file: &SourceFile,
    content: Result<Content, StoreError>,
) -> Result<Vec<TuneEntry>, Failure> {
    let path = file.path.as_str();
    if file.size_bytes > MAX_FILE_BYTES {
        let message = format!(
            "{path} has {} bytes, more than the {MAX_FILE_BYTES} that are read; split the file",
            file.size_bytes
        );
        return Err(Failure::new(FailureKind::TooLarge, path, message));
    }
    let found = abc::read(&small_bytes(file, content)?);
    if found.is_empty() {
        let message = format!("{path}: has no tune; a tune in ABC notation begins with X:1");
        return Err(Failure::new(FailureKind::AbcFormat, path, message));
    }
    Ok(found)
}

/// Returns tune number `i` of a file as a song.
fn tune_song(file: &SourceFile, url: &str, i: usize, found: TuneEntry, seed: u64) -> Song {
    let id = format!("{}-{:04}", file.path, i + 1);
    let url = format!("{url}#{}", i + 1);
    let TuneEntry { line, text, tune } = found;
    match tune {
        Ok(tune) => {
            let seed = xxh3_64_with_seed(text.as_bytes(), seed);
            let duration_s = music::arrange(&tune, seed).end_s();
            let files = SongFiles::Score { piece: Piece::Tune(Arc::new(tune)), seed, duration_s };
            song_of_tune((id, url), &text, files, None)
        }
        Err(e) => {
            let message = format!("{id} (from line {line}): the tune {e}");
            let failure = Failure::new(FailureKind::AbcFormat, &file.path, message);
            song_of_tune((id, url), &text, SongFiles::Missing, Some(failure))
        }
    }
}

fn song_of_tune(
    (id, url): (String, String),
    text: &str,
    files: SongFiles,
    problem: Option<Failure>,
) -> Song {
    let fingerprint = format!("tune {}", digest(text.as_bytes()));
    let (slug, split) = (slug(&id), TRAIN);
    Song { id, slug, url, fingerprint, split, is_unidentified: false, problem, files }
}

/// The instruments that play, of a soundfont or the synthesizer.
#[derive(Clone, Default)]
pub struct Band {
    #[cfg(feature = "soundfont")]
    instruments: Option<Instruments>,
    /// Digest of the soundfont; none where our own voices play.
    hash: Option<String>,
}

impl Band {
    /// Reads a soundfont, if one is given.
    ///
    /// # Errors
    /// When it cannot be read.
    #[cfg(feature = "soundfont")]
    pub fn of(soundfont: Option<&Path>) -> anyhow::Result<Self> {
        let Some(path) = soundfont else { return Ok(Self::default()) };
        let name = path.display();
        let bytes = std::fs::read(path).with_context(|| format!("soundfont {name}"))?;
        let path = name.to_string();
        // Its reader takes some damaged files for whole ones and breaks on them.
        let instruments = guarded(&path, || {
            let refused = |e| Failure::new(FailureKind::SoundFont, &path, format!("{path}: {e}"));
            Instruments::read(&bytes).map_err(refused)
        });
        let instruments = instruments.map_err(|failure| anyhow::anyhow!(failure.message))?;
        Ok(Self { instruments: Some(instruments), hash: Some(digest(&bytes)) })
    }

    /// Returns what tells songs of this band from those of another.
    fn fingerprint(&self, notes: &str) -> String {
        let hash = self.hash.as_ref().map(|hash| format!(" {hash}")).unwrap_or_default();
        format!("{notes} {}{hash}", music::VERSION)
    }

    fn play(&self, score: &Score, seed: u64) -> Result<Vec<f32>, String> {
        #[cfg(feature = "soundfont")]
        if let Some(instruments) = &self.instruments {
            return instruments.render(score, seed).map_err(|e| e.to_string());
        }
        synth::render(score, seed).map_err(|e| e.to_string())
    }
}

/// Plays a song; the seed chooses the sound of the band.
///
/// # Errors
/// A [`Failure`] that names it.
pub fn perform(song: &Song, piece: &Piece, seed: u64, band: &Band) -> Result<Performance, Failure> {
    let score = match piece {
        Piece::Composed { seed, index } => music::compose(*seed, *index),
        Piece::Tune(tune) => music::arrange(tune, seed),
    };
    let unplayed = |e| Failure::new(FailureKind::Unplayable, &song.id, format!("{}: {e}", song.id));
    let samples = band.play(&score, seed).map_err(unplayed)?;
    Ok(Performance { wav: wav::wav(&samples).into(), beats: beats_of(song, &score)? })
}

fn beats_of(song: &Song, score: &Score) -> Result<Beats, Failure> {
    let beats = score.beats();
    let times_s = beats.iter().map(|beat| beat.time_s).collect();
    let numbers = beats.iter().map(|beat| i64::from(beat.number)).collect();
    Beats::new(times_s, Some(numbers), Some(score.beats_per_bar))
        .map_err(|e| Failure::new(FailureKind::NoBeats, &song.id, format!("{}: {e}", song.id)))
}

/// Returns an estimate of the memory that playing takes: three buffers of samples and the file.
pub fn needed_bytes(duration_s: f64) -> u64 {
    let n_samples = (duration_s * f64::from(crate::audio::SAMPLE_RATE_HZ)) as u64;
    n_samples * (3 * size_of::<f32>() + size_of::<i16>()) as u64
}

/// Returns beats as a beat list.
pub fn beats_text(beats: &Beats) -> String {
    let numbers = beats.numbers().unwrap_or_default();
    let lines = beats.times_s().iter().zip(numbers);
    lines.map(|(time_s, number)| format!("{time_s} {number}\n")).collect()
}

/// Writes a song for people to hear: `NAME.wav` and `NAME.beats.txt`.
///
/// # Errors
/// The error of the file system.
pub fn write(folder: &Path, song: &Song, performance: &Performance) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let file = |ending: &str| folder.join(format!("{}.{ending}", song.slug));
    write_file(&file("wav"), |out| out.write_all(&performance.wav))?;
    write_file(&file("beats.txt"), |out| out.write_all(beats_text(&performance.beats).as_bytes()))
}
