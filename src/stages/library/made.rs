//! Songs that are made here: composed from a seed, and played.

use std::path::Path;

use super::songs::{Files, Song};
use super::split::TRAIN;
use crate::motion::Beats;
use crate::music::{self, Score, compose, synth, wav};
use crate::stages::failure::{Failure, FailureKind};
use crate::store::write_file;

/// Where a song's notes come from.
#[derive(Clone, Debug)]
pub enum Piece {
    /// Song number `index` of a seed.
    Composed { seed: u64, index: u64 },
}

/// A song that was played.
pub struct Performance {
    /// A WAV file.
    pub wav: bytes::Bytes,
    /// Every beat with its number in the bar.
    pub beats: Beats,
}

/// Returns the first `n` songs of a seed, named `composed-00017-house-124bpm`.
pub fn composed(n: u32, seed: u64) -> impl Iterator<Item = Song> {
    (0..u64::from(n)).map(move |index| {
        let (style, tempo_bpm) = compose::heading(seed, index);
        let id = format!("composed-{index:05}-{style}-{tempo_bpm:.0}bpm");
        let url = format!("composed:{seed}/{index}");
        Song {
            slug: id.clone(),
            fingerprint: format!("{url} {}", music::VERSION),
            url,
            id,
            split: TRAIN,
            is_unidentified: false,
            problem: None,
            files: Files::Made {
                piece: Piece::Composed { seed, index },
                duration_s: compose::MAX_SONG_S,
            },
        }
    })
}

/// Plays a song.
///
/// # Errors
/// A [`Failure`] that names it.
pub fn perform(song: &Song, piece: &Piece) -> Result<Performance, Failure> {
    let score = match piece {
        Piece::Composed { seed, index } => music::compose(*seed, *index),
    };
    let samples = synth::render(&score, ensemble(song))
        .map_err(|e| Failure::new(FailureKind::TooLong, &song.id, format!("{}: {e}", song.id)))?;
    Ok(Performance { wav: wav::wav(&samples).into(), beats: beats_of(song, &score)? })
}

/// Returns the seed of the ensemble that plays a song: another song, another ensemble.
fn ensemble(song: &Song) -> u64 {
    xxhash_rust::xxh3::xxh3_64(song.url.as_bytes())
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
/// What the file system says.
pub fn write(folder: &Path, song: &Song, performance: &Performance) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let file = |ending: &str| folder.join(format!("{}.{ending}", song.slug));
    write_file(&file("wav"), |out| out.write_all(&performance.wav))?;
    write_file(&file("beats.txt"), |out| out.write_all(beats_text(&performance.beats).as_bytes()))
}
